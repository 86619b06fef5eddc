"""A robot of one's own: the example's controller as a process, and holdfast on the other end.

The controller counts what it does by itself, so it is the witness of what was performed and how
often. It shares no code with holdfast.
"""

from __future__ import annotations

import asyncio
import importlib.util
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from tests.ports import free_port

from holdfast.config.loader import Configuration, load
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.outcome import Done, MoveResult
from holdfast.planning.planner import Planner
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.protocol.events import (
    Acted,
    EnvironmentEvent,
    EnvironmentFailed,
    EnvironmentReady,
    Sensed,
)
from holdfast.robot.environment import Environment, Later
from holdfast.robot.environment_maker import EnvironmentMaker, load_environment
from holdfast.robot.environment_runner import EnvironmentRunner, make_runner
from holdfast.robot.trial import run_trial

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_robot"
PATIENCE_S = 60.0


class Controller:
    """The example's controller in a directory of its own; it may be killed and started again."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.port = 0
        self.process: subprocess.Popen[str] | None = None

    def start(self, *options: str) -> None:
        self.process = subprocess.Popen(
            [
                sys.executable,
                str(EXAMPLE / "controller.py"),
                *("--port", str(self.port), "--directory", str(self.directory)),
                *("--delay-ms", "0", *options),
            ],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line.startswith("listening on 127.0.0.1:"), line
        self.port = int(line.rpartition(":")[2])

    def kill(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait(PATIENCE_S)
            assert self.process.stdout is not None
            self.process.stdout.close()
            self.process = None

    def connect(self) -> Operator:
        return Operator(self.port)

    def moves(self) -> list[dict[str, Any]]:
        """Return what it has noted of each move."""
        lines = (self.directory / "performed.log").read_text().splitlines()
        return [note for note in map(json.loads, lines) if "step" in note]


class Operator:
    """A connection to the controller, without holdfast."""

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), PATIENCE_S)
        self.lines = self.socket.makefile("r")

    def send(self, **command: Any) -> None:
        self.socket.sendall(json.dumps(command).encode() + b"\n")

    def ask(self, **command: Any) -> dict[str, Any]:
        self.send(**command)
        answer = json.loads(self.lines.readline())
        assert isinstance(answer, dict)
        return answer

    def close(self) -> None:
        self.lines.close()
        self.socket.close()


@pytest.fixture
def controller(tmp_path: Path) -> Iterator[Controller]:
    controller = Controller(tmp_path)
    yield controller
    controller.kill()


@pytest.fixture(autouse=True)
def _clean_imports(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield
    sys.modules.pop("environment", None)


def configuration_for(
    controller: Controller, arguments: dict[str, Any] | None = None, timeout_ms: float = 60000.0
) -> Configuration:
    return load(
        EXAMPLE / "own_robot.yaml",
        overrides={
            "environment.object": "environment:SocketRobot",
            "environment.arguments": {"port": controller.port, **(arguments or {})},
            "environment.timeout_ms": timeout_ms,
        },
    )


def module_of_controller() -> ModuleType:
    spec = importlib.util.spec_from_file_location("own_controller", EXAMPLE / "controller.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class TestController:
    def test_its_peg_collides_where_holdfast_says(self) -> None:
        problem = PegInHole2D()
        drawn = np.random.default_rng(1).uniform([-2, -0.5, -3.2], [2, 2.5, 3.2], (4000, 3))
        # Many in the slot, upright, where it is tight.
        drawn[2000:] *= [0.06, 1.0, 0.02]
        expected = problem.world.collides(drawn)
        assert 500 < expected[:2000].sum() < 1900
        assert 200 < expected[2000:].sum() < 1900
        collides = module_of_controller().collides
        assert [collides(tuple(pose)) for pose in drawn.tolist()] == expected.tolist()

    def test_what_it_answers(self, controller: Controller) -> None:
        controller.start()
        operator = controller.connect()
        start = operator.ask(do="start", trial=3)
        assert start == {"trial": 3, "performed": 0, "reward": 0.0}
        shown = operator.ask(do="sense", coordinate=0)["value"]
        assert operator.ask(do="sense", coordinate=0)["value"] == shown
        moved = operator.ask(do="move", step=0, action=[0.3, 0.4, 0.0])
        assert moved == {"trial": 3, "performed": 1, "reward": -0.5}
        assert operator.ask(do="count") == moved
        assert operator.ask(do="done") == {"done": False}
        assert operator.ask(do="sense", coordinate=0)["value"] != shown
        assert operator.ask(do="fly")["error"] == "unknown command fly"
        assert "KeyError" in operator.ask(do="move")["error"]
        operator.socket.sendall(b"{\n")
        assert "JSONDecodeError" in json.loads(operator.lines.readline())["error"]
        assert operator.ask(do="count")["performed"] == 1
        operator.close()

    def test_it_goes_on_after_a_kill(self, controller: Controller) -> None:
        controller.start()
        operator = controller.connect()
        operator.ask(do="start", trial=1)
        for step in range(3):
            operator.ask(do="move", step=step, action=[-0.1, 0.0, 0.0])
        seen = [operator.ask(do="sense", coordinate=at)["value"] for at in range(3)]
        controller.kill()
        operator.close()
        controller.start()
        operator = controller.connect()
        assert operator.ask(do="count") == {"trial": 1, "performed": 3, "reward": -0.1}
        assert [operator.ask(do="sense", coordinate=at)["value"] for at in range(3)] == seen
        operator.close()

    def test_a_step_that_comes_twice_is_performed_twice_and_told(
        self, controller: Controller
    ) -> None:
        controller.start()
        operator = controller.connect()
        operator.ask(do="start", trial=0)
        operator.ask(do="move", step=0, action=[-0.1, 0.0, 0.0])
        assert operator.ask(do="move", step=0, action=[-0.1, 0.0, 0.0])["performed"] == 2
        first, second = controller.moves()
        assert "error" not in first
        assert second["error"] == "step 0 was performed where step 1 was due"
        assert second["after"]["pose"] != first["after"]["pose"]
        operator.close()

    def test_who_connected_last_operates_it(self, controller: Controller) -> None:
        """What a dead robot process still had on the wire is not carried out later."""
        controller.start("--silent-at", "0", "--silent-s", "1")
        first = controller.connect()
        first.ask(do="start", trial=0)
        first.send(do="move", step=0, action=[-0.1, 0.0, 0.0])  # this takes a second
        first.send(do="move", step=1, action=[-0.1, 0.0, 0.0])  # this waits behind it
        second = controller.connect()
        performed = second.ask(do="count")["performed"]
        assert performed in (0, 1)  # 1 if it had begun when the second one came
        assert first.socket.recv(65536).count(b"\n") == performed
        assert first.socket.recv(65536) == b""
        assert second.ask(do="count")["performed"] == performed
        first.close()
        second.close()


class Meddling:
    """An environment in whose steps something is done to the controller."""

    def __init__(self, environment: Environment, controller: Controller) -> None:
        self._environment = environment
        self._controller = controller
        self._step = 0

    def perform_sensing(self, sensing_action: int) -> FloatArray | Later | None:
        return self._environment.perform_sensing(sensing_action)

    def perform(self, task_action: FloatArray) -> float | MoveResult | None:
        self._step += 1
        if self._step == 10:  # between two moves
            self._controller.kill()
            self._controller.start("--delay-ms", "300")
        if self._step == 11:  # in the middle of one, if the machine is not too busy for that
            thread = threading.Timer(0.1, self._restart)
            thread.start()
            reward = self._environment.perform(task_action)
            thread.join(PATIENCE_S)
            return reward
        return self._environment.perform(task_action)

    def _restart(self) -> None:
        self._controller.kill()
        self._controller.start()

    def is_done(self) -> Done:
        return self._environment.is_done()


class TestTrial:
    def test_it_succeeds_and_a_restarted_controller_changes_nothing(
        self, controller: Controller
    ) -> None:
        controller.start()
        configuration = configuration_for(controller)
        planner = Planner(configuration.problem, configuration.planning)
        maker = load_environment(configuration)
        quiet: Any = maker(2)
        expected = run_trial(
            planner,
            configuration.simulator.seed,
            2,
            max_steps=configuration.simulator.max_steps,
            environment=quiet,
        )
        quiet.close()
        assert expected.success
        moves = controller.moves()
        assert len(moves) == expected.steps
        (controller.directory / "performed.log").unlink()

        robot: Any = maker(2)
        result = run_trial(
            planner,
            configuration.simulator.seed,
            2,
            max_steps=configuration.simulator.max_steps,
            environment=Meddling(robot, controller),
        )
        robot.close()
        assert result.digest == expected.digest
        assert result.reward == expected.reward
        assert controller.moves() == moves

    def test_the_simulation_has_the_same_file(self) -> None:
        """Without the name of the class, the same configuration is simulated."""
        configuration = load(EXAMPLE / "own_robot.yaml")
        maker = load_environment(configuration)
        assert maker.simulated
        result = run_trial(
            Planner(configuration.problem, configuration.planning),
            configuration.simulator.seed,
            0,
            max_steps=configuration.simulator.max_steps,
            environment=maker(0),
        )
        assert result.success


def test_without_its_controller_the_example_says_why_in_time() -> None:
    settings = load(EXAMPLE / "own_robot.yaml").environment
    assert 1e3 * settings.arguments["connect_timeout_s"] < settings.timeout_ms
    controller = Controller(Path())
    controller.port = free_port()
    maker = load_environment(configuration_for(controller, {"connect_timeout_s": 0.1}))
    watched = Watched(maker)
    failed = watched.begin()
    assert isinstance(failed, EnvironmentFailed)
    assert "Connection refused" in failed.text
    watched.close()


class Watched:
    """A runner with the queue of its events, on an event loop of its own."""

    def __init__(self, maker: EnvironmentMaker, trial: int = 0, *, resumed: bool = False) -> None:
        self.loop = asyncio.new_event_loop()
        self.queue: asyncio.Queue[EnvironmentEvent] = asyncio.Queue()
        self.runner: EnvironmentRunner = make_runner(
            maker, trial, lambda event, _: self.queue.put_nowait(event), resumed=resumed
        )

    def _event_of(self, call: Callable[..., None], *arguments: object) -> EnvironmentEvent:
        async def event() -> EnvironmentEvent:
            call(*arguments)
            return await asyncio.wait_for(self.queue.get(), PATIENCE_S)

        return self.loop.run_until_complete(event())

    def begin(self) -> EnvironmentEvent:
        return self._event_of(self.runner.begin)

    def perform(self, step: int) -> EnvironmentEvent:
        return self._event_of(self.runner.perform, step, np.array([-0.1, 0.0, 0.0]))

    def sense(self, step: int, sensing_action: int) -> EnvironmentEvent:
        return self._event_of(self.runner.sense, step, sensing_action)

    def close(self) -> None:
        self.runner.close()
        self.loop.close()


class TestFailures:
    @pytest.mark.slow
    def test_a_silent_controller_stops_the_robot_and_the_count_settles_it(
        self, controller: Controller
    ) -> None:
        controller.start("--silent-at", "2", "--silent-s", "3")
        maker = load_environment(configuration_for(controller, timeout_ms=1000.0))
        first = Watched(maker)
        assert first.begin() == EnvironmentReady(None, None)
        assert isinstance(first.perform(0), Acted)
        assert isinstance(first.perform(1), Acted)
        failed = first.perform(2)
        assert failed == EnvironmentFailed(
            2,
            "perform",
            "environment:SocketRobot: perform has not returned within 1000 ms, which is "
            "environment.timeout_ms",
            True,
        )
        # A new process of the robot would do this; the controller answers once it speaks again.
        patient = load_environment(configuration_for(controller))
        again = Watched(patient, resumed=True)
        assert again.begin() == EnvironmentReady(None, 3)
        assert isinstance(again.perform(3), Acted)
        assert [move["step"] for move in controller.moves()] == [0, 1, 2, 3]
        assert not [move for move in controller.moves() if "error" in move]
        first.close()
        again.close()

    def test_no_controller_at_all(self, controller: Controller) -> None:
        controller.port = free_port()
        maker = load_environment(configuration_for(controller, {"connect_timeout_s": 0.2}))
        watched = Watched(maker)
        failed = watched.begin()
        assert isinstance(failed, EnvironmentFailed)
        assert failed.text.startswith("environment:SocketRobot raised ConnectionRefusedError")
        assert f'File "{EXAMPLE / "environment.py"}", line ' in failed.text
        assert not failed.action_in_doubt
        watched.close()

    def test_a_controller_in_another_trial_is_not_resumed(self, controller: Controller) -> None:
        controller.start()
        maker = load_environment(configuration_for(controller))
        first = Watched(maker, trial=0)
        assert isinstance(first.begin(), EnvironmentReady)
        first.close()
        other = Watched(maker, trial=1, resumed=True)
        failed = other.begin()
        assert isinstance(failed, EnvironmentFailed)
        assert "RuntimeError: the controller is in trial 0, not in 1" in failed.text
        other.close()


ROBOT = """\
import asyncio
import sys

import numpy as np

from holdfast.config.loader import load
from holdfast.robot.environment_maker import load_environment
from holdfast.robot.environment_runner import make_runner

file, port, timeout_ms, steps = sys.argv[1:]
configuration = load(file, overrides={
    "environment.object": "environment:SocketRobot",
    "environment.arguments": {"port": int(port)},
    "environment.timeout_ms": float(timeout_ms),
})


async def main():
    events = asyncio.Queue()
    runner = make_runner(
        load_environment(configuration), 0, lambda event, _: events.put_nowait(event)
    )
    runner.begin()
    print(await events.get(), flush=True)
    for step in range(int(steps)):
        runner.perform(step, np.array([-0.1, 0.0, 0.0]))
        print("performing", flush=True)
        print(await events.get(), flush=True)
    runner.close()


asyncio.run(main())
"""


@pytest.mark.slow
class TestProcesses:
    """The robot's own process meets its signals while the robot moves."""

    @staticmethod
    def robot(controller: Controller, timeout_ms: float, steps: int) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [
                *(sys.executable, "-c", ROBOT, str(EXAMPLE / "own_robot.yaml")),
                *map(str, (controller.port, timeout_ms, steps)),
            ],
            stdout=subprocess.PIPE,
            text=True,
        )

    @staticmethod
    def lines(process: subprocess.Popen[str], count: int) -> Sequence[str]:
        assert process.stdout is not None
        return [process.stdout.readline().rstrip() for _ in range(count)]

    def test_killed_while_the_robot_moves(self, controller: Controller) -> None:
        controller.start("--delay-ms", "500")
        with self.robot(controller, 60000.0, 1) as process:
            assert self.lines(process, 2)[1] == "performing"
            process.kill()
        again = Watched(load_environment(configuration_for(controller)), resumed=True)
        begun = again.begin()
        assert isinstance(begun, EnvironmentReady)
        # The controller counts a motion that goes on as what it becomes, and nothing is lost.
        assert begun.steps_performed == len(controller.moves())
        for step in range(len(controller.moves()), 3):
            assert isinstance(again.perform(step), Acted)
        assert [move["step"] for move in controller.moves()] == [0, 1, 2]
        assert not [move for move in controller.moves() if "error" in move]
        again.close()

    def test_stopped_for_longer_than_the_timeout(self, controller: Controller) -> None:
        """A robot that was stopped itself does not blame its controller for the time."""
        controller.start("--delay-ms", "300")
        with self.robot(controller, 1000.0, 2) as process:
            assert self.lines(process, 2)[1] == "performing"
            os.kill(process.pid, signal.SIGSTOP)
            assert not wait_for_exit(process, 2.0)
            os.kill(process.pid, signal.SIGCONT)
            answers = self.lines(process, 3)
            assert process.wait(PATIENCE_S) == 0
        assert answers[0].startswith("Acted(step=0")
        assert answers[2].startswith("Acted(step=1")


def wait_for_exit(process: subprocess.Popen[str], timeout_s: float) -> bool:
    try:
        process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        return False
    return True


def test_sensing_through_the_runner(controller: Controller) -> None:
    controller.start()
    watched = Watched(load_environment(configuration_for(controller)))
    assert isinstance(watched.begin(), EnvironmentReady)
    sensed = watched.sense(0, 1)
    assert isinstance(sensed, Sensed)
    assert sensed.observation is not None
    assert sensed.observation.shape == (1,)
    watched.close()
    operator = controller.connect()
    assert operator.ask(do="sense", coordinate=1)["value"] == sensed.observation[0]
    operator.close()
