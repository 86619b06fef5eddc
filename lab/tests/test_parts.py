"""The parts of the simulated world, each by itself: one that lies would prove nothing."""

import msgspec
import numpy as np
import pytest

from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.randomness import Stream
from holdfast.planning.outcome import TrialResult
from holdfast.planning.planner import Planner
from holdfast.planning.settings import PlanningSettings
from holdfast.planning.tracking import Trial
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast_lab.errors import Violation
from holdfast_lab.simulation.checked_memo import CheckedPlanner
from holdfast_lab.simulation.checkers import StatusChecker, WireChecker, check_size
from holdfast_lab.simulation.environment_model import EnvironmentModel
from holdfast_lab.simulation.event_queue import Clock, EventQueue
from holdfast_lab.simulation.exploration import shrink
from holdfast_lab.simulation.reference_runs import (
    UNDISTURBED,
    Circumstances,
    ReferenceRun,
    ReferenceRuns,
    ReferenceStep,
)
from holdfast_lab.simulation.schedule import (
    Crash,
    MessageFault,
    RunSettings,
    SimulationSchedule,
    Stop,
)


class TestEventQueue:
    def test_clocks(self) -> None:
        queue = EventQueue()
        clock = Clock(queue, 1e6, 0.97)
        assert clock.now() == 1e6
        due = clock.now() + 0.25
        queue.after(clock.until(due), lambda: None)
        queue.step()
        assert clock.now() == pytest.approx(due, abs=1e-9)
        assert clock.reached(due) >= due
        assert clock.now() >= due, "a clock does not go back"
        assert clock.until(due - 1.0) == 0.0


def reference_run() -> ReferenceRun:
    steps = tuple(
        ReferenceStep(
            0 if step == 0 else None,
            np.zeros(1),
            np.full(2, float(step)).tobytes(),
            -1.0,
            step == 2,
        )
        for step in range(3)
    )
    return ReferenceRun(steps, False, "digest")


class OneReference(ReferenceRuns):
    """A world in which whatever is sensed again leads to another end."""

    def __init__(self) -> None:
        pass

    def get(
        self, trial: int, max_steps: int, circumstances: Circumstances = UNDISTURBED
    ) -> ReferenceRun:
        return reference_run()._replace(digest=f"digest{circumstances.repeats or ''}")


def environment(*, shows_the_same: bool = False) -> EnvironmentModel:
    return EnvironmentModel(0, 3, OneReference(), shows_the_same=shows_the_same)


def result(steps: int, digest: str) -> TrialResult:
    return TrialResult(
        trial=0,
        seed=0,
        success=True,
        steps=steps,
        reward=-3.0,
        sensing_decisions=1,
        mean_sensing_ms=0.0,
        recoveries=0,
        unexplained_observations=0,
        digest=digest,
        sensing_ms=(),
    )


class TestEnvironmentModel:
    @pytest.mark.parametrize(
        ("shows_the_same", "ends"), [(True, "digest"), (False, "digest((0, 2),)")]
    )
    def test_what_is_sensed_again(self, shows_the_same: bool, ends: str) -> None:
        world = environment(shows_the_same=shows_the_same)
        for _ in range(3):
            world.sense(0, 0)
        for step in range(3):
            world.act(step, np.full(2, float(step)))
        world.check_end(result(3, ends), rewards_are_known=True)

    def test_another_end(self) -> None:
        world = environment()
        with pytest.raises(Violation, match="ended after 3 steps, 0 of which"):
            world.check_end(result(3, "digest"), rewards_are_known=True)
        world.begin_again([np.full(2, float(step)) for step in range(3)])
        with pytest.raises(Violation, match="digest of the decisions"):
            world.check_end(result(3, "another"), rewards_are_known=True)
        for changed in ({"success": False}, {"sensing_decisions": 2}, {"reward": -4.0}):
            said = msgspec.structs.replace(result(3, "digest"), **changed)
            with pytest.raises(Violation, match="the undisturbed run has"):
                world.check_end(said, rewards_are_known=True)
        world.check_end(said, rewards_are_known=False)
        with pytest.raises(Violation, match="has ended before"):
            world.act(3, np.zeros(2))


def request(epoch: int) -> bytes:
    return bytes(msgspec.msgpack.encode([2, b"s", epoch, 1])) + b"sum!"


def reply(tag: int) -> bytes:
    return bytes(msgspec.msgpack.encode([tag, 1])) + b"sum!"


class Wire(WireChecker):
    """One that is told of all that happens to a request."""

    def carry(self, call: int, payload: bytes, *, as_: bytes = b"") -> None:
        self.requested(call, payload)
        self.arrived("cloud-1", 1, call)
        self.taken("cloud-1", 1, call, as_ or payload)

    def answer(self, call: int, tag: int) -> None:
        self.replied("cloud-1", 1, call, reply(tag))


class TestWireChecker:
    def test_a_stale_epoch_is_not_answered(self) -> None:
        checker = Wire()
        for call, epoch in ((1, 1), (2, 2)):
            checker.carry(call, request(epoch))
        checker.answer(2, 1)
        checker.answer(1, 6)  # to refuse it is right
        with pytest.raises(Violation, match="of epoch 1, after one of epoch 2"):
            checker.answer(1, 1)

    def test_a_damaged_request_is_not_answered(self) -> None:
        checker = Wire()
        checker.carry(1, request(1), as_=request(3))
        checker.answer(1, 6)
        with pytest.raises(Violation, match="which was damaged"):
            checker.answer(1, 2)

    def test_an_end_is_the_end(self) -> None:
        checker = Wire()
        checker.carry(1, request(1))
        checker.ended("cloud-1", 1)
        with pytest.raises(Violation, match="after its end"):
            checker.answer(1, 1)
        with pytest.raises(Violation, match="ends call 1 again"):
            checker.ended("cloud-1", 1)

    def test_calls_are_ended_and_few(self) -> None:
        checker = Wire()
        checker.open_calls(8)
        with pytest.raises(Violation, match="9 calls open to one service: allowed are 8"):
            checker.open_calls(9)
        with pytest.raises(Violation, match="that it has not ended"):
            for call in range(1000):
                checker.carry(call, request(1))

    def test_other_robots_have_epochs_of_their_own(self) -> None:
        checker = Wire()
        other = bytes(msgspec.msgpack.encode([2, b"t", 1, 1])) + b"sum!"
        for call, payload in ((1, request(7)), (2, other)):
            checker.carry(call, payload)
            checker.answer(call, 1)


def test_what_grows_is_found_wherever_it_is() -> None:
    planner = Planner(PegInHole2D(), PlanningSettings())
    history = Trial(planner, 1, 0)
    check_size("the robot", history)
    history.sensing_ms += [1.0] * 600
    with pytest.raises(Violation, match="the robot holds a list of 600 entries"):
        check_size("the robot", [history])


def test_statuses() -> None:
    checker = StatusChecker()
    checker.heard("cloud-1", reply(1))
    checker.changed("standard", "local_recovery")
    for service, tag in (("local", 1), ("cloud-1", 3)):
        checker.heard(service, reply(tag))
        with pytest.raises(Violation, match="no service of the cloud has answered"):
            checker.changed("local_recovery", "keep_alive")
    checker.heard("cloud-1", reply(2))
    checker.changed("local_recovery", "keep_alive")
    for before, after in (("keep_alive", "standard"), ("standard", "local_recovery")):
        with pytest.raises(Violation, match="where the status was keep_alive"):
            checker.changed(before, after)


class TestMemory:
    def test_an_impure_function_is_found(self) -> None:
        class Impure(PegInHole2D):
            calls = 0

            def move(self, states: FloatArray, action: FloatArray, random: Stream) -> FloatArray:
                self.calls += 1
                return super().move(states, action + 0.01 * self.calls, random)

        planner = CheckedPlanner(Impure(), PlanningSettings())
        state = planner.init(1, 0)
        with pytest.raises(Violation, match="another state"):
            for _ in range(200):
                planner.advance(state, np.zeros(3))


class TestShrinking:
    def test_what_has_nothing_to_do_with_it_is_left_out(self) -> None:
        stop = Stop(node="robot", at=0.3, for_s=0.1)
        crash = Crash(service="cloud-1", at=0.5)
        noise = tuple(
            MessageFault(service="cloud-2", direction="to", number=number, what="drop")
            for number in range(40)
        )
        run = RunSettings(trial=9, replicas=3, deadline_ms=5.0, act_s=0.02)
        schedule = SimulationSchedule(run, (*noise[:20], stop, *noise[20:], crash))
        asked = []

        def fails(candidate: SimulationSchedule) -> bool:
            asked.append(candidate)
            return {stop, crash} <= set(candidate.faults) and candidate.run.act_s == 0.02

        assert shrink(schedule, fails) == SimulationSchedule(RunSettings(act_s=0.02), (stop, crash))
        assert len(asked) < 500
