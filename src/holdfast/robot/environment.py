"""The robot's environment: a world that can be sensed and moved.

The loop uses three methods. The simulated world is made from the problem and has its own random
streams; a real robot is an object of a user's class with the same methods.

No journal can know whether the last task action before a crash was performed. An environment that
counts its task actions answers that, with a fourth method.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from typing import Protocol, Self, runtime_checkable

import numpy as np

from holdfast.errors import EnvironmentFailedError, InvalidValueError
from holdfast.numerics.arrays import NOTHING_ELSE, FloatArray, KeepsReadOnly, floats, real_numbers
from holdfast.numerics.floating_mode import in_own_mode
from holdfast.numerics.randomness import Purpose, Stream, seed_and_trial, stream
from holdfast.planning.inputs import Late, Moved, Sensed, encode_floats
from holdfast.planning.outcome import Done, Ending, MoveResult, ending_of
from holdfast.planning.settings import EnvironmentSettings
from holdfast.printable import brief
from holdfast.problems import checked
from holdfast.problems.attributes import check_sizes, has_general_observations, sensing_action_of
from holdfast.problems.problem import Problem, ProblemBase
from holdfast.protocol.messages import MAX_ACTION_SIZE
from holdfast.protocol.robot_events import Acted, EnvironmentReady, NoReading

_NUMBERS = f"numbers {NOTHING_ELSE}"

_REQUIRED = ("perform_sensing", "perform", "is_done")


class Later(enum.Enum):
    """The type of :data:`LATER`."""

    LATER = "later"


LATER = Later.LATER
"""What ``perform_sensing`` returns if the observation comes later."""


@runtime_checkable
class Environment(Protocol):
    """A world that can be sensed and moved.

    It may have further methods, each of which is used if it is there:

    ``late_observations()``
        After each task action: returns what has come since the last call, a list of (step,
        observation), None for no reading. The step says when the sensing action was performed: it
        is the number of task actions that this trial had had then.
    ``steps_performed()``
        After a crash of the robot's process: returns how many task actions have been performed in
        this trial. The environment counts them itself, and is right even if that process died
        during a task action.
    ``last_move()``
        After a crash in the midst of a move: returns again what the last ``perform`` of this trial
        has returned, or would have. Without it what the move has shown is lost: its reward counts
        as 0, and its motion is the model's.
    ``close()``
        After the trial.
    """

    def perform_sensing(self, sensing_action: int) -> FloatArray | Later | None:
        """Perform a sensing action and return the observation, shape ``(observation_size,)``.

        None, or NaN in every component, is no reading: the belief stays as it is. Or :data:`LATER`:
        the robot goes on, and ``late_observations`` returns it when it is there.
        """

    def perform(self, task_action: FloatArray) -> float | MoveResult | None:
        """Perform a task action and return its reward, or None where there is none.

        A :class:`~holdfast.planning.outcome.MoveResult` also says what the move has shown.
        """

    def is_done(self) -> Done:
        """Return True if the task has succeeded, False if it goes on, or ``"failed"``.

        ``"failed"`` ends the trial as well, but in failure: the robot has crashed, say, or broken
        what it was to handle. An :class:`~holdfast.planning.outcome.Ending` also says why, and may
        say that the trial was cut off.
        """


class SimulatedEnvironment(KeepsReadOnly):
    """A world simulated from a problem, with its own random streams.

    What happens is a function of (seed, trial) and of the task actions performed so far: sensing
    draws from a stream of its own and so does not change how the world moves.

    Parameters
    ----------
    seed, trial : int
        Name the random streams; see :func:`holdfast.numerics.randomness.stream`.

    Attributes
    ----------
    problem : Problem
    state : array of shape (state_size,)
        The true state.
    step : int
        Task actions performed so far.
    """

    @in_own_mode
    def __init__(self, problem: Problem, seed: int, trial: int = 0) -> None:
        self.problem = problem
        self._seed, self._trial = seed, trial = seed_and_trial(seed, trial)
        self.step = 0
        check_sizes(problem)
        self._moves_show = any(
            hasattr(problem, name) for name in ("measure_motion", "sample_move_observation")
        )
        initial = stream(seed, trial, 0, Purpose.WORLD_INITIAL_STATE)
        self.state = _initial_state(problem, initial)

    @classmethod
    def after(cls, problem: Problem, seed: int, trial: int, actions: Sequence[FloatArray]) -> Self:
        """Return the world as it is after these task actions: they are performed again."""
        environment = cls(problem, seed, trial)
        for action in actions:
            environment.perform(action)
        return environment

    @in_own_mode
    def perform_sensing(self, sensing_action: int) -> FloatArray:
        """Draw an observation of the true state.

        Raises
        ------
        InvalidValueError
            If the sensing action does not exist.
        """
        problem = self.problem
        sensing_action = sensing_action_of(problem, sensing_action)
        noise = stream(self._seed, self._trial, self.step, Purpose.WORLD_OBSERVATION)
        if hasattr(problem, "sample_observation"):
            return checked.sample_observation(problem, self.state, sensing_action, noise)
        mean, variance = checked.prediction(problem, self.state, sensing_action)
        with np.errstate(invalid="ignore"):
            shown: FloatArray = mean + np.sqrt(variance) * noise.normal(mean.shape)
        if not np.isfinite(shown).all():
            checked.require_usable(problem, sensing_action, mean, variance)
        return shown

    @in_own_mode
    def perform(self, task_action: FloatArray) -> float | MoveResult | None:
        """Move the true state by an executed task action and return the reward.

        None if the problem defines no reward. A problem that has ``measure_motion`` or
        ``sample_move_observation`` says what else the move shows.
        """
        seed, trial, step, problem = self._seed, self._trial, self.step, self.problem
        before, action = self.state, floats("task action", task_action)
        noise = stream(seed, trial, step, Purpose.WORLD_MOTION)
        state = checked.move(problem, before, action, noise)
        reward = motion = observation = None
        if getattr(type(problem), "reward", None) is not ProblemBase.reward:
            reward = checked.reward(problem, state, action)
        if hasattr(problem, "measure_motion"):
            noise = stream(seed, trial, step, Purpose.WORLD_MEASURED_MOTION)
            motion = checked.measured_motion(problem, before, state, noise)
        if hasattr(problem, "sample_move_observation"):
            noise = stream(seed, trial, step, Purpose.WORLD_MOVE_OBSERVATION)
            observation = checked.move_observation(problem, state, action, noise)
        # Only now: a move that fails leaves the world as it was.
        self.state, self.step = state, step + 1
        return MoveResult(reward, motion, observation) if self._moves_show else reward

    @in_own_mode
    def is_done(self) -> Done:
        """Return whether the true state is a goal, or ``"failed"`` if it is a failure."""
        if checked.is_failure(self.problem, self.state):
            return "failed"
        return checked.is_goal(self.problem, self.state)

    def steps_performed(self) -> int:
        """Return the number of task actions performed, those of :meth:`after` included."""
        return self.step


def require_methods(environment: object, name: str) -> None:
    """Raise EnvironmentFailedError if an environment lacks one of the three methods."""
    missing = [method for method in _REQUIRED if not callable(getattr(environment, method, None))]
    if missing:
        raise EnvironmentFailedError(
            f"{name} is no environment: it lacks {' and '.join(missing)}; it needs "
            "perform_sensing(sensing_action), perform(task_action) and is_done()"
        )


def is_no_reading(numbers: FloatArray) -> bool:
    """Return whether an observation is no reading: it has components, and each of them is NaN."""
    return bool(numbers.size) and bool(np.isnan(numbers).all())


class ObservationSizes(dict[int, "int | None"]):
    """Numbers that a problem expects of each sensing action; None where it does not say."""

    def __init__(self, problem: Problem) -> None:
        super().__init__()
        self._problem = problem

    def __missing__(self, sensing_action: int) -> int | None:
        problem = self._problem
        size: int | None = None
        if not has_general_observations(problem):
            state = _initial_state(problem, stream(0, 0, 0, Purpose.INITIAL_BELIEF))
            size = int(checked.prediction(problem, state, sensing_action)[0].shape[-1])
        self[sensing_action] = size
        return size


class CheckedEnvironment:
    """Calls an environment, and checks what it returns.

    Methods raise whatever the environment raises, and an EnvironmentFailedError, with the method's
    name, for what does not keep to its contract. ``environment`` is None until it is made,
    ``method`` the one that was called last (at first the environment's name), and ``performed``
    what the last task action has shown: what is asked after it may fail.
    """

    def __init__(
        self,
        problem: Problem,
        name: str,
        max_missing_in_a_row: int = EnvironmentSettings().max_missing_in_a_row,
        environment: Environment | None = None,
    ) -> None:
        self._sizes = ObservationSizes(problem)
        self._name = self.method = name
        self._max_missing_in_a_row = max_missing_in_a_row
        self._missing_in_a_row = 0
        self.environment = environment
        self.performed: Acted | None = None

    def ready(self, *, resumed: bool) -> EnvironmentReady:
        """Ask how the task stands, and of a ``resumed`` trial what has been done in it."""
        environment = self._environment
        count = None
        ask = getattr(environment, "steps_performed", None)
        if resumed and callable(ask):
            self.method = "steps_performed"
            count = self._count(ask())
        last: Moved | None = None
        late: tuple[Late, ...] = ()
        if resumed:
            ask = getattr(environment, "last_move", None)
            if count and callable(ask):
                self.method = "last_move"
                last = self._moved(count - 1, ask())
            late, _ = self._late(count or 0)
        return EnvironmentReady(self._is_done(), count, last, late)

    def sense(self, step: int, sensing_action: int) -> Sensed | NoReading:
        """Perform a sensing action."""
        # Before sensing: the problem may write into the array that the environment returns.
        size = self._sizes[sensing_action]
        self.method = "perform_sensing"
        shown = self._environment.perform_sensing(sensing_action)
        if shown is LATER:
            if not callable(getattr(self.environment, "late_observations", None)):
                raise EnvironmentFailedError(
                    f"{self.called} returned LATER, but there is no late_observations() that "
                    "could return the observation when it is there"
                )
            return Sensed(step, sensing_action, b"")
        if self._is_missing(shown):
            return NoReading(step)
        need = f"an array of shape ({size or 'n'},), of {_NUMBERS}, or None"
        observation = self._array(shown, shown, need, size)
        return Sensed(step, sensing_action, encode_floats(observation))

    def perform(self, step: int, task_action: FloatArray) -> Acted:
        """Perform a task action, take what comes late, and ask whether the task is done."""
        self.performed = None
        self.method = "perform"
        # A copy: the robot's own record of the action must stay what it is.
        action = np.array(task_action, dtype=np.float64)
        acted = self.performed = Acted(self._moved(step, self._environment.perform(action)))
        late, no_reading = self._late(step + 1)
        acted = self.performed = acted._replace(late=late, no_reading=no_reading)
        return acted._replace(ending=self._is_done())

    def _moved(self, step: int, shown: object) -> Moved:
        """Return what a task action has shown."""
        if not isinstance(shown, MoveResult):
            return Moved(step, self._reward(shown))
        need = f"a MoveResult whose {{}} is an array of 1 to {MAX_ACTION_SIZE} {_NUMBERS}"
        motion, observation = (
            b"" if value is None else encode_floats(self._array(value, value, need.format(what)))
            for value, what in ((shown.motion, "motion"), (shown.observation, "observation"))
        )
        return Moved(step, self._reward(shown.reward), motion, observation)

    @property
    def called(self) -> str:
        """The method that was called last, for messages."""
        return self._name if self.method == self._name else f"{self._name}: {self.method}"

    @property
    def _environment(self) -> Environment:
        assert self.environment is not None
        return self.environment

    def _reward(self, value: object) -> float | None:
        if value is None:
            return None
        number = real_numbers(value)
        if number is None or number.ndim != 0 or not np.isfinite(number):
            raise self._unusable(value, "a finite number, the reward, a MoveResult, or None")
        return float(number)

    def _is_done(self) -> Ending | None:
        self.method = "is_done"
        try:
            return ending_of(self._environment.is_done())
        except InvalidValueError as error:
            raise EnvironmentFailedError(f"{self.called} {error}") from error

    def _array(
        self, value: object, whole: object, need: str, size: int | None = None
    ) -> FloatArray:
        """Return a read-only copy of an array; ``whole`` is what the environment has returned."""
        array = real_numbers(value)
        fits = array is not None and array.ndim == 1 and 1 <= array.size <= MAX_ACTION_SIZE
        if not fits or array is None or size not in (None, array.size):
            raise self._unusable(whole, need)
        finite = np.array(array, dtype=np.float64)
        if not np.isfinite(finite).all():
            raise self._unusable(whole, "finite numbers")
        finite.setflags(write=False)
        return finite

    def _late(self, now: int) -> tuple[tuple[Late, ...], tuple[int, ...]]:
        """Ask for observations of earlier steps, and of which steps there is no reading."""
        ask = getattr(self._environment, "late_observations", None)
        if not callable(ask):
            return (), ()
        self.method = "late_observations"
        value = ask()
        need = "a list of (step, observation)"
        if not isinstance(value, Sequence) or isinstance(value, str):
            raise self._unusable(value, need)
        late, no_reading = [], []
        for entry in value:
            if not isinstance(entry, tuple | list) or len(entry) != 2:
                raise self._unusable(value, need)
            step = self._count(entry[0])
            if self._is_missing(entry[1]):
                no_reading.append(step)
                continue
            of_shape = f"{need} with observations of shape (n,), of {_NUMBERS}"
            observation = self._array(entry[1], value, of_shape)
            late.append(Late(now, step, encode_floats(observation)))
        return tuple(late), tuple(no_reading)

    def _is_missing(self, shown: object) -> bool:
        """Return whether sensing has given no reading; raise if it has too often in a row."""
        numbers = None if shown is None else real_numbers(shown)
        if shown is not None and (numbers is None or not is_no_reading(numbers)):
            self._missing_in_a_row = 0
            return False
        self._missing_in_a_row += 1
        if self._missing_in_a_row > self._max_missing_in_a_row:
            raise EnvironmentFailedError(
                f"{self.called} gave no reading {self._missing_in_a_row} times in a row; "
                f"environment.max_missing_in_a_row allows {self._max_missing_in_a_row}"
            )
        return True

    def _count(self, value: object) -> int:
        number = real_numbers(value)
        if number is None or number.ndim != 0 or number.dtype.kind not in "iu" or number < 0:
            raise self._unusable(value, "a whole number >= 0")
        return int(number)

    def _unusable(self, value: object, need: str) -> EnvironmentFailedError:
        came = f"an array of shape {value.shape}: " if isinstance(value, np.ndarray) else ""
        return EnvironmentFailedError(
            f"{self.called} returned {came}{brief(value)}; it must return {need}"
        )


def _initial_state(problem: Problem, random: Stream) -> FloatArray:
    state: FloatArray = checked.initial_states(problem, random, 1)[0]
    return state
