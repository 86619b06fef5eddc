"""What of a choice depends on the units of the coordinates, as docs/results.md says.

The same problem, once in metres and radians, once with a coordinate in another unit. The same
beliefs, the same policy; so what is chosen ought to be the same. With a resolution for each
coordinate it is: in a unit that is a power of two of the old one to the last bit, for then
everything that holdfast computes is either the same or an exact multiple.
"""

from itertools import product
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pytest

from holdfast import _kernel
from holdfast.numerics.arrays import FloatArray, IntArray
from holdfast.numerics.randomness import Stream
from holdfast.planning import sensing
from holdfast.planning.planner import Planner
from holdfast.planning.settings import (
    ActiveSensingSettings,
    ParticleFilterSettings,
    PlanningSettings,
    SelectorSettings,
)
from holdfast.problems.capsule_robot import CapsuleRobot
from holdfast.problems.multitier_peg_in_hole_2d import MultitierPegInHole2D
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.problems.peg_in_hole_3d import PegInHole3D
from holdfast.problems.problem import ProblemBase
from holdfast.robot.environment import SimulatedEnvironment
from studies.light_dark import LightDark


class Rescaled(ProblemBase):
    """A problem whose coordinates have other units, and so have its resolutions and its noise."""

    def __init__(
        self,
        problem: ProblemBase,
        states: FloatArray,
        actions: FloatArray,
        resolution: float | FloatArray,
        *,
        observations: bool = False,
    ) -> None:
        self._own: Any = problem
        self._states, self._actions = states, actions
        self._observed = states if observations else np.ones_like(states)
        self.name = f"rescaled_{problem.name}"
        self.state_size = self.action_size = problem.state_size
        self.sensing_actions = problem.sensing_actions
        self.num_stages = problem.num_stages
        self.motion_variance = problem.motion_variance * actions**2
        self.resolution = resolution
        if not isinstance(resolution, float):
            self.resolution = resolution * actions
            self.state_resolution = resolution * states

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        return np.asarray(self._own.initial_states(stream, count) * self._states)

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        moved = self._own.move(states / self._states, actions / self._actions, stream)
        return np.asarray(moved * self._states)

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        mean = self._own.observation_mean(states / self._states, sensing_action)
        return np.asarray(mean * self._observed_unit(mean, sensing_action))

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        variance = self._own.observation_variance(states / self._states, sensing_action)
        return np.asarray(variance * self._observed_unit(variance, sensing_action) ** 2)

    def _observed_unit(self, observation: FloatArray, sensing_action: int) -> FloatArray:
        all_of_them = observation.shape[-1] == self.state_size
        return self._observed if all_of_them else self._observed[[sensing_action]]

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        return np.asarray(self._own.policy(states / self._states, stage) * self._actions)

    def limit_action(self, actions: FloatArray) -> FloatArray:
        return np.asarray(self._own.limit_action(actions / self._actions) * self._actions)

    def next_stage(self, estimates: FloatArray, stage: int | IntArray) -> int | IntArray:
        following: int | IntArray = self._own.next_stage(estimates / self._states, stage)
        return following

    def is_goal(self, states: FloatArray) -> npt.NDArray[np.bool_]:
        return np.asarray(self._own.is_goal(states / self._states))


class Choice(NamedTuple):
    """What was decided in a step of a trial, and in what order it finds the sensing actions."""

    sensing_action: int | None
    order: tuple[int, ...]
    task_action: bytes


PROBLEMS: dict[str, ProblemBase] = {
    "plane": PegInHole2D(),
    "space": PegInHole3D(),
    "three plates": MultitierPegInHole2D(),
    "capsule": CapsuleRobot(),
    "light and dark": LightDark(),
}

SELECTORS: dict[str, SelectorSettings] = {
    **{
        f"{method}, {estimator}": SelectorSettings(
            method=method,  # type: ignore[arg-type]
            estimator=estimator,  # type: ignore[arg-type]
        )
        for method, estimator in product(
            ("action_entropy", "path_entropy", "state_entropy"),
            (
                "nearest_neighbor",
                "prior_neighbors",
                "gaussian_mixture_upper",
                "gaussian_mixture_lower",
            ),
        )
    },
    "executed actions": SelectorSettings(
        method="action_entropy", estimator="nearest_neighbor", actions="executed"
    ),
    "action_covariance": SelectorSettings(method="action_covariance"),
}


QUICK = {"path_entropy, nearest_neighbor", "state_entropy, gaussian_mixture_upper"}
EACH_PROBLEM_AND_EACH_SELECTOR = pytest.mark.parametrize(
    ("name", "selector"),
    [
        pytest.param(
            *(name, selector),
            id=f"{name}, {how}",
            marks=[] if name == "plane" or how in QUICK else [pytest.mark.slow],
        )
        for name, (how, selector) in product(PROBLEMS, SELECTORS.items())
    ],
)
"""Quickly each problem with two ways of choosing, and each way with one problem."""


def choices_of(
    name: str,
    trial: int,
    selector: SelectorSettings,
    states: FloatArray | None = None,
    actions: FloatArray | None = None,
    *,
    observations: bool = False,
    horizon: int = 1,
) -> tuple[list[Choice], list[FloatArray]]:
    """Return what is decided in the beginning of a trial, in the old units, and the entropies."""
    own = PROBLEMS[name]
    ones = np.ones(own.state_size)
    states, actions = ones if states is None else states, ones if actions is None else actions
    # What the motion noise moves each coordinate by.
    resolution = np.sqrt(own.motion_variance)
    problem = Rescaled(own, states, actions, resolution, observations=observations)
    settings = PlanningSettings(
        particle_filter=ParticleFilterSettings(num_particles=100),
        active_sensing=ActiveSensingSettings(horizon=horizon, discount=0.5, num_cores=1),
        selector=selector,
        sensing_interval=2,
    )
    environment = SimulatedEnvironment(problem, 7, trial)
    planner = Planner(problem, settings)
    state = planner.init(7, trial)
    found, entropies = [], []
    while not environment.is_done() and state.step < 45:
        action, order = None, ()
        if planner.needs_sensing(state):
            action, info = planner.choose_sensing_action(state)
            assert info.entropies is not None
            order = tuple(np.argsort(info.entropies, kind="stable").tolist())
            entropies.append(info.entropies)
            shown = environment.perform_sensing(action)
            state, _ = planner.observe(state, action, shown)
        task_action, _ = planner.choose_task_action(state)
        environment.perform(task_action)
        state = planner.advance(state, task_action)
        found.append(Choice(action, order, (task_action / actions).tobytes()))
    return found, entropies


@EACH_PROBLEM_AND_EACH_SELECTOR
def test_the_same_bits_in_units_of_a_power_of_two(name: str, selector: SelectorSettings) -> None:
    """Each coordinate in turn: its states and its actions apart, what is observed with it or not.

    Where the variance of an observation depends on the state, the logarithm of that variance is
    part of the likelihood, and it rounds otherwise in another unit. So in light and dark what is
    observed keeps its unit.
    """
    size = PROBLEMS[name].state_size
    rng = np.random.default_rng(23)
    expected, before = choices_of(name, 0, selector)
    assert len({choice.sensing_action for choice in expected}) > 1
    for coordinate in range(size):
        states, actions = np.ones(size), np.ones(size)
        states[coordinate], actions[coordinate] = np.exp2(rng.integers(-30, 31, 2))
        observations = bool(rng.integers(2)) and name != "light and dark"
        found, after = choices_of(name, 0, selector, states, actions, observations=observations)
        assert found == expected
        if selector.method == "action_covariance":
            shift = 0.0
        else:
            of_states = selector.method == "state_entropy"
            shift = np.log((states if of_states else actions)[coordinate])
            if selector.method == "path_entropy":
                shift *= 1.5  # the entropy after the next look counts half
        # In the new units' own nats.
        for one, other in zip(before, after, strict=True):
            np.testing.assert_allclose(other, one + shift, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("selector", SELECTORS.values(), ids=SELECTORS.keys())
def test_the_choice_is_made_from_the_same_bits(
    selector: SelectorSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even where two entropies differ by rounding alone, which the orders above need not show."""
    found: list[bytes] = []

    class Recording:
        def __getattr__(self, name: str) -> Any:
            return getattr(_kernel, name)

        def hypothetical_entropies(self, *arguments: Any) -> Any:
            entropies, samples, *counts = _kernel.hypothetical_entropies(*arguments)
            found.append(entropies.tobytes() + samples.tobytes())
            return entropies, samples, *counts

    monkeypatch.setattr(sensing, "_kernel", Recording())
    choices_of("plane", 2, selector)
    expected, found = found, []
    units = np.array([2.0**7, 2.0**-13, 4.0])
    choices_of("plane", 2, selector, units, units[::-1].copy(), observations=True)
    assert len(found) > 5
    assert found == expected


@pytest.mark.parametrize("method", ["action_entropy", "state_entropy", "action_covariance"])
def test_the_same_bits_two_steps_ahead(method: str) -> None:
    selector = SelectorSettings(method=method)  # type: ignore[arg-type]
    expected, before = choices_of("plane", 1, selector, horizon=2)
    states, actions = np.array([8.0, 1.0, 2.0**-9]), np.array([1.0, 2.0**20, 0.25])
    found, after = choices_of("plane", 1, selector, states, actions, observations=True, horizon=2)
    assert found == expected
    shift = {
        "action_entropy": np.log(actions).sum(),
        "state_entropy": np.log(states).sum(),
        "action_covariance": 0.0,
    }[method]
    # The second entropy counts half.
    for one, other in zip(before, after, strict=True):
        np.testing.assert_allclose(other, one + 1.5 * shift, rtol=0.0, atol=1e-9)


@EACH_PROBLEM_AND_EACH_SELECTOR
def test_the_same_sensing_in_other_units(name: str, selector: SelectorSettings) -> None:
    """Millimetres and degrees round: what is sensed is the same here, task actions but nearly."""
    size = PROBLEMS[name].state_size
    units = np.where(np.arange(size) < (3 if size == 6 else 2), 1000.0, 180.0 / np.pi)
    expected, _ = choices_of(name, 1, selector)
    found, _ = choices_of(name, 1, selector, units, units, observations=True)
    assert [choice[:2] for choice in found] == [choice[:2] for choice in expected]
    for one, other in zip(expected, found, strict=True):
        np.testing.assert_allclose(
            np.frombuffer(other.task_action), np.frombuffer(one.task_action), rtol=0.0, atol=1e-9
        )
