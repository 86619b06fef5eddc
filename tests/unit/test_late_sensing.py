"""Sensing that takes time: on a thread, or by a world that shows it later."""

import threading
from typing import Any

import numpy as np
import pytest

from holdfast.errors import EnvironmentFailedError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.outcome import TrialResult
from holdfast.planning.planner import Planner
from holdfast.planning.settings import ParticleFilterSettings, PlanningSettings
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.problems.problem import Problem
from holdfast.robot.environment import LATER, Environment, Later, SimulatedEnvironment
from holdfast.robot.late_sensing import SenseInBackground
from holdfast.robot.trial import LateStep, SensingStep, TaskStep, TrialObserver, run_trial

PATIENCE_S = 30.0
"""Longest wait for what is sure to come; nothing is measured by it."""

ACTION = np.array([0.1, 0.0, 0.0])


class LateWorld(SimulatedEnvironment):
    """A simulated world whose observations come ``moves`` task actions later; 0 is at once."""

    def __init__(self, problem: Problem, seed: int, trial: int, moves: int) -> None:
        super().__init__(problem, seed, trial)
        self._moves = moves
        self._due: dict[int, tuple[int, FloatArray]] = {}

    def perform_sensing(self, sensing_action: int) -> FloatArray | Later:  # type: ignore[override]
        """Sense, and keep the observation until it is due."""
        shown = super().perform_sensing(sensing_action)
        if not self._moves:
            return shown
        self._due[self.step + self._moves] = self.step, shown
        return LATER

    def late_observations(self) -> list[tuple[int, FloatArray]]:
        """Return what is due after this move."""
        due = self._due.pop(self.step, None)
        return [] if due is None else [due]


def planner_of(interval: int = 2) -> Planner:
    settings = PlanningSettings(
        particle_filter=ParticleFilterSettings(num_particles=50), sensing_interval=interval
    )
    return Planner(PegInHole2D(), settings)


class Noting(TrialObserver):
    """Notes what was sensed, done and came late."""

    def __init__(self) -> None:
        self.sensed_at: list[int] = []
        self.late: list[tuple[int, int]] = []
        self.actions: list[bytes] = []

    def sensed(self, step: SensingStep) -> None:
        assert step.observation is None
        self.sensed_at.append(step.before.step)

    def acted(self, step: TaskStep) -> None:
        self.actions.append(step.executed.tobytes())

    def observed_late(self, step: LateStep) -> None:
        self.late.append((step.late.taken, step.after.step))


def run(environment: Environment, max_steps: int = 30) -> tuple[TrialResult, Noting]:
    noting = Noting()
    result = run_trial(
        planner_of(), 5, max_steps=max_steps, environment=environment, observer=noting
    )
    return result, noting


def world() -> SimulatedEnvironment:
    return SimulatedEnvironment(PegInHole2D(), 5, 0)


def late_world(moves: int) -> LateWorld:
    return LateWorld(PegInHole2D(), 5, 0, moves)


@pytest.mark.parametrize("moves", [1, 2, 3, 7])
def test_each_observation_comes_so_many_moves_later(moves: int) -> None:
    result, noting = run(late_world(moves))
    assert noting.sensed_at == list(range(0, result.steps, 3))
    assert noting.late == [
        (step, step + moves) for step in noting.sensed_at if step + moves <= result.steps
    ]
    again, _ = run(late_world(moves))
    assert again.digest == result.digest


def test_a_late_robot_gets_there_all_the_same() -> None:
    result, _ = run(late_world(3), 500)
    assert result.success


def test_no_reading_may_be_found_late() -> None:
    """The belief stays as it is; the observation just does not come."""

    class Blind(SimulatedEnvironment):
        def perform_sensing(self, sensing_action: int) -> Any:
            return None

    planner = planner_of()
    state, steps = planner.init(5), 21
    while state.step < steps:
        if planner.needs_sensing(state):
            state, _ = planner.observe(state, planner.choose_sensing_action(state)[0], None)
        state = planner.advance(state, planner.choose_task_action(state)[0])
    result, noting = run(SenseInBackground(Blind(PegInHole2D(), 5, 0)), steps)
    assert result.decisions is not None
    assert result.decisions.log.endswith(planner.digest(state))
    assert noting.late == []
    assert result.missing_observations == len(noting.sensed_at) == 7


def test_what_an_environment_keeps_may_change() -> None:
    """Its arrays are copied: they are folded in again after each late observation."""

    class Kept(SimulatedEnvironment):
        reuses = False

        def __init__(self) -> None:
            super().__init__(PegInHole2D(), 5, 0)
            self.late: dict[int, FloatArray] = {}
            self.buffer = np.zeros(1)

        def perform_sensing(self, sensing_action: int) -> Any:
            shown = super().perform_sensing(sensing_action)
            if self.step % 6 == 0:
                self.late[self.step + 4] = shown
                return LATER
            if not self.reuses:
                return shown
            self.buffer[:] = shown
            return self.buffer

        def perform(self, task_action: FloatArray) -> Any:
            result = super().perform(task_action)
            if self.reuses:
                task_action[:] = 0.0
            return result

        def late_observations(self) -> list[tuple[int, FloatArray]]:
            due = self.late.pop(self.step, None)
            return [] if due is None else [(self.step - 4, due)]

    digests = set()
    for Kept.reuses in (False, True):
        digests.add(run_trial(planner_of(), 5, max_steps=20, environment=Kept()).digest)
    assert len(digests) == 1


def test_what_waits_is_kept_as_it_came() -> None:
    """The environment shows the next observation in the same array."""
    buffer = np.zeros(1)

    class Reusing(SimulatedEnvironment):
        def perform_sensing(self, sensing_action: int) -> Any:
            buffer[:] = sensing_action
            return buffer

    robot = SenseInBackground(Reusing(PegInHole2D(), 5, 0))
    for sensing_action in (1, 2, 0):
        robot.perform_sensing(sensing_action)
    robot.perform(ACTION)
    robot.close()
    assert [np.asarray(shown)[0] for _, shown in robot.late_observations()] == [1.0, 2.0, 0.0]


class Slow:
    """A world whose sensing ends when it is told to."""

    def __init__(self) -> None:
        self.world = world()
        self.may_end = threading.Event()
        self.begun = threading.Semaphore(0)

    def perform_sensing(self, sensing_action: int) -> FloatArray:
        self.begun.release()
        assert self.may_end.wait(PATIENCE_S)
        return np.array([float(sensing_action)])

    def perform(self, task_action: FloatArray) -> float | None:
        self.world.perform(task_action)
        return None

    def is_done(self) -> bool:
        return False


def test_the_robot_moves_while_it_senses() -> None:
    slow = Slow()
    robot = SenseInBackground(slow)
    robot.perform(ACTION)
    assert robot.perform_sensing(1) is LATER
    for _ in range(3):
        robot.perform(ACTION)
        assert robot.late_observations() == []
    slow.may_end.set()
    # The next sensing action waits for this one.
    assert robot.perform_sensing(0) is LATER
    came: list[tuple[int, object]] = []
    while len(came) < 2:
        came += robot.late_observations()
    assert [(step, np.asarray(shown).tolist()) for step, shown in came] == [(1, [1.0]), (4, [0.0])]
    assert not hasattr(robot, "steps_performed")
    assert not robot.is_done()


def test_steps_that_the_robot_counts_are_its_own() -> None:
    inner = SimulatedEnvironment.after(PegInHole2D(), 5, 0, [ACTION] * 4)
    robot = SenseInBackground(inner)
    robot.perform_sensing(0)
    came: list[tuple[int, object]] = []
    while not came:
        came += robot.late_observations()
    assert came[0][0] == 4
    assert robot.steps_performed() == 4


def test_what_sensing_raises_is_heard() -> None:
    class Broken(Slow):
        def perform_sensing(self, sensing_action: int) -> FloatArray:
            raise OSError("the camera is unplugged")

    robot = SenseInBackground(Broken())
    robot.perform_sensing(0)
    message = "perform_sensing, begun at step 0 in the background, raised OSError: the camera is un"
    with pytest.raises(EnvironmentFailedError, match=message):
        robot.perform_sensing(1)


def test_it_is_closed_when_sensing_has_ended() -> None:
    """The next trial's robot is made after that: there is one robot."""
    ended: list[str] = []

    class Closed(Slow):
        def perform_sensing(self, sensing_action: int) -> FloatArray:
            shown = super().perform_sensing(sensing_action)
            ended.append("sensed")
            return shown

        def close(self) -> None:
            ended.append("closed")

    slow = Closed()
    robot = SenseInBackground(slow)
    robot.perform_sensing(0)
    threading.Timer(0.05, slow.may_end.set).start()
    robot.close()
    assert ended == ["sensed", "closed"]
    SenseInBackground(Slow()).close()
