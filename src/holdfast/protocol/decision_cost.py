"""What an answer costs, in seconds of one core and in bytes, before it is computed.

A robot chooses its settings, and a service has to know what they ask of it before it begins. So
everything that a computation repeats is a factor here: particles, samples, sensing actions, steps
of a horizon, of a path, of a rollout, neighbours, inputs of the request, steps to roll forward.
Each numeric setting is either in :data:`COSTLY` or, with the reason, in :data:`FREE`; a test holds
it.

What the problem's own functions take is measured (:class:`ProblemCost`), because a problem is
anybody's code and its model may have any number of walls. What holdfast's code takes was measured
once; ``slowness`` is how many times as long it takes on this machine. The estimate is for the worst
belief, so most computations take less. ``python -m benchmarks.decision_cost`` compares.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

from holdfast import _kernel
from holdfast.planning.expected_return import has_own_rollouts
from holdfast.planning.settings import (
    ENTROPY_METHODS,
    PRIOR_ESTIMATORS,
    UNINFORMED_METHODS,
    PlanningSettings,
    estimator_of,
    path_steps,
)
from holdfast.problems.attributes import has_general_observations, has_own
from holdfast.problems.problem import Problem

COSTLY: Mapping[str, str] = {
    "particle_filter.num_particles": "every method",
    "active_sensing.num_observation_samples": "informed",
    "active_sensing.horizon": "entropy, covariance",
    "active_sensing.num_nearest_neighbors": "neighbours",
    "selector.path_offsets": "path_entropy",
    "selector.rollout_steps": "expected_return",
    "selector.rollout_sensing_steps": "expected_return",
    "selector.max_observation_samples": "expected_return",
    "sensing_interval": "every method",
}
"""Numeric settings that are factors, and for which methods."""

FREE: Mapping[str, str] = {
    "particle_filter.resampling_threshold": "resampling is counted for each observation",
    "active_sensing.discount": "a factor of values, not of their number",
    "active_sensing.num_cores": "the service chooses it; seconds are those of one core",
    "selector.sensing_action": "a choice that is returned as it is",
    "selector.nats_per_cost": "a factor of values",
    "selector.resolution": "the cost is that of the worst resolution",
    "selector.path_discount": "a factor of values",
}
"""Numeric settings that are no factors, and why."""


class CallCost(NamedTuple):
    """Seconds of a function: of a call, and of each state that it is given."""

    call_s: float
    state_s: float

    def of(self, states: float, calls: float = 1.0) -> float:
        """Return the seconds of some calls with so many states together."""
        return calls * self.call_s + states * self.state_s


class ProblemCost(NamedTuple):
    """Seconds that a problem's functions take."""

    # initial, move, stage: time of ``initial_states``, ``move`` and ``next_stage``.
    initial: CallCost
    move: CallCost
    stage: CallCost
    act: CallCost  # time of ``policy`` and ``limit_action`` together
    # Time of the mean and variance of one sensing action's observation; with a general likelihood,
    # of drawing an observation and evaluating it.
    sense: CallCost
    judge: CallCost  # time of ``reward``, ``is_goal`` and ``is_failure`` together
    path_step: CallCost  # time of one step of a noise-free path
    known_return: CallCost | None  # time of ``known_state_return``; None without one
    observation_size: int  # numbers in the largest observation


TYPICAL_PROBLEM = ProblemCost(
    initial=CallCost(8e-6, 70e-9),
    move=CallCost(7e-6, 80e-9),
    stage=CallCost(3e-6, 20e-9),
    act=CallCost(12e-6, 40e-9),
    sense=CallCost(2e-6, 5e-9),
    judge=CallCost(8e-6, 30e-9),
    path_step=CallCost(2e-6, 15e-9),
    known_return=None,
    observation_size=2,
)
"""Costs of a problem that was not measured."""


class Cost(NamedTuple):
    """Seconds of one core, and the most bytes that are taken at a time."""

    seconds: float
    num_bytes: float


class Reaching(NamedTuple):
    """What it takes at most to reach a state."""

    least: Cost  # of what each one takes
    begin_s: float  # for the initial belief
    step_s: float  # for each step by which it is rolled forward, those of the task part included
    fold_s: float  # for each observation
    byte_s: float  # for each byte of the request

    def cost(self, *, steps: float, inputs: float, begins: bool, num_bytes: float) -> Cost:
        """Return the cost of one state; ``begins`` if it is reached from the initial belief."""
        seconds = self.least.seconds + (self.begin_s if begins else 0.0) + steps * self.step_s
        seconds += inputs * self.fold_s + num_bytes * self.byte_s
        return Cost(seconds, self.least.num_bytes + 3.0 * num_bytes)


class Price(NamedTuple):
    """What is the same for all decisions of a session."""

    problem: ProblemCost
    sensing: Cost
    reaching: Reaching


class Pricing(NamedTuple):
    """What a service knows of the machine that it runs on."""

    slowness: float = 1.0  # how many times as long it takes as the one for which the model was made
    # Measures a problem's functions. None takes what is typical.
    measure: Callable[[Problem], ProblemCost] | None = None

    def price_of(
        self, problem: Problem, planning: PlanningSettings, known: ProblemCost | None = None
    ) -> Price:
        """Return what decisions cost; ``known`` is what the problem does, if it was measured."""
        own = known or (TYPICAL_PROBLEM if self.measure is None else self.measure(problem))
        sizes = _Sizes(problem, planning, own, self.slowness)
        return Price(own, _cost_of_sensing(sizes), _cost_of_reaching(sizes))


ANY_MACHINE = Pricing()
"""Where nothing was measured."""


# Times are in nanoseconds, on the machine on which they were measured.
_LIKELIHOOD = 8.0
"""For a posterior's weight, and again for each coordinate of the observation."""
_NEAREST_ALONE, _NEAREST_TOGETHER, _GROUP = 420.0, 90.0, 32
"""For a point's neighbours in one posterior alone, and in one of a group of this size."""
_NEIGHBOR, _SQUARED_NEIGHBOR = 50.0, 0.17
"""For each neighbour beyond five; many are kept in order, so the square counts too."""
_SAMPLED_PAIR, _SAMPLED_WEIGHT = 1.2, 15.0
"""For a pair of a term of the kernel's sample and a particle; for a weight."""
_MIXTURE_PAIR = 0.28
_PRIOR_PAIR, _PRIOR_MEMBER, _PRIOR_LANES = 4.0, 4.0, 8
_ADD = 2.0
"""For each number in a pass over an array."""
_CONTACT = 2.0
"""A move in contact takes so many times as long as a free one, which is measured."""
_PYTHON = 60e3
"""For the Python code around a handful of calls."""
_MODE_PARTICLES, _MODE_STARTS, _MODE_CLIMBS, _MODE_SPLITS = 1000, 16, 10, 3
"""Sizes in :mod:`holdfast.planning.modes`."""

_CLOUD = 8.0
"""Particles that follow each estimate of a rollout."""
_WEIGHTS_BYTES = 64 << 20
_GROUP_BYTES = 15.0 * _GROUP  # for each particle
_GAINS_BYTES = 16 << 20
_BLOCK = 1 << 20
"""Sizes of the kernel's batches and of :mod:`holdfast.planning.sensing`'s blocks."""


class _Sizes:
    """The numbers of one decision, and what all its parts are made of."""

    def __init__(
        self, problem: Problem, planning: PlanningSettings, own: ProblemCost, slowness: float
    ) -> None:
        sensing, selector = planning.active_sensing, planning.selector
        self.problem = problem
        self.planning = planning
        self.own = own
        self.unit_s = 1e-9 * slowness
        self.particles = float(planning.particle_filter.num_particles)
        self.coordinates = float(max(problem.state_size, 1))
        self.action_size = float(max(problem.action_size, 1))
        self.senses = float(len(problem.sensing_actions))
        self.choices = self.senses + selector.sensing_is_optional
        self.samples = float(sensing.num_observation_samples)
        self.general = has_general_observations(problem)
        self.problem_has_angles = len(getattr(problem, "circular", ())) > 0
        self.state_bytes = 8.0 * self.particles * (self.coordinates + 1.0)

    def estimate_s(self) -> float:
        """Return the seconds of a state that stands for a belief."""
        number = 4.0 + _ADD * self.coordinates
        if self.problem_has_angles:
            number += 60.0 * self.coordinates
        found = 15e3 + number * self.particles
        if self.planning.particle_filter.estimate == "heaviest_mode":
            shown = min(self.particles, float(_MODE_PARTICLES))
            found += _MODE_SPLITS * (
                self.coordinates * (100e3 + 200.0 * self.particles + _MODE_STARTS * shown * 10.0)
                + _MODE_CLIMBS * _MODE_STARTS * shown * 10.0
            )
        return found * self.unit_s

    def act_s(self, times: float) -> float:
        """Return the seconds of so many task actions, each of a belief's estimate."""
        one = self.own.act.of(1.0) + self.own.stage.of(1.0) + 25e3 * self.unit_s
        return times * (self.estimate_s() + one)

    def step_s(self) -> float:
        """Return the seconds of a task action and the move of all particles."""
        # Choosing and moving each ask for the estimate.
        return 1.3 * self.act_s(2.0) + self.move_s(self.particles)

    def move_s(self, states: float, calls: float = 1.0) -> float:
        """Return the seconds of moves."""
        return _CONTACT * self.own.move.of(states, calls)

    def hypotheses_s(self, actions: float, samples: float) -> float:
        """Return the seconds of hypothetical observations and their posteriors."""
        size = self.own.observation_size
        weights = actions * samples * self.particles
        likelihoods = weights * (_LIKELIHOOD + _ADD * size) * self.unit_s
        if self.general:
            likelihoods += actions * samples * 5e3 * self.unit_s
            return likelihoods + self.own.sense.of(weights, actions * samples)
        predicted = self.own.sense.of(actions * self.particles, actions)
        return predicted + likelihoods + actions * size * self.particles * 10.0 * self.unit_s

    def entropies_s(self, posteriors: float, sets: float, dimension: float) -> float:
        """Return the seconds of the entropies of posteriors, each of several sets of points."""
        selector, particles = self.planning.selector, self.particles
        if selector.method == "action_covariance":
            return posteriors * sets * particles * 2.0 * _ADD * dimension * self.unit_s
        kind = estimator_of(selector, int(particles))
        neighbors = min(float(self.planning.active_sensing.num_nearest_neighbors), particles)
        wide = 1.0 + max(0.0, dimension - 3.0) / 3.0
        terms = particles if particles <= _kernel.few_up_to else _kernel.sample_of_groups
        groups = math.ceil(posteriors / _GROUP)
        if kind == "nearest_neighbor":
            together = min(posteriors, float(_GROUP))
            point = _NEAREST_TOGETHER + (_NEAREST_ALONE - _NEAREST_TOGETHER) / together
            # A tree is descended.
            point *= 1.0 + math.log2(1.0 + particles / 1000.0) / 2.0
            point += _NEIGHBOR * max(0.0, neighbors - 5.0)
            point += _SQUARED_NEIGHBOR * neighbors * neighbors
            found = posteriors * sets * terms * point * wide
            if terms < particles:
                weight = _SAMPLED_WEIGHT * posteriors + _SAMPLED_PAIR * groups * terms
                found += sets * particles * weight
        elif kind in PRIOR_ESTIMATORS:
            pair = _PRIOR_PAIR + min(0.45 * neighbors, 9.0 * math.log2(1.0 + neighbors))
            pieces = math.ceil(posteriors / _PRIOR_LANES)
            members = particles * particles
            found = sets * (
                particles * particles * (pair + dimension)
                + pieces * (_PRIOR_MEMBER * members + 20.0 * _PRIOR_LANES * particles)
            )
        else:
            pairs = terms * particles * sets * groups * _GROUP
            found = (pairs * _MIXTURE_PAIR + posteriors * sets * particles * 100.0) * wide
        return (found + sets * particles * 400.0) * self.unit_s

    def entropy_bytes(self, posteriors: float, sets: float, dimension: float) -> float:
        """Return what the kernel takes for these."""
        particles = self.particles
        batch = min(posteriors, max(float(_GROUP), (_WEIGHTS_BYTES >> 3) / particles))
        together = max(particles, min(sets * particles, float(_BLOCK)))
        kept = sets * particles * (24.0 * dimension + 64.0)
        if estimator_of(self.planning.selector, int(particles)) in PRIOR_ESTIMATORS:
            # The posteriors once more, point by point, and what they gain at each of these.
            gains = min(8.0 * sets * batch * particles, float(_GAINS_BYTES))
            return 8.0 * batch * particles + kept + 2.0 * gains
        # A quarter and a tenth more: what of these is given back late.
        return 1.25 * 8.0 * batch * particles + 1.1 * _GROUP_BYTES * together + kept


def _cost_of_sensing(sizes: _Sizes) -> Cost:
    """Return the most that the choice of a sensing action takes."""
    planning, own = sizes.planning, sizes.own
    method = planning.selector.method
    if method in UNINFORMED_METHODS:
        return Cost(2.0 * _PYTHON * sizes.unit_s, sizes.state_bytes)
    if method == "expected_return":
        return _expected_return(sizes)
    dimension = sizes.coordinates if method == "state_entropy" else sizes.action_size
    posteriors = sizes.choices * sizes.samples
    sets = 1.0
    seconds = _PYTHON * sizes.unit_s + sizes.hypotheses_s(sizes.senses, sizes.samples)
    predicted = 24.0 * sizes.senses * own.observation_size * sizes.particles
    if sizes.general:
        predicted = 16.0 * posteriors * sizes.particles
    num_bytes = 4.0 * sizes.state_bytes + predicted + 16.0 * posteriors
    way_bytes = 0.0
    if method == "path_entropy":
        offsets = path_steps(planning)
        sets = float(len(offsets))
        seconds += _path_s(sizes, float(max(offsets, default=0)))
        way_bytes = sets * sizes.particles * 8.0 * (2.0 * sizes.coordinates + 4.0 * dimension + 2)
    if method in ENTROPY_METHODS and len(getattr(sizes.problem, "circular_actions", ())):
        seconds += sets * sizes.particles * dimension * 150.0 * sizes.unit_s
    seconds += own.act.of(sets * sizes.particles)
    seconds += sizes.entropies_s(posteriors, sets, dimension)
    # The way is over before the entropies begin.
    num_bytes += max(way_bytes, sizes.entropy_bytes(posteriors, sets, dimension))
    later = float(planning.active_sensing.horizon - 1)
    if later > 0.0:
        each = (
            sizes.act_s(1.0)
            + sizes.move_s(sizes.particles)
            + own.act.of(sizes.particles)
            + sizes.entropies_s(1.0, 1.0, dimension)
            + _PYTHON * sizes.unit_s
        )
        seconds += sizes.hypotheses_s(sizes.senses, sizes.samples) + later * posteriors * each
        block = max(
            sizes.particles * sizes.coordinates,
            min(float(_BLOCK), posteriors * sizes.particles * sizes.coordinates),
        )
        num_bytes += 24.0 * posteriors * sizes.particles + 64.0 * block
    return Cost(seconds, num_bytes)


def _path_s(sizes: _Sizes, steps: float) -> float:
    """Return the seconds in which all particles follow their paths."""
    own = sizes.own
    if has_own(sizes.problem, "expected_path", ("policy", "limit_action", "move", "next_stage")):
        return own.path_step.of(steps * sizes.particles)
    one = own.act.of(sizes.particles) + sizes.move_s(sizes.particles)
    return steps * (one + own.stage.of(sizes.particles) + 10e3 * sizes.unit_s)


def _expected_return(sizes: _Sizes) -> Cost:
    """Return the cost of the method ``expected_return``, if no sensing action is given up early."""
    planning, own, unit_s = sizes.planning, sizes.own, sizes.unit_s
    selector = planning.selector
    choices, particles = sizes.choices, sizes.particles
    samples = max(sizes.samples, float(selector.max_observation_samples))
    # Each round doubles the samples.
    rounds = 1.0 + math.ceil(math.log2(samples / sizes.samples))
    posteriors = choices * samples
    seconds = sizes.hypotheses_s(sizes.senses, samples)
    seconds += posteriors * (sizes.estimate_s() + (25e3 + 14.0 * particles) * unit_s)
    steps = float(selector.rollout_steps)
    interval = planning.sensing_interval + 1.0
    num_bytes = 16.0 * choices * samples * particles + 24.0 * choices * samples * rounds
    if not sizes.general:
        num_bytes += 24.0 * sizes.senses * own.observation_size * particles
    if has_own_rollouts(sizes.problem):
        # The true state and two particles; and once at each look the way from there.
        unknown_steps = min(steps, interval * selector.rollout_sensing_steps)
        known_steps = min(steps / interval, float(selector.rollout_sensing_steps)) * steps
        seconds += posteriors * 6.0 * unknown_steps * sizes.move_s(1.0, 0.0)
        seconds += posteriors * 20.0 * known_steps * unit_s
        return Cost(seconds, num_bytes)
    # Columns of a rollout: it forks at each of the next looks, and carries a cloud up to the last.
    looks = min(float(selector.rollout_sensing_steps), math.floor((steps - 1.0) / interval))
    forks = 0.0 if own.known_return is not None else looks
    unknown_steps = min(steps, interval * selector.rollout_sensing_steps)
    column_steps = unknown_steps * (1.0 + forks / 2.0)
    if own.known_return is None:
        column_steps += (steps - unknown_steps) * forks
    else:
        seconds += own.known_return.of(posteriors * looks, rounds * looks)
    cloud_steps = _CLOUD * unknown_steps
    state_s = own.act.state_s + own.stage.state_s + own.judge.state_s + sizes.move_s(1.0, 0.0)
    numbers = sizes.coordinates + sizes.action_size
    state_s += (150.0 + 30.0 * numbers) * unit_s
    cloud_s = sizes.move_s(1.0, 0.0) + (10.0 + 12.0 * numbers) * unit_s
    if sizes.problem_has_angles:
        cloud_s += 60.0 * sizes.coordinates * unit_s
    seconds += posteriors * (column_steps * state_s + cloud_steps * cloud_s)
    call_s = own.act.call_s + own.stage.call_s + own.judge.call_s
    call_s += choices * (own.move.call_s + 3e3 * unit_s) + 3.0 * _PYTHON * unit_s
    seconds += rounds * steps * call_s
    last = samples if rounds == 1.0 else max(sizes.samples, samples / 2.0)
    columns = 1.0 + forks
    num_bytes += 6.0 * sizes.state_bytes + 8.0 * choices * last * (
        columns * (4.0 * numbers + 8.0) + 4.0 * _CLOUD * numbers
    )
    return Cost(seconds, num_bytes)


def _cost_of_reaching(sizes: _Sizes) -> Reaching:
    """Return what it takes to reach the states of a session."""
    own, particles, size = sizes.own, sizes.particles, float(sizes.own.observation_size)
    # Likelihood, gate and resampling.
    number = 30.0 + 10.0 * size + 6.0 * size * size + 6.0 * sizes.coordinates
    fold_s = (2.0 * _PYTHON + particles * number) * sizes.unit_s + own.sense.of(particles)
    if sizes.general and getattr(sizes.problem, "rank_test", False):
        fold_s += 19.0 * (own.sense.of(particles) + 20.0 * particles * sizes.unit_s)
    return Reaching(
        Cost(
            (2.0 * _PYTHON + 2.0 * sizes.state_bytes) * sizes.unit_s,
            8.0 * sizes.state_bytes + 24.0 * size * particles,
        ),
        own.initial.of(particles),
        sizes.step_s(),
        fold_s + own.stage.of(1.0),
        4.0 * sizes.unit_s,
    )


def describe_cost(problem: Problem | None, planning: PlanningSettings) -> str:
    """Name the settings that a decision's cost comes from, with their values."""
    sensing, selector = planning.active_sensing, planning.selector
    parts = [
        f"selector.method {selector.method}",
        f"particle_filter.num_particles {planning.particle_filter.num_particles}",
    ]
    if selector.method not in UNINFORMED_METHODS:
        parts.append(f"active_sensing.num_observation_samples {sensing.num_observation_samples}")
    if problem is not None:
        parts.append(f"{len(problem.sensing_actions)} sensing actions")
    if selector.method == "expected_return":
        parts += [
            f"selector.max_observation_samples {selector.max_observation_samples}",
            f"selector.rollout_steps {selector.rollout_steps}",
            f"selector.rollout_sensing_steps {selector.rollout_sensing_steps}",
        ]
    elif selector.method not in UNINFORMED_METHODS:
        parts.append(f"active_sensing.num_nearest_neighbors {sensing.num_nearest_neighbors}")
        if selector.method == "path_entropy":
            parts.append(f"selector.path_offsets {list(selector.path_offsets)}")
        else:
            parts.append(f"active_sensing.horizon {sensing.horizon}")
    parts.append(f"sensing_interval {planning.sensing_interval}")
    return ", ".join(parts)
