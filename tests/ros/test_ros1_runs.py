"""A run over ROS 1 in whose midst the guarded master is killed, again and again."""

import contextlib
import json
import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from tests.ros.graph import Graph, keeps_on, settled, start_everything
from tests.ros.ros1_processes import Ros1, wait_for
from tests.ros.test_ros1_service import CLOUD, EXAMPLE, RECOVERY, Robot
from tests.unit.test_ros_client import in_process

from holdfast.config.loader import load

KILLS = 10


class Kills:
    """Kills of a guarded master, and how long it takes until everything is listed again."""

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


def test_the_master_is_killed_ten_times(ros1: Mapping[str, str], tmp_path: Path) -> None:
    """In the midst of a run by a node in rospy, among stock nodes."""
    with contextlib.ExitStack() as stack:
        graph = stack.enter_context(Graph(tmp_path, ros1))
        around = Ros1(graph.environment, tmp_path, graph.port)
        stack.callback(around.close)
        guard = graph.guard()
        caller, listener = start_everything(graph)
        cloud = around.serve(CLOUD, EXAMPLE)
        around.serve(RECOVERY, EXAMPLE)
        robot = Robot(around, 30.0)
        said = robot.next()
        settled(graph)
        kills = Kills(graph)
        stack.callback(kills.close)
        theirs = {name for _, name, node in kills.known if node in ("/server", "/relay")}
        assert {"/work", "/relayed", "/relay/get_loggers"} <= theirs
        step = 0
        while isinstance(said, int):
            step += 1
            told = ""
            kills.wait()
            match step:
                case 4:
                    # The cloud dies, and a master that has never heard of it is told of a new one.
                    cloud.kill()
                    cloud.wait()
                    kills.without(f"/{CLOUD}")
                case 6:
                    around.serve(CLOUD, EXAMPLE)
                    kills.everything()
                    told = "wait for the cloud"
            if step <= KILLS:
                kills.strike()
            robot.go_on(told)
            said = robot.next()
        kills.wait()
        for process in (caller, listener):
            keeps_on(process)
        (tmp_path / "kills.jsonl").write_text(
            "".join(f"{json.dumps(figures)}\n" for figures in kills.figures)
        )
        print("\n", *kills.figures, sep="\n")
        assert len(kills.figures) == len(graph.events(guard, "master_lost")) == KILLS
        made, statuses = said
        assert made == json.loads(json.dumps(in_process(load(EXAMPLE), 0)))
        assert [each.replace("_", " ") for each in statuses] == ["local recovery", "keep alive"]
