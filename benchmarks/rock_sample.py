"""RockSample[7,8]: what to check and when, beside the planners of POMDPPlanners.

A rover crosses a plane of 7 x 7 cells and leaves it in the east. Eight rocks are good or bad with
equal chances; a sample of a good one earns 10, of a bad one -10, the exit 10, discounted by 0.95 a
step. To check a rock from d cells away takes a step and is right with probability
(1 + 2**(-d / 20)) / 2 (Smith and Simmons, "Heuristic search value iteration for POMDPs", UAI 2004;
the places of Silver and Veness, "Monte-Carlo planning in large POMDPs", NeurIPS 2010).

Cast as a sensing problem, a check is a sensing action; the policy takes rocks that are more likely
good than not for good, and follows the best tour of these. ::

    pip install POMDPPlanners==0.6.0    # for its two planners; without it the others are run
    python -m benchmarks.rock_sample --out docs/results/other_worlds/rock_sample.csv

Trials of seed 2026 judge, those of ``--seed 2025`` chose how often each way checks. The rivals are
given the exact belief, and as many simulations as take a second of processor time.
"""

from __future__ import annotations

import logging
import random
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np

from benchmarks import trial_table
from holdfast import numerics
from holdfast.numerics.arrays import BoolArray, FloatArray, IntArray
from holdfast.numerics.randomness import Stream
from holdfast.planning.planner import Planner
from holdfast.planning.settings import (
    ActiveSensingSettings,
    ParticleFilterSettings,
    PlanningSettings,
    SelectorSettings,
)
from holdfast.problems.problem import ProblemBase

COLUMNS = ("discounted_reward", "steps", "checks", "decision_s")
SIZE, START, DISCOUNT, MOST_STEPS = 7, (0, 3), 0.95, 100
ROCKS = np.array([(2, 0), (0, 1), (3, 1), (6, 3), (2, 4), (3, 4), (5, 5), (1, 6)])
HALF_DISTANCE = 20.0
GOOD, EXIT = 10.0, 10.0
LIKELY = 0.45
"""Share of the belief from which on a rock is taken for good: one that is unknown is worth a way,
for a check beside it does not err."""
SAMPLE, NORTH, EAST, SOUTH, WEST, CHECK = range(6)
"""Numbers of actions; those of checks begin with the last one."""
STEPS = {NORTH: (0, -1), EAST: (1, 0), SOUTH: (0, 1), WEST: (-1, 0)}


class World:
    """A trial: all ways meet the same rocks, and the same noise at the same step."""

    def __init__(self, seed: int, trial: int) -> None:
        draws = np.random.default_rng([seed, trial])
        self.good = draws.integers(0, 2, len(ROCKS)).astype(bool)
        self.noise = draws.random(MOST_STEPS)
        self.place = np.array(START)
        self.steps = self.checks = 0
        self.reward = 0.0

    @property
    def over(self) -> bool:
        return self.place[0] == SIZE or self.steps == MOST_STEPS

    def accuracy(self, rock: int) -> float:
        return float(_accuracy(self.place, rock))

    def act(self, action: int) -> bool | None:
        """Take a step; return whether a check says good."""
        gained, shown = 0.0, None
        if action >= CHECK:
            rightly = self.noise[self.steps] < self.accuracy(action - CHECK)
            shown = bool(self.good[action - CHECK] == rightly)
            self.checks += 1
        elif action == SAMPLE:
            for rock in np.flatnonzero((self.place == ROCKS).all(axis=1)):
                gained = GOOD if self.good[rock] else -GOOD
                self.good[rock] = False
        else:
            moved = self.place + STEPS[action]
            if moved[0] == SIZE:
                gained = EXIT
            if moved[0] in range(SIZE + 1) and moved[1] in range(SIZE):
                self.place = moved
        self.reward += DISCOUNT**self.steps * gained
        self.steps += 1
        return shown


def _accuracy(places: FloatArray | IntArray, rock: int) -> FloatArray:
    away = places - ROCKS[rock]
    return np.asarray(0.5 + 0.5 * 2.0 ** (-np.sqrt((away * away).sum(axis=-1)) / HALF_DISTANCE))


@cache
def tours() -> tuple[FloatArray, IntArray]:
    """Return the value of each cell for each set of good rocks, and where to go from there.

    Shape (256, 7, 7); rock ``len(ROCKS)`` is the exit.
    """
    x, y = np.meshgrid(np.arange(SIZE), np.arange(SIZE), indexing="ij")
    values = np.empty((2 ** len(ROCKS), SIZE, SIZE))
    targets = np.empty(values.shape, dtype=np.int64)
    for rocks in range(len(values)):
        best, target = EXIT * DISCOUNT ** (SIZE - 1.0 - x), np.full(x.shape, len(ROCKS))
        for rock, (rock_x, rock_y) in enumerate(ROCKS):
            if rocks >> rock & 1:
                then = GOOD + DISCOUNT * values[rocks - 2**rock, rock_x, rock_y]
                value = then * DISCOUNT ** (np.abs(x - rock_x) + np.abs(y - rock_y))
                target = np.where(value > best, rock, target)
                best = np.maximum(value, best)
        values[rocks], targets[rocks] = best, target
    return values, targets


class RockSample(ProblemBase):
    """States are x, y and the rocks: 1 good, 0 bad, and 2 less once it has been sampled.

    An action is the way to the next target, and 1 to sample what is there; a step of it is one cell
    along x, or along y if x is right.
    """

    name = "rock_sample"
    state_size = 2 + len(ROCKS)
    action_size = 3
    sensing_actions: Sequence[str] = tuple(f"rock {rock}" for rock in range(len(ROCKS)))
    resolution = 0.5
    state_resolution = 0.5
    motion_variance = np.full(3, 0.25)
    sensing_costs: Sequence[float] = (1.0,) * len(ROCKS)
    """What a step's delay costs: a twentieth of about 20 that are still to be earned."""

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        rocks = np.where(stream.uniform((count, len(ROCKS))) < 0.5, 1.0, 0.0)
        return np.concatenate([np.tile(np.array(START, float), (count, 1)), rocks], axis=1)

    def _known(self, states: FloatArray) -> tuple[IntArray, IntArray, IntArray]:
        places = np.clip(np.rint(states[..., :2]), 0, SIZE - 1).astype(np.int64)
        rocks = (states[..., 2:] >= LIKELY) * 2 ** np.arange(len(ROCKS))
        return rocks.sum(axis=-1), places[..., 0], places[..., 1]

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        del stage
        ends = np.concatenate([ROCKS, [[SIZE, 0]]]).astype(float)
        target = tours()[1][self._known(states)]
        way = ends[target] - states[..., :2]
        way[..., 1] *= target < len(ROCKS)
        there = (np.abs(way) < 0.5).all(axis=-1, keepdims=True)
        return np.concatenate([way, there.astype(float)], axis=-1)

    def known_state_return(self, states: FloatArray, stages: IntArray) -> FloatArray:
        del stages
        return np.where(self.is_goal(states), 0.0, tours()[0][self._known(states)])

    def limit_action(self, actions: FloatArray) -> FloatArray:
        along = np.clip(np.rint(actions), -1.0, 1.0)
        along[..., 1] *= along[..., 0] == 0.0
        along[..., 2] *= (along[..., :2] == 0.0).all(axis=-1)
        return along

    def _at(self, states: FloatArray) -> BoolArray:
        return np.asarray((np.abs(states[..., np.newaxis, :2] - ROCKS) < 0.5).all(axis=-1))

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        del stream
        moved: FloatArray = states + np.concatenate(
            [actions[..., :2], np.zeros((*actions.shape[:-1], len(ROCKS)))], axis=-1
        )
        moved[..., 0] = np.clip(moved[..., 0], 0.0, SIZE)
        moved[..., 1] = np.clip(moved[..., 1], 0.0, SIZE - 1.0)
        taken = self._at(states) & (actions[..., 2:] > 0.5) & (states[..., 2:] > -0.5)
        moved[..., 2:] -= 2.0 * taken
        return moved

    def reward(self, states: FloatArray, actions: FloatArray) -> FloatArray:
        taken = self._at(states) & (actions[..., 2:] > 0.5)
        gains = np.where(states[..., 2:] > -1.5, GOOD, -GOOD)
        out = (states[..., 0] > SIZE - 0.5) & (actions[..., 0] > 0.5)
        return np.asarray((taken * gains).sum(axis=-1) + EXIT * out)

    def is_goal(self, states: FloatArray) -> BoolArray:
        return np.asarray(states[..., 0] > SIZE - 0.5)

    def log_likelihood(
        self, states: FloatArray, sensing_action: int, observation: FloatArray
    ) -> FloatArray:
        return np.asarray(self.log_likelihoods(states, sensing_action, observation[np.newaxis])[0])

    def log_likelihoods(
        self, states: FloatArray, sensing_action: int, observations: FloatArray
    ) -> FloatArray:
        right = np.minimum(_accuracy(states[:, :2], sensing_action), 1.0 - 1e-6)
        agrees = (observations > 0.5) == (states[:, 2 + sensing_action] > 0.5)
        return np.where(agrees, numerics.log(right), numerics.log(1.0 - right))

    def sample_observation(
        self, state: FloatArray, sensing_action: int, stream: Stream
    ) -> FloatArray:
        rightly = stream.uniform((1,)) < _accuracy(state[:2], sensing_action)
        return np.where(rightly == (state[2 + sensing_action] > 0.5), 1.0, 0.0)


def code_of(action: FloatArray) -> int:
    """Return the number of an executed action."""
    if action[2]:
        return SAMPLE
    return next(step for step, way in STEPS.items() if way == tuple(action[:2]))


class Rule(NamedTuple):
    """When to check: after so many moves, or, without a number, if the selector wants to."""

    moves: int | None
    nats: float = 0.0


def play(method: str, rule: Rule, seed: int, trial: int) -> World:
    """Play a trial with one of holdfast's selectors."""
    selector = SelectorSettings(
        method=method,  # type: ignore[arg-type]
        rollout_sensing_steps=8,
        sensing_is_optional=rule.moves is None,
        nats_per_cost=rule.nats,
    )
    settings = PlanningSettings(
        particle_filter=ParticleFilterSettings(num_particles=500, resampling_threshold=0.5),
        active_sensing=ActiveSensingSettings(num_cores=1, discount=DISCOUNT),
        selector=selector,
        sensing_interval=rule.moves or 0,
    )
    problem: Any = RockSample()  # its observations have a likelihood of their own
    planner, world = Planner(problem, settings), World(seed, trial)
    state, moves = planner.init(seed, trial), rule.moves or 0
    wait = np.zeros(3)
    while not world.over:
        chosen = planner.no_sensing
        if rule.moves is None or moves >= rule.moves:
            chosen, _ = planner.choose_sensing_action(state)
        if chosen == planner.no_sensing:
            action, _ = planner.choose_task_action(state)
            world.act(code_of(action))
            state, moves = planner.advance(state, action), moves + 1
        else:
            shown = np.array([float(bool(world.act(CHECK + chosen)))])
            state, moves = planner.advance(planner.observe(state, chosen, shown)[0], wait), 0
    return world


PLANNERS: Mapping[str, dict[str, Any]] = {
    "POMCP": {"depth": 20, "exploration_constant": 5.0, "n_simulations": 4000},
    "POMCPOW": {
        "depth": 20,
        "exploration_constant": 5.0,
        "n_simulations": 10_000,
        "k_a": len(ROCKS) + 4.5,
        "alpha_a": 0.0,
        "k_o": 3.0,
        "alpha_o": 0.5,
    },
}
"""Rivals of POMDPPlanners 0.6.0; all actions and observations are branches from the first visit."""


def play_rival(name: str, seed: int, trial: int, **settings: Any) -> World:
    """Play a trial with a planner of POMDPPlanners, told the exact belief at each step."""
    try:
        logging.disable(logging.INFO)
        from POMDPPlanners.core.belief import WeightedParticleBelief
        from POMDPPlanners.environments.rock_sample_pomdp import RockSamplePOMDP
        from POMDPPlanners.planners.mcts_planners import pomcp, pomcpow
        from POMDPPlanners.utils.action_samplers import DiscreteActionSampler
    except ImportError as error:
        raise SystemExit(f"{name} needs: pip install POMDPPlanners==0.6.0 ({error})") from error
    world = World(seed, trial)
    model = RockSamplePOMDP(
        map_size=(SIZE, SIZE),
        rock_positions=[(int(y), int(x)) for x, y in ROCKS],
        init_pos=START[::-1],
        sensor_efficiency=HALF_DISTANCE,
        discount_factor=DISCOUNT,
    )
    given = {"environment": model, "discount_factor": DISCOUNT, "name": name}
    given |= PLANNERS[name] | settings
    if name == "POMCP":
        planner = pomcp.POMCP(**given)
    else:
        sampler = DiscreteActionSampler(model.get_actions())
        planner = pomcpow.POMCPOW(action_sampler=sampler, **given)
    np.random.seed(trial)  # noqa: NPY002 - the planners draw from it
    random.seed(trial)
    draws = np.random.default_rng([seed, trial, 1])
    good, weights = np.full(len(ROCKS), 0.5), np.full(500, -np.log(500.0))
    while not world.over:
        rocks = draws.random((500, len(ROCKS))) < good
        particles = [np.array([*world.place[::-1], *row], dtype=float) for row in rocks]
        action = planner.action(WeightedParticleBelief(particles, weights))[0][0]
        if action == SAMPLE:
            good[(world.place == ROCKS).all(axis=1)] = 0.0
        shown = world.act(int(action))
        if shown is not None:
            rock, right = action - CHECK, world.accuracy(action - CHECK)
            if not shown:
                right = 1.0 - right
            likely = good[rock] * right
            good[rock] = likely / (likely + (1.0 - good[rock]) * (1.0 - right))
    return world


WAYS: Mapping[str, tuple[str, Rule]] = {
    "default": ("path_entropy", Rule(None, 0.5)),
    "expected return": ("expected_return", Rule(None)),
    "state entropy": ("state_entropy", Rule(None, 0.5)),
    "action covariance": ("action_covariance", Rule(2)),
    "random": ("random", Rule(2)),
}
"""Holdfast's ways, the default first, each with the rule that was best in trials of seed 2025."""


def _row(play_one: Callable[..., World], seed: int, trial: int) -> Mapping[str, Any]:
    began = time.process_time()
    world = play_one(seed=seed, trial=trial)
    seconds = (time.process_time() - began) / max(1, world.steps)
    return dict(zip(COLUMNS, (world.reward, world.steps, world.checks, seconds), strict=True))


def cells_of(seed: int) -> list[trial_table.Cell]:
    own = [
        trial_table.Cell({"way": way}, partial(_row, partial(play, method, rule), seed))
        for way, (method, rule) in WAYS.items()
    ]
    rivals = [
        trial_table.Cell({"way": name}, partial(_row, partial(play_rival, name), seed), 20)
        for name in PLANNERS
    ]
    return [*own, *rivals]


if __name__ == "__main__":
    out = trial_table.main(__doc__, "runs/rock_sample/trials.csv", 60, cells_of, COLUMNS)
    print(trial_table.ranked(out, COLUMNS[0], COLUMNS[1:]))
