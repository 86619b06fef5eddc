"""The implementation of 2017, emulated: its filter with its defects, our models and policies.

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

The selector of sensing actions is the random one, which asks nothing of the entropies. All trials
run side by side as one batch; a trial leaves the batch when it is done.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from holdfast.problems.problem import FloatArray, IntArray, Problem
from holdfast.randomness import Purpose, stream

BoolArray = npt.NDArray[np.bool_]


class Emulation(NamedTuple):
    """What came of the trials, one entry each.

    Attributes
    ----------
    successes : array of bool
        Whether the goal was reached within the steps allowed.
    rewards : array
        Sum of the rewards until then.
    steps : array of int
        Task actions performed.
    """

    successes: BoolArray
    rewards: FloatArray
    steps: IntArray


def emulate(
    problem: Problem,
    *,
    sensing_interval: int,
    max_steps: int,
    num_trials: int,
    num_particles: int,
    seed: int,
) -> Emulation:
    """Run trials with the random selector as the implementation of 2017 did.

    Parameters
    ----------
    problem : Problem
        Whose observation variances are the same in all states.
    sensing_interval : int
        Steps without an observation after each step with one.
    max_steps, num_trials, num_particles : int
    seed : int
        Names the streams; all trials share one stream per step and purpose.
    """
    world = problem.initial_states(stream(seed, 0, 0, Purpose.WORLD_INITIAL_STATE), num_trials)
    particles = problem.initial_states(
        stream(seed, 0, 0, Purpose.INITIAL_BELIEF), num_trials * num_particles
    ).reshape(num_trials, num_particles, problem.state_size)
    stages = np.zeros(num_trials, dtype=np.int64)
    done = np.array(problem.is_goal(world))
    rewards = np.zeros(num_trials)
    steps = np.zeros(num_trials, dtype=np.int64)

    running = np.flatnonzero(~done)
    world, particles, stages = world[running], particles[running], stages[running]
    for step in range(max_steps):
        if running.size == 0:
            break
        if step % (sensing_interval + 1) == 0:
            particles = _sense(problem, world, particles, seed, step)
        first = particles[:, 0]
        stages = np.asarray(problem.next_stage(first, stages))
        actions = problem.execute(problem.policy(first, stages))
        particles = problem.move(
            particles, actions[:, None, :], stream(seed, 0, step, Purpose.PREDICTION)
        )
        world = problem.move(world, actions, stream(seed, 0, step, Purpose.WORLD_MOTION))
        rewards[running] += problem.reward(world, actions)
        steps[running] += 1
        arrived = np.array(problem.is_goal(world))
        if arrived.any():
            done[running[arrived]] = True
            going = ~arrived
            running, world = running[going], world[going]
            particles, stages = particles[going], stages[going]
    return Emulation(done, rewards, steps)


def _sense(
    problem: Problem, world: FloatArray, particles: FloatArray, seed: int, step: int
) -> FloatArray:
    """Return the particles after one observation per trial, by sensing actions drawn at random."""
    num_actions = len(problem.sensing_actions)
    selection = stream(seed, 0, step, Purpose.SELECTION).uniform(len(world))
    chosen = np.minimum((selection * num_actions).astype(np.int64), num_actions - 1)
    offsets = stream(seed, 0, step, Purpose.RESAMPLING).uniform(len(world))
    noise = stream(seed, 0, step, Purpose.WORLD_OBSERVATION)
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

    Parameters
    ----------
    problem : Problem
    world : array of shape (trials, state_size)
    particles : array of shape (trials, num_particles, state_size)
    action : int
        The sensing action.
    noise : array of shape (trials, observation_size)
        Standard normal numbers, from which the observations are made.

    Returns
    -------
    array of shape (trials, num_particles)
        Plain densities: far from the observation they underflow to zero, as they did in 2017.
    """
    variance = problem.observation_variance(world, action)
    observed = problem.observation_mean(world, action) + np.sqrt(variance) * noise
    difference = observed[:, None, :] - problem.observation_mean(particles, action)
    exponent = -0.5 * (difference * difference / variance).sum(axis=-1)
    return np.asarray(np.exp(exponent) / np.sqrt(np.prod(2.0 * np.pi * variance)))


def drawn_particle(weights: FloatArray, offsets: FloatArray) -> IntArray:
    """Return the particle of each trial that all its particles become.

    Parameters
    ----------
    weights : array of shape (trials, num_particles)
        Need not sum to 1; where all are zero, particle 0 is returned.
    offsets : array of shape (trials,)
        Uniform on [0, 1); from 0 to 1 they go through the particles in proportion to the weights.
    """
    cumulative = np.cumsum(weights, axis=1)
    reached = cumulative >= (offsets * cumulative[:, -1])[:, None]
    return np.asarray(np.argmax(reached, axis=1), dtype=np.int64)
