"""What the robot's loop acts on: a world that can be sensed and moved.

The loop knows three methods. The simulated world is made from the problem and draws from streams
of its own; a real robot is another object with the same three methods.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from holdfast import contract
from holdfast.errors import InvalidValueError
from holdfast.problems.problem import Problem
from holdfast.randomness import Purpose, stream

__all__ = ["Environment", "SimulatedEnvironment"]

FloatArray = npt.NDArray[np.float64]


@runtime_checkable
class Environment(Protocol):
    """A world that can be sensed and moved."""

    def perform_sensing(self, sensing_action: int) -> FloatArray:
        """Perform a sensing action and return what it shows, shape ``(observation_size,)``."""
        ...

    def perform(self, task_action: FloatArray) -> float | None:
        """Perform a task action and return its reward, or None where there is none."""
        ...

    def is_done(self) -> bool:
        """Tell whether the task is done."""
        ...


class SimulatedEnvironment:
    """A world made from a problem, with random streams of its own.

    What happens is a function of (seed, trial) and of the task actions performed so far: sensing
    draws from a stream of its own and so does not change how the world moves.

    Parameters
    ----------
    problem : Problem
    seed, trial : int
        Name the random streams; see :func:`holdfast.randomness.stream`.

    Attributes
    ----------
    state : array of shape (state_size,)
        The true state.
    step : int
        Task actions performed so far.
    """

    def __init__(self, problem: Problem, seed: int, trial: int) -> None:
        self._problem = problem
        self._seed = seed
        self._trial = trial
        self.step = 0
        initial = stream(seed, trial, 0, Purpose.WORLD_INITIAL_STATE)
        drawn = problem.initial_states(initial, 1)
        shape = (1, problem.state_size)
        self.state: FloatArray = contract.states_of(problem, "initial_states", drawn, shape)[0]

    def perform_sensing(self, sensing_action: int) -> FloatArray:
        """Draw an observation of the true state.

        Raises
        ------
        InvalidValueError
            If the sensing action does not exist.
        """
        problem = self._problem
        if not 0 <= sensing_action < len(problem.sensing_actions):
            raise InvalidValueError(
                f"sensing action {sensing_action}: {problem.name} has 0 to "
                f"{len(problem.sensing_actions) - 1}"
            )
        noise = stream(self._seed, self._trial, self.step, Purpose.WORLD_OBSERVATION)
        draw = getattr(problem, "sample_observation", None)
        if draw is not None:
            observation: FloatArray = draw(self.state, sensing_action, noise)
            return observation
        mean = contract.observation_mean(problem, self.state, sensing_action)
        variance = contract.observation_variance(problem, self.state, sensing_action, mean)
        shown: FloatArray = mean + np.sqrt(variance) * noise.normal(mean.shape)
        return shown

    def perform(self, task_action: FloatArray) -> float:
        """Move the true state by an executed task action and return the reward."""
        motion = stream(self._seed, self._trial, self.step, Purpose.WORLD_MOTION)
        problem = self._problem
        moved = problem.move(self.state, task_action, motion)
        self.state = contract.states_of(problem, "move", moved, self.state.shape)
        self.step += 1
        return contract.scalar(problem, "reward", problem.reward(self.state, task_action))

    def is_done(self) -> bool:
        """Tell whether the true state is a goal."""
        problem = self._problem
        return bool(contract.scalar(problem, "is_goal", problem.is_goal(self.state)))
