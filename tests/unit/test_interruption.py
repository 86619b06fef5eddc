"""A computation ends at its next check, once nobody awaits it."""

import contextlib
import threading
import time
from typing import Any, get_args

import numpy as np
import pytest
from tests.fuzz.hostile_settings import with_key

from holdfast import _kernel
from holdfast.errors import InterruptedComputationError
from holdfast.numerics.randomness import Purpose, stream
from holdfast.planning.interruption import Interruption, check, interruptible
from holdfast.planning.planner import Planner
from holdfast.planning.settings import Method, PlanningSettings
from holdfast.problems.capsule_robot import CapsuleRobot


class Counting(CapsuleRobot):
    """Sets an interruption in the n-th call of its policy."""

    def __init__(self, last: int) -> None:
        super().__init__()
        self.interruption = Interruption()
        self.calls = 0
        self._last = last

    def policy(self, states: Any, stage: Any) -> Any:
        self.calls += 1
        if self.calls == self._last:
            self.interruption.set()
        return super().policy(states, stage)


def test_without_an_interruption_a_check_does_nothing() -> None:
    check()
    interruption = Interruption()
    with interruptible(interruption):
        check()
        interruption.set()
        with pytest.raises(InterruptedComputationError):
            check()
    check()


@pytest.mark.parametrize("method", ["expected_return", "path_entropy", "action_entropy"])
def test_a_long_decision_ends_after_few_more_calls(method: Method) -> None:
    assert method in get_args(Method)
    settings = with_key(PlanningSettings(), "selector.method", method)
    settings = with_key(settings, "selector.rollout_steps", 10_000)
    settings = with_key(settings, "selector.path_offsets", (0, 1000))
    if method != "path_entropy":
        settings = with_key(settings, "active_sensing.horizon", 1000)
    problem = Counting(20)
    planner = Planner(problem, settings, particles=50)
    with pytest.raises(InterruptedComputationError), interruptible(problem.interruption):
        planner.choose_sensing_action(planner.init(1))
    assert problem.calls <= 22


def test_rolling_a_state_forward_ends() -> None:
    problem = Counting(5)
    planner = Planner(problem, PlanningSettings(sensing_interval=5000), particles=20)
    state = planner.init(1)._replace(sensed=True)
    with pytest.raises(InterruptedComputationError), interruptible(problem.interruption):
        planner.plan_until_sensing(state, 10_000)
    assert problem.calls <= 6


def test_an_interruption_that_is_not_set_changes_no_decision() -> None:
    planner = Planner(CapsuleRobot(), method="expected_return", particles=50)
    state = planner.init(3)
    expected, info = planner.choose_sensing_action(state)
    with interruptible(Interruption()):
        found, again = planner.choose_sensing_action(state)
    assert found == expected
    assert info.entropies is not None
    assert again.entropies is not None
    assert info.entropies.tobytes() == again.entropies.tobytes()


@pytest.mark.parametrize("threads", [1, 2])
def test_the_kernel_ends_between_its_tasks(threads: int) -> None:
    points, rows = np.arange(600.0).reshape(200, 3), np.zeros((40, 200))
    arguments = (points, rows, True, 0, 5, 1e-3, 0.0, 0.0, threads, (1.0,), np.empty(0), True)
    expected = _kernel.entropies(*arguments)[0]
    interruption = Interruption()
    before = _kernel.use_threads_from(0.0)
    try:
        with interruptible(interruption):
            assert _kernel.entropies(*arguments)[0].tobytes() == expected.tobytes()
        interruption.set()
        with pytest.raises(InterruptedComputationError), interruptible(interruption):
            _kernel.entropies(*arguments)
        assert _kernel.entropies(*arguments)[0].tobytes() == expected.tobytes()
    finally:
        _kernel.use_threads_from(before)


def test_a_computation_ends_once_its_thread_has_computed_for_so_long() -> None:
    planner = Planner(CapsuleRobot(), particles=50)
    state = planner.init(3)
    for most_s in (0.0, 3600.0):
        interruption = Interruption(most_s)
        with contextlib.suppress(InterruptedComputationError), interruptible(interruption):
            check()
            interruption.start_clock()
            planner.choose_sensing_action(state)
        assert interruption.took_too_long == (most_s == 0.0)
        assert interruption.is_set == interruption.took_too_long


def compute_for(seconds: float) -> None:
    began = time.thread_time()
    while time.thread_time() < began + seconds:
        pass


def test_only_what_its_own_thread_computes_counts() -> None:
    interruption = Interruption(0.05)
    with interruptible(interruption):
        interruption.start_clock()
        other = threading.Thread(target=compute_for, args=(0.1,))
        other.start()
        other.join()
        check()
        compute_for(0.06)
        with pytest.raises(InterruptedComputationError, match=r"takes more than 0\.05 s"):
            check()


def interruption_error(interruption: Interruption) -> None:
    with interruptible(interruption):
        interruption.start_clock()
        check()


def test_one_that_is_set_before_its_time_is_over_was_not_too_long() -> None:
    interruption = Interruption(0.0)
    interruption.set()
    with pytest.raises(InterruptedComputationError, match="nobody awaits"):
        interruption_error(interruption)
    assert not interruption.took_too_long


@pytest.mark.parametrize("placed", ["before a wall", "in a wall"])
def test_few_particles_among_many_obstacles_leave_the_interpreter(placed: str) -> None:
    """Nothing of it would end while another thread could not set the interruption.

    In a wall, each of a thousand attempts to place the noise of one block of particles takes long.
    """
    elsewhere = {"end_0": [100.0, 100.0], "end_1": [100.0, 101.0]}
    wall: Any = {"end_0": [-1000.0, -9.0], "end_1": [-1000.0, 9.0]}
    model: Any = {"walls": [elsewhere] * 9000 + [wall]}
    states, action = np.tile([-1001.0, 0.0], (1000, 1)), np.array([1.0, 0.0])
    if placed == "in a wall":
        wall = {"end_0": [-1000.0, 0.0], "end_1": [-1000.0, 3.0], "thickness": 500.0}
        model = {"walls": [elsewhere] * 3000 + [wall], "motion_cov": [1e-12, 1e-12]}
        states, action = np.tile([-1000.0, 1.0], (128, 1)), np.zeros(2)
    problem = CapsuleRobot.from_settings(model, {})
    interruption = Interruption()
    other = threading.Timer(0.02, interruption.set)
    other.start()
    with pytest.raises(InterruptedComputationError), interruptible(interruption):
        problem.move(states, action, stream(0, 0, 0, Purpose.PREDICTION))
    other.join()
