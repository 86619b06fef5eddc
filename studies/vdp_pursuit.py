"""Playing Van der Pol tag: plans for a belief, and looks that are worth their price.

A plan is a place and a time: be there then, and tag what comes by. Where a particle's target will
be is such a place; how many of the other particles' targets will be there, too, is how likely the
plan succeeds; and whether the agent can be there in time is known. So the best plan for a belief is
found among its own particles, and so is the best one for what the belief would be after a look. A
look is worth its price if the best plans after what it may show are better, in the mean, by more
than that. A look that is not taken now may be taken after the next step, so that is a plan as well,
at the price of that look.

Directions of the next step are compared by the best plan that is left after them. Whether to look
is decided together with the direction, or afterwards by a rule of its own: one of holdfast's
selectors, say, asked about the belief that the step leads to.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from holdfast import _kernel, numerics
from holdfast.numerics.arrays import FloatArray, IntArray
from holdfast.numerics.randomness import Stream
from holdfast.planning.belief import Belief
from holdfast.planning.sensing import choose_sensing_action
from holdfast.planning.settings import PlanningSettings
from studies.vdp_tag import (
    DISCOUNT,
    INSIDE_TIPS,
    LOOK_COST,
    STEP,
    TAG_RADIUS,
    TAG_REWARD,
    TARGET_DEVIATION,
    VdpTag,
    chance_of_tag,
    missing_length,
    stop_at_barriers,
    target_flow,
    toward,
    value_of_plan,
    way_length,
)


class PursuitSettings(NamedTuple):
    """How much a decision computes, and what it takes for granted."""

    num_particles: int = 128  # of the belief, that stand for it
    num_places: int = 32  # of these, whose targets' places are those of plans
    horizon: int = 16  # steps of the longest plan
    num_directions: int = 24  # all around; those to some of the particles come on top
    num_candidates: int = 6  # of the directions, for which a look is imagined
    num_second_directions: int = 16  # of the step after which the next look may come
    num_observations: int = 16  # hypothetical ones of a look
    value_of_failure: float = 10.0  # what is left when a plan fails
    residual: float = 6.0  # what uncertainty costs after the next look but one


LookRule: TypeAlias = Callable[[VdpTag, Belief, Stream], bool]
"""Tells whether to look after a step, from the belief that the step leads to and from random
numbers of this decision."""


def never(problem: VdpTag, belief: Belief, draw: Stream) -> bool:
    """Do not look."""
    del problem, belief, draw
    return False


def always(problem: VdpTag, belief: Belief, draw: Stream) -> bool:
    """Look at each step."""
    del problem, belief, draw
    return True


def by_chance(share: float) -> LookRule:
    """Return the rule that looks at a share of the steps, by chance."""
    return lambda _problem, _belief, draw: float(draw.uniform()) < share


def by_selector(planning: PlanningSettings, least_nats: float = 0.0) -> LookRule:
    """Return the rule that looks if one of holdfast's selectors would.

    A selector that knows no price looks if that takes at least so many nats of entropy.
    """

    def rule(problem: VdpTag, belief: Belief, draw: Stream) -> bool:
        index, info = choose_sensing_action(
            problem, planning, belief, 0, draw.substream(1), draw.substream(2)
        )
        if planning.selector.method == "expected_return" or info.entropies is None:
            return index == 1
        return float(info.entropies[0] - info.entropies[1]) > least_nats

    return rule


class Pursuit:
    """Takes the direction that leaves the best plan, and looks where that is worth its price.

    Parameters
    ----------
    rule : callable, optional
        Decides about looks after the direction is chosen. Without it direction and look are chosen
        together, by the expected return of both.
    """

    def __init__(
        self, rule: LookRule | None = None, settings: PursuitSettings | None = None
    ) -> None:
        self._rule = rule
        self._settings = settings = PursuitSettings() if settings is None else settings
        self._problem = VdpTag()
        self._compass = _compass(settings.num_directions)
        self._second_compass = _compass(settings.num_second_directions)
        steps = np.arange(1, settings.horizon + 1)
        variance = TARGET_DEVIATION * TARGET_DEVIATION * steps
        self._chances = np.array([chance_of_tag(int(step)) for step in steps])
        # A disc is as wide, in each coordinate, as a Gaussian of a quarter of its squared radius.
        self._doubled_widths: FloatArray = np.asarray(
            2.0 * (variance + 0.25 * TAG_RADIUS * TAG_RADIUS), dtype=np.float64
        )
        self._waits = rule is not never

    def decide(self, beliefs: FloatArray, draws: Sequence[Stream]) -> tuple[FloatArray, IntArray]:
        """Return the steps of the agents and whether to look after them."""
        count = self._settings.num_particles
        chosen = (np.arange(count) * beliefs.shape[1]) // count
        places = [np.ascontiguousarray(beliefs[:, chosen, 2:])]
        for _ in range(self._settings.horizon):
            places.append(target_flow(places[-1]))
        paths = np.stack(places[1:], axis=1)
        steps = np.empty((len(draws), 2))
        looks = np.empty(len(draws), dtype=np.int64)
        for trial, draw in enumerate(draws):
            decision = _Decision(self, beliefs[trial, 0, :2], paths[trial], draw)
            steps[trial], looks[trial] = decision.best()
        return steps, looks


class _Decision:
    """One decision; ``paths`` of shape (horizon, n, 2) are where the targets will be."""

    def __init__(
        self, pursuit: Pursuit, agent: FloatArray, paths: FloatArray, draw: Stream
    ) -> None:
        self._by = pursuit
        self._agent, self._paths, self._draw = agent, paths, draw
        settings = pursuit._settings
        horizon, count, _ = paths.shape
        self._later = np.arange(1, horizon)  # steps of plans, after the first step
        stride = max(1, count // settings.num_places)
        self._places = np.ascontiguousarray(paths[:, ::stride])
        # How likely a target of particle n is tagged at the place of a plan, rows n.
        offsets = self._places[1:, :, _NEW] - paths[1:, _NEW]
        hits = pursuit._chances[1:, _NEW, _NEW] * _near(
            _squares(offsets), pursuit._doubled_widths[1:, _NEW, _NEW]
        )
        self._hits = np.ascontiguousarray(np.moveaxis(hits, 2, 0).reshape(count, -1))
        self._few = np.arange(0, count, stride)
        self._hopeless = float(value_of_plan(horizon, 0.0, settings.value_of_failure))

    def best(self) -> tuple[FloatArray, int]:
        by, settings = self._by, self._by._settings
        directions = self._directions()
        agents = stop_at_barriers(self._agent, directions)
        tags = self._tags(agents, self._paths[0], 0)
        count = self._paths.shape[1]
        even = np.full(count, 1.0 / count)
        first = numerics.weighted_mean(np.ascontiguousarray(tags.T), even)
        lengths = way_length(agents[:, _NEW, _NEW], self._places[1:])
        steps = self._later[:, _NEW]
        missing = missing_length(lengths, steps)
        reach = _near(missing * missing, by._doubled_widths[1:, _NEW])
        # To begin with, as if a plan that fails were the end of it, or a look told everything.
        after = settings.value_of_failure
        mean_hits = numerics.weighted_mean(self._hits, even).reshape(steps.shape[0], -1)
        values = value_of_plan(steps, reach * mean_hits, after).max(axis=(1, 2))
        known = value_of_plan(steps, reach * by._chances[1:, _NEW], after).max(axis=1)
        if by._waits:
            few = np.full(known.shape[1], 1.0 / known.shape[1])
            waits = numerics.weighted_mean(np.ascontiguousarray(known.T), few)
            values = np.maximum(values, waits - settings.residual - LOOK_COST)
        estimates = _return(first, values)
        order = np.argsort(-estimates, kind="stable")[: settings.num_candidates]
        best = (-np.inf, directions[order[0]], 0)
        for index in order:
            own = self._candidate(agents[index], tags[index], float(first[index]), reach[index])
            for look, value in enumerate(own):
                if value > best[0]:
                    best = (value, directions[index], look)
        if by._rule is None:
            return best[1], best[2]
        agent = stop_at_barriers(self._agent, best[1])
        belief = self._belief(agent)
        return best[1], int(by._rule(by._problem, belief, self._draw))

    def _candidate(
        self, agent: FloatArray, tags: FloatArray, first: float, reach: FloatArray
    ) -> list[float]:
        """Return the expected return of a step without a look after it, and with one."""
        by, settings = self._by, self._by._settings
        left = 1.0 - tags
        weights = left / numerics.sum(left)
        waits = self._waits(agent) if by._waits else None
        looks = []
        if by._rule is None or by._rule is always:
            looks = [self._posteriors(agent, weights)]
        found = []
        # Most places cannot be reached in time.
        chosen = np.flatnonzero(reach > _OUT_OF_REACH)
        in_reach = reach.reshape(-1)[chosen]
        steps = self._later[chosen // reach.shape[1]]
        hits = np.ascontiguousarray(self._hits[:, chosen])
        for posteriors in [weights[_NEW], *looks]:
            chances = np.stack([numerics.weighted_mean(hits, own) for own in posteriors])
            plans = value_of_plan(steps, in_reach * chances, settings.value_of_failure)
            values = plans.max(axis=1, initial=self._hopeless)
            if waits is not None:
                values = np.maximum(values, self._waiting(waits, posteriors[:, self._few]))
            found.append(numerics.sum(values) / values.size)
        without = float(_return(first, found[0]))
        if not looks:
            return [without]
        with_look = float(_return(first, found[1])) - LOOK_COST
        return [without, with_look]

    @staticmethod
    def _waiting(waits: FloatArray, posteriors: FloatArray) -> FloatArray:
        """Return what the best second step is worth, under each posterior."""
        found = np.full(posteriors.shape[0], -np.inf)
        for row, own in enumerate(posteriors):
            total = numerics.sum(own)
            if total > 0.0:
                found[row] = numerics.weighted_mean(waits, own / total).max()
        return found

    def _belief(self, agent: FloatArray) -> Belief:
        """Return what is believed after a step to there, if it does not tag."""
        noise = self._draw.substream(0).normal(self._paths.shape[1:])
        targets = self._paths[0] + TARGET_DEVIATION * noise
        states = np.concatenate([np.broadcast_to(agent, targets.shape), targets], axis=-1)
        left = np.where(self._by._problem.is_goal(states), 0.0, 1.0)
        return Belief.weighted(states, left) if left.any() else Belief.uniform(states)

    def _posteriors(self, agent: FloatArray, weights: FloatArray) -> FloatArray:
        """Return the weights after hypothetical looks, one row for each."""
        problem = self._by._problem
        states = self._belief(agent).states
        return _kernel.hypothetical_weights(
            weights,
            [8],
            np.ascontiguousarray(problem.observation_mean(states, 1).T),
            np.ascontiguousarray(problem.observation_variance(states, 1).T),
            self._by._settings.num_observations,
            self._draw.substream(1).words,
            [],
            False,
        ).reshape(-1, weights.size)

    def _waits(self, agent: FloatArray) -> FloatArray:
        """Return what a second step and a look after it are worth, particles by second steps."""
        by, settings = self._by, self._by._settings
        paths = self._paths[:, self._few]
        some = paths[1, :: max(1, paths.shape[1] // 8)]
        agents = stop_at_barriers(agent, np.concatenate([by._second_compass, toward(some - agent)]))
        tags = self._tags(agents, paths[1], 1)
        steps = self._later[:-1, np.newaxis]
        lengths = way_length(agents[:, _NEW, _NEW], paths[2:])
        missing = missing_length(lengths, steps)
        # The look makes the targets' places known, and noise adds up anew.
        reach = _near(missing * missing, by._doubled_widths[: steps.size, _NEW])
        chances = by._chances[: steps.size, _NEW]
        known = value_of_plan(steps, reach * chances, settings.value_of_failure).max(axis=1)
        values = _return(tags, known - settings.residual) - LOOK_COST
        return np.ascontiguousarray(values.T)

    def _tags(self, agents: FloatArray, targets: FloatArray, step: int) -> FloatArray:
        """Return how likely each agent tags each target, which is expected after ``step`` more."""
        by = self._by
        squares = _squares(agents[:, _NEW] - targets)
        near = _near(squares, by._doubled_widths[step])
        return np.asarray(by._chances[step] * near)

    def _directions(self) -> FloatArray:
        """Return steps all around, to targets, to where targets can be met next, and to the gap."""
        first, second = (
            place[:: max(1, place.shape[0] // _DIRECT)] - self._agent for place in self._paths[:2]
        )
        squares = _squares(second)
        second = second[(squares < 4.0 * STEP * STEP) & (squares > 0.0)]
        ratio = STEP * STEP / _squares(second) - 0.25
        aside = np.sqrt(np.maximum(ratio, 0.0))[:, _NEW] * np.stack(
            [-second[:, 1], second[:, 0]], axis=-1
        )
        ahead = 0.5 * second
        every = [self._by._compass, first, ahead + aside, ahead - aside, INSIDE_TIPS - self._agent]
        return toward(np.concatenate(every))


_NEW = np.newaxis
_OUT_OF_REACH = 0.05
"""Share of a chance that is left where a plan is not worth a thought."""
_DIRECT = 10
"""Particles to which directions lead."""


def _compass(count: int) -> FloatArray:
    # Not along a barrier.
    angles = (2.0 * np.pi / count) * (np.arange(count) + 0.25)
    return STEP * np.stack([numerics.cos(angles), numerics.sin(angles)], axis=-1)


def _squares(offsets: FloatArray) -> FloatArray:
    x, y = offsets[..., 0], offsets[..., 1]
    return np.asarray(x * x + y * y)


def _near(squares: FloatArray, doubled_widths: FloatArray) -> FloatArray:
    """Return what is left of a chance so far from the expected place."""
    return numerics.exp(-squares / doubled_widths)


def _return(chance: FloatArray | float, after: FloatArray | float) -> FloatArray:
    """Return the expected return of a step that tags with some chance."""
    return np.asarray(TAG_REWARD * chance + (1.0 - chance) * (DISCOUNT * after - 1.0))
