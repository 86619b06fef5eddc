"""A cloud machine from nothing, the units of both roles under a real systemd, and faults there."""

import json
import os
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from tests.deploy.docker import ROOT, Engine, Images, holdfast
from tests.deploy.machine import USER, Machine, booted

CLOUD_INIT = ROOT / "deploy/cloud-init"
EXAMPLE = ROOT / "examples/peg_in_hole_2d.yaml"
CLOUD, ROBOT = "holdfast-cloud", "holdfast-robot"

RUN = "/var/lib/private/holdfast/run"
OTHER_BOOT = f"""/opt/holdfast/robot/bin/python -c '
from pathlib import Path
from holdfast.journal.journal import Journal
with Journal.open(Path("{RUN}/journal.bin")) as journal:
    journal.set_meta(boot="another")'"""
"""Command that lets the robot have moved in another boot."""

MOST_EXPOSED = 20
"""In tenths of systemd's exposure level, which is 9.6 for a unit without any restriction."""

MOST_USER_DATA_BYTES = 16_384
"""What EC2 takes; other providers take more."""

INSTALL_S = 600.0
"""For packages to come; only a hang takes so long."""

TRIALS = 60

SLOWLY = "--rate 10"
"""With it the run takes eight minutes, which no fault outlasts; without it, seconds."""

SOON = "[Service]\nWatchdogSec=2\nTimeoutAbortSec=1\n"
"""So that nobody waits for twenty seconds and five."""


class Lab(NamedTuple):
    """A machine with a service, and what belongs to it here."""

    machine: Machine
    keys: Path
    config: Path
    wheel: Path

    def set_up(self, role: str, *words: object) -> None:
        """Install a role, as a person does it."""
        command = (CLOUD_INIT / "set-up", f"{USER}@{self.machine.address}", role)
        done = subprocess.run(
            [str(word) for word in (*command, "--wheel", self.wheel, *words)],
            env={**os.environ, "SSH": " ".join(self.machine.ssh)},
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=INSTALL_S,
            check=False,
        )
        assert done.returncode == 0, done.stdout


@pytest.fixture(scope="module")
def wheel(engine: Engine, images: Images, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the wheel of which the images were made."""
    name = "holdfast-test-wheel"
    engine.docker(
        *("build", "-q", "-f", "deploy/Containerfile", "--target", "build", "-t", name, "."),
        cwd=ROOT,
        timeout=INSTALL_S,
    )
    container = engine.docker("create", name, "true")
    directory = tmp_path_factory.mktemp("wheel")
    try:
        engine.docker("cp", f"{container}:/wheel", directory)
    finally:
        engine.docker("rm", container)
    (found,) = directory.rglob("*.whl")
    return found


@pytest.fixture(scope="module")
def machine(
    engine: Engine, images: Images, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Machine]:
    del images  # it stands on their base
    directory = tmp_path_factory.mktemp("machine")
    with booted(engine, CLOUD_INIT / "user-data.yaml", directory) as machine:
        yield machine


@pytest.fixture(scope="module")
def lab(machine: Machine, wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Lab:
    directory = tmp_path_factory.mktemp("lab")
    keys = directory / "keys"
    holdfast("keys", keys, "--host", machine.address)
    holdfast("keys", keys, "--robot", "other")
    config = directory / "robot.yaml"
    services = f"offload: {{services: [tls/{machine.address}:7447]}}\n"
    config.write_text(f"{EXAMPLE.read_text()}\n{services}")
    lab = Lab(machine, keys, config, wheel)
    lab.set_up("cloud", "--keys", keys / "service")
    return lab


def test_user_data_is_valid_and_fits(machine: Machine) -> None:
    place = "/var/lib/cloud/seed/nocloud/user-data"
    assert "Valid cloud-config" in machine.do(f"cloud-init schema --config-file {place}")
    assert (CLOUD_INIT / "user-data.yaml").stat().st_size <= MOST_USER_DATA_BYTES


def test_a_machine_from_nothing_is_as_it_should_be(lab: Lab) -> None:
    machine = lab.machine
    assert "status: done" in machine.do("cloud-init status --long")
    assert machine.do("systemctl is-system-running") == "running"
    assert "passwordauthentication no" in machine.do("sshd -T")
    assert 'Please login as the user \\"debian\\"' in machine.do("cat /root/.ssh/authorized_keys")
    assert machine.show("unattended-upgrades", "UnitFileState") == "enabled"
    # Nobody listens there, so what has no firewall refuses at once.
    with pytest.raises(TimeoutError), socket.socket() as stranger:
        stranger.settimeout(1.0)
        stranger.connect((machine.address, 9999))


def test_a_robot_elsewhere_decides_through_it_until_it_is_revoked(lab: Lab, tmp_path: Path) -> None:
    calm = tmp_path / "calm"
    holdfast("run", EXAMPLE, "--trials", 1, "--out", calm)
    service = f"tls/{lab.machine.address}:7447"

    through = tmp_path / "through"
    robot = ("run", lab.config, "--trials", 1, "--tls", lab.keys / "other", "--out")
    holdfast(*robot, through)
    assert set(summary(through)["sensing_decisions_by_service"]) == {service}
    holdfast("compare", calm, through)

    holdfast("keys", lab.keys, "--revoke", "other")
    revoked = (lab.keys / "service/revoked.pem", f"{lab.machine.name}:/etc/holdfast/keys/cloud/")
    lab.machine.engine.docker("cp", *revoked)
    lab.machine.do(f"chmod 644 /etc/holdfast/keys/cloud/revoked.pem; systemctl reload {CLOUD}")
    assert lab.machine.show(CLOUD, "NRestarts") == "0"
    (lab.keys / "other/revoked.pem").unlink()  # as a thief does
    without = tmp_path / "without"
    holdfast(*robot, without)
    assert service not in summary(without)["sensing_decisions_by_service"]
    assert "revoked" in (without / "events.jsonl").read_text()
    holdfast("compare", calm, without)


def test_faults_under_systemd_change_no_decision(lab: Lab, tmp_path: Path) -> None:
    machine = lab.machine
    calm = tmp_path / "calm"
    holdfast("run", EXAMPLE, "--trials", TRIALS, "--out", calm)
    machine.do(f"""
        mkdir -p /etc/systemd/system/{CLOUD}.service.d
        printf '{SOON}' > /etc/systemd/system/{CLOUD}.service.d/soon.conf
        systemctl daemon-reload
        systemctl restart {CLOUD}
        echo 'HOLDFAST_OPTIONS={SLOWLY} --trials {TRIALS}' > /etc/holdfast/robot.env""")
    lab.set_up("robot", "--keys", lab.keys / "robot", "--config", lab.config)
    machine.wait_for(ROBOT, "StatusText", "standard, ")

    # A service that is stuck says so by silence.
    machine.signal(CLOUD, "STOP")
    machine.wait_for(CLOUD, "NRestarts", "1")
    machine.wait_for(CLOUD, "ActiveState", "active")
    assert "Watchdog timeout" in machine.do(f"journalctl --unit {CLOUD}")

    # Whoever takes an answer away, it is asked for again.
    machine.signal(ROBOT, "KILL")
    machine.wait_for(ROBOT, "NRestarts", "1")
    machine.wait_for(ROBOT, "StatusText", "standard, ")

    # In order: nothing is left but the exit code.
    machine.do(f"systemctl stop {CLOUD}")
    assert machine.show(CLOUD, "Result") == "success"
    status = machine.wait_for(ROBOT, "StatusText", "local_recovery, ")
    # Of the trial that has begun, the cloud may have decided all. The next is the local service's.
    trial = int(status.rpartition(" ")[2])
    machine.wait_for(ROBOT, "StatusText", f"local_recovery, trial {trial + 2}")

    # The cloud comes up again by itself. The robot does so only if a person says that it may.
    machine.reboot()
    machine.wait_for(CLOUD, "ActiveState", "active")
    # A container has the boot of the machine that it runs on, so the run gets another.
    machine.do(f"{OTHER_BOOT}; chown -R --reference=/var/lib/private/holdfast {RUN}")
    assert machine.show(ROBOT, "ActiveState") == "inactive"
    machine.do(f"! systemctl start {ROBOT}")
    assert machine.show(ROBOT, "ExecMainStatus") == "5"
    assert machine.show(ROBOT, "NRestarts") == "0"
    assert "no robot moves by itself" in machine.do(f"journalctl --unit {ROBOT} --lines 20")
    machine.do(f"""
        systemctl set-environment HOLDFAST_AFTER_REBOOT=--after-reboot
        systemctl restart {ROBOT}""")
    machine.wait_for(ROBOT, "StatusText", "standard, ")
    machine.signal(ROBOT, "KILL")  # and goes on after a crash, as before
    machine.wait_for(ROBOT, "NRestarts", "1")
    machine.wait_for(ROBOT, "StatusText", "standard, ")

    machine.do(f"""
        echo 'HOLDFAST_OPTIONS=--trials {TRIALS}' > /etc/holdfast/robot.env
        systemctl stop {ROBOT}
        [ "$(systemctl show --value --property=Result {ROBOT})" = success ]
        systemctl start {ROBOT}""")
    machine.wait_for(ROBOT, "ActiveState", "inactive")
    assert machine.show(ROBOT, "Result") == "success"

    run = tmp_path / "run"
    machine.engine.docker("cp", f"{machine.name}:{RUN}", run)
    holdfast("compare", calm, run)
    assert summary(run)["finished"] == TRIALS
    assert len(summary(run)["sensing_decisions_by_service"]) == 2  # the cloud's and the local one


def test_units_are_without_fault_and_hardened(lab: Lab) -> None:
    units = f"{ROOT}/deploy/systemd/."
    lab.machine.engine.docker("cp", units, f"{lab.machine.name}:/etc/systemd/system")
    for unit in (CLOUD, ROBOT):
        assert lab.machine.do(f"systemd-analyze verify --man=no {unit}.service 2>&1") == ""
        security = f"systemd-analyze security --no-pager --threshold={MOST_EXPOSED} {unit}.service"
        print(lab.machine.do(security).splitlines()[-1])


def summary(run: Path) -> dict[str, Any]:
    """Return what a run came to."""
    read: dict[str, Any] = json.loads((run / "summary.json").read_text())
    return read
