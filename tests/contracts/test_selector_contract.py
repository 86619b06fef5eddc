"""What every way of choosing a sensing action promises, on every registered problem.

The promises: a valid index; a function of its arguments alone, to the last bit, whatever the number
of threads; nothing changed that was handed in; finite entropies even where a belief has collapsed.
"""

import itertools
from typing import Any, get_args

import msgspec
import numpy as np
import pytest

from holdfast.config import registry
from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.randomness import Purpose, stream
from holdfast.planning.belief import Belief
from holdfast.planning.sensing import SensingInfo, choose_sensing_action
from holdfast.planning.settings import (
    ENTROPY_METHODS,
    UNINFORMED_METHODS,
    ActiveSensingSettings,
    Estimator,
    ParticleFilterSettings,
    PlanningSettings,
    SelectorSettings,
)
from holdfast.problems.problem import Problem

SEED = 17
COUNT = 60
BELIEFS: dict[tuple[Any, int], Belief] = {}

LOOKING = [
    SelectorSettings(
        method=method,
        estimator=estimator,
        actions=actions,  # type: ignore[arg-type]
        resolution=0.05,
    )
    for method, estimator, actions in itertools.product(
        sorted(ENTROPY_METHODS), get_args(Estimator), ("commanded", "executed")
    )
]
LOOKING += [
    SelectorSettings(method="action_covariance", actions=actions)
    for actions in ("commanded", "executed")
]
LOOKING += [
    # Long enough for the capsule, whose rewards are all zero unless it hits a wall.
    SelectorSettings(
        method="expected_return",
        rollout_reward="steps",
        rollout_steps=400,
        max_observation_samples=4,
    )
]
SELECTORS = [
    *LOOKING,
    SelectorSettings(method="action_entropy", estimator="nearest_neighbor"),
    SelectorSettings(method="random"),
    SelectorSettings(method="fixed", sensing_action=1),
]


def describe(selector: SelectorSettings) -> str:
    if selector.method in UNINFORMED_METHODS:
        return selector.method
    resolution = "" if selector.resolution else "default "
    return f"{resolution}{selector.method} {selector.estimator} {selector.actions}"


@pytest.fixture(scope="module", params=registry.names())
def problem(request: pytest.FixtureRequest) -> Problem:
    built = registry.problem_class(request.param).from_settings({}, {})
    assert isinstance(built, Problem)
    return built


def settings_of(
    selector: SelectorSettings, *, cores: int = 1, horizon: int = 1
) -> PlanningSettings:
    return PlanningSettings(
        particle_filter=ParticleFilterSettings(num_particles=COUNT),
        active_sensing=ActiveSensingSettings(
            horizon=horizon, num_observation_samples=4, num_cores=cores
        ),
        selector=selector,
    )


def belief_of(problem: Problem, count: int = COUNT) -> Belief:
    """Return the same belief each time; nobody can change it."""
    if (problem, count) not in BELIEFS:
        BELIEFS[problem, count] = made_belief(problem, count)
    return BELIEFS[problem, count]


def made_belief(problem: Problem, count: int) -> Belief:
    """Return a belief on the way, where limited actions differ too."""
    draws = stream(SEED, 0, 0, Purpose.INITIAL_BELIEF)
    states = problem.initial_states(draws, count)
    for step in range(40):
        actions = problem.limit_action(problem.policy(states, 0))
        states = problem.move(states, actions, draws.substream(2).substream(step))
    weights = draws.substream(1).uniform(count)
    weights[::7] = 0.0
    belief = Belief.weighted(states, weights)
    for array in belief:
        array.setflags(write=False)
    return belief


def choose(
    problem: Problem, settings: PlanningSettings, belief: Belief, step: int = 0
) -> tuple[int, SensingInfo]:
    hypotheses = stream(SEED, 0, step, Purpose.HYPOTHESES)
    selection = stream(SEED, 0, step, Purpose.SELECTION)
    return choose_sensing_action(problem, settings, belief, 0, hypotheses, selection)


def as_bytes(chosen: tuple[int, SensingInfo]) -> tuple[int, bytes, bytes]:
    index, info = chosen
    entropies = b"" if info.entropies is None else info.entropies.tobytes()
    return index, entropies, b"" if info.samples is None else info.samples.tobytes()


@pytest.mark.parametrize("selector", SELECTORS, ids=describe)
class TestEverySelector:
    def test_form(self, problem: Problem, selector: SelectorSettings) -> None:
        count = len(problem.sensing_actions)
        index, info = choose(problem, settings_of(selector), belief_of(problem))
        assert type(index) is int
        assert 0 <= index < count
        if selector.method in UNINFORMED_METHODS:
            assert info == SensingInfo(None, None, 0, 0)
            return
        assert info.entropies is not None
        assert info.samples is not None
        assert info.entropies.shape == (count,)
        assert info.samples.shape == (count, 4)
        assert np.isfinite(info.samples).all()
        np.testing.assert_allclose(info.entropies, info.samples.mean(axis=1), rtol=1e-12)
        assert info.entropies[index] == info.entropies.min()

    def test_a_function_of_its_arguments(
        self, problem: Problem, selector: SelectorSettings
    ) -> None:
        settings, belief = settings_of(selector), belief_of(problem)
        first = as_bytes(choose(problem, settings, belief))
        choose(problem, settings, belief, step=1)
        again = Belief(belief.states.copy(), belief.weights.copy())
        assert as_bytes(choose(problem, settings, again)) == first
        if selector.method not in UNINFORMED_METHODS:
            assert as_bytes(choose(problem, settings, belief, step=1))[2] != first[2]

    def test_nothing_is_changed(self, problem: Problem, selector: SelectorSettings) -> None:
        belief = belief_of(problem)
        before = belief.states.tobytes(), belief.weights.tobytes()
        horizon = 1 if selector.method == "path_entropy" else 2
        _, info = choose(problem, settings_of(selector, horizon=horizon), belief)
        assert (belief.states.tobytes(), belief.weights.tobytes()) == before
        for found in (info.entropies, info.samples):
            assert found is None or not any(np.shares_memory(found, own) for own in belief)

    def test_threads_change_nothing(self, problem: Problem, selector: SelectorSettings) -> None:
        belief = belief_of(problem, 600)
        results = {
            as_bytes(choose(problem, settings_of(selector, cores=cores), belief))
            for cores in (0, 1, 7)
        }
        assert len(results) == 1

    def test_collapsed_beliefs(self, problem: Problem, selector: SelectorSettings) -> None:
        """All particles alike, or all weight on one: all is finite, ties go low or are drawn."""
        states = belief_of(problem).states
        one_weight = np.zeros(COUNT)
        one_weight[5] = 1.0
        copies: FloatArray = np.repeat(states[3:4], COUNT, axis=0)
        for belief in (Belief.uniform(copies), Belief(states, one_weight)):
            index, info = choose(problem, settings_of(selector), belief)
            entropies = info.entropies
            if entropies is not None:
                assert np.isfinite(entropies).all()
                np.testing.assert_allclose(entropies, entropies[0], rtol=1e-12)
                assert index == 0 or selector.method == "expected_return"


@pytest.mark.parametrize("selector", SELECTORS, ids=describe)
def test_sensing_may_be_left_out(problem: Problem, selector: SelectorSettings) -> None:
    """One choice more, of which nothing else depends; it wins if sensing is dear enough."""
    count, belief = len(problem.sensing_actions), belief_of(problem)
    optional = msgspec.structs.replace(selector, sensing_is_optional=True)
    results = {
        as_bytes(choose(problem, settings_of(optional, cores=cores), belief)) for cores in (1, 3)
    }
    assert len(results) == 1
    index, info = choose(problem, settings_of(optional), belief)
    assert type(index) is int
    assert 0 <= index <= count
    if selector.method in UNINFORMED_METHODS:
        assert info == SensingInfo(None, None, 0, 0)
        return
    assert info.samples is not None
    assert info.samples.shape == (count + 1, 4)
    assert np.isfinite(info.samples).all()
    if selector.method == "expected_return":
        return  # Whose price is the problem's; the mean of later ones is another, too.
    _, without = choose(problem, settings_of(selector), belief)
    assert without.samples is not None
    np.testing.assert_array_equal(info.samples[:count], without.samples)
    dear = msgspec.structs.replace(optional, nats_per_cost=1e3)
    assert choose(problem, settings_of(dear), belief)[0] == count


@pytest.mark.parametrize("selector", [LOOKING[index] for index in (0, 2, 6, 21)], ids=describe)
def test_horizon(problem: Problem, selector: SelectorSettings) -> None:
    """A longer horizon adds to what the next step's entropy is."""
    belief = belief_of(problem)
    _, near = choose(problem, settings_of(selector), belief)
    _, far = choose(problem, settings_of(selector, horizon=3), belief)
    assert near.samples is not None
    assert far.samples is not None
    assert np.isfinite(far.samples).all()
    assert np.abs(far.samples - near.samples).max() > 1e-3
    nothing_later = msgspec.structs.replace(
        settings_of(selector, horizon=3),
        active_sensing=msgspec.structs.replace(
            settings_of(selector, horizon=3).active_sensing, discount=0.0
        ),
    )
    _, discounted = choose(problem, nothing_later, belief)
    assert discounted.samples is not None
    np.testing.assert_array_equal(discounted.samples, near.samples)
