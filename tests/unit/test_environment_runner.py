"""Calling a robot's world: every call ends in one event, whatever the world does."""

from __future__ import annotations

import asyncio
import sys
import threading
from collections.abc import Callable, Iterator
from time import monotonic
from typing import Any

import numpy as np
import pytest

from holdfast.errors import EnvironmentFailedError, InvalidValueError
from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.randomness import Stream
from holdfast.planning.inputs import Late, Moved, Sensed, encode_floats
from holdfast.planning.outcome import Ending, MoveResult, ending_of
from holdfast.problems.capsule_robot import CapsuleRobot
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.protocol.robot_events import (
    Acted,
    EnvironmentEvent,
    EnvironmentFailed,
    EnvironmentReady,
    NoReading,
)
from holdfast.robot.environment import LATER, Environment, SimulatedEnvironment
from holdfast.robot.environment_maker import EnvironmentMaker
from holdfast.robot.environment_runner import (
    EnvironmentRunner,
    InlineRunner,
    ThreadedRunner,
    make_runner,
)

PATIENCE_S = 30.0
"""Longest wait for what is sure to come; nothing is measured by it."""

ACTION = np.array([0.1, 0.0, 0.0])


class Robot:
    """A world that does what a test says; each method's answer is a value or is called for one."""

    def __init__(self, **answers: Any) -> None:
        self.answers = {
            "perform_sensing": [0.5],
            "perform": -1.0,
            "is_done": False,
            "steps_performed": 4,
            **answers,
        }
        self.calls: list[tuple[str, Any]] = []
        self.threads: set[str] = set()
        self.closed = threading.Event()

    def _answer(self, method: str, argument: Any = None) -> Any:
        self.calls.append((method, argument))
        self.threads.add(threading.current_thread().name)
        answer = self.answers[method]
        return answer() if callable(answer) else answer

    def perform_sensing(self, sensing_action: int) -> Any:
        return self._answer("perform_sensing", sensing_action)

    def perform(self, task_action: FloatArray) -> Any:
        return self._answer("perform", task_action)

    def is_done(self) -> Any:
        return self._answer("is_done")

    def steps_performed(self) -> Any:
        return self._answer("steps_performed")

    def close(self) -> None:
        self.threads.add(threading.current_thread().name)
        self.closed.set()


class Made(EnvironmentMaker):
    """Makes one environment."""

    def __init__(
        self, make: Callable[[], Environment], problem: Any, timeout_ms: float, max_missing: int
    ) -> None:
        super().__init__("robot", problem, 0, timeout_ms, max_missing_in_a_row=max_missing)
        self._make = make

    def __call__(self, trial: int, **_: Any) -> Environment:
        return self._make()


class Bench:
    """A runner under test on an event loop, and the queue of its events."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.loop = asyncio.new_event_loop()
        self.queue: asyncio.Queue[EnvironmentEvent] = asyncio.Queue()
        self.opened: list[OnLoop] = []

    def deliver(self, event: EnvironmentEvent, at: float) -> None:
        assert at <= monotonic()
        self.queue.put_nowait(event)

    def open(
        self,
        environment: Environment | Callable[[], Environment],
        *,
        resumed: bool = False,
        timeout_ms: float = 1e3 * PATIENCE_S,
        problem: Any = None,
        max_missing: int = 9,
    ) -> OnLoop:
        make = environment if callable(environment) else lambda: environment
        maker = Made(make, problem or PegInHole2D(), timeout_ms, max_missing)
        kind = InlineRunner if self.kind == "inline" else ThreadedRunner
        runner = kind(maker, 0, self.deliver, resumed=resumed)
        return self.drive(runner)

    def drive(self, runner: EnvironmentRunner) -> OnLoop:
        self.opened.append(OnLoop(runner, self.loop))
        return self.opened[-1]

    def event(self) -> EnvironmentEvent:
        return self.loop.run_until_complete(asyncio.wait_for(self.queue.get(), PATIENCE_S))

    def acted(self) -> Acted:
        event = self.event()
        assert isinstance(event, Acted)
        return event

    def call(
        self, robot: Robot, method: str, answer: Any, step: int = 0, **settings: Any
    ) -> OnLoop:
        """Have a method called that answers so; those before it answer as ever."""
        if method == "steps_performed":
            robot.answers[method] = answer
            runner = self.open(robot, resumed=True, **settings)
            runner.begin(step)
            return runner
        runner = self.begin(robot, **settings)
        robot.answers[method] = answer
        if method == "perform_sensing":
            runner.sense(step, 0)
        else:
            runner.perform(step, ACTION)
        return runner

    def failure(self) -> EnvironmentFailed:
        event = self.event()
        assert isinstance(event, EnvironmentFailed)
        return event

    def begin(self, robot: Environment, **settings: Any) -> OnLoop:
        runner = self.open(robot, **settings)
        runner.begin()
        assert isinstance(self.event(), EnvironmentReady)
        return runner


class OnLoop:
    """Calls a runner on a loop that runs for so long."""

    def __init__(self, runner: EnvironmentRunner, loop: asyncio.AbstractEventLoop) -> None:
        self.runner = runner
        self._loop = loop

    def _call(self, method: Callable[..., None], *arguments: Any) -> None:
        async def call() -> None:
            method(*arguments)

        self._loop.run_until_complete(call())

    def begin(self, step: int = 0) -> None:
        self._call(self.runner.begin, step)

    def sense(self, step: int, sensing_action: int) -> None:
        self._call(self.runner.sense, step, sensing_action)

    def perform(self, step: int, task_action: FloatArray) -> None:
        self._call(self.runner.perform, step, task_action)

    def close(self, timeout_s: float) -> None:
        self._call(self.runner.close, timeout_s)


@pytest.fixture(params=["inline", "threaded"])
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    yield from opened_bench(request.param)


@pytest.fixture
def threaded() -> Iterator[Bench]:
    yield from opened_bench("threaded")


def opened_bench(kind: str) -> Iterator[Bench]:
    bench = Bench(kind)
    before = set(threading.enumerate())
    yield bench
    for runner in bench.opened:
        runner.close(PATIENCE_S)
    # Whatever was not expected would otherwise go unseen.
    bench.loop.run_until_complete(asyncio.sleep(0))
    assert bench.queue.empty()
    bench.loop.close()
    begun = set(threading.enumerate()) - before
    assert not [thread for thread in begun if "environment" in thread.name]


def fail() -> None:
    raise ValueError("the motor is hot")


class TestEvents:
    def test_each_call_is_answered(self, bench: Bench) -> None:
        robot = Robot()
        runner = bench.open(robot)
        runner.begin()
        assert bench.event() == EnvironmentReady(None, None)
        runner.sense(0, 2)
        sensed = bench.event()
        assert isinstance(sensed, Sensed)
        assert sensed == Sensed(0, 2, encode_floats([0.5]))
        runner.perform(0, ACTION)
        assert bench.event() == Acted(Moved(0, -1.0))
        robot.answers.update(perform=None, is_done=np.True_)
        runner.perform(1, ACTION)
        acted = bench.acted()
        assert acted == Acted(Moved(1, None), Ending("succeeded"))
        assert type(acted.ending) is Ending
        methods = [method for method, _ in robot.calls]
        assert methods == ["is_done", "perform_sensing", *("perform", "is_done") * 2]
        assert robot.calls[1][1] == 2
        assert robot.calls[2][1].tolist() == ACTION.tolist()

    @pytest.mark.parametrize("failed", ["failed", np.str_("failed")])
    def test_the_task_may_have_failed(self, failed: str, bench: Bench) -> None:
        robot = Robot(is_done=failed)
        runner = bench.open(robot)
        runner.begin()
        assert bench.event() == EnvironmentReady(Ending("failed"), None)
        runner.perform(0, ACTION)
        acted = bench.acted()
        assert acted == Acted(Moved(0, -1.0), Ending("failed"))
        assert type(acted.ending) is Ending

    def test_the_count_is_asked_for_after_a_crash_alone(self, bench: Bench) -> None:
        robot = Robot(is_done=True)
        bench.open(robot, resumed=True).begin(4)
        assert bench.event() == EnvironmentReady(Ending("succeeded"), 4)
        assert [method for method, _ in robot.calls] == ["steps_performed", "is_done"]

    def test_what_was_handed_over_stays_what_it_was(self, bench: Bench) -> None:
        shown = np.array([1.0])
        robot = Robot(perform_sensing=lambda: shown)
        runner = bench.begin(robot)
        runner.sense(0, 0)
        sensed = bench.event()
        assert isinstance(sensed, Sensed)
        shown[0] = 7.0
        assert sensed.observation == encode_floats([1.0])
        action = ACTION.copy()
        action.setflags(write=False)
        runner.perform(0, action)
        assert isinstance(bench.event(), Acted)
        robot.calls[-2][1][:] = 9.0  # the robot may do with its copy what it likes
        assert action.tolist() == ACTION.tolist()

    @pytest.mark.parametrize("problem", [PegInHole2D(), CapsuleRobot()])
    def test_a_simulated_world_fits(self, problem: Any, bench: Bench) -> None:
        runner = bench.begin(SimulatedEnvironment(problem, 1, 0), problem=problem)
        world = SimulatedEnvironment(problem, 1, 0)
        for sensing_action in range(len(problem.sensing_actions)):
            runner.sense(0, sensing_action)
            sensed = bench.event()
            assert isinstance(sensed, Sensed)
            assert sensed.observation == encode_floats(world.perform_sensing(sensing_action))
        action = problem.limit_action(np.full(problem.action_size, -0.05))
        runner.perform(0, action)
        reward = world.perform(action)
        assert not isinstance(reward, MoveResult)
        assert bench.event() == Acted(Moved(0, reward), ending_of(world.is_done()))


class TestFailures:
    def test_an_environment_that_cannot_be_made(self, bench: Bench) -> None:
        def make() -> Environment:
            raise OSError("no such port")

        runner = bench.open(make)
        runner.begin(3)
        failed = bench.failure()
        assert failed[:2] == (3, "robot")
        assert failed.text.startswith("robot raised OSError: no such port\n  File ")
        assert 'raise OSError("no such port")' in failed.text
        assert not failed.action_in_doubt

    @pytest.mark.parametrize(
        ("method", "unknown", "performed"),
        [
            ("steps_performed", False, False),
            ("perform_sensing", False, False),
            ("perform", True, False),
            ("is_done", False, True),
        ],
    )
    def test_a_method_that_raises(
        self, method: str, unknown: bool, performed: bool, bench: Bench
    ) -> None:
        bench.call(Robot(), method, fail, step=5)
        failed = bench.failure()
        assert (failed.step, failed.what, failed.action_in_doubt) == (5, method, unknown)
        assert failed.performed == (Acted(Moved(5, -1.0)) if performed else None)
        assert failed.text.startswith(
            f"robot: {method} raised ValueError: the motor is hot\n  File"
        )
        assert "holdfast/runtime" not in failed.text

    def test_after_a_failure_nothing_more_is_called(self, bench: Bench) -> None:
        robot = Robot(perform=fail)
        runner = bench.begin(robot)
        runner.perform(0, ACTION)
        first = bench.failure()
        called = len(robot.calls)
        robot.answers["perform"] = None
        runner.perform(1, ACTION)
        runner.sense(2, 0)
        assert bench.event() == EnvironmentFailed(1, "perform", first.text, False)
        assert bench.event() == EnvironmentFailed(2, "perform", first.text, False)
        assert len(robot.calls) == called

    def test_errors_of_holdfast_come_as_they_are(self, bench: Bench) -> None:
        runner = bench.begin(SimulatedEnvironment(PegInHole2D(), 0, 0))
        runner.perform(0, np.array([np.nan, 0.0, 0.0]))
        failed = bench.failure()
        assert "nan" in failed.text
        assert failed.action_in_doubt

    @pytest.mark.parametrize(
        ("method", "answer", "expected"),
        [
            ("perform_sensing", 0.5, "returned 0.5; it must return an array of shape (1,)"),
            ("perform_sensing", ["0.5"], "returned ['0.5']; it must return an array of shape (1,)"),
            ("perform", MoveResult(0.0, np.array([True])), "numbers (no text, truth value, "),
            ("perform_sensing", [1j], "returned [1j]; it must return an array of shape (1,)"),
            ("perform_sensing", [float("inf")], "returned [inf]; it must return finite numbers"),
            ("perform", float("nan"), "returned nan; it must return a finite number, the reward"),
            ("perform", True, "returned True; it must return a finite number"),
            ("is_done", 1, 'returned 1; it must return True, False, None, "failed" or an Ending'),
            ("is_done", "", "returned ''; it must return True, False, None"),
            ("is_done", np.array([True]), "it must return True, False, None"),
            ("steps_performed", -1, "returned -1; it must return a whole number >= 0"),
            ("steps_performed", 3.0, "returned 3.0; it must return a whole number >= 0"),
            ("steps_performed", None, "returned None; it must return a whole number >= 0"),
        ],
    )
    def test_a_value_that_nobody_can_use(
        self, method: str, answer: object, expected: str, bench: Bench
    ) -> None:
        bench.call(Robot(), method, answer)
        failed = bench.failure()
        assert failed.what == method
        assert failed.text.startswith(f"robot: {method} returned ")
        assert expected in failed.text
        # What perform returned may mean that it was not performed; what is_done did does not.
        assert failed.action_in_doubt == (method == "perform")
        assert (failed.performed is not None) == (method == "is_done")

    def test_general_observations_have_any_size(self, bench: Bench) -> None:
        class General(PegInHole2D):
            def log_likelihood(
                self, states: FloatArray, sensing_action: int, observation: FloatArray
            ) -> FloatArray:
                return np.zeros(len(states))

            def sample_observation(
                self, state: FloatArray, sensing_action: int, stream: Stream
            ) -> FloatArray:
                return np.zeros(5)

        runner = bench.begin(Robot(perform_sensing=np.zeros(5)), problem=General())
        runner.sense(0, 0)
        assert isinstance(bench.event(), Sensed)


class TestClose:
    def test_the_environment_is_closed_once(self, bench: Bench) -> None:
        robot = Robot()
        runner = bench.begin(robot)
        runner.close(PATIENCE_S)
        assert robot.closed.is_set()
        robot.closed.clear()
        runner.close(PATIENCE_S)
        assert not robot.closed.is_set()

    def test_what_close_raises_concerns_nobody(self, bench: Bench) -> None:
        robot = Robot()
        robot.close = fail  # type: ignore[method-assign]
        bench.begin(robot).close(PATIENCE_S)

    def test_an_environment_that_was_never_made(self, bench: Bench) -> None:
        robot = Robot()
        bench.open(robot).close(PATIENCE_S)
        assert not robot.closed.is_set()

    def test_after_it_nothing_happens(self, bench: Bench) -> None:
        robot = Robot()
        runner = bench.begin(robot)
        runner.close(PATIENCE_S)
        called = len(robot.calls)
        runner.sense(0, 0)
        runner.perform(0, ACTION)
        assert len(robot.calls) == called
        # The fixture looks whether an event came.


class TestThreads:
    def test_the_loop_goes_on_while_the_robot_moves(self, threaded: Bench) -> None:
        moving, arrived = threading.Event(), threading.Event()

        def move() -> float:
            moving.set()
            assert arrived.wait(PATIENCE_S)
            return -1.0

        runner = threaded.begin(Robot(perform=move))
        runner.perform(0, ACTION)
        assert moving.wait(PATIENCE_S)
        assert threaded.queue.empty()
        arrived.set()
        assert threaded.event() == Acted(Moved(0, -1.0))

    def test_one_call_at_a_time(self, threaded: Bench) -> None:
        arrived = threading.Event()
        robot = Robot(perform=lambda: arrived.wait(PATIENCE_S) and None)
        runner = threaded.begin(robot)
        runner.perform(0, ACTION)
        with pytest.raises(
            InvalidValueError, match="sense of step 1 while perform of step 0 has not ended"
        ):
            runner.sense(1, 0)
        arrived.set()
        assert threaded.event() == Acted(Moved(0, None))
        assert "perform_sensing" not in [method for method, _ in robot.calls]

    def test_it_is_made_called_and_closed_on_one_thread(self, threaded: Bench) -> None:
        threads = []

        def make() -> Environment:
            threads.append(threading.current_thread().name)
            return robot

        robot = Robot()
        runner = threaded.open(make)
        runner.begin()
        threaded.event()
        runner.perform(0, ACTION)
        threaded.event()
        runner.close(PATIENCE_S)
        assert robot.threads == set(threads) == {"environment-0"}

    def test_leaving_the_program_is_a_failure_as_well(self, threaded: Bench) -> None:
        runner = threaded.begin(Robot(perform=lambda: sys.exit(3)))
        runner.perform(0, ACTION)
        assert threaded.failure().text.startswith("robot: perform raised SystemExit: 3\n")

    def test_ctrl_c_passes_through_where_there_is_no_thread(self) -> None:
        def interrupt() -> None:
            raise KeyboardInterrupt

        events: list[EnvironmentEvent] = []
        robot = Robot(perform=interrupt)
        maker = Made(lambda: robot, PegInHole2D(), 1e3 * PATIENCE_S, 9)
        runner = InlineRunner(maker, 0, lambda event, _: events.append(event))
        runner.begin()
        assert runner.world.environment is robot
        with pytest.raises(KeyboardInterrupt):
            runner.perform(0, ACTION)
        assert events == [EnvironmentReady(None, None)]


class TestStalls:
    """The environment waits for the test, and so the timeout always comes first."""

    @pytest.mark.parametrize(
        ("method", "unknown"), [("perform_sensing", False), ("perform", True), ("is_done", False)]
    )
    def test_a_method_that_does_not_return(
        self, method: str, unknown: bool, threaded: Bench
    ) -> None:
        released = threading.Event()
        robot = Robot()
        # Long enough for the calls before that one, however busy the machine is.
        runner = threaded.call(
            robot, method, lambda: released.wait(PATIENCE_S) and None, 7, timeout_ms=1000.0
        )
        assert threaded.event() == EnvironmentFailed(
            7,
            method,
            f"robot: {method} has not returned within 1000 ms, which is environment.timeout_ms",
            unknown,
            *((Acted(Moved(7, -1.0)),) if method == "is_done" else ()),
        )
        runner.perform(8, ACTION)
        assert threaded.failure()[:2] == (8, method)
        released.set()
        runner.close(PATIENCE_S)
        # It is closed although it had stalled; what it returned is dropped (the fixture looks).
        assert robot.closed.is_set()

    def test_one_that_cannot_be_made_in_time(self, threaded: Bench) -> None:
        released = threading.Event()

        def make() -> Environment:
            released.wait(PATIENCE_S)
            return Robot()

        runner = threaded.open(make, timeout_ms=20.0)
        runner.begin(2)
        assert threaded.event() == EnvironmentFailed(
            2,
            "robot",
            "the constructor of robot has not returned within 20 ms, which is "
            "environment.timeout_ms",
            False,
        )
        released.set()

    def test_close_does_not_wait_for_it(self, threaded: Bench) -> None:
        released = threading.Event()
        robot = Robot()
        runner = threaded.begin(robot)
        robot.answers["perform"] = lambda: released.wait(PATIENCE_S) and None
        runner.perform(0, ACTION)
        runner.close(0.05)
        assert not robot.closed.is_set()
        released.set()
        assert robot.closed.wait(PATIENCE_S)

    def test_many_calls_outlive_the_timeout_of_one(self, threaded: Bench) -> None:
        """Each call has the whole time to itself, and none is watched for an older one's."""
        pause = threading.Event()
        robot = Robot(perform=lambda: float(pause.wait(0.06)))
        runner = threaded.begin(robot, timeout_ms=1000.0)
        for step in range(25):
            runner.perform(step, ACTION)
            assert threaded.event() == Acted(Moved(step, 0.0))


class TestMakePerformer:
    def test_a_simulated_world_is_performed_at_once(self) -> None:
        problem = PegInHole2D()
        lived = SimulatedEnvironment(problem, 3, 1)
        for _ in range(2):
            lived.perform(ACTION)
        maker = EnvironmentMaker("simulated", problem, 3, 1000.0)
        events: list[EnvironmentEvent] = []
        runner = make_runner(
            maker,
            1,
            lambda event, _: events.append(event),
            resumed=True,
            performed=[ACTION, ACTION],
        )
        runner.begin(2)
        assert events == [EnvironmentReady(None, 2)]
        assert isinstance(runner, InlineRunner)
        assert isinstance(runner.world.environment, SimulatedEnvironment)
        assert runner.world.environment.state.tobytes() == lived.state.tobytes()

    def test_a_robot_is_performed_on_a_thread(self, threaded: Bench) -> None:
        class Own(Robot):
            def __init__(self, trial: int, resumed: bool) -> None:
                super().__init__(steps_performed=trial, is_done=resumed)

        maker = EnvironmentMaker("own:Own", PegInHole2D(), 3, 1e3 * PATIENCE_S, Own)
        runner = make_runner(maker, 6, threaded.deliver, resumed=True)
        assert isinstance(runner, ThreadedRunner)
        threaded.drive(runner).begin()
        assert threaded.event() == EnvironmentReady(Ending("succeeded"), 6)

    def test_what_is_no_robot_names_what_it_lacks(self, threaded: Bench) -> None:
        maker = EnvironmentMaker("own:Int", PegInHole2D(), 3, 1e3 * PATIENCE_S, int)
        threaded.drive(make_runner(maker, 0, threaded.deliver)).begin()
        assert threaded.failure().text.startswith(
            "own:Int is no environment: it lacks perform_sensing and perform and is_done; it needs"
        )
        with pytest.raises(EnvironmentFailedError):
            maker(0)


class TestShown:
    """What moves show, and observations that come later."""

    @staticmethod
    def late_robot(late: Any = (), **answers: Any) -> Robot:
        robot = Robot(perform_sensing=LATER, **answers)
        robot.late_observations = lambda: late  # type: ignore[attr-defined]
        return robot

    def test_a_move_shows_its_motion_and_an_observation(self, bench: Bench) -> None:
        shown = MoveResult(-2.0, [0.1, 0.2], np.array([3], dtype=np.int32))
        runner = bench.begin(Robot(perform=shown))
        runner.perform(0, ACTION)
        acted = bench.acted()
        assert acted.moved == Moved(0, -2.0, encode_floats([0.1, 0.2]), encode_floats([3.0]))
        assert acted.ending is None

    def test_an_ending_has_a_reason_of_one_line(self, bench: Bench) -> None:
        ending = Ending("failed", "hit\n  the \x1b[2Jwall " + 300 * "!")
        runner = bench.begin(Robot(is_done=False))
        robot = bench.opened[-1].runner.world.environment
        assert isinstance(robot, Robot)
        robot.answers["is_done"] = ending
        runner.perform(0, ACTION)
        acted = bench.acted()
        assert acted.ending is not None
        assert acted.ending.outcome == "failed"
        assert acted.ending.reason.startswith("hit the \\x1b[2Jwall !!!")
        assert len(acted.ending.reason) == 200

    def test_an_observation_comes_with_a_later_move(self, bench: Bench) -> None:
        runner = bench.begin(self.late_robot([(0, [1.5])]))
        runner.sense(0, 1)
        assert bench.event() == Sensed(0, 1, b"")
        runner.perform(0, ACTION)
        acted = bench.acted()
        assert acted.late == (Late(1, 0, encode_floats([1.5])),)

    @pytest.mark.parametrize("nothing", [None, [np.nan], np.full(3, np.nan), float("nan")])
    def test_no_reading(self, nothing: Any, bench: Bench) -> None:
        """At once, or of an earlier step; what is NaN in a part is an error, not a reading."""
        robot = self.late_robot([(0, nothing), (1, [1.5])])
        robot.answers["perform_sensing"] = nothing
        runner = bench.begin(robot)
        runner.sense(0, 1)
        assert bench.event() == NoReading(0)
        runner.perform(0, ACTION)
        acted = bench.acted()
        assert (acted.no_reading, [late.taken for late in acted.late]) == ((0,), [1])
        robot.answers["perform_sensing"] = [np.nan, 1.0]
        runner.sense(1, 1)
        assert "an array of shape (1,), of numbers" in bench.failure().text

    def test_too_many_in_a_row_stop_the_run(self, bench: Bench) -> None:
        """An observation, late or not, begins the count anew; what is still to come does not."""
        robot = self.late_robot()
        runner = bench.begin(robot, max_missing=2)

        def sense(shown: Any) -> EnvironmentEvent:
            robot.answers["perform_sensing"] = shown
            runner.sense(0, 1)
            return bench.event()

        for shown in (None, None, [1.0], None, LATER, None):
            assert isinstance(sense(shown), NoReading if shown is None else Sensed)
        failed = sense(None)
        assert isinstance(failed, EnvironmentFailed)
        assert failed.text == (
            "robot: perform_sensing gave no reading 3 times in a row; "
            "environment.max_missing_in_a_row allows 2"
        )
        assert not failed.action_in_doubt

    def test_later_needs_a_way_to_come(self, bench: Bench) -> None:
        runner = bench.begin(Robot(perform_sensing=LATER))
        runner.sense(0, 1)
        assert "there is no late_observations() that could return" in bench.failure().text

    @pytest.mark.parametrize(
        ("shown", "message"),
        [
            (MoveResult(motion="far"), "MoveResult whose motion is an array of 1 to 4096 numbers"),
            (MoveResult(observation=1.0), "MoveResult whose observation is an array"),
            (MoveResult(observation=[np.nan]), "finite numbers"),
            (MoveResult(reward=np.inf), "a finite number, the reward, a MoveResult, or None"),
        ],
    )
    def test_what_a_move_cannot_show(self, shown: Any, message: str, bench: Bench) -> None:
        runner = bench.begin(Robot(perform=shown))
        runner.perform(0, ACTION)
        failed = bench.failure()
        assert message in failed.text
        assert failed.action_in_doubt

    @pytest.mark.parametrize(
        ("late", "message"),
        [
            (None, "returned None; it must return a list of (step, observation)"),
            ([(0.5, [1.0])], "a whole number >= 0"),
            ([(0, "far")], "a list of (step, observation) with observations of shape (n,)"),
            ([(0, [np.nan, 1.0])], "finite numbers"),
        ],
    )
    def test_what_cannot_come_late(self, late: Any, message: str, bench: Bench) -> None:
        """The move itself is known: its reward is not lost."""
        runner = bench.begin(self.late_robot(late))
        runner.perform(0, ACTION)
        failed = bench.failure()
        assert message in failed.text
        assert failed.what == "late_observations"
        assert not failed.action_in_doubt
        assert failed.performed == Acted(Moved(0, -1.0))
