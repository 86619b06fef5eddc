"""The robot's process on its event loop: what is handled when, what ends it, who is blamed."""

import asyncio
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import AsyncMock, Mock

import pytest
from tests.recordings import decided, robot_configuration
from tests.unit.test_runtime_events import RecordingSink

from holdfast.config.loader import Configuration
from holdfast.errors import HeldError, ProblemError, TrialError
from holdfast.journal.run_directory import RunDirectory
from holdfast.planning.inputs import Moved, PausedRecord, Sensed
from holdfast.planning.outcome import TrialResult
from holdfast.planning.planner import Planner, PlanningState
from holdfast.protocol.effects import LogEvent
from holdfast.protocol.question import InProcessSource
from holdfast.protocol.robot_events import (
    Act,
    Acted,
    ComputeOwnAnswer,
    OwnAnswer,
    Paused,
    RecoveryExited,
    RobotEffect,
    Sense,
    Timing,
    TransportEvent,
)
from holdfast.protocol.status import Status
from holdfast.robot import own_planner
from holdfast.robot import process as robot_process
from holdfast.robot.environment_maker import EnvironmentMaker, load_environment
from holdfast.robot.links import make_links
from holdfast.robot.process import RobotProcess
from holdfast.runtime.events import BoundedEventLog

PATIENCE_S = 30.0
"""Longest wait for what is sure to come; nothing is measured by it."""


@pytest.fixture
def configuration(tmp_path: Path) -> Configuration:
    return robot_configuration(tmp_path, num_trials=2)


class Robots(RecordingSink):
    """Makes robots that go on in one directory, and keeps what they say."""

    def __init__(self, configuration: Configuration, directory: RunDirectory) -> None:
        super().__init__()
        self.configuration, self.directory = configuration, directory

        self.results: list[TrialResult] = []
        self.on_timing: Callable[[Timing], None] = lambda _: None
        self.maker = load_environment(configuration)
        self.on_order: Callable[[PlanningState, Act | Sense], None] | None = None

    def make(self) -> RobotProcess:
        configuration = self.configuration
        links = make_links(configuration, None, BoundedEventLog())
        return RobotProcess(
            configuration,
            links,
            self.directory.journal,
            self.maker,
            self,
            self._on_result,
            lambda timing: self.on_timing(timing),
            lambda _: None,
            on_order=self.on_order,
        )

    def run(self) -> None:
        self.make().run(self.directory.journal.finished())

    def _on_result(self, result: TrialResult) -> None:
        self.directory.add(result)
        self.results.append(result)

    @property
    def digests(self) -> list[str]:
        return [result.digest for result in self.results]


@pytest.fixture
def robots(configuration: Configuration, tmp_path: Path) -> Iterator[Robots]:
    with RunDirectory.create(tmp_path / "run", configuration) as directory:
        yield Robots(configuration, directory)


def plain_digests(configuration: Configuration) -> list[str]:
    """Return what a loop without journal, wire and service decides."""
    return [
        decided(configuration, trial).digest for trial in range(configuration.simulator.num_trials)
    ]


class Machine:
    """A machine that is scripted: what it is told comes into a trace."""

    trial, state = 0, None
    num_unverified = 0

    def __init__(self) -> None:
        self.trace: list[str] = []
        self.deaf_s: list[float] = []
        self.wakeups: list[float] = []
        self.answers: list[list[RobotEffect]] = []

    def start(self, now: float) -> list[RobotEffect]:
        return []

    def handle(self, event: object, now: float) -> list[RobotEffect]:
        self.trace.append(f"handle {type(event).__name__}")
        return self.answers.pop(0) if self.answers else []

    def wake(self, now: float) -> list[RobotEffect]:
        assert now >= self.wakeups.pop(0)
        self.trace.append("wake")
        return self.answers.pop(0) if self.answers else []

    def event_loop_stalled(self, seconds: float) -> None:
        self.deaf_s.append(seconds)

    def pause(self, now: float) -> list[RobotEffect]:
        return [Paused()]

    def next_wakeup(self) -> float | None:
        return self.wakeups[0] if self.wakeups else None

    def salvage(self) -> list[RobotEffect]:
        return []


class Clock:
    """Time as the robot's process sees it, which may jump: as if the process had been stopped."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.ahead_s = 0.0
        monkeypatch.setattr(robot_process, "monotonic", lambda: time.monotonic() + self.ahead_s)

    def jump(self, seconds: float) -> None:
        self.ahead_s += seconds


def scripted(robots: Robots, begin: Callable[[], object]) -> tuple[RobotProcess, Machine]:
    """Return a robot whose machine is a script, which begins with something of the test's own."""
    robot, machine = robots.make(), Machine()
    robot._transport = Mock(close=AsyncMock())  # over which nothing comes
    robot.robot = machine  # type: ignore[assignment]
    robot._begin_next = begin  # type: ignore[method-assign, assignment]
    return robot, machine


def test_it_decides_as_a_plain_loop_does(robots: Robots) -> None:
    robots.run()
    assert robots.digests == plain_digests(robots.configuration)


def test_what_comes_from_inside_an_effect_is_handled_after_the_effects_at_hand(
    robots: Robots,
) -> None:
    def world_answers(name: str, **_: object) -> None:
        machine.trace.append(name)
        if name == "first":
            robot._happens(Acted(Moved(0, None)))

    robots.event = world_answers  # type: ignore[method-assign, assignment]
    robot, machine = scripted(robots, lambda: robot._happens(RecoveryExited(1, "begin")))
    machine.answers = [[LogEvent("first", {}), LogEvent("second", {})], [Paused()]]
    robot.run(())
    assert machine.trace == ["handle RecoveryExited", "first", "second", "handle Acted"]


def test_the_loop_looks_at_the_wire_before_it_handles_more_than_some_events(
    robots: Robots, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock(monkeypatch)

    def event(name: str, **_: object) -> None:
        machine.trace.append(name)
        if name == "first":
            # A simulated world of which each step takes long never lets the queue run empty.
            robot._on_loop().call_soon(machine.trace.append, "the wire")
            clock.jump(0.1)
            robot._happens(Acted(Moved(0, None)))
            robot._happens(Acted(Moved(1, None)))

    robots.event = event  # type: ignore[method-assign, assignment]
    robot, machine = scripted(robots, lambda: robot._happens(RecoveryExited(1, "begin")))
    machine.answers = [[LogEvent("first", {})], [], [Paused()]]
    robot.run(())
    assert machine.trace == [
        *("handle RecoveryExited", "first", "the wire", "handle Acted", "handle Acted")
    ]


def test_what_comes_while_all_is_closed_ends_nothing_too_early(robots: Robots) -> None:
    closed: list[bool] = []

    async def close(timeout_s: float = 1.0) -> None:
        robot._happens(RecoveryExited(2, "while the wire is closed"))
        robot._on_loop().call_soon(robot._end)
        await asyncio.sleep(0.01)
        closed.append(True)

    robot, machine = scripted(robots, lambda: robot._happens(RecoveryExited(1, "ended")))
    robot._transport = Mock(close=close)
    machine.answers = [[Paused()]]
    robot.run(())
    assert closed == [True]
    assert machine.trace == ["handle RecoveryExited"]


def test_an_earlier_time_replaces_a_later_one(robots: Robots) -> None:
    robot, machine = scripted(
        robots, lambda: robot._on_loop().call_later(0.001, robot._happens, RecoveryExited(1, ""))
    )
    machine.wakeups = [time.monotonic() + 10.0 * PATIENCE_S]

    def handle(event: object, now: float) -> list[RobotEffect]:
        machine.trace.append("handle")
        machine.wakeups = [now + 0.01]
        return []

    machine.handle = handle  # type: ignore[method-assign]
    machine.answers = [[Paused()]]
    robot.run(())
    assert machine.trace == ["handle", "wake"]


def test_nobody_is_blamed_for_the_time_in_which_the_loop_did_not_listen(
    robots: Robots, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock(monkeypatch)
    blocked_s = 50.0

    def event(name: str, **_: object) -> None:
        clock.jump(blocked_s)

    robots.event = event  # type: ignore[method-assign, assignment]
    robot, machine = scripted(robots, lambda: robot._happens(RecoveryExited(1, "begin")))
    machine.answers = [[LogEvent("an event that is written to a slow disk", {})], [Paused()]]
    machine.wakeups = [time.monotonic() + 0.1]
    robot.run(())
    assert machine.trace == ["handle RecoveryExited", "wake"]
    assert machine.deaf_s[0] >= blocked_s


def test_nobody_is_blamed_for_what_a_wakeup_itself_takes(
    robots: Robots, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock(monkeypatch)
    robots.event = lambda *_, **__: clock.jump(50.0)  # type: ignore[method-assign]

    def begin() -> None:
        machine.wakeups = [time.monotonic()]
        robot._on_loop().call_later(0.02, robot._happens, RecoveryExited(1, "end"))

    robot, machine = scripted(robots, begin)
    machine.answers = [[LogEvent("a policy that takes long", {})], [Paused()]]
    robot.run(())
    assert machine.trace == ["wake", "handle RecoveryExited"]
    assert machine.deaf_s[0] >= 50.0


def test_nobody_is_blamed_if_the_process_was_stopped_when_it_should_have_woken_up(
    robots: Robots, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock(monkeypatch)
    late_s = 50.0

    def begin() -> None:
        machine.wakeups = [time.monotonic() + 0.001]
        # Something else on the loop, or another process, has the core.
        robot._on_loop().call_soon(clock.jump, 0.1 + late_s)

    robot, machine = scripted(robots, begin)
    machine.answers = [[Paused()]]
    robot.run(())
    assert machine.trace == ["wake"]
    assert machine.deaf_s[0] >= late_s


def test_an_error_in_what_is_called_on_the_loop_ends_the_run(robots: Robots) -> None:
    class OwnError(Exception):
        pass

    def fail(_: object) -> None:
        raise OwnError

    robots.on_timing = fail
    with pytest.raises(TrialError, match=r"trial 0 \(seed 3\), step 0: .* raised OwnError"):
        robots.run()
    assert robots.events[-1][0] == "stopped"


def test_an_error_of_whatever_else_runs_on_the_loop_ends_the_run(robots: Robots) -> None:
    class OwnError(Exception):
        pass

    def fail() -> None:
        raise OwnError

    robot, _ = scripted(robots, lambda: robot._on_loop().call_soon(fail) and None)
    with pytest.raises(TrialError, match="raised OwnError"):
        robot.run(())


@pytest.mark.parametrize("part", ["task", "sensing"])
def test_a_defect_of_its_own_planner_ends_the_run(
    robots: Robots, monkeypatch: pytest.MonkeyPatch, part: str
) -> None:
    """It would wait for ever: nothing else can decide."""
    answer = own_planner._answer

    def fail(planner: Planner, plan: ComputeOwnAnswer) -> OwnAnswer:
        if plan.part == part:
            raise ZeroDivisionError("a defect")
        return answer(planner, plan)

    monkeypatch.setattr(own_planner, "_answer", fail)
    with pytest.raises(TrialError, match=r"(?s)trial 0 .*ZeroDivisionError: a defect"):
        robots.run()


def test_what_its_own_planner_refuses_is_said_and_ends_the_run(
    robots: Robots, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(planner: Planner, plan: ComputeOwnAnswer) -> OwnAnswer:
        raise ProblemError("policy gives nan")

    monkeypatch.setattr(own_planner, "_answer", refuse)
    with pytest.raises(ProblemError, match="policy gives nan"):
        robots.run()
    assert ("stopped", {"reason": "policy gives nan"}) in robots.events


class TestSignals:
    @pytest.fixture(autouse=True)
    def _handlers(self) -> Iterator[None]:
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        yield
        signal.signal(signal.SIGINT, before)

    def test_the_first_one_ends_the_run_in_order(self, robots: Robots) -> None:
        timings: list[Timing] = []

        def interrupt(timing: Timing) -> None:
            timings.append(timing)
            if len(timings) == 3:
                os.kill(os.getpid(), signal.SIGINT)

        robots.on_timing = interrupt
        with pytest.raises(KeyboardInterrupt):
            robots.run()
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        unfinished = robots.directory.journal.unfinished()
        assert unfinished is not None
        assert unfinished.records[-1] == PausedRecord()
        robots.on_timing = lambda _: None
        robots.run()
        assert robots.digests == plain_digests(robots.configuration)

    def test_it_wakes_a_loop_that_sleeps(self, robots: Robots) -> None:
        robot, _ = scripted(
            robots, lambda: threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
        )
        with pytest.raises(KeyboardInterrupt):
            robot.run(())

    def test_the_second_one_ends_it_at_once_even_inside_a_problem_that_never_returns(
        self, robots: Robots
    ) -> None:
        ends: list[str] = []

        def stuck(_: object) -> None:
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)
            ends.append("it went on")

        robots.on_timing = stuck
        with pytest.raises(KeyboardInterrupt):
            robots.run()
        assert not ends


@pytest.mark.parametrize("brief", [True, False])
def test_what_takes_long_is_computed_on_a_thread_while_the_robot_goes_on(
    robots: Robots, monkeypatch: pytest.MonkeyPatch, *, brief: bool
) -> None:
    """What is brief is not, but for the first of its kind: nobody knows how long that takes."""
    computed_on: list[str] = []
    told_on: set[str] = set()
    answer, handle = own_planner._answer, InProcessSource.handle

    def noted(planner: Planner, plan: ComputeOwnAnswer) -> OwnAnswer:
        computed_on.append(threading.current_thread().name)
        return answer(planner, plan)

    def told(self: InProcessSource, event: TransportEvent | OwnAnswer, now: float) -> None:
        told_on.add(threading.current_thread().name)
        handle(self, event, now)

    monkeypatch.setattr(own_planner, "_BRIEF_S", PATIENCE_S if brief else 0.0)
    monkeypatch.setattr(own_planner, "_answer", noted)
    monkeypatch.setattr(InProcessSource, "handle", told)
    robots.run()
    here, thread = threading.current_thread().name, "holdfast-own-planner-0"
    assert told_on == {here}
    assert set(computed_on[:1]) == {thread}
    assert set(computed_on[4:]) == ({here} if brief else {thread})
    assert robots.digests == plain_digests(robots.configuration)


class TestPause:
    """What a process does that has something else on its main thread."""

    def test_an_environment_that_does_not_return_is_left_alone(self, robots: Robots) -> None:
        called, let_go = threading.Event(), threading.Event()

        def stuck(sensing_action: int) -> list[float]:
            called.set()
            let_go.wait(PATIENCE_S)
            return [0.0]

        def world() -> Mock:
            return Mock(perform_sensing=stuck, is_done=lambda: False)

        problem = robots.configuration.problem
        robots.maker = EnvironmentMaker("stuck", problem, 0, 60_000.0, world)  # type: ignore[arg-type]
        robot = robots.make()

        def pause() -> None:
            called.wait(PATIENCE_S)
            robot.pause(0.0)

        threading.Thread(target=pause).start()
        with pytest.raises(HeldError, match="has not ended its call in 0 s"):
            robot.run(())
        let_go.set()

    def test_after_the_end_it_does_nothing(self, robots: Robots) -> None:
        robot = robots.make()
        robot.run(())
        robot.pause(0.0)
        assert robots.digests == plain_digests(robots.configuration)


def test_who_looks_on_sees_each_order_and_its_state(robots: Robots) -> None:
    seen: list[tuple[int, int, str]] = []

    def look(state: PlanningState, order: Act | Sense) -> None:
        assert state.step == order.step
        seen.append((state.trial, state.step, type(order).__name__))

    robots.on_order = look
    robot = robots.make()
    robot.run(())
    expected = []
    for result in robots.results:
        assert result.decisions is not None
        expected += [
            (result.trial, one.step, "Sense" if isinstance(one, Sensed) else "Act")
            for one in result.decisions
        ]
    assert seen == expected
    assert (robot.robot.status, robot.robot.unexplained_observations) == (Status.STANDARD, 0)
