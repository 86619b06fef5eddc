"""Robot and cloud as Compose starts them; the cloud comes to harm, and no decision changes."""

import contextlib
import csv
import json
import os
import signal
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from tests.deploy.docker import ROOT, USER, Engine, Images, give_to, holdfast, wait_until
from tests.ports import free_port
from tests.processes.test_watchdog import STANDS_STILL

from holdfast.journal.journal import Journal

COMPOSE = ROOT / "deploy/compose"
TRIALS = 60
"""More than pass while the cloud comes to harm."""


class Site:
    """A network with the cloud's project and the robot's."""

    def __init__(self, engine: Engine, images: Images, protocol: str, directory: Path) -> None:
        self.engine = engine
        self.directory = directory
        self.name = f"holdfast-test-{uuid.uuid4().hex[:8]}"
        self.endpoint = f"{protocol}/cloud:7447"
        holdfast("keys", "keys", "--host", "cloud", cwd=directory)
        configuration = yaml.safe_load((ROOT / "examples/peg_in_hole_2d.yaml").read_text())
        configuration["simulator"] |= {"num_trials": TRIALS, "sensing_intervals": 2}
        self.write("calm.yaml", configuration)
        configuration["offload"] = {"services": [self.endpoint], "tls": "/keys"}
        self.write("config/robot.yaml", configuration)
        (directory / "runs").mkdir()
        (directory / "still").mkdir()
        (directory / "still/sitecustomize.py").write_text(STANDS_STILL)
        give_to(USER, directory / "keys", directory / "runs")
        self.variables = {
            "HOLDFAST_CLOUD_IMAGE": images.cloud,
            "HOLDFAST_ROBOT_IMAGE": images.robot,
            "HOLDFAST_CONFIG": str(directory / "config"),
            "HOLDFAST_RUNS": str(directory / "runs"),
        }
        serve = ["serve", "--listen", f"{protocol}/0.0.0.0:7447", "--tls", "/keys"]
        self.override("cloud", [*serve, "--health", "0.0.0.0:8080", "--watchdog-s", "3"])
        self.start_robot_with("--rate", "50")

    def write(self, name: str, document: object) -> None:
        path = self.directory / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(yaml.safe_dump(document))

    def override(self, role: str, command: list[str]) -> None:
        """Say what is the test's own: the network between the two, and the command."""
        service = {"command": command, "networks": ["line"], "environment": ["PYTHONPATH=/still"]}
        service["volumes"] = [f"{self.directory}/still:/still:ro"]
        networks = {"line": {"external": True, "name": self.name}}
        self.write(f"{role}.yaml", {"services": {role: service}, "networks": networks})

    def start_robot_with(self, *options: str) -> None:
        run = ["run", "/config/robot.yaml", "--out", "/runs/run", "--resume-if-begun", "--restart"]
        self.override("robot", [*run, "--health", "0.0.0.0:8080", *options])

    def compose(self, role: str, *words: str) -> str:
        own = f"HOLDFAST_{role.upper()}"
        ports = {name: str(free_port()) for name in ("HOLDFAST_PORT", f"{own}_HEALTH_PORT")}
        keys = "service" if role == "cloud" else "robot"
        files = ("-f", COMPOSE / f"{role}.yaml", "-f", self.directory / f"{role}.yaml")
        return self.engine.compose(
            f"{self.name}-{role}",
            *(*files, *words),
            variables={
                **self.variables,
                **ports,
                f"{own}_KEYS": str(self.directory / "keys" / keys),
            },
        )

    def container(self, role: str) -> str:
        found = self.compose(role, "ps", "-a", "-q", role)
        assert found, f"there is no container of {role}"
        return found

    def state(self, role: str) -> Any:
        return self.engine.inspect(self.container(role))["State"]

    def kill_robot(self) -> None:
        """Kill the robot's process, which is not the first one of its container."""
        first = self.state("robot")["Pid"]
        (robot,) = Path(f"/proc/{first}/task/{first}/children").read_text().split()
        os.kill(int(robot), signal.SIGKILL)

    def wait_for_health(self, role: str) -> None:
        container = self.container(role)
        wait_until(
            lambda: self.engine.inspect(container)["State"]["Health"]["Status"] == "healthy",
            f"{role} to be healthy: {self.engine.run('docker', 'logs', container)}",
        )

    def up(self) -> None:
        """Start the cloud, and then the robot, which sees it."""
        self.compose("cloud", "up", "-d")
        self.wait_for_health("cloud")
        with self.then("service_appeared", service=self.endpoint):
            self.compose("robot", "up", "-d")
        self.wait_for_health("robot")

    def address(self) -> str:
        networks = self.engine.inspect(self.container("cloud"))["NetworkSettings"]["Networks"]
        return str(networks[self.name]["IPAddress"])

    def events(self) -> list[dict[str, Any]]:
        path = self.directory / "runs/run/events.jsonl"
        lines = path.read_text().splitlines() if path.exists() else []
        return [json.loads(line) for line in lines if line.endswith("}")]

    @contextlib.contextmanager
    def then(self, name: str, **fields: object) -> Iterator[None]:
        """Wait, after what is done here, until the robot has told of this."""
        before = len(self.events())
        yield

        def told() -> bool:
            return any(
                event["event"] == name and fields.items() <= event.items()
                for event in self.events()[before:]
            )

        wait_until(told, f"{name} {fields}")

    def close(self) -> None:
        for role in ("robot", "cloud"):
            self.compose(role, "down", "--volumes", "--timeout", "1")
        self.engine.docker("network", "rm", self.name)


@pytest.fixture(params=["tls", pytest.param("udp", marks=pytest.mark.slow)])
def site(
    request: pytest.FixtureRequest, engine: Engine, images: Images, tmp_path: Path
) -> Iterator[Site]:
    site = Site(engine, images, request.param, tmp_path)
    engine.docker("network", "create", site.name)
    try:
        yield site
    finally:
        site.close()


def test_the_cloud_is_killed_paused_cut_off_and_moved(site: Site, engine: Engine) -> None:
    docker = engine.docker
    site.up()
    cloud = site.container("cloud")

    def harm(*strike: Callable[[], object], heal: Callable[[], object]) -> None:
        with site.then("status", to="local_recovery"):
            for each in strike:
                each()
        with site.then("status", to="keep_alive"):
            heal()

    harm(lambda: docker("kill", cloud), heal=lambda: docker("start", cloud))
    harm(lambda: docker("pause", cloud), heal=lambda: docker("unpause", cloud))
    # Its loop stands still: it ends itself, and the engine starts it again with nobody there.
    harm(lambda: os.kill(site.state("cloud")["Pid"], signal.SIGUSR1), heal=lambda: None)
    assert engine.inspect(cloud)["RestartCount"] == 1
    harm(
        lambda: docker("network", "disconnect", site.name, cloud),
        heal=lambda: docker("network", "connect", "--alias", "cloud", site.name, cloud),
    )
    address = site.address()
    neighbour = f"{site.name}-neighbour"
    image = site.variables["HOLDFAST_CLOUD_IMAGE"]
    taken = ("run", "-d", "--rm", "--name", neighbour, "--network", site.name)
    try:
        harm(
            lambda: docker("rm", "--force", cloud),
            lambda: docker(*taken, "--entrypoint", "sleep", image, "600"),
            heal=lambda: site.compose("cloud", "up", "-d"),
        )
    finally:
        engine.run("docker", "rm", "--force", neighbour)
    assert site.address() != address

    # The robot's container is replaced, too; its journal is on the volume.
    site.compose("robot", "stop", "--timeout", "60")
    assert site.state("robot")["ExitCode"] == 143
    site.start_robot_with()
    site.compose("robot", "up", "-d")
    robot = site.container("robot")
    docker("wait", robot)
    assert engine.inspect(robot)["State"]["ExitCode"] == 0, engine.run("docker", "logs", robot)

    holdfast("run", "calm.yaml", "--out", "calm", cwd=site.directory)
    holdfast("compare", "calm", "runs/run", cwd=site.directory)
    with (site.directory / "runs/run/timings.csv").open() as table:
        deciders = {row["service"] for row in csv.DictReader(table)}
    assert deciders >= {site.endpoint, "cloud_active_sensing_recovery"}


def test_a_robot_that_dies_goes_on_but_no_engine_starts_one(site: Site, engine: Engine) -> None:
    if engine.restart is None:
        pytest.skip("an engine that is not the tests' own is not restarted")
    site.up()

    # Its process dies, in the midst of a trial: it goes on with nobody there.
    with site.then("resumed_trial"):
        site.kill_robot()

    # The engine ends and is back, as after an upgrade or a reboot. It has ended both; what a person
    # started again is what moves.
    engine.restart()
    site.wait_for_health("cloud")
    assert site.state("robot")["Status"] == "exited"
    events = len(site.events())
    site.compose("robot", "up", "-d")
    wait_until(lambda: len(site.events()) > events, "the robot to move again")
    site.compose("robot", "stop", "--timeout", "60")

    # Nor does it after a reboot of the machine, which whoever starts it may not know of.
    reboot(site.directory / "runs/run/journal.bin")
    site.compose("robot", "up", "-d")
    engine.docker("wait", site.container("robot"))
    assert site.state("robot")["ExitCode"] == 5
    events = len(site.events())
    site.start_robot_with("--after-reboot")
    site.compose("robot", "up", "-d")
    engine.docker("wait", site.container("robot"))
    assert site.state("robot")["ExitCode"] == 0
    assert len(site.events()) > events
    holdfast("run", "calm.yaml", "--out", "calm", cwd=site.directory)
    holdfast("compare", "calm", "runs/run", cwd=site.directory)


def test_keys_are_rotated_and_a_robot_is_revoked_where_they_are_mounted(
    site: Site, engine: Engine
) -> None:
    site.up()
    cloud = site.container("cloud")

    def reloaded(count: int) -> bool:
        log = engine.run("docker", "logs", cloud)
        return (log.stdout + log.stderr).count("credentials reloaded") == count

    holdfast("keys", "keys", "--rotate", "--service", "service", cwd=site.directory)
    wait_until(lambda: reloaded(1), "the cloud to read its new key")
    with site.then("status", to="local_recovery"):
        holdfast("keys", "keys", "--revoke", "robot", cwd=site.directory)
        wait_until(lambda: reloaded(2), "the cloud to read the list")
    site.wait_for_health("cloud")

    for name in ("authority", "certificate", "key"):
        (site.directory / "keys/service" / f"{name}.pem").unlink()
    wait_until(
        lambda: engine.inspect(cloud)["State"]["Health"]["Status"] == "unhealthy",
        "a cloud without keys to be unhealthy",
    )


def reboot(journal: Path) -> None:
    """Let a run have moved in another boot: that of a machine in a test cannot be changed."""
    with Journal.open(journal) as opened:
        opened.set_meta(boot="another")
