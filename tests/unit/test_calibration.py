"""What a service measures of its machine and of problems; no number of seconds is expected."""

from typing import Any

import numpy as np
import pytest

from holdfast.config import registry
from holdfast.config.registry import BUILT_IN
from holdfast.errors import InvalidValueError
from holdfast.problems.capsule_robot import CapsuleRobot
from holdfast.protocol.decision_cost import TYPICAL_PROBLEM
from holdfast.service import calibration
from holdfast.service.calibration import measure_problem, measure_slowness


class Clock:
    """Seconds that a problem's functions spend."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


class Slow(CapsuleRobot):
    """Its policy takes a microsecond for each state, and ten for a call."""

    def __init__(self, clock: Clock, state_s: float = 1e-7, call_s: float = 1e-5) -> None:
        super().__init__()
        self._clock = clock
        self._state_s, self._call_s = state_s, call_s
        self.asked = 0

    def policy(self, states: Any, stage: Any) -> Any:
        count = states.size // self.state_size
        self.asked += count
        self._clock.now += self._call_s + count * self._state_s
        return super().policy(states, stage)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(calibration, "thread_time", clock)
    return clock


@pytest.mark.parametrize("name", BUILT_IN)
def test_built_in_problems_are_measured(name: str) -> None:
    found = measure_problem(registry.problem_class(name).from_settings({}, {}))
    assert found != TYPICAL_PROBLEM
    assert found.move.of(300.0) > 0.0
    assert 1 <= found.observation_size <= 6


def test_calls_and_states_are_told_apart(clock: Clock) -> None:
    found = measure_problem(Slow(clock))
    assert found.act.state_s == pytest.approx(1e-7)
    assert found.act.call_s == pytest.approx(1e-5)
    assert found.move == (0.0, 0.0)


def test_a_slow_function_is_asked_seldom(clock: Clock) -> None:
    quick, slow = Slow(clock), Slow(clock, state_s=1e-3)
    found = measure_problem(slow)
    measure_problem(quick)
    assert found.act.state_s == pytest.approx(1e-3, rel=0.1)
    assert slow.asked < quick.asked / 10


def test_of_many_sensing_actions_some_are_asked() -> None:
    asked = set()

    class Many(CapsuleRobot):
        def observation_mean(self, states: Any, sensing_action: int) -> Any:
            asked.add(sensing_action)
            return super().observation_mean(states, 0)

    problem = Many()
    for count in (1, 16, 17, 10_000):
        asked.clear()
        problem.sensing_actions = tuple(map(str, range(count)))
        measure_problem(problem)
        assert 1 <= len(asked) <= 16
        assert max(asked) < count


def test_a_problem_that_fails_is_typical_from_there_on() -> None:
    class Broken(CapsuleRobot):
        def move(self, states: Any, actions: Any, stream: Any) -> Any:
            raise ZeroDivisionError

    found = measure_problem(Broken())
    assert found.move == TYPICAL_PROBLEM.move
    assert found.act != TYPICAL_PROBLEM.act


def test_a_problem_without_an_initial_state_is_refused() -> None:
    class Nowhere(CapsuleRobot):
        def initial_states(self, stream: Any, count: int) -> Any:
            raise InvalidValueError("model.init_mean: no place")

    with pytest.raises(InvalidValueError, match="no place"):
        measure_problem(Nowhere())


def test_what_it_takes_to_try_counts_where_some_states_find_no_place(clock: Clock) -> None:
    class Narrow(CapsuleRobot):
        def initial_states(self, stream: Any, count: int) -> Any:
            clock.now += 1e-4 * count
            if count > 16:
                raise InvalidValueError("model.init_mean: no place for some")
            return super().initial_states(stream, count)

    found = measure_problem(Narrow())
    assert found.initial.state_s >= 1e-4
    assert found.act == (0.0, 0.0), "the others are measured"


def test_a_general_likelihood_is_measured(clock: Clock) -> None:
    class General(CapsuleRobot):
        def log_likelihood(self, states: Any, sensing_action: int, observation: Any) -> Any:
            clock.now += 1e-6 * len(states)
            return np.zeros(len(states))

        def sample_observation(self, state: Any, sensing_action: int, stream: Any) -> Any:
            clock.now += 1e-5
            return np.zeros(7)

    found = measure_problem(General())
    assert found.observation_size == 7
    assert found.sense.state_s == pytest.approx(1e-6)

    class Together(General):
        def log_likelihoods(self, states: Any, sensing_action: int, observations: Any) -> Any:
            clock.now += 4e-6 * len(states)
            return np.zeros((len(observations), len(states)))

    found = measure_problem(Together())
    assert found.observation_size == 7
    assert found.sense.state_s == pytest.approx(4e-6 / calibration._BATCH)
    assert found.sense.call_s == pytest.approx(1e-5)


def test_the_machine_is_compared_with_the_one_of_the_model(
    monkeypatch: pytest.MonkeyPatch, clock: Clock
) -> None:
    def work(*_: object) -> None:
        clock.now += 3.0 * calibration._REFERENCE_S

    assert measure_slowness() == calibration._LEAST, "no time at all"
    monkeypatch.setattr(calibration, "_work", work)
    assert measure_slowness() == pytest.approx(3.0)
