"""A gymnasium environment as a robot's world.

gymnasium shows everything at each step. A robot that senses actively does not have that: it has to
choose. So here an observation of gymnasium's stays behind a curtain, and each sensing action shows
a part of it, with noise if you say so. What comes with a move by itself (an encoder, a contact) may
be shown too. How an episode ends is told honestly: ``terminated`` is a success only if somebody
says by what one knows it, and ``truncated`` is neither success nor failure.

For each part there is plain data, for configurations, and a function, for the rest::

    environment:
      object: gymnasium
      arguments:
        env_id: MountainCarContinuous-v0
        sensing: [[0], [1]]         # the first sensing action shows coordinate 0, the second 1
        sensing_noise: [0.05, 0.01] # standard deviations
        success: terminated         # this one terminates at the goal alone
"""

from __future__ import annotations

import copy
import importlib
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from holdfast.errors import (
    ConfigurationError,
    EnvironmentFailedError,
    InvalidValueError,
    how_to_install,
)
from holdfast.numerics.arrays import (
    FloatArray,
    floats,
    in_brief,
    integer,
    plain,
    real_number,
    real_numbers,
)
from holdfast.numerics.randomness import Purpose, seed_and_trial, stream
from holdfast.planning.outcome import Done, Ending, MoveResult
from holdfast.printable import brief
from holdfast.problems.problem import Problem

if TYPE_CHECKING:
    import gymnasium

Function: TypeAlias = Callable[..., Any] | str
"""A function, or the name of one: ``module:function``."""

Coordinates: TypeAlias = Sequence[int]
"""Indices into the observation, flattened as ``gymnasium.spaces.flatten`` does."""

_TERMINATED = "terminated"


class GymnasiumEnvironment:
    """An environment of gymnasium that is sensed and moved as a robot is.

    A trial is an episode. It begins with ``reset(seed=...)``, the seed drawn from (seed, trial) of
    the run: the same run meets the same episodes. After a crash of the robot's process the task
    actions are performed again, which leads to where the robot was if the environment is
    deterministic.

    Parameters
    ----------
    env_id : str or gymnasium.Env
        What ``gymnasium.make`` makes, ``module:Id`` too; or an environment, which stays the
        caller's to close.
    sensing : sequence of coordinates, or function
        What each sensing action shows: coordinates of gymnasium's present observation, a list for
        each sensing action. Or ``function(environment, observation, sensing_action)``, which
        returns an array, or None for no reading.
    action : function, optional
        ``function(environment, task_action)`` returns gymnasium's action. Without it, for a Box
        the task action is clipped to its limits, and its coordinates fill the Box in order; for
        Discrete, MultiDiscrete and MultiBinary each coordinate becomes the nearest whole number
        that is allowed. (The planner does not see that: let the problem's ``limit_action``
        have the same limits.)
    motion : coordinates or function, optional
        The measured motion: by how much these coordinates have changed, or
        ``function(environment, before, after)`` of the two observations. The problem's
        ``move_by_measurement`` takes it.
    observation : coordinates or function, optional
        What comes with a move: these coordinates after it, or
        ``function(environment, observation, task_action)``. The problem's ``move_log_likelihood``
        takes it.
    success : str or function, optional
        By what one knows success: ``terminated`` (the environment terminates in success alone), a
        key of ``info`` such as ``is_success``, or ``function(environment, observation, info)``,
        asked after each move, which returns True, False or an
        :class:`~holdfast.planning.outcome.Ending` with its own reason. Without it no trial
        succeeds.
    sensing_noise : float or sequence, optional
        Standard deviation of the noise that is added to what sensing shows: for all, or one for
        each sensing action, each a number or one for each coordinate.
    motion_noise, observation_noise : float or sequence of float, optional
        The same for what comes with a move.
    env_arguments : mapping, optional
        Arguments of ``gymnasium.make``.
    seed, trial : int, optional
        Of the run.
    problem : Problem, optional
        Its number of sensing actions is compared.
    performed : sequence of array, optional
        Task actions to perform again.

    Attributes
    ----------
    environment : gymnasium.Env
    info : dict
        gymnasium's, of the last step.

    Raises
    ------
    ConfigurationError
        If gymnasium is not installed, a function is not found, or what is given does not suit the
        environment's spaces.
    """

    def __init__(
        self,
        env_id: str | gymnasium.Env[Any, Any],
        sensing: Sequence[Coordinates] | Function,
        action: Function | None = None,
        *,
        motion: Coordinates | Function | None = None,
        observation: Coordinates | Function | None = None,
        success: Function | None = None,
        sensing_noise: float | Sequence[Any] = 0.0,
        motion_noise: float | Sequence[float] = 0.0,
        observation_noise: float | Sequence[float] = 0.0,
        env_arguments: Mapping[str, Any] | None = None,
        seed: int = 0,
        trial: int = 0,
        problem: Problem | None = None,
        performed: Sequence[FloatArray] = (),
    ) -> None:
        self._own = isinstance(env_id, str)
        self.environment = _made(env_id, env_arguments)
        spec = self.environment.spec
        self._name = spec.id if spec is not None else type(self.environment.unwrapped).__name__
        self._seed, self._trial = seed, trial = seed_and_trial(seed, trial)

        self._sensing, self._sensing_noise = self._sensing_readers(sensing, sensing_noise, problem)
        self._action = None if action is None else _function(action, "action")
        if self._action is None:
            self._check_action_space(problem)
        self._motion = self._reader(motion, "motion")
        self._observation = self._reader(observation, "observation")
        self._motion_noise = _deviations(motion_noise, "motion_noise")
        self._observation_noise = _deviations(observation_noise, "observation_noise")
        named = isinstance(success, str) and ":" not in success
        self._success = success if success is None or named else _function(success, "success")

        self._steps = 0
        self._ending: Ending | None = None
        self._last_move: MoveResult | None = None
        drawn = stream(seed, trial, 0, Purpose.WORLD_INITIAL_STATE).uniform()
        # Some environments return the same array each time: a copy stays as it was.
        seen, self.info = self.environment.reset(seed=int(float(drawn) * 2.0**31))
        self._seen = copy.deepcopy(seen)
        for each in performed:
            self.perform(each)

    def perform_sensing(self, sensing_action: int) -> FloatArray:
        """Return what the sensing action shows of the present observation, with its noise."""
        chosen = integer(sensing_action)
        count = None if callable(self._sensing) else len(self._sensing)
        if chosen is None or chosen < 0 or (count is not None and chosen >= count):
            raise InvalidValueError(
                f"sensing action {brief(sensing_action)}: sensing of {self._name} has 0 to "
                f"{'...' if count is None else count - 1}"
            )
        sensing_action = chosen
        if callable(self._sensing):
            shown = self._sensing(self.environment, self._seen, sensing_action)
        else:
            shown = self._vector(self._seen)[self._sensing[sensing_action]]
        if shown is None:
            return np.full(1, np.nan)  # no reading
        noise = self._sensing_noise[sensing_action if len(self._sensing_noise) > 1 else 0]
        return self._noisy(shown, noise, "sensing", Purpose.WORLD_OBSERVATION, self._steps)

    def perform(self, task_action: FloatArray) -> MoveResult:
        """Perform one step of gymnasium's; return its reward and what the move has shown."""
        step, before = self._steps, self._seen
        action = self._translated(floats("task action", task_action))
        seen, reward, terminated, truncated, self.info = self.environment.step(action)
        if (earned := real_number(reward)) is None:
            raise EnvironmentFailedError(
                f"the reward of {self._name} is {brief(reward)}; it must be a number"
            )
        self._seen = copy.deepcopy(seen)
        self._steps += 1
        self._ending = self._ended(terminated=bool(terminated), truncated=bool(truncated))
        motion = observation = None
        if callable(self._motion):
            motion = self._motion(self.environment, before, self._seen)
        elif self._motion is not None:
            motion = (self._vector(self._seen) - self._vector(before))[self._motion]
        if callable(self._observation):
            observation = self._observation(self.environment, self._seen, task_action)
        elif self._observation is not None:
            observation = self._vector(self._seen)[self._observation]
        if motion is not None:
            purpose = Purpose.WORLD_MEASURED_MOTION
            motion = self._noisy(motion, self._motion_noise, "motion", purpose, step)
        if observation is not None:
            purpose = Purpose.WORLD_MOVE_OBSERVATION
            noise = self._observation_noise
            observation = self._noisy(observation, noise, "observation", purpose, step)
        self._last_move = MoveResult(earned, motion, observation)
        return self._last_move

    def is_done(self) -> Done:
        """Return False while the episode goes on, and then how it has ended."""
        return False if self._ending is None else self._ending

    def steps_performed(self) -> int:
        """Return the number of task actions performed in this episode."""
        return self._steps

    def last_move(self) -> MoveResult | None:
        """Return again what the last move has shown."""
        return self._last_move

    def close(self) -> None:
        """Close an environment that was made here."""
        if self._own:
            self.environment.close()

    def _ended(self, *, terminated: bool, truncated: bool) -> Ending | None:
        if callable(self._success):
            found = self._success(self.environment, self._seen, self.info)
        else:
            found = (
                terminated if self._success == _TERMINATED else self.info.get(self._success or "")
            )
        if isinstance(found, Ending):
            return found
        if bool(found):
            return Ending("succeeded")
        hint = self._missing_key()
        if terminated:
            hint = "; success is not defined" if self._success is None else hint
            return Ending("failed", f"{self._name} terminated without success{hint}")
        if truncated:
            return Ending("truncated", f"{self._name} truncated after {self._steps} steps{hint}")
        return None

    def _missing_key(self) -> str:
        """Return in words that ``info`` has no such key as ``success``; empty if it has."""
        key = self._success
        if not isinstance(key, str) or key in (_TERMINATED, *self.info):
            return ""
        from holdfast.validation import close_match

        keys = [str(each) for each in self.info]
        there = ", ".join(keys) or "nothing"
        return f"; info has no {key}{close_match(key, keys)}; it has {there}"

    def _translated(self, task_action: FloatArray) -> Any:
        from gymnasium import spaces

        space = self.environment.action_space
        if self._action is not None:
            action = self._action(self.environment, task_action.copy())
            if not space.contains(action):
                raise EnvironmentFailedError(
                    f"action of {self._name} returned {brief(action)}, which is not in {space}"
                )
            return action
        limits = _limits(space)
        assert limits is not None
        low, high, rounds = limits
        if task_action.size != low.size:
            raise EnvironmentFailedError(_misfit(self._name, space, low.size, task_action))
        within = np.clip(np.rint(task_action) if rounds else task_action, low.ravel(), high.ravel())
        if isinstance(space, spaces.Discrete):
            return int(within[0])
        return within.reshape(low.shape).astype(space.dtype)

    def _check_action_space(self, problem: Problem | None) -> None:
        space = self.environment.action_space
        limits = _limits(space)
        if limits is None:
            raise ConfigurationError(
                f"environment.arguments.action: {self._name} takes actions in {space}; give a "
                "function(environment, task_action) that returns one"
            )
        if problem is not None and problem.action_size != limits[0].size:
            raise ConfigurationError(
                f"environment.arguments.action: "
                f"{_misfit(self._name, space, limits[0].size, np.zeros(problem.action_size))}"
            )

    def _sensing_readers(
        self, sensing: Any, noise: Any, problem: Problem | None
    ) -> tuple[Callable[..., Any] | list[list[int]], list[FloatArray]]:
        # An array has as many numbers as the list that it came from.
        sensing, noise = plain(sensing), plain(noise)
        if callable(sensing) or isinstance(sensing, str):
            readers: Any = _function(sensing, "sensing")
            count = None if problem is None else len(problem.sensing_actions)
        else:
            key = "sensing"
            if not isinstance(sensing, Sequence) or not sensing:
                raise ConfigurationError(
                    f"environment.arguments.sensing is {brief(sensing)}; it must have a list of "
                    "coordinates for each sensing action, or be a function"
                )
            readers = [self._indices(each, f"{key}[{n}]") for n, each in enumerate(sensing)]
            count = len(readers)
            if problem is not None and len(problem.sensing_actions) != count:
                raise ConfigurationError(
                    f"environment.arguments.sensing has {count} entries; {problem.name} has "
                    f"{len(problem.sensing_actions)} sensing actions"
                )
        if not isinstance(noise, Sequence):
            return readers, [_deviations(noise, "sensing_noise")]
        if count is not None and len(noise) != count:
            raise ConfigurationError(
                f"environment.arguments.sensing_noise has {len(noise)} entries; there are "
                f"{count} sensing actions"
            )
        return readers, [_deviations(each, f"sensing_noise[{n}]") for n, each in enumerate(noise)]

    def _reader(self, given: Any, key: str) -> Callable[..., Any] | list[int] | None:
        if callable(given) or isinstance(given, str):
            return _function(given, key)
        return None if given is None else self._indices(given, key)

    def _indices(self, given: Any, key: str) -> list[int]:
        from gymnasium import spaces

        given, space = plain(given), self.environment.observation_space
        try:
            size = spaces.flatdim(space)
        except (NotImplementedError, ValueError) as error:
            raise ConfigurationError(
                f"environment.arguments.{key}: observations of {self._name} are in {space}, which "
                "has no fixed number of coordinates; give a function"
            ) from error
        if (
            not isinstance(given, Sequence)
            or not given
            or not all(integer(each) is not None and 0 <= each < size for each in given)
        ):
            raise ConfigurationError(
                f"environment.arguments.{key} is {brief(given)}; it must be a list of numbers "
                f"from 0 to {size - 1}, the coordinates of an observation of {self._name}"
            )
        return list(given)

    def _vector(self, observation: Any) -> FloatArray:
        from gymnasium import spaces

        flat = spaces.flatten(self.environment.observation_space, observation)
        return np.asarray(flat, dtype=np.float64)

    def _noisy(
        self, shown: npt.ArrayLike, deviations: FloatArray, key: str, purpose: Purpose, step: int
    ) -> FloatArray:
        numbers = real_numbers(shown)
        if numbers is None:
            raise EnvironmentFailedError(
                f"{key} of {self._name} shows {brief(shown)}; it must be an array of numbers"
            )
        values = np.array(numbers, dtype=np.float64).reshape(-1)
        if deviations.size not in (1, values.size):
            raise EnvironmentFailedError(
                f"{key}_noise of {self._name} is {in_brief(deviations)}: {key} shows "
                f"{values.size} numbers"
            )
        if not deviations.any():
            return values
        noise = stream(self._seed, self._trial, step, purpose).normal(values.shape)
        noisy: FloatArray = values + deviations * noise
        return noisy


def _made(
    env_id: str | gymnasium.Env[Any, Any], arguments: Mapping[str, Any] | None
) -> gymnasium.Env[Any, Any]:
    try:
        import gymnasium
    except ImportError as error:
        advice = how_to_install("gymnasium", "gymnasium")
        raise ConfigurationError(f"GymnasiumEnvironment needs gymnasium: {advice}") from error
    if isinstance(env_id, gymnasium.Env):
        return env_id
    if not isinstance(env_id, str):
        raise ConfigurationError(
            f"environment.arguments.env_id is {brief(env_id)}; it must be the id of an environment "
            "of gymnasium"
        )
    try:
        return gymnasium.make(env_id, **dict(arguments or {}))
    except (gymnasium.error.Error, ImportError) as error:
        raise ConfigurationError(f"environment.arguments.env_id: {env_id}: {error}") from error


def _function(given: Any, key: str) -> Callable[..., Any]:
    if not isinstance(given, str):
        if callable(given):
            found: Callable[..., Any] = given
            return found
        raise ConfigurationError(
            f"environment.arguments.{key} is {brief(given)}; it must be a function, module:function"
        )
    module, _, name = given.partition(":")
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigurationError(
            f"environment.arguments.{key}: {given} is no module:function that is found: {error}"
        ) from error
    if not callable(found):
        raise ConfigurationError(f"environment.arguments.{key}: {given} is no function")
    return found


def _deviations(given: Any, key: str) -> FloatArray:
    numbers = real_numbers(given)
    array = np.empty(0) if numbers is None else np.array(numbers, dtype=np.float64).reshape(-1)
    if not array.size or not (np.isfinite(array) & (array >= 0.0)).all():
        raise ConfigurationError(
            f"environment.arguments.{key} is {brief(given)}; it must be a standard deviation, a "
            "number >= 0, or one for each coordinate"
        )
    return array


def _limits(space: Any) -> tuple[npt.NDArray[Any], npt.NDArray[Any], bool] | None:
    """Return the least and greatest action, and whether they are whole numbers; None: unknown."""
    from gymnasium import spaces

    if isinstance(space, spaces.Box):
        return space.low, space.high, bool(np.issubdtype(space.dtype, np.integer))
    if isinstance(space, spaces.Discrete):
        return np.asarray(space.start), np.asarray(space.start + space.n - 1), True
    if isinstance(space, spaces.MultiDiscrete):
        return space.start, space.start + space.nvec - 1, True
    if isinstance(space, spaces.MultiBinary):
        return np.zeros(space.shape), np.ones(space.shape), True
    return None


def _misfit(name: str, space: Any, size: int, task_action: FloatArray) -> str:
    return (
        f"{name} takes actions in {space}, {size} numbers, and a task action has "
        f"{task_action.size}; give a function(environment, task_action) that returns one"
    )
