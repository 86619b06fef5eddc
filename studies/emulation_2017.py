"""The implementation of 2017, emulated: its filter and entropies with their defects, our problems.

A shared defect cannot hide a difference. If our worlds and policies, put into a loop that fails in
the ways in which the first implementation's loop failed, succeed as often and earn as much as it
did, then what differs in holdfast's own results is the filter and not the problem.

What failed in 2017:

- The resampler's comb was computed in integers, so after every observation all particles were
  copies of one, drawn with a probability proportional to its weight.
- An observation replaced the weights by the likelihoods instead of multiplying them. These were
  plain numbers, not logarithms: where all underflowed to zero, every particle became a copy of
  particle 0.
- The task action was that of particle 0, and the stage of the task advanced with particle 0.
- The k nearest neighbours of a point included the point itself, and the entropy was summed over the
  neighbours' mean weight instead of the point's own::

      H = log k - psi(k) - sum_n (W_n / k) log(W_n / (c_d r_n^d)),

  W_n the weight of the k nearest, r_n the distance to the last of them, c_d the volume of the unit
  ball and d the number of coordinates, also where the policy leaves some of them at zero. Equal
  points make it minus infinity, and minus infinity wins; if that, or no number, is what all sensing
  actions have, one of them is drawn.
- Each hypothetical observation was drawn for one sensing action alone.

Source: T. Greigarn's ``estimateEntropy`` and ``ActiveSensing::getSensingAction``, as published; the
formula is theirs, the code here is not.

All trials run side by side as one batch; a trial leaves the batch when it is done.
"""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import pandas as pd

from holdfast.numerics.arrays import FloatArray, IntArray
from holdfast.numerics.randomness import Purpose, stream
from holdfast.planning.settings import PlanningSettings
from holdfast.problems.problem import Problem
from studies.trial_batches import TrialSeries, problem_of

_TRIALS_AT_A_TIME = 16
"""Trials whose hypothetical weights are in memory together: a megabyte, which caches hold."""

_NEGLIGIBLE = 1e-16
"""Weight below which a neighbourhood was left out."""


def run_emulation(first_trial: int, **series: Any) -> pd.DataFrame:
    """Run trials of a series as the implementation of 2017 did.

    The function of tasks of the kind ``emulation_2017``: it gets the fields of
    :class:`TrialSeries`, whose problem has the same observation variances in all states. All these
    trials share one stream per step and purpose.
    """
    wanted = msgspec.convert(series, TrialSeries)
    problem, planning = problem_of(wanted.problem, wanted.model), wanted.planning
    num_trials, num_particles = wanted.num_trials, planning.particle_filter.num_particles
    world = problem.initial_states(
        stream(wanted.seed, first_trial, 0, Purpose.WORLD_INITIAL_STATE), num_trials
    )
    particles = problem.initial_states(
        stream(wanted.seed, first_trial, 0, Purpose.INITIAL_BELIEF), num_trials * num_particles
    ).reshape(num_trials, num_particles, problem.state_size)
    stages = np.zeros(num_trials, dtype=np.int64)
    done = np.array(problem.is_goal(world))
    rewards = np.zeros(num_trials)
    steps = np.zeros(num_trials, dtype=np.int64)

    # Whatever is drawn in step t is named by this, t and its purpose.
    name = (wanted.seed, first_trial)
    running = np.flatnonzero(~done)
    world, particles, stages = world[running], particles[running], stages[running]
    for step in range(wanted.max_steps):
        if running.size == 0:
            break
        if step % (planning.sensing_interval + 1) == 0:
            chosen = _chosen(problem, planning, particles, stages, running, name, step)
            particles = _sense(problem, world, particles, chosen, name, step)
        first = particles[:, 0]
        stages = np.asarray(problem.next_stage(first, stages))
        actions = problem.limit_action(problem.policy(first, stages))
        particles = problem.move(
            particles, actions[:, None, :], stream(*name, step, Purpose.PREDICTION)
        )
        world = problem.move(world, actions, stream(*name, step, Purpose.WORLD_MOTION))
        rewards[running] += problem.reward(world, actions)
        steps[running] += 1
        arrived = np.array(problem.is_goal(world))
        if arrived.any():
            done[running[arrived]] = True
            going = ~arrived
            running, world = running[going], world[going]
            particles, stages = particles[going], stages[going]
    return pd.DataFrame(
        {
            "trial": first_trial + np.arange(num_trials),
            "success": done,
            "steps": steps,
            "reward": rewards,
        }
    )


def _chosen(
    problem: Problem,
    planning: PlanningSettings,
    particles: FloatArray,
    stages: IntArray,
    running: IntArray,
    name: tuple[int, int],
    step: int,
) -> IntArray:
    """Return the sensing action of each trial."""
    if planning.selector.method == "random":
        num_actions = len(problem.sensing_actions)
        selection = stream(*name, step, Purpose.SELECTION).uniform(len(particles))
        return np.minimum((selection * num_actions).astype(np.int64), num_actions - 1)
    chosen = np.empty(len(particles), dtype=np.int64)
    for first in range(0, len(particles), _TRIALS_AT_A_TIME):
        some = slice(first, first + _TRIALS_AT_A_TIME)
        # Any name that no other draw of these trials has.
        own = (name[0], name[1] + int(running[first]))
        entropies = _entropies(problem, planning, particles[some], stages[some], own, step)
        drawn = stream(*own, step, Purpose.SELECTION).uniform(len(entropies))
        chosen[some] = least_of(entropies, drawn)
    return chosen


def _entropies(
    problem: Problem,
    planning: PlanningSettings,
    particles: FloatArray,
    stages: IntArray,
    name: tuple[int, int],
    step: int,
) -> FloatArray:
    """Return the entropy after each sensing action, summed over its hypothetical observations.

    Shape (trials, sensing actions).
    """
    points = particles
    if planning.selector.method == "action_entropy":
        points = np.stack(
            [problem.policy(own, int(stage)) for own, stage in zip(particles, stages, strict=True)]
        )
    neighbors, log_volumes = _neighborhoods(points, planning.active_sensing.num_nearest_neighbors)
    samples = planning.active_sensing.num_observation_samples
    num_actions = len(problem.sensing_actions)
    trials, count, _ = particles.shape
    hypotheses = stream(*name, step, Purpose.HYPOTHESES)
    shape = (trials, num_actions, samples)
    drawn = np.minimum((hypotheses.uniform(shape) * count).astype(np.int64), count - 1)
    entropies = np.empty((trials, num_actions))
    for action in range(num_actions):
        states = np.take_along_axis(particles, drawn[:, action, :, None], axis=1)
        noise = hypotheses.substream(1 + action).normal(
            (trials, samples, problem.observation_mean(states[:1, 0], action).shape[-1])
        )
        variance = problem.observation_variance(particles[:, 0], action)
        observed = problem.observation_mean(states, action) + np.sqrt(variance) * noise
        expected = problem.observation_mean(particles, action)
        scale = np.sqrt(variance)
        weights = np.exp(-0.5 * _squared_distances(observed / scale, expected / scale))
        # Where none is likely this is 0 / 0, as it was.
        with np.errstate(invalid="ignore"):
            weights /= weights.sum(axis=-1, keepdims=True)
        entropies[:, action] = entropy_of_neighborhoods(weights, neighbors, log_volumes).sum(axis=1)
    return entropies


def _squared_distances(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the squared distances (trials, a, b) of points (trials, a, d) and (trials, b, d)."""
    squares = np.zeros((first.shape[0], first.shape[1], second.shape[1]))
    # One coordinate after the other: arrays with the few coordinates as last axis are slow.
    for coordinate in range(first.shape[2]):
        difference = first[:, :, None, coordinate] - second[:, None, :, coordinate]
        difference *= difference
        squares += difference
    return squares


def _neighborhoods(points: FloatArray, neighbors: int) -> tuple[IntArray, FloatArray]:
    """Return the nearest neighbours of each point, itself among them, and the log volume around it.

    Of points of shape (trials, num_particles, d): indices of shape (trials, num_particles,
    neighbors), and logarithms of shape (trials, num_particles); minus infinity where all neighbours
    are the same point.
    """
    squares = _squared_distances(points, points)
    indices = np.argpartition(squares, neighbors - 1, axis=-1)[..., :neighbors]
    farthest = np.take_along_axis(squares, indices, axis=-1).max(axis=-1)
    size = points.shape[-1]
    log_ball = 0.5 * size * math.log(math.pi) - math.lgamma(0.5 * size + 1.0)
    with np.errstate(divide="ignore"):
        return indices, log_ball + 0.5 * size * np.log(farthest)


def entropy_of_neighborhoods(
    weights: FloatArray, indices: IntArray, log_volumes: FloatArray
) -> FloatArray:
    """Return the entropies (trials, samples) that the implementation of 2017 estimated.

    Weights of shape (trials, samples, num_particles): each row sums to 1, or is not a number where
    no particle was likely. Indices (trials, num_particles, k) of the nearest points of each, itself
    among them; logarithms (trials, num_particles) of the volumes of the balls that hold them.
    """
    neighbors = indices.shape[-1]
    trials, samples, count = weights.shape
    # A neighbour after the other, in one flat gather each.
    mass = np.zeros(weights.shape)
    rows = count * np.arange(trials * samples).reshape(trials, samples, 1)
    for neighbor in range(neighbors):
        mass += weights.reshape(-1).take(rows + indices[:, None, :, neighbor])
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = mass * (np.log(mass) - log_volumes[:, None, :]) / neighbors
    terms = np.where(mass <= _NEGLIGIBLE, 0.0, terms)
    digamma = -np.euler_gamma + sum(1.0 / number for number in range(1, neighbors))
    return np.asarray(math.log(neighbors) - digamma - terms.sum(axis=-1))


def least_of(entropies: FloatArray, drawn: FloatArray) -> IntArray:
    """Return the column of the least entropy in each row, as the implementation of 2017 did.

    No number loses against any; minus infinity wins, the first one of several. Where all are one or
    the other, what was ``drawn`` decides: a number on [0, 1) for each row.
    """
    numbers = np.where(np.isnan(entropies), np.inf, entropies)
    chosen = np.argmin(numbers, axis=1)
    count = entropies.shape[1]
    undecided = np.isnan(entropies) | (entropies == -np.inf)
    random = np.minimum((drawn * count).astype(np.int64), count - 1)
    return np.asarray(np.where(undecided.all(axis=1), random, chosen), dtype=np.int64)


def _sense(
    problem: Problem,
    world: FloatArray,
    particles: FloatArray,
    chosen: IntArray,
    name: tuple[int, int],
    step: int,
) -> FloatArray:
    """Return the particles after one observation per trial."""
    num_actions = len(problem.sensing_actions)
    offsets = stream(*name, step, Purpose.RESAMPLING).uniform(len(world))
    noise = stream(*name, step, Purpose.WORLD_OBSERVATION)
    copied = np.zeros(len(world), dtype=np.int64)
    for action in range(num_actions):
        trials = np.flatnonzero(chosen == action)
        shape = (trials.size, *problem.observation_mean(world[:1], action).shape[1:])
        weights = likelihoods(
            problem, world[trials], particles[trials], action, noise.substream(action).normal(shape)
        )
        copied[trials] = drawn_particle(weights, offsets[trials])
    picked = particles[np.arange(len(world)), copied]
    return np.ascontiguousarray(np.broadcast_to(picked[:, None, :], particles.shape))


def likelihoods(
    problem: Problem, world: FloatArray, particles: FloatArray, action: int, noise: FloatArray
) -> FloatArray:
    """Return the densities of one observation per world in each of its particles.

    Of shape (trials, num_particles). Plain densities: far from the observation they underflow to
    zero, as they did in 2017. The observations are made of standard normal ``noise``.
    """
    variance = problem.observation_variance(world, action)
    observed = problem.observation_mean(world, action) + np.sqrt(variance) * noise
    difference = observed[:, None, :] - problem.observation_mean(particles, action)
    exponent = -0.5 * (difference * difference / variance).sum(axis=-1)
    return np.asarray(np.exp(exponent) / np.sqrt(np.prod(2.0 * np.pi * variance)))


def drawn_particle(weights: FloatArray, offsets: FloatArray) -> IntArray:
    """Return the particle of each trial that all its particles become.

    Weights (trials, num_particles) need not sum to 1; where all are zero, it is particle 0. Offsets
    from 0 to 1 go through the particles in proportion to the weights.
    """
    cumulative = np.cumsum(weights, axis=1)
    reached = cumulative >= (offsets * cumulative[:, -1])[:, None]
    return np.asarray(np.argmax(reached, axis=1), dtype=np.int64)
