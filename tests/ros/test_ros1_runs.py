"""Whole runs of ``holdfast run`` over ROS 1: whatever dies, decisions stay those without faults.

The stories are those of every wire's cloud; what only ROS 1 has is its master.
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import pytest
from tests.processes import test_faults
from tests.processes.faults import (
    KEEP_ALIVE,
    LOST,
    PATIENT,
    RESTORED,
    References,
    Service,
    Site,
    Story,
    document_of,
    sensing_steps,
)
from tests.ros.graph import Graph, keeps_on, settled, start_everything
from tests.ros.ros1_processes import Ros1, ros1_in, wait_for
from tests.ros.test_ros1_service import CLOUD as TYPED_CLOUD
from tests.ros.test_ros1_service import EXAMPLE, Robot
from tests.ros.test_ros1_service import RECOVERY as TYPED_RECOVERY
from tests.unit.test_ros_client import in_process

from holdfast.config.loader import load

PEG = "peg_in_hole_2d"
CLOUD = "cloud_active_sensing"


class RosSite(Site):
    """Services are where a ROS 1 master says that they are."""

    def __init__(self, directory: Path, around: Ros1) -> None:
        super().__init__(directory)
        self.around = around

    def environment(self, variables: Mapping[str, str] | None = None) -> dict[str, str]:
        names = ("ROS_MASTER_URI", "ROS_HOSTNAME")
        ours = {name: self.around.environment[name] for name in names}
        return super().environment({**ours, **(variables or {})})

    def service(
        self, *options: str, endpoint: str | None = None, lease_ms: float = PATIENT["lease_ms"]
    ) -> Service:
        return super().service(*options, endpoint=endpoint or f"ros1/{CLOUD}", lease_ms=lease_ms)


@pytest.fixture
def around(ros1: Mapping[str, str], tmp_path: Path) -> Iterator[Ros1]:
    yield from ros1_in(ros1, tmp_path)


@pytest.fixture
def site(around: Ros1, tmp_path: Path) -> Iterator[Site]:
    with RosSite(tmp_path, around) as site:
        yield site


@pytest.fixture(scope="module")
def references(tmp_path_factory: pytest.TempPathFactory) -> References:
    return References(tmp_path_factory.mktemp("references"))


def test_killed_and_started_again(site: Site, references: References) -> None:
    test_faults.TestCloud().test_killed_and_started_again(PEG, site, references)


def test_stopped_for_longer_than_the_timeout(site: Site, references: References) -> None:
    test_faults.TestCloud().test_stopped_for_longer_than_the_timeout(PEG, site, references)


def test_never_there(site: Site, references: References) -> None:
    test_faults.TestCloud().test_never_there(PEG, site, references)


def test_the_master_is_killed_and_then_the_cloud(site: RosSite, references: References) -> None:
    document = document_of(PEG)
    steps = sensing_steps(document)
    cloud = site.service().start()
    around = site.around
    assert around.master is not None
    first = around.master

    def kill_the_master() -> None:
        first.kill()
        first.wait()

    def start_another() -> None:
        around.start_master()
        wait_for(lambda: around.service_uri(f"{CLOUD}/exchange"), "the cloud is listed")

    story = Story(site, references, document)
    story.at("sense", steps[1], kill_the_master)
    story.at("sense", steps[2], cloud.kill)
    # Without a master it is there, and nobody can find it.
    story.at("perform", steps[3], cloud.start)
    story.at("perform", steps[4], start_another, story.status(KEEP_ALIVE))
    robot = story.run(cloud)
    assert robot.statuses() == [LOST, RESTORED]


class Kills:
    """Kills of a guarded master, and how long it takes until everything is listed again.

    Attributes
    ----------
    known : set
        What the master knew at first.
    figures : list of dict
        Of each kill, the seconds until the master's ``getSystemState`` has everything, and until a
        ``rosservice list`` that was begun at once has ended, 0.2 s of which it always takes.
    """

    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        self.known = self._listed()
        self._expected = self.known
        self._waiter = ThreadPoolExecutor(1)
        self._last: Future[None] | None = None
        self.figures: list[dict[str, float]] = []

    def _listed(self) -> set[tuple[str, str, str]]:
        """Return what the master knows: the kind of a thing, its name, and whose it is."""
        tables = zip(
            ("published", "subscribed", "service"),
            self._graph.ask("getSystemState")[2],
            strict=True,
        )
        return {(kind, name, node) for kind, table in tables for name, of in table for node in of}

    def without(self, *services: str) -> None:
        """Expect no more of the nodes that offer these services; they are dead."""
        dead = {node for kind, name, node in self.known if name in services}
        assert dead
        self._expected = {each for each in self.known if each[2] not in dead}

    def everything(self) -> None:
        """Expect what there was at first, and wait for it."""
        self._expected = self.known
        wait_for(lambda: self._listed() == self._expected, lambda: str(self._listed()))

    def strike(self) -> None:
        """Kill the master; return at once."""
        killed = self._graph.kill_master()
        self._last = self._waiter.submit(self._wait, killed, time.monotonic())

    def wait(self) -> None:
        """Wait until all is listed since the last one was killed."""
        if self._last is not None:
            self._last.result()

    def close(self) -> None:
        self._waiter.shutdown()

    def _wait(self, killed: int, since: float) -> None:
        command = self._graph.start("rosservice", "list")
        wait_for(
            lambda: self._graph.master_pid() != killed and self._listed() == self._expected,
            lambda: str(self._listed() ^ self._expected),
        )
        back = time.monotonic()
        wait_for(lambda: command.process.poll() is not None, command.account)
        # It was asked when there was no master, and has waited for the whole answer.
        assert set(command.lines) == {
            name for kind, name, _ in self._expected if kind == "service"
        }, command.account()
        ended = time.monotonic()
        self.figures.append(
            {"get_system_state_s": back - since, "rosservice_list_s": ended - since}
        )


def test_the_master_is_killed_ten_times(
    ros1: Mapping[str, str], tmp_path: Path, references: References
) -> None:
    """In the midst of two runs, by ``holdfast run`` and by a node in rospy, among stock nodes."""
    document = document_of(PEG)
    steps = sensing_steps(document)[1:]
    with contextlib.ExitStack() as stack:
        graph = stack.enter_context(Graph(tmp_path, ros1))
        around = Ros1(graph.environment, tmp_path, graph.port)
        stack.callback(around.close)
        site = stack.enter_context(RosSite(tmp_path, around))
        guard = graph.guard()
        caller, listener = start_everything(graph)
        cloud = site.service(endpoint="ros1/cloud").start()
        typed = around.serve(TYPED_CLOUD, EXAMPLE)
        around.serve(TYPED_RECOVERY, EXAMPLE)
        ours = ("/cloud/exchange", f"/{TYPED_CLOUD}")
        wait_for(lambda: around.service_uri(ours[0]))
        typed_robot = Robot(around, 30.0)
        said = typed_robot.next()
        settled(graph)
        kills = Kills(graph)
        stack.callback(kills.close)
        theirs = {name for _, name, node in kills.known if node in ("/server", "/relay")}
        assert {"/work", "/relayed", "/relay/get_loggers"} <= theirs

        def strike(told: str = "") -> None:
            nonlocal said
            kills.wait()
            assert isinstance(said, int)
            kills.strike()
            typed_robot.go_on(told)
            said = typed_robot.next()

        def kill_the_clouds() -> None:
            kills.wait()
            cloud.kill()
            typed.kill()
            typed.wait()
            kills.without(*ours)

        def start_the_clouds() -> None:
            kills.wait()
            cloud.start()
            around.serve(TYPED_CLOUD, EXAMPLE)
            kills.everything()

        story = Story(site, references, document)
        for step in (*steps[:2], steps[3], steps[4]):
            story.at("sense", step, strike)
        for step in (*steps[:2], steps[4]):
            story.at("perform", step + 3, strike)
        # The clouds die, and a master that has never heard of them is told of new ones.
        story.at("sense", steps[2], kill_the_clouds, strike)
        story.at("perform", steps[2] + 3, strike, start_the_clouds, story.status(KEEP_ALIVE))
        story.at("perform", steps[3] + 3, lambda: strike("wait for the cloud"))
        robot = story.run(cloud)
        kills.wait()
        while isinstance(said, int):
            typed_robot.go_on("")
            said = typed_robot.next()
        for process in (caller, listener):
            keeps_on(process)
        (tmp_path / "kills.jsonl").write_text(
            "".join(f"{json.dumps(figures)}\n" for figures in kills.figures)
        )
        print("\n", *kills.figures, sep="\n")
        assert len(kills.figures) == len(graph.events(guard, "master_lost")) == 10
        assert robot.statuses() == [LOST, RESTORED]
        made, statuses = said
        assert made == json.loads(json.dumps(in_process(load(EXAMPLE), 0)))
        assert [each.replace("_", " ") for each in statuses] == ["local recovery", "keep alive"]
