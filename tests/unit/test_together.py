"""Several states decided at once: the bits are those of each alone."""

import numpy as np
import pytest

from holdfast.config.registry import BUILT_IN, problem_class
from holdfast.errors import InvalidValueError, ProblemError
from holdfast.planning.planner import Planner, PlanningState, digest
from holdfast.planning.settings import Method, PlanningSettings
from holdfast.planning.together import (
    can_decide_together,
    choose_together,
    observe_together,
    plan_together,
)
from holdfast.problems import checked
from holdfast.problems.peg_in_hole_2d import PegInHole2D

METHODS: tuple[Method, ...] = (
    *("path_entropy", "action_entropy", "state_entropy", "action_covariance", "random"),
)


def planner_of(name: str, method: Method = "path_entropy") -> Planner:
    settings = PlanningSettings(sensing_interval=2)
    return Planner(problem_class(name).from_settings({}, {}), settings, particles=40, method=method)


def observations_of(
    planner: Planner, states: list[PlanningState], actions: list[int]
) -> list[np.ndarray]:
    """Return what the first particles would show, and for one state what none would."""
    shown = [
        checked.prediction(planner.problem, state.belief.states[0], action)[0]
        for state, action in zip(states, actions, strict=True)
    ]
    return [shown[0] + 1e3, *shown[1:]]


@pytest.mark.parametrize("name", BUILT_IN)
@pytest.mark.parametrize("method", METHODS)
def test_same_bits_as_alone(name: str, method: Method) -> None:
    planner = planner_of(name, method)
    assert can_decide_together(planner)
    states = [planner.init(5 + number, number) for number in range(5)]
    for _ in range(3):
        actions = [planner.choose_sensing_action(state)[0] for state in states]
        assert choose_together(planner, states) == actions
        observations = observations_of(planner, states, actions)
        alone = [
            planner.observe(*each)[0] for each in zip(states, actions, observations, strict=True)
        ]
        together = observe_together(planner, states, actions, observations)
        assert [digest(state) for state in together] == [digest(state) for state in alone]
        # The last has less to go, and one is where it has to sense first.
        begun = [*alone[:-1], planner.plan_until_sensing(alone[-1], 1)[1], states[0]]
        planned = plan_together(planner, begun, 100)
        for state, (path, ahead) in zip(begun, planned, strict=True):
            own_path, own_ahead = planner.plan_until_sensing(state, 100)
            assert np.array(path).tobytes() == np.array(own_path).tobytes()
            assert digest(ahead) == digest(own_ahead)
            assert ahead.belief.states.base is None, "it would keep the particles of all"
            assert not ahead.belief.states.flags.writeable
        states = [ahead for _, ahead in planned[:-1]]


def test_users_problems_are_asked_one_by_one() -> None:
    class Own(PegInHole2D):
        """A policy of its own may have other bits in company."""

    assert not can_decide_together(Planner(Own()))


def test_what_goes_wrong_raises() -> None:
    planner = planner_of("peg_in_hole_2d")
    vars(planner.problem)["policy"] = lambda states, _: np.full(states.shape, np.nan)
    states = [planner.observe(planner.init(5), 0, None)[0]] * 2
    with pytest.raises(ProblemError, match="not finite"):
        plan_together(planner, states, 1)


@pytest.mark.parametrize("shown", [[0.1], [0.1, 0.1, 0.1], [np.nan, 0.1], [0.1, np.inf]])
def test_observations_that_are_refused_alone(shown: list[float]) -> None:
    planner = planner_of("capsule_robot")
    observations = [np.array(shown)] * 2
    states = [planner.init(seed) for seed in range(2)]
    with pytest.raises(InvalidValueError):
        planner.observe(states[0], 0, observations[0])
    with pytest.raises(InvalidValueError):
        observe_together(planner, states, [0, 0], observations)
