"""The expected return after each sensing action, less its price.

Sample a true state and an observation of it; update the belief; let the robot act by the policy on
that belief while the true state moves; and add up the reward. The mean over many samples is the
expected return after that sensing action. It is in units of reward, so it can be weighed against
the price of sensing.

Sampled naively, the differences between sensing actions drown in noise: far from the goal all of
them lead to the same actions, and a return is the sum of a hundred noisy steps. So:

- All sensing actions share the true states and the noise of observations and motions (common random
  numbers). A difference then comes from the observations alone.
- Within a rollout the belief is its estimate, which moves as a few of its particles do.
- The robot will sense again and learn then what it does not sense now. At each of the next
  ``rollout_sensing_steps`` sensing steps the rollout forks: with a probability of one over their
  number the state is known from then on, and the known-state policy acts; at the last one it is
  known for sure. Both branches are followed: no draw decides. With one such step this is QMDP
  (Littman, Cassandra and Kaelbling, "Learning policies for partially observable environments",
  ICML 1995) over an interval.
- Where sensing has prices, the mean price is paid at each later sensing step up to the goal, as by
  a robot that senses at random from then on: a robot that is sooner at the goal pays less often. If
  knowledge were free later, sensing would be put off for ever. Not to sense, where it is a choice,
  counts in that mean, too.
- True state i is left out of the posterior of its own observation. A robot's true state is not
  among its particles, and a posterior of few particles with it would be too good.
- A rollout ends at the goal or in a failure, or as soon as the state is known and the same after
  every sensing action: the rest cancels in every difference. Far from the goal, where all of them
  lead to the same actions, that is soon. After a failure no reward follows. Where steps are
  counted, a failure costs all that are left, as if the goal were never reached.
- The kernel has rollouts of its own for the built-in problems (cpp/src/rollouts.hpp): ten times
  faster, with contacts to a quarter of an action, and without obstacles once the state is known.
- The number of samples is doubled, up to a bound, for those sensing actions alone whose paired
  difference from the best is less than two standard errors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from holdfast import _kernel
from holdfast.errors import ProblemError
from holdfast.numerics import reproducible as numerics
from holdfast.numerics.arrays import BoolArray, FloatArray, IntArray
from holdfast.numerics.circular import differences
from holdfast.numerics.geometry import RolloutSettings
from holdfast.numerics.randomness import Stream
from holdfast.planning import interruption
from holdfast.planning.belief import Belief, estimate
from holdfast.planning.settings import PlanningSettings
from holdfast.problems import checked
from holdfast.problems.attributes import circular_states, has_own, sensing_costs
from holdfast.problems.problem import Problem, ProblemBase

Posteriors = Callable[[Sequence[int], int, Stream], tuple[IntArray, FloatArray]]
"""Called with sensing actions, a number M of samples and a stream. Returns the M particles that are
the true states, and the weights of the posteriors, shape ``(len(sensing_actions), M, N)``, an array
of the caller's own."""

# Substreams of the stream of hypotheses (1 to 3 are those of holdfast.planning.sensing and the
# kernel). Further rounds of samples have substreams of the first one.
_ROUNDS = 4
_CLOUDS = 5
_MOTION = 6

_CLOUD, _KERNEL_CLOUD = 8, 2
"""Particles that stand for a posterior where it only has to move. In NumPy more cost little."""

_CLOSE = 2.0
"""Standard errors below which a difference counts as undecided."""

_NEGLIGIBLE = 1e-9
"""Weight of all others below which the true state stays in its posterior."""


class Returns(NamedTuple):
    """Expected returns of all sensing actions."""

    means: FloatArray
    """Of shape (J,): expected discounted return after each sensing action, less its price, and up
    to a constant that all of them share. For one that was given up early it is the best one's mean
    plus their mean difference in the samples that they share."""

    samples: FloatArray
    """Of shape (J, M): the returns after single hypothetical observations, less the price. NaN for
    those of later rounds of a sensing action that had been given up."""


def expected_returns(
    problem: Problem,
    settings: PlanningSettings,
    belief: Belief,
    stage: int,
    hypotheses: Stream,
    posteriors: Posteriors,
) -> Returns:
    """Return the expected return after each sensing action; if sensing is optional, without one.

    Not to sense comes last, has no price, and ``posteriors`` is asked for it as for the others.
    ProblemError says if a function of the problem breaks its contract, or a hypothetical
    observation has no likelihood under any particle.
    """
    costs = sensing_costs(problem, optional=settings.selector.sensing_is_optional)
    count = costs.shape[0]
    size = settings.active_sensing.num_observation_samples
    limit = max(size, settings.selector.max_observation_samples)
    roll_out = _rollouts_of(problem, settings, costs)
    contenders = list(range(count))
    rounds: list[FloatArray] = []
    drawn = 0
    while True:
        stream = hypotheses if not rounds else hypotheses.substream(_ROUNDS).substream(len(rounds))
        truths, weights = posteriors(contenders, size, stream)
        begun = _after_sensing(problem, settings, belief, truths, weights, stream)
        returns = roll_out(*begun, stage, stream.substream(_MOTION)) - costs[contenders, np.newaxis]
        if not numerics.all_finite(returns):
            raise ProblemError(
                f"the rewards of {problem.name} add up to more than a number can hold in "
                f"{settings.selector.rollout_steps} steps of expected_return"
            )
        rounds.append(np.full((count, size), np.nan))
        rounds[-1][contenders] = returns
        drawn += size
        samples = np.concatenate(rounds, axis=1)
        contenders = _contenders(samples, contenders)
        size = min(drawn, limit - drawn)
        if len(contenders) == 1 or size <= 0:
            return Returns(_paired_means(samples), samples)


def _after_sensing(
    problem: Problem,
    settings: PlanningSettings,
    belief: Belief,
    truths: IntArray,
    weights: FloatArray,
    stream: Stream,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the true states, the estimates after each observation, and particles of the beliefs.

    The shapes are those of :func:`rollout_returns`.
    """
    kind, circular = settings.particle_filter.estimate, circular_states(problem)
    states, words = belief.states, stream.substream(_CLOUDS).words
    members = _KERNEL_CLOUD if has_own_rollouts(problem) else _CLOUD
    found = _kernel.beliefs_without_truth(weights, states, truths, words, members, _NEGLIGIBLE)
    if found is None:
        raise ProblemError(
            f"a hypothetical observation of {problem.name} had no likelihood under any particle"
        )
    estimates, clouds = found
    if kind != "mean" or circular:
        for j, i in np.ndindex(*weights.shape[:2]):
            interruption.check()
            estimates[j, i] = estimate(Belief(states, weights[j, i]), kind, circular)
    return states[truths], estimates, clouds


def has_own_rollouts(problem: Problem) -> bool:
    """Tell whether the rollouts are those of the kernel, as for the built-in problems."""
    ends = ("reward", "is_goal", "is_failure", "known_state_return")
    alike = ("policy", "limit_action", "move", "next_stage", *ends)
    return has_own(problem, "rollout_returns", alike) and not circular_states(problem)


def rollout_returns(
    problem: Problem,
    settings: PlanningSettings,
    true_states: FloatArray,
    estimates: FloatArray,
    clouds: FloatArray,
    stage: int,
    motion: Stream,
) -> FloatArray:
    """Return the discounted returns, shape (J, M), of robots that act on a belief, up to the goal.

    They lack what is the same for all J: a rollout ends where only that is left. ``true_states``,
    (M, state_size), are those of the robots, ``estimates``, (J, M, state_size), what they assume
    after each of J observations; and ``clouds``, (J, M, L, state_size), are some particles of these
    beliefs, by whose mean displacement the estimates move. All J have the same ``motion`` noise.
    """
    costs = sensing_costs(problem, optional=settings.selector.sensing_is_optional)
    roll_out = _rollouts_of(problem, settings, costs)
    return roll_out(true_states, estimates, clouds, stage, motion)


def _rollouts_of(
    problem: Problem, settings: PlanningSettings, costs: FloatArray
) -> Callable[[FloatArray, FloatArray, FloatArray, int, Stream], FloatArray]:
    """Return :func:`rollout_returns` with what all samples of a decision share."""
    price = numerics.sum(costs) / costs.shape[0]
    own_rewards = getattr(type(problem), "reward", None) is not ProblemBase.reward
    counts_steps = settings.selector.rollout_reward == "steps" or not own_rewards
    own = RolloutSettings(
        settings.sensing_interval + 1,
        settings.selector.rollout_sensing_steps,
        settings.selector.rollout_steps,
        settings.active_sensing.discount,
        price,
        counts_steps,
    )
    if has_own_rollouts(problem):
        threads = settings.active_sensing.num_cores
        return lambda *begun: checked.rollout_returns(problem, *begun, own, threads)

    def roll_out(
        truths: FloatArray, estimates: FloatArray, clouds: FloatArray, stage: int, motion: Stream
    ) -> FloatArray:
        rollouts = _Rollouts(problem, own, truths, estimates, clouds, stage)
        for step in range(own.steps):
            interruption.check()
            later, between = divmod(step, own.interval)
            if between == 0 and later > 0:
                rollouts.pay(price)
                if later <= own.looks:
                    rollouts.fork(1.0 if later == own.looks else 1.0 / own.looks)
                rollouts.drop_decided()
            if not rollouts.advance(motion.substream(step)):
                break
        return rollouts.returns

    return roll_out


class _Rollouts:
    """Robots on their way, all of them at once.

    All arrays have the J sensing actions first and then a column for each branch of a rollout. The
    columns whose state is not known come first, and each of them has a cloud of particles. A column
    is dropped once the goal is reached in it after every one of the J: as noise is drawn by
    position, all J have the same noise only while they have the same columns.
    """

    def __init__(
        self,
        problem: Problem,
        settings: RolloutSettings,
        true_states: FloatArray,
        estimates: FloatArray,
        clouds: FloatArray,
        stage: int,
    ) -> None:
        actions, samples, size = estimates.shape
        self._problem = problem
        self._counts_steps = settings.counts_steps
        self._discount = settings.discount
        self._factor = 1.0
        self.returns = np.zeros((actions, samples))
        self._unknown = samples
        self._states = np.broadcast_to(true_states, (actions, samples, size))
        self._clouds = clouds
        self._circular = list(circular_states(problem))
        self._offsets = differences(estimates, self._means(), self._circular)
        self._stages: IntArray = np.full((actions, samples), stage, dtype=np.int64)
        self._origins = np.arange(samples)
        # The probability of the branch; 0 where it has ended.
        self._shares = np.ones((actions, samples))
        self._steps_left = settings.steps
        self._end()

    def pay(self, price: float) -> None:
        """Pay for a later sensing action wherever the goal is not reached."""
        if price > 0.0:
            self._add(self._origins, -price * self._shares)

    def fork(self, chance: float) -> None:
        """Split each column whose state is not known: with this probability it is from now on."""
        unknown = self._unknown
        shares = self._shares[:, :unknown] * chance
        value = checked.known_state_return(
            self._problem, self._states[:, :unknown], self._stages[:, :unknown]
        )
        if value is not None:
            self._add(self._origins[:unknown], shares * value)
        else:
            self._states = np.concatenate([self._states, self._states[:, :unknown]], axis=1)
            self._stages = np.concatenate([self._stages, self._stages[:, :unknown]], axis=1)
            self._shares = np.concatenate([self._shares, shares], axis=1)
            self._origins = np.concatenate([self._origins, self._origins[:unknown]])
        self._shares[:, :unknown] -= shares
        if chance == 1.0:
            self._keep(np.arange(self._origins.shape[0]) >= unknown)

    def advance(self, motion: Stream) -> bool:
        """Take one step; return False if there was none to take."""
        count, unknown = self._origins.shape[0], self._unknown
        if count == 0 or self._factor == 0.0 or not self._shares.any():
            return False
        problem = self._problem
        believed = np.concatenate(
            [self._means() + self._offsets, self._states[:, unknown:]], axis=1
        )
        shape, size, cloud = believed.shape[:2], believed.shape[2], self._clouds.shape[2]
        rows = believed.reshape(-1, size)
        _read_only(rows)
        stage: int | IntArray = 0
        if problem.num_stages > 1:
            stage = checked.next_stages(problem, rows, self._stages.reshape(-1))
            self._stages = stage.reshape(shape)
        commanded = checked.policy(problem, rows, stage)
        executed = checked.executed_action(problem, commanded)
        actions = executed.reshape(*shape, -1)
        for_clouds = np.repeat(actions[:, :unknown], cloud, axis=1)
        before = np.concatenate(
            [self._states, self._clouds.reshape(actions.shape[0], -1, size)], axis=1
        )
        all_actions = np.concatenate([actions, for_clouds], axis=1)
        _read_only(before, all_actions)
        moved = np.stack(
            [
                # The same noise for each of the J: the stream is lent anew to each call.
                checked.move(problem, states, own_actions, motion)
                for states, own_actions in zip(before, all_actions, strict=True)
            ]
        )
        self._states = moved[:, :count]
        self._clouds = moved[:, count:].reshape(self._clouds.shape)
        if self._counts_steps:
            self._add(self._origins, -self._shares)
        else:
            rewards = checked.rewards(problem, self._states.reshape(-1, size), executed)
            self._add(self._origins, self._shares * rewards.reshape(shape))
        self._factor *= self._discount
        self._steps_left -= 1
        self._end()
        return True

    def _means(self) -> FloatArray:
        """Return the mean of each cloud; of angles, the mean direction."""
        means = _means(self._clouds)
        if angles := self._circular:
            sines, cosines = (
                _means(function(self._clouds[..., angles]))
                for function in (numerics.sin, numerics.cos)
            )
            means[..., angles] = numerics.arctan2(sines, cosines)
        return means

    def _end(self) -> None:
        """End the branches at the goal, and those that failed: in steps, these cost the rest."""
        rows = self._states.reshape(-1, self._states.shape[2])
        ended, failed = checked.ends(self._problem, rows)
        if self._counts_steps and failed is not None and failed.any():
            rest = 0.0
            for _ in range(self._steps_left):
                rest = 1.0 + self._discount * rest
            self._add(self._origins, -rest * self._shares * failed.reshape(self._shares.shape))
        self._shares = np.where(ended.reshape(self._shares.shape), 0.0, self._shares)

    def drop_decided(self) -> None:
        """Drop the columns in which nothing can differ any more.

        Either the goal is reached in them after every sensing action, or the state is known and the
        same after each: with the same noise the rest is the same, too.
        """
        going_on = self._shares > 0.0
        differ = (self._states != self._states[:1]).any(axis=2)
        differ |= (self._stages != self._stages[:1]) | (self._shares != self._shares[:1])
        differ[:, : self._unknown] = True
        self._keep(np.asarray(going_on.any(axis=0) & differ.any(axis=0)))

    def _keep(self, columns: BoolArray) -> None:
        of_unknown = columns[: self._unknown]
        self._clouds = self._clouds[:, of_unknown]
        self._offsets = self._offsets[:, of_unknown]
        self._unknown = self._offsets.shape[1]
        self._states = self._states[:, columns]
        self._stages = self._stages[:, columns]
        self._shares = self._shares[:, columns]
        self._origins = self._origins[columns]

    def _add(self, origins: IntArray, values: FloatArray) -> None:
        """Add values to the rollouts that their columns are branches of, column by column."""
        samples = self.returns.shape[1]
        discounted = self._factor * values
        for row, added in zip(self.returns, discounted, strict=True):
            # bincount adds one by one, in order.
            row += np.bincount(origins, weights=added, minlength=samples)


def _read_only(*arrays: FloatArray) -> None:
    for array in arrays:
        array.setflags(write=False)


def _means(clouds: FloatArray) -> FloatArray:
    """Return the mean of each cloud, added one by one, in order."""
    total = clouds[:, :, 0]
    for member in range(1, clouds.shape[2]):
        total = total + clouds[:, :, member]
    return np.asarray(total / clouds.shape[2])


def _contenders(samples: FloatArray, among: Sequence[int]) -> list[int]:
    """Return the sensing actions whose difference from the best one is undecided."""
    count = samples.shape[1]
    if count < 2:
        return list(among)  # One sample has no standard error.
    means = {j: numerics.sum(samples[j]) / count for j in among}
    best = max(among, key=lambda j: means[j])
    close = []
    for j in among:
        differences, mean = samples[best] - samples[j], means[best] - means[j]
        away = differences - mean
        squared_error = numerics.sum(away * away) / (count * (count - 1))
        # More samples of equal returns are equal, too.
        if j == best or (differences.any() and mean * mean < _CLOSE * _CLOSE * squared_error):
            close.append(j)
    return close


def _paired_means(samples: FloatArray) -> FloatArray:
    """Return the mean of each row; of a shorter one, by its difference from the best."""
    lengths = [int((row == row).sum()) for row in samples]
    longest = max(lengths)
    full = [j for j, length in enumerate(lengths) if length == longest]
    means = np.empty(len(lengths))
    for j in full:
        means[j] = numerics.sum(samples[j]) / longest
    best = max(full, key=lambda j: means[j])
    for j, length in enumerate(lengths):
        if length < longest:
            differences = samples[j, :length] - samples[best, :length]
            means[j] = means[best] + numerics.sum(differences) / length
    return means
