"""The steps ahead of all hypothetical beliefs at once, against one belief after the other.

The reference is how they were computed before: the same functions, called for a single belief. The
results are equal to the last bit, for every problem, estimate and number of threads.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from benchmarks.horizon import one_by_one
from tests.golden.sonar_room import SonarRoom

from holdfast.config import registry
from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.randomness import Purpose, Stream, stream
from holdfast.planning import sensing
from holdfast.planning.belief import Belief
from holdfast.planning.sensing import choose_sensing_action
from holdfast.planning.settings import (
    ActiveSensingSettings,
    ParticleFilterSettings,
    PlanningSettings,
    SelectorSettings,
)
from holdfast.problems import checked
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from studies.busy_room import BusyRoom
from studies.light_dark import LightDark

PROBLEMS: dict[str, Callable[[], Any]] = {
    **{
        name: lambda name=name: registry.problem_class(name).from_settings({}, {})  # type: ignore[misc]
        for name in registry.names()
    },
    "light_dark": LightDark,
    "busy_room": BusyRoom,
    "sonar_room": SonarRoom,
}
SELECTORS = [
    SelectorSettings(method="action_entropy", estimator="nearest_neighbor"),
    SelectorSettings(
        method="action_entropy", estimator="gaussian_mixture_upper", actions="executed"
    ),
    SelectorSettings(method="state_entropy"),
    SelectorSettings(method="action_covariance"),
]


def on_the_way(problem: Any, count: int) -> tuple[Belief, int]:
    """Return a belief of unequal weights, some steps after the start, and its stage."""
    draws = stream(61, 0, 0, Purpose.INITIAL_BELIEF)
    states = problem.initial_states(draws, count)
    stage = 0
    for step in range(42):
        mean = states.mean(axis=0)
        stage = checked.next_stage(problem, mean, stage)
        action = problem.limit_action(problem.policy(mean, stage))
        states = problem.move(states, action, draws.substream(2).substream(step))
    weights = draws.substream(1).uniform(count)
    weights[::7] = 0.0
    return Belief.weighted(states, weights), stage


def settings_of(
    selector: SelectorSettings, threads: int = 1, estimates: str = "mean"
) -> PlanningSettings:
    return PlanningSettings(
        particle_filter=ParticleFilterSettings(num_particles=60, estimate=estimates),  # type: ignore[arg-type]
        active_sensing=ActiveSensingSettings(
            horizon=4, discount=0.7, num_observation_samples=3, num_cores=threads
        ),
        selector=selector,
    )


def samples_of(problem: Any, settings: PlanningSettings, belief: Belief, stage: int) -> bytes:
    hypotheses = stream(61, 0, 0, Purpose.HYPOTHESES)
    selection = stream(61, 0, 0, Purpose.SELECTION)
    _, info = choose_sensing_action(problem, settings, belief, stage, hypotheses, selection)
    assert info.samples is not None
    return info.samples.tobytes()


@pytest.mark.parametrize("name", PROBLEMS)
@pytest.mark.parametrize("selector", SELECTORS, ids=lambda each: f"{each.method} {each.estimator}")
def test_every_problem(
    name: str, selector: SelectorSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = PROBLEMS[name]()
    belief, stage = on_the_way(problem, 60)
    for estimates in ("mean", "most_likely"):
        together = {
            samples_of(problem, settings_of(selector, threads, estimates), belief, stage)
            for threads in (1, 2, 0)
        }
        with monkeypatch.context() as patched:
            patched.setattr(sensing, "_later_entropies", one_by_one)
            alone = samples_of(problem, settings_of(selector, 1, estimates), belief, stage)
        assert together == {alone}


@pytest.mark.parametrize("largest", [1, 400, 10**9])
def test_blocks_change_nothing(largest: int, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = PROBLEMS["peg_in_hole_2d"]()
    belief, stage = on_the_way(problem, 60)
    usual = samples_of(problem, settings_of(SELECTORS[0]), belief, stage)
    monkeypatch.setattr(sensing, "_LARGEST_BLOCK", largest)
    assert samples_of(problem, settings_of(SELECTORS[0]), belief, stage) == usual


def test_stages_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Some hypothetical beliefs have reached the light, and others have not."""
    asked: list[set[int]] = []
    draws = stream(62, 0, 0, Purpose.INITIAL_BELIEF)
    belief = Belief.uniform(np.array([4.8, 0.0]) + 0.3 * draws.normal((60, 2)))
    by_stage = sensing._points_by_stage

    def noted(points_of: Any, states: FloatArray, stages: Any) -> FloatArray:
        asked.append(set(stages))
        return by_stage(points_of, states, stages)

    monkeypatch.setattr(sensing, "_points_by_stage", noted)
    together = samples_of(LightDark(), settings_of(SELECTORS[0]), belief, 0)
    assert {0, 1} in asked
    monkeypatch.setattr(sensing, "_later_entropies", one_by_one)
    assert samples_of(LightDark(), settings_of(SELECTORS[0]), belief, 0) == together


def test_who_moves_otherwise_does_not_inherit_the_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    class Slow(PegInHole2D):
        def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
            return super().move(states, 0.5 * actions, stream)

    belief, stage = on_the_way(PegInHole2D(), 60)
    together = samples_of(Slow(), settings_of(SELECTORS[0]), belief, stage)
    assert together != samples_of(PegInHole2D(), settings_of(SELECTORS[0]), belief, stage)
    monkeypatch.setattr(sensing, "_later_entropies", one_by_one)
    assert samples_of(Slow(), settings_of(SELECTORS[0]), belief, stage) == together
