"""Trials of Van der Pol tag, and the two published heuristics."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from holdfast import _kernel, numerics
from holdfast.numerics.arrays import BoolArray, FloatArray, IntArray
from holdfast.numerics.randomness import Purpose, Stream, stream
from holdfast.planning.belief import Belief, resample, uniform_weights
from studies.vdp_tag import (
    DISCOUNT,
    MAX_STEPS,
    NUM_BEAMS,
    VdpTag,
    active_beam,
    interception,
    moved,
    reading_log_likelihood,
    target_flow,
    toward,
)

_LARGEST_AREA = 0.01
"""Largest uncertainty of the target without a look: an area, in the unit of the plane, squared."""


VdpTagPolicy: TypeAlias = Callable[[FloatArray, Sequence[Stream]], tuple[FloatArray, IntArray]]
"""Chooses a step and whether to look, both before the step is made.

It gets beliefs of shape (b, n, 4), of each of ``b`` trials n equally likely states, which all have
the agent at one place; and random numbers of each decision. It returns the steps of the agents,
shape (b, 2), and the sensing actions after them, (b,)."""


def to_next(beliefs: FloatArray, draws: Sequence[Stream]) -> tuple[FloatArray, IntArray]:
    """Decide as the published heuristic ``to_next``.

    It heads for where the target of a random particle will be after the next step, and never looks.
    """
    count = beliefs.shape[1]
    chosen = [int(float(draw.uniform()) * count) for draw in draws]
    states = beliefs[np.arange(len(draws)), chosen]
    steps = toward(target_flow(states[:, 2:]) - states[:, :2])
    return steps, np.zeros(len(draws), dtype=np.int64)


def intercept(beliefs: FloatArray, draws: Sequence[Stream]) -> tuple[FloatArray, IntArray]:
    """Head for where the target of the first particle can be met first, and never look.

    With known states: what certainty would be worth.
    """
    steps, _ = interception(beliefs[:, 0, :2], beliefs[:, 0, 2:])
    return steps, np.zeros(len(draws), dtype=np.int64)


def manage_uncertainty(beliefs: FloatArray, draws: Sequence[Stream]) -> tuple[FloatArray, IntArray]:
    """Decide as the published heuristic ``manage_uncertainty``.

    It heads for where a target at the mean will be after the next step, and looks where the square
    root of the determinant of the target's covariance exceeds a bound.
    """
    weights = np.full(beliefs.shape[1], 1.0 / beliefs.shape[1])
    means = np.empty((len(draws), 2))
    looks = np.empty(len(draws), dtype=np.int64)
    for trial, targets in enumerate(beliefs[..., 2:]):
        means[trial] = numerics.weighted_mean(targets, weights)
        x, y = (targets - means[trial]).T
        products = np.stack([x * x, x * y, y * y], axis=-1)
        xx, xy, yy = numerics.weighted_mean(products, weights)
        looks[trial] = np.sqrt(max(xx * yy - xy * xy, 0.0)) > _LARGEST_AREA
    return toward(target_flow(means) - beliefs[:, 0, :2]), looks


class VdpTagTrial(NamedTuple):
    """The outcome of a trial."""

    discounted_reward: float
    tagged: bool
    steps: int
    looks: int


def run_vdp_tag_trials(
    policy: VdpTagPolicy,
    seed: int,
    trials: Sequence[int],
    num_particles: int = 1000,
    *,
    misses_at_once: bool = True,
    known_state: bool = False,
) -> list[VdpTagTrial]:
    """Run trials, side by side, with the order of events of the published figures.

    Step and look are chosen together, before the step; then agent and target move, the reward
    follows, and the eight beams are read unless the target is tagged. There is no reading before
    the first step. A look in the step that tags is paid as well. All policies see the same target
    and the same noise in the beams of a trial.

    The particle filter resamples after each reading. With ``misses_at_once`` it drops a particle
    whose target would have been tagged before the next decision; that of the published figures
    drops it one step later. With ``known_state`` the policy is told the true state instead: what no
    filter can give, for a bound.
    """
    runs = [_Run(seed, trial, num_particles) for trial in trials]
    if known_state:
        for run in runs:
            run.states[1:] = run.states[:1]
    for step in range(MAX_STEPS):
        going = [run for run in runs if not run.tagged]
        if not going:
            break
        # The true state goes first, and moves in one go with what is believed.
        states = np.stack([run.states for run in going])
        draws = [stream(seed, run.trial, step, Purpose.SELECTION) for run in going]
        actions, looks = policy(states[:, 1:], draws)
        noise = np.empty((len(going), num_particles + 1, 2))
        for run, own in zip(going, noise, strict=True):
            own[:1] = stream(seed, run.trial, step, Purpose.WORLD_MOTION).normal((1, 2))
            own[1:] = stream(seed, run.trial, step, Purpose.PREDICTION).normal((num_particles, 2))
        impossible = _Run.problem.is_goal(states)
        states = moved(states, actions[:, np.newaxis], noise)
        rewards = _Run.problem.reward(states[:, 0], actions)
        tagged = _Run.problem.is_goal(states)
        if misses_at_once:
            impossible = tagged
        beams = active_beam(states[..., 2:] - states[..., :2])
        for index, run in enumerate(going):
            run.earn(float(rewards[index]), int(looks[index]), bool(tagged[index, 0]))
            if not run.tagged and known_state:
                run.states = np.repeat(states[index, :1], num_particles + 1, axis=0)
            elif not run.tagged:
                run.observe(step, int(looks[index]), states[index], impossible[index], beams[index])
    return [VdpTagTrial(run.total, run.tagged, run.steps, run.looks) for run in runs]


class _Run:
    """A trial under way; ``states`` are the true one and the belief's."""

    problem = VdpTag()

    def __init__(self, seed: int, trial: int, num_particles: int) -> None:
        self.seed, self.trial = seed, trial
        truth = stream(seed, trial, 0, Purpose.WORLD_INITIAL_STATE)
        belief = stream(seed, trial, 0, Purpose.INITIAL_BELIEF)
        self.states = np.concatenate(
            [
                self.problem.initial_states(truth, 1),
                self.problem.initial_states(belief, num_particles),
            ]
        )
        self.tagged = bool(self.problem.is_goal(self.states[0]))
        self.total, self.factor = 0.0, 1.0
        self.steps = self.looks = 0

    def earn(self, reward: float, look: int, tagged: bool) -> None:
        """Count a step."""
        self.total += self.factor * (reward - self.problem.sensing_costs[look])
        self.factor *= DISCOUNT
        self.steps += 1
        self.looks += look
        self.tagged = tagged

    def observe(
        self, step: int, look: int, states: FloatArray, impossible: BoolArray, beams: IntArray
    ) -> None:
        """Read the beams, and weigh and resample the belief that was states to there."""
        noise = stream(self.seed, self.trial, step, Purpose.WORLD_OBSERVATION).normal(NUM_BEAMS)
        deviation = np.sqrt(self.problem.observation_variance(states[0], look))
        reading = self.problem.observation_mean(states[0], look) + deviation * noise
        log_weights = reading_log_likelihood(states[1:], look, reading, beams[1:])
        log_weights[impossible[1:]] = -np.inf
        weights, survivors = _kernel.normalize(log_weights, False)
        if not survivors:
            weights = uniform_weights(log_weights.size)
        belief = Belief(states[1:], weights)
        offset = stream(self.seed, self.trial, step, Purpose.RESAMPLING)
        self.states = np.concatenate([states[:1], resample(belief, offset).states])
