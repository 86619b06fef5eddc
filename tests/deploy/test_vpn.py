"""The thesis's network: robot and cloud joined by a real OpenVPN or WireGuard tunnel, which is cut and restored.

The robot, the cloud and the internet between them are three networks on this machine. The profiles
are those of ``deploy/vpn/make-profiles``. They stand where systemd's units look for them, each end
with an /etc of its own, and ``openvpn`` and ``wg-quick`` are called as those units call them.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import shutil
import statistics
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest
from tests.processes.faults import (
    KEEP_ALIVE,
    LOCAL_RECOVERY,
    LOST,
    LOST_AGAIN,
    PATIENCE_S,
    QUICK,
    RESTORED,
    References,
    Robot,
    Service,
    Site,
    Story,
    document_of,
    sensing_steps,
    wait_until,
)

from holdfast.chaos.namespace import NetworkNamespace

MAKE_PROFILES = Path(__file__).parents[2] / "deploy" / "vpn" / "make-profiles"
TOOLS = {
    "ip": "iproute2",
    "nft": "nftables",
    "openssl": "openssl",
    "openvpn": "openvpn",
    "wg": "wireguard-tools",
    "wireguard-go": "wireguard-go",
}
KINDS = ("openvpn", "wireguard")
BOTH = pytest.mark.parametrize("kind", KINDS)

ROBOT, CLOUD, INSIDE = "192.0.2.2", "198.51.100.2", "10.77.0.1"
"""Where they are in the world, and where the cloud is in the tunnel."""

PORT = 7447

_NEW_NETWORK = 0x40000000
_libc = ctypes.CDLL(None, use_errno=True)


# -- networks ------------------------------------------------------------------------------------


class Network:
    """A network of its own."""

    def __init__(self, stack: contextlib.ExitStack) -> None:
        self.prefix = stack.enter_context(NetworkNamespace()).prefix
        self._holder = self.prefix[self.prefix.index("--target") + 1]

    def call(self, *command: str, fails: bool = False) -> str:
        """Run a command in it; return what it says."""
        done = subprocess.run(
            [*self.prefix, *command], capture_output=True, text=True, timeout=PATIENCE_S
        )
        assert fails == (done.returncode != 0), f"{command}: {done.stderr}"
        return done.stdout + done.stderr

    def connect_to(self, other: Network, device: str, own: str, gateway: str) -> None:
        """Lay a cable to another one, which is the way to everywhere."""
        cable = ("ip", "link", "add", device, "type", "veth", "peer", "name", "eth0")
        other.call(*cable, "netns", self._holder)
        for network, end, address in ((other, device, gateway), (self, "eth0", own)):
            network.call("ip", "addr", "add", f"{address}/24", "dev", end)
            network.call("ip", "link", "set", end, "up")
        self.call("ip", "route", "add", "default", "via", gateway)

    @contextlib.contextmanager
    def entered(self) -> Iterator[None]:
        """Let this thread be in it, and whatever it starts: threads, processes, sockets."""
        with (
            Path("/proc/thread-self/ns/net").open() as before,
            Path(f"/proc/{self._holder}/ns/net").open() as here,
        ):
            _enter(here.fileno())
            try:
                yield
            finally:
                _enter(before.fileno())


def _enter(descriptor: int) -> None:
    assert _libc.setns(descriptor, _NEW_NETWORK) == 0, os.strerror(ctypes.get_errno())


class Internet(Network):
    """What lies between a robot and a cloud."""

    def __init__(self, stack: contextlib.ExitStack) -> None:
        super().__init__(stack)
        self.call("sh", "-c", "echo 1 > /proc/sys/net/ipv4/ip_forward")
        self.robot, self.cloud = Network(stack), Network(stack)
        self.robot.connect_to(self, "to-robot", ROBOT, "192.0.2.1")
        self.cloud.connect_to(self, "to-cloud", CLOUD, "198.51.100.1")

    def cut(self) -> None:
        self.call("ip", "link", "set", "to-cloud", "down")

    def restore(self) -> None:
        self.call("ip", "link", "set", "to-cloud", "up")


# -- tunnels -------------------------------------------------------------------------------------


class End:
    """One end of a tunnel: a process in a network, with files of its own in /etc."""

    def __init__(self, network: Network, kind: str, role: str, directory: Path) -> None:
        self._network = network
        self._log = directory / "log"
        self.etc = directory / "etc"
        self.etc.mkdir(parents=True)
        # Only OpenVPN starts a process that stays; wireguard-go leaves its parent, and ends with
        # the first process of its namespace.
        self._unshare = ["unshare", "--mount"]
        if kind == "openvpn":  # as openvpn-server@.service and openvpn-client@.service
            place = f"/etc/openvpn/{role}"
            nobind = "--nobind" if role == "client" else ""
            run = f"exec openvpn --suppress-timestamps {nobind} --config holdfast.conf"
            self._up = "Initialization Sequence Completed"
        else:  # as wg-quick@.service
            self._unshare += ["--pid", "--fork", "--kill-child", "--mount-proc"]
            place = "/etc/wireguard"
            run = "mount -t tmpfs none /run && wg-quick up holdfast && echo is up && exec cat"
            self._up = "is up"
        self._run = f"mount --bind {self.etc} {place} && cd {place} && {run}"
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it as its unit does."""
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [*self._network.prefix, *self._unshare, "sh", "-c", self._run],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def wait_until_up(self) -> None:
        self.wait_for(self._up)

    def wait_for(self, words: str, count: int = 1) -> None:
        """Wait until it has said something so many times."""
        wait_until(
            lambda: self._log.read_text().count(words) >= count or self._has_ended(),
            f"{words!r} from a tunnel's end",
        )
        said = self._log.read_text()
        assert said.count(words) >= count, said

    def call(self, script: str) -> str:
        """Run a script where its files are."""
        assert self._process is not None
        spaces = ["--mount", "--net", f"--pid=/proc/{self._process.pid}/ns/pid_for_children"]
        target = ["nsenter", "--target", str(self._process.pid), *spaces]
        return subprocess.run(
            [*target, "bash", "-c", script], capture_output=True, timeout=PATIENCE_S, check=True
        ).stdout.decode()

    def kill(self) -> None:
        """End it with SIGKILL; when this returns its device is gone."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            assert self._process.stdin is not None
            self._process.stdin.close()
            self._process = None
            devices = Path("/proc/thread-self/net/dev")
            with self._network.entered():
                wait_until(lambda: "holdfast:" not in devices.read_text(), "the device's end")

    def _has_ended(self) -> bool:
        return self._process is None or self._process.poll() is not None


class Tunnel:
    """Profiles of robots, and the two ends that have them.

    Parameters
    ----------
    internet : Internet
    kind : {"openvpn", "wireguard"}
    directory : Path
    stack : ExitStack
        Ends it.
    """

    def __init__(
        self, internet: Internet, kind: str, directory: Path, stack: contextlib.ExitStack
    ) -> None:
        self.internet = internet
        self.kind = kind
        self.profiles = directory / "vpn"
        self._directory = directory
        self._stack = stack
        make_profiles(kind, self.profiles, CLOUD, "anna", "ben")
        self.cloud = self._end(internet.cloud, "server")
        self.robot = self._end(internet.robot, "client")
        self.give_to_cloud()
        self.give(self.robot, profile_of(self.profiles, "anna"))

    def _end(self, network: Network, role: str) -> End:
        end = End(network, self.kind, role, self._directory / role)
        self._stack.callback(end.kill)
        return end

    def give_to_cloud(self) -> None:
        """Copy what the cloud's end needs, as the script says."""
        files = f"{self.profiles}/cloud/."
        subprocess.run(["cp", "-r", "--preserve=mode", files, self.cloud.etc], check=True)

    @staticmethod
    def give(end: End, profile: Path) -> None:
        shutil.copy(profile, end.etc / "holdfast.conf")

    def up(self) -> Tunnel:
        """Bring both ends up."""
        for end in (self.cloud, self.robot):
            end.start()
            end.wait_until_up()
        return self

    def stranger(self, profile: str) -> End:
        """Return an end of somebody else, somewhere in the internet, who has a profile."""
        end = self._end(self.internet, "client")
        return end

    def remove(self, robot: str) -> None:
        """Shut a robot out, as the script says."""
        make_profiles("remove", self.profiles, robot)
        self.give_to_cloud()
        if self.kind == "openvpn":
            self.cloud.kill()
            self.cloud.start()
            self.cloud.wait_until_up()
        else:  # as the unit does when it is reloaded
            self.cloud.call("wg syncconf holdfast <(wg-quick strip holdfast)")


def profile_of(profiles: Path, robot: str) -> Path:
    (found,) = (profiles / "robots").glob(f"{robot}.*")
    return found


def make_profiles(*words: str | Path, **variables: str) -> str:
    """Call the script; return what it says."""
    done = called(*words, **variables)
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    return done.stdout


def called(*words: str | Path, **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [MAKE_PROFILES, *words],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        env={**os.environ, **variables},
    )


# -- fixtures ------------------------------------------------------------------------------------


@pytest.fixture(scope="module", autouse=True)
def _tools() -> None:
    missing = sorted({package for tool, package in TOOLS.items() if shutil.which(tool) is None})
    reason = f"not installed (Debian's packages): {', '.join(missing)}" if missing else ""
    if os.geteuid() != 0:
        reason = "devices in networks of their own need root"
    elif not Path("/dev/net/tun").exists():
        reason = "this machine has no /dev/net/tun"
    if reason:
        (pytest.fail if os.environ.get("CI") else pytest.skip)(reason)


@pytest.fixture(scope="module")
def references(tmp_path_factory: pytest.TempPathFactory) -> References:
    return References(tmp_path_factory.mktemp("references"))


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("keys")
    with Site(directory) as site:
        hosts = ("--host", INSIDE, "--host", CLOUD)
        made = site.holdfast("keys", directory / "keys", *hosts)
        assert made.process.returncode == 0, made.account()
    return directory / "keys"


@pytest.fixture
def stack() -> Iterator[contextlib.ExitStack]:
    with contextlib.ExitStack() as stack:
        yield stack


@pytest.fixture
def tunnel(kind: str, tmp_path: Path, stack: contextlib.ExitStack) -> Tunnel:
    return Tunnel(Internet(stack), kind, tmp_path / "tunnel", stack).up()


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with Site(tmp_path) as site:
        yield site


# -- holdfast over them --------------------------------------------------------------------------


class Run:
    """``holdfast serve`` in the cloud and a robot that is to run; the same whatever joins them."""

    def __init__(
        self,
        internet: Internet,
        site: Site,
        references: References,
        keys: Path,
        wire: str,
        host: str = INSIDE,
    ) -> None:
        self._internet = internet
        self._keys = keys
        self.document = document_of("peg_in_hole_2d", max_steps=180)
        # So long an answer takes nearly the largest datagram that there is.
        self.document["simulator"]["sensing_intervals"] = 44
        self.steps = sensing_steps(self.document)
        with internet.cloud.entered():
            self.cloud: Service = site.service(
                *("--tls", str(keys / "service")),
                endpoint=f"{wire}/{host}:{PORT}",
                lease_ms=QUICK["lease_ms"],
            ).start()
        # The world that the robot acts on is where the robot is.
        with internet.robot.entered():
            self.story = Story(site, references, self.document, offload=QUICK)

    def finish(self) -> Robot:
        with self._internet.robot.entered():
            return self.story.run(self.cloud, options=("--tls", str(self._keys / "robot")))


@BOTH
@pytest.mark.parametrize("wire", ["tls", "udp"])
def test_cut_and_restored(
    tunnel: Tunnel, wire: str, site: Site, references: References, keys: Path
) -> None:
    run = Run(tunnel.internet, site, references, keys, wire)
    story, steps = run.story, run.steps
    story.at("sense", steps[1], tunnel.internet.cut)
    story.at("perform", steps[2], tunnel.internet.restore, story.status(KEEP_ALIVE))
    robot = run.finish()
    assert robot.statuses() == [LOST, RESTORED]
    # No datagram is too large for the tunnel.
    assert robot.matching("no_datagrams") == []
