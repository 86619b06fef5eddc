"""A cloud machine that was never started: Debian with systemd, cloud-init and ssh, in a container.

It boots as a provider's does: systemd is process 1, and cloud-init finds user-data and an ssh key.
What a container cannot show is the provider's own network, disk and kernel.
"""

import contextlib
import json
import shutil
import subprocess
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from tests.deploy.docker import BASE, Engine, missing, wait_until

USER = "debian"
"""Whom cloud-init makes on Debian's images."""

_IMAGE = f"""
FROM {BASE}
RUN apt-get update && DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends \
    systemd systemd-sysv dbus cloud-init openssh-server sudo iproute2 \
    && rm -f /etc/ssh/ssh_host_* && mkdir -p /var/lib/cloud/seed
STOPSIGNAL SIGRTMIN+3
CMD ["sh", "-c", "mount --make-rshared / && exec /lib/systemd/systemd"]
"""
"""Where mounts are not shared, as in Docker's containers, no credential reaches its unit."""

_CONTAINER = """\
datasource_list: [NoCloud]
network: {config: disabled}
locale: false
"""
"""Docker has made the network, nobody else has user-data, and a slim Debian has no languages."""

_BUILD_S = 600.0


class Machine(NamedTuple):
    """A machine that runs."""

    engine: Engine
    name: str
    address: str
    ssh: tuple[str, ...]

    def do(self, command: str, **options: Any) -> str:
        """Run a command as root, which must succeed, and return what it prints."""
        return self.engine.docker("exec", self.name, "bash", "-euc", command, **options)

    def show(self, unit: str, name: str) -> str:
        """Return what systemd knows of a unit."""
        return self.do(f"systemctl show --value --property={name} {unit}")

    def wait_for(self, unit: str, name: str, beginning: str) -> str:
        """Return what systemd knows of a unit, once it begins like this."""
        found = ""

        def is_so() -> bool:
            nonlocal found
            command = f"systemctl show --value --property={name} {unit}"
            done = self.engine.run("docker", "exec", self.name, "bash", "-c", command)
            found = done.stdout.strip()
            return found.startswith(beginning)

        try:
            wait_until(is_so, f"{name} of {unit} to be {beginning}")
        except AssertionError as error:
            log = self.do(f"journalctl --no-pager --lines=40 --unit={unit}")
            raise AssertionError(f"{error}; it is {found}\n{log}") from None
        return found

    def signal(self, unit: str, name: str) -> None:
        """Send a signal to a unit's first process."""
        self.do(f"systemctl kill --kill-who=main --signal={name} {unit}")

    def reboot(self) -> None:
        """Switch it off in order, and on again."""
        self.engine.docker("restart", "--time", "60", self.name)


@contextlib.contextmanager
def booted(engine: Engine, user_data: Path, directory: Path) -> Iterator[Machine]:
    """Switch a machine on that takes this user-data, and in the end throw it away."""
    if shutil.which("ssh-keygen") is None:
        missing("there is no command ssh-keygen (Debian: openssh-client)")
    engine.docker("build", "-q", "-t", "holdfast-test-machine", "-", input=_IMAGE, timeout=_BUILD_S)
    key = directory / "ssh_key"
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", key], check=True)
    name = f"holdfast-test-machine-{uuid.uuid4().hex[:8]}"
    seed = directory / "seed"
    seed.mkdir()
    (seed / "user-data").write_bytes(user_data.read_bytes())
    public = key.with_suffix(".pub").read_text().strip()
    # A provider hands the key over in the same way.
    (seed / "meta-data").write_text(json.dumps({"instance-id": name, "public-keys": [public]}))
    (directory / "container.cfg").write_text(_CONTAINER)
    engine.docker(
        *("create", "--name", name, "--hostname", "cloud"),
        # What systemd needs. Not --privileged, which not every engine can give.
        *("--cap-add", "SYS_ADMIN", "--cap-add", "NET_ADMIN"),
        *("--security-opt", "seccomp=unconfined", "--security-opt", "apparmor=unconfined"),
        *("--tmpfs", "/run", "--tmpfs", "/run/lock", *_control_groups(engine)),
        "holdfast-test-machine",
    )
    try:
        engine.docker("cp", seed, f"{name}:/var/lib/cloud/seed/nocloud")
        engine.docker(
            "cp", directory / "container.cfg", f"{name}:/etc/cloud/cloud.cfg.d/99_container.cfg"
        )
        engine.docker("start", name)
        address = str(engine.inspect(name)["NetworkSettings"]["IPAddress"])
        known = directory / "known_hosts"
        option = f"UserKnownHostsFile={known}"
        machine = Machine(engine, name, address, ("ssh", "-i", str(key), "-o", option))
        # What a person reads on the console. cloud-init makes it.
        host_key = "/etc/ssh/ssh_host_ed25519_key.pub"
        wait_until(
            lambda: engine.run("docker", "exec", name, "test", "-s", host_key).returncode == 0,
            "the machine to have made its key",
        )
        known.write_text(f"{address} {machine.do(f'cat {host_key}')}\n")
        yield machine
    finally:
        engine.docker("rm", "-f", "-v", name)


def _control_groups(engine: Engine) -> tuple[str, ...]:
    """Return options with which systemd finds control groups, of either version."""
    if engine.docker("info", "--format", "{{.CgroupVersion}}") == "2":
        return ("--cgroupns", "host", "-v", "/sys/fs/cgroup:/sys/fs/cgroup")
    return ("-v", "/sys/fs/cgroup:/sys/fs/cgroup:ro")
