"""Van der Pol tag: catch a target on a limit cycle, and pay for each look at it.

The target follows a planar Van der Pol oscillator with noise. It is soon on the limit cycle, so the
main unknown is how far along it is. The agent takes steps of one length between four barriers that
block its way and not the target's. It always knows its own place. Eight beams measure the target's
distance: well if the agent pays for a look, hardly at all if it does not. Which beam holds the
target has to be inferred.

Source: Sunberg and Kochenderfer, "Online algorithms for POMDPs with continuous state, action, and
observation spaces", ICAPS 2018, section 5.3; what the paper leaves open (beams, barriers, order of
events, particle filter) as in VDPTag2.jl and ContinuousPOMDPTreeSearchExperiments.jl by the same
authors, which made its figures (folder ``icaps_2018``).
"""

from __future__ import annotations

import itertools
import operator
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from holdfast import numerics
from holdfast.numerics.arrays import BoolArray, FloatArray, IntArray
from holdfast.numerics.randomness import Stream
from holdfast.problems.problem import ProblemBase, Scene

DISCOUNT = 0.95
MAX_STEPS = 100
STEP = 0.5
"""Length of each step of the agent."""
TAG_RADIUS = 0.1
TAG_REWARD = 100.0
LOOK_COST = 5.0
TARGET_DEVIATION = 0.05
"""Standard deviation of the noise on each coordinate of the target, each step."""
BARRIER_START, BARRIER_END = 0.2, 3.0
"""Distances of the ends of each barrier from the origin."""

_MU = 2.0
_TIME_STEP = 0.1
_SUBSTEPS = 5
_START_HALF_WIDTH = 4.0
NUM_BEAMS = 8
_LOOK_DEVIATION = 0.1
_BEAM_DEVIATION = 5.0
_EMPTY_BEAM = 1.0
"""Mean reading of a beam that does not hold the target."""
_LONGEST_PURSUIT = 30
INSIDE_TIPS = 0.9 * BARRIER_START * np.array([(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)])
"""Places by which a way leads past the inner ends."""
_EPSILON = float(np.finfo(np.float64).eps)

_POWERS = np.array([*itertools.accumulate([1.0, *[DISCOUNT] * MAX_STEPS], operator.mul)])


def target_flow(targets: FloatArray, steps: int = 1) -> FloatArray:
    """Return where targets, shape (..., 2), are some steps of the agent later, without noise.

    Each is five steps of the classical Runge-Kutta method of order 4.
    """
    x, y = targets[..., 0], targets[..., 1]
    half, whole = 0.5 * _TIME_STEP, _TIME_STEP
    for _ in range(steps * _SUBSTEPS):
        ax, ay = _velocity(x, y)
        bx, by = _velocity(x + half * ax, y + half * ay)
        cx, cy = _velocity(x + half * bx, y + half * by)
        dx, dy = _velocity(x + whole * cx, y + whole * cy)
        x = x + (whole / 6.0) * (ax + 2.0 * (bx + cx) + dx)
        y = y + (whole / 6.0) * (ay + 2.0 * (by + cy) + dy)
    return np.stack([x, y], axis=-1)


def _velocity(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    return _MU * (x - x * x * x / 3.0 - y), x / _MU


def stop_at_barriers(places: FloatArray, moves: FloatArray) -> FloatArray:
    """Return where straight moves lead, which end at the first barrier that they meet.

    A move along a barrier is free. A stopped move keeps two machine epsilons of its length away
    from the barrier, so that the next one begins on the side from which it came. Places and moves
    of shape (..., 2) are broadcast against each other.
    """
    share = np.full(np.broadcast_shapes(places.shape, moves.shape)[:-1], 1.0 + 2.0 * _EPSILON)
    for across, along in ((1, 0), (0, 1)):
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            met = -places[..., across] / moves[..., across]
            where = np.abs(places[..., along] + met * moves[..., along])
            # Comparisons with NaN (a move along the barrier's line that begins on it) are false.
            hit = (met >= 0.0) & (met < share) & (where >= BARRIER_START) & (where <= BARRIER_END)
        share = np.where(hit & (moves[..., across] != 0.0), met, share)
    return np.asarray(places + (share - 2.0 * _EPSILON)[..., np.newaxis] * moves)


def active_beam(offsets: FloatArray) -> IntArray:
    """Return which beam holds the target, from 0: beam i the angles (45 i, 45 (i + 1)] degrees.

    Of offsets from the agent to the target, shape (..., 2). None counts as one along x: beam 7.
    """
    x, y = offsets[..., 0], offsets[..., 1]
    upper = np.where(x > 0.0, np.where(y <= x, 0, 1), np.where(y >= -x, 2, 3))
    upper = np.where((x == 0.0) & (y > 0.0), 1, upper)
    lower = np.where(x < 0.0, np.where(y >= x, 4, 5), np.where(y <= -x, 6, 7))
    lower = np.where((x == 0.0) & (y < 0.0), 5, lower)
    lower = np.where((x == 0.0) & (y == 0.0), 7, lower)
    left = (y == 0.0) & (x < 0.0)
    return np.asarray(np.where((y > 0.0) | left, upper, lower))


def toward(offsets: FloatArray) -> FloatArray:
    """Return vectors scaled to the length of a step; zero becomes a step along x."""
    length = _norm(offsets[..., 0], offsets[..., 1])
    # The square of a tiny offset is zero.
    usable = length > 0.0
    scale = STEP / np.where(usable, length, 1.0)
    along_x = np.array([STEP, 0.0])
    return np.where(usable[..., np.newaxis], scale[..., np.newaxis] * offsets, along_x)


def way_length(starts: FloatArray, ends: FloatArray) -> FloatArray:
    """Return lengths of ways that lead past the barriers.

    A straight one, if no barrier is in its way; else past the inner end of the barrier that is, or
    the longer of two such ways where two barriers are. The outer ends are further off than any
    target ever is. Starts and ends of shape (..., 2) are broadcast against each other.
    """
    ax, ay, bx, by = starts[..., 0], starts[..., 1], ends[..., 0], ends[..., 1]
    dx, dy = bx - ax, by - ay
    straight = _norm(dx, dy)
    # Zero only where the way crosses no axis.
    at_x = ax - ay * dx / np.where(dy == 0.0, 1.0, dy)
    at_y = ay - ax * dy / np.where(dx == 0.0, 1.0, dx)
    stops_x = ((ay > 0.0) != (by > 0.0)) & _is_barrier(at_x)
    stops_y = ((ax > 0.0) != (bx > 0.0)) & _is_barrier(at_y)
    tip_x, tip_y = np.copysign(BARRIER_START, at_x), np.copysign(BARRIER_START, at_y)
    past_x = _norm(ax - tip_x, ay) + _norm(bx - tip_x, by)
    past_y = _norm(ax, ay - tip_y) + _norm(bx, by - tip_y)
    detour = np.maximum(np.where(stops_x, past_x, 0.0), np.where(stops_y, past_y, 0.0))
    return np.asarray(np.maximum(straight, detour))


def _is_barrier(at: FloatArray) -> BoolArray:
    size = np.abs(at)
    return np.asarray((size > BARRIER_START) & (size < BARRIER_END))


def _norm(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(x * x + y * y))


def missing_length(lengths: FloatArray, steps: npt.ArrayLike) -> FloatArray:
    """Return how far from the end of a way some steps of the agent, at least 1, must end.

    Two steps or more end anywhere within their reach, as they need not lead straight on; a single
    one ends on a circle.
    """
    beyond = lengths - STEP * np.asarray(steps)
    return np.where(np.equal(steps, 1), np.abs(beyond), np.maximum(beyond, 0.0))


def chance_of_tag(steps: int) -> float:
    """Return how likely a target is tagged where it is expected in some steps.

    Its noise is taken to add up; the flow makes less of that which leads off the limit cycle.
    """
    variance = steps * TARGET_DEVIATION * TARGET_DEVIATION
    return 1.0 - float(numerics.exp(np.array(-0.5 * TAG_RADIUS * TAG_RADIUS / variance)))


def value_of_plan(steps: npt.ArrayLike, chance: npt.ArrayLike, after: float = 0.0) -> FloatArray:
    """Return the discounted return of steps, at least 1, of which the last one may tag.

    ``chance`` is that it tags, ``after`` the value of being there if it does not.
    """
    before = _POWERS[np.asarray(steps) - 1]
    chance = np.asarray(chance)
    last = TAG_REWARD * chance + (1.0 - chance) * (DISCOUNT * after - 1.0)
    return np.asarray(before * last - (1.0 - before) / (1.0 - DISCOUNT))


def interception(agents: FloatArray, targets: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the steps that lead to where known targets can be met first, and how many it takes.

    Agents, targets and steps have the shape (n, 2).
    """
    count = agents.shape[0]
    numbers = np.zeros(count, dtype=np.int64)
    places = np.zeros((count, 2))
    place = targets
    for step in range(1, _LONGEST_PURSUIT + 1):
        place = target_flow(place)
        missing = missing_length(way_length(agents, place), step)
        met = (numbers == 0) & ((missing < 0.5 * TAG_RADIUS) | (step == _LONGEST_PURSUIT))
        numbers = np.where(met, step, numbers)
        places = np.where(met[:, np.newaxis], place, places)
    return _first_steps(agents, places, numbers), numbers


def _first_steps(agents: FloatArray, places: FloatArray, numbers: IntArray) -> FloatArray:
    """Return the first of some steps to places, of which two must not lead straight on."""
    offsets = places - agents
    length = _norm(offsets[:, 0], offsets[:, 1])
    direct = toward(offsets)
    # Two steps of the same length make an isosceles triangle with the way.
    half = 0.5 * length / STEP
    aside = np.sqrt(np.maximum(1.0 - half * half, 0.0))[:, np.newaxis]
    left = np.stack([-direct[:, 1], direct[:, 0]], axis=-1)
    bends = [half[:, np.newaxis] * direct + sign * aside * left for sign in (1.0, -1.0)]
    free = [np.abs(stop_at_barriers(agents, bend) - agents - bend).max(axis=1) for bend in bends]
    bend = np.where((free[0] <= free[1])[:, np.newaxis], bends[0], bends[1])
    chosen = np.where(((numbers == 2) & (length < 2.0 * STEP))[:, np.newaxis], bend, direct)
    # Round a barrier: past the inner end that makes the way short.
    blocked = way_length(agents, places) > length + 1e-9
    tips = INSIDE_TIPS - agents[:, np.newaxis]
    ways = way_length(agents[:, np.newaxis], INSIDE_TIPS) + way_length(
        INSIDE_TIPS, places[:, np.newaxis]
    )
    best = tips[np.arange(agents.shape[0]), ways.argmin(axis=1)]
    # At the end itself, go on.
    there = _norm(best[:, 0], best[:, 1]) < 1e-6
    return np.where((blocked & ~there)[:, np.newaxis], toward(best), chosen)


class VdpTag(ProblemBase):
    """Van der Pol tag with barriers; states are agent (x, y) and target (x, y).

    Actions are steps of the agent, all of the length 0.5. Its policy heads for where the target
    can be met first.
    """

    name = "vdp_tag"
    state_size = 4
    action_size = 2
    sensing_actions: Sequence[str] = ("do not look", "look")
    sensing_costs = (0.0, LOOK_COST)
    state_labels: Sequence[str] = ("agent x", "agent y", "target x", "target y")
    resolution = TAG_RADIUS  # steps that differ by less tag the same targets
    motion_variance = np.zeros(2)  # the agent steps as it is told

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        """Put the agent at the origin and the target anywhere in the square."""
        states = np.zeros((count, 4))
        states[:, 2:] = _START_HALF_WIDTH * (2.0 * stream.uniform((count, 2)) - 1.0)
        return states

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        """Move the agent up to the next barrier, and the target by its flow, with noise."""
        return moved(states, actions, stream.normal((*states.shape[:-1], 2)))

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        """Return the distance for the beam that holds the target, one for the others."""
        del sensing_action
        offsets = states[..., 2:] - states[..., :2]
        distance = _norm(offsets[..., 0], offsets[..., 1])
        return np.where(_is_active(offsets), distance[..., np.newaxis], _EMPTY_BEAM)

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        """Return a small variance for the beam that holds the target, if the agent looks."""
        if sensing_action == 0:
            return np.full(NUM_BEAMS, _BEAM_DEVIATION**2)
        active = _is_active(states[..., 2:] - states[..., :2])
        return np.where(active, _LOOK_DEVIATION**2, _BEAM_DEVIATION**2)

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        """Head for where the target can be met first."""
        del stage
        rows = np.ascontiguousarray(states).reshape(-1, 4)
        return interception(rows[:, :2], rows[:, 2:])[0].reshape(*states.shape[:-1], 2)

    def known_state_return(self, states: FloatArray, stages: IntArray) -> FloatArray:
        """Return what meeting the target first is worth, if the last step succeeds as it may."""
        del stages
        return value_of_plan(interception(states[:, :2], states[:, 2:])[1], chance_of_tag(1))

    def limit_action(self, actions: FloatArray) -> FloatArray:
        """Make a step of every action: its direction is what counts."""
        return toward(actions)

    def reward(self, states: FloatArray, actions: FloatArray) -> FloatArray:
        """Return 100 where the target is tagged, and minus 1 elsewhere."""
        del actions
        return np.where(self.is_goal(states), TAG_REWARD, -1.0)

    def is_goal(self, states: FloatArray) -> BoolArray:
        """Tell where the target is tagged."""
        offsets = states[..., 2:] - states[..., :2]
        return _norm(offsets[..., 0], offsets[..., 1]) < TAG_RADIUS

    def scene(self) -> Scene:
        """Return the plane of agent and target with the barriers."""
        near, far, thin = BARRIER_START, BARRIER_END, 0.01
        barriers = [(near, -thin, far, thin), (-thin, near, thin, far)]
        barriers += [(-far, -thin, -near, thin), (-thin, -far, thin, -near)]
        return Scene((0, 1), (-4, -4, 4, 4), barriers, body=TAG_RADIUS, targets=[(2, 3)])


def moved(states: FloatArray, actions: FloatArray, noise: FloatArray) -> FloatArray:
    """Return where states are after a step: agents at barriers, targets by their flow with noise.

    Noise, of shape (..., 2) as actions are, is standard normal.
    """
    agents = stop_at_barriers(states[..., :2], actions)
    targets = target_flow(states[..., 2:]) + TARGET_DEVIATION * noise
    return np.concatenate([agents, targets], axis=-1)


def _is_active(offsets: FloatArray) -> BoolArray:
    return np.asarray(active_beam(offsets)[..., np.newaxis] == np.arange(NUM_BEAMS))


def reading_log_likelihood(
    states: FloatArray, look: int, reading: FloatArray, beams: IntArray | None = None
) -> FloatArray:
    """Return log p(reading | state) up to a constant, shape (n,).

    Beams that do not hold the target say nothing of it, so that one beam of each state counts: how
    likely its reading is there, compared with how likely it would be if the beam held nothing.
    ``beams`` are those that hold the target, where that is known already.
    """
    offsets = states[:, 2:] - states[:, :2]
    distance = _norm(offsets[:, 0], offsets[:, 1])
    own = reading[active_beam(offsets) if beams is None else beams]
    held = (own - distance) / (_LOOK_DEVIATION if look else _BEAM_DEVIATION)
    empty = (own - _EMPTY_BEAM) / _BEAM_DEVIATION
    return np.asarray(0.5 * (empty * empty - held * held))
