"""A world that somebody else's executive stands for: it asks for decisions, one after another.

Many robots have a program already that drives them. It does not want to be called; it calls. So
here a robot's run meets an environment whose ``perform_sensing`` and ``perform`` hand the decision
to whoever calls :meth:`Executive.call`, and wait for the call that says what came of it. The run
itself is like any other: journalled, with services that may die, to be resumed.

A call may be repeated, because the one who makes it may not have heard the answer, or because a
process died. So each decision has a number that follows from where in the trial it stands, not from
who counts: the observation of step t is number 2 t + 1, its task action is 2 t + 2. A run that goes
on after a crash gives the same decisions the same numbers.
"""

from __future__ import annotations

import enum
import threading
from time import monotonic
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from holdfast.errors import EnvironmentFailedError, InvalidValueError
from holdfast.outcome import Done
from holdfast.problems.problem import Problem
from holdfast.runtime.environment import EnvironmentMaker, observation_size

__all__ = ["Call", "Code", "DueDecision", "Executive", "ExecutiveEnvironment", "ExecutiveMaker"]

FloatArray = npt.NDArray[np.float64]

_NO_NUMBERS: FloatArray = np.empty(0)


class Code(enum.IntEnum):
    """How a call ends."""

    OK = 0
    HOLDING = 1
    """Nothing is decided yet: make the same call again."""
    FINISHED = 2
    """All trials are."""
    BAD_REQUEST = 3
    """The call's answer was not taken; the decision is still due."""
    INACTIVE = 4
    """Nobody runs here."""
    ENDED = 5
    """The run has ended early."""


class DueDecision(NamedTuple):
    """A decision that waits for what comes of it.

    Attributes
    ----------
    trial, number : int
        Name it.
    step : int
        Task actions before it.
    sensing_action : int or None
        None for a task action.
    task_action : array of shape (action_size,)
        Empty for a sensing action.
    """

    trial: int
    number: int
    step: int
    sensing_action: int | None
    task_action: FloatArray = _NO_NUMBERS


class Call(NamedTuple):
    """What came of a decision.

    Attributes
    ----------
    trial, number : int
        Of the decision; number 0 answers none.
    observation : array of shape (n,)
    reward : float or None
    done : bool or "failed"
    """

    trial: int = 0
    number: int = 0
    observation: FloatArray = _NO_NUMBERS
    reward: float | None = None
    done: Done = False


class Reply(NamedTuple):
    """What a call gets.

    Attributes
    ----------
    code : Code
    message : str
        Why there is no decision.
    due : DueDecision or None
    """

    code: Code
    message: str = ""
    due: DueDecision | None = None


class Executive:
    """Where a robot's run and whoever performs its decisions meet; for any number of threads.

    It is for one run, until that ends or is held.

    Parameters
    ----------
    problem : Problem
        Its own instance: it is called by the threads of callers.
    sensing_interval : int
        Task actions between two sensing steps.
    """

    def __init__(self, problem: Problem, sensing_interval: int) -> None:
        self._problem = problem
        self._interval = sensing_interval
        self._sizes: dict[int, int | None] = {}
        self._changed = threading.Condition()
        self._due: DueDecision | None = None
        self._answer: Call | None = None
        self._answered: tuple[int, int] | None = None
        self._end: Reply | None = None

    def end(self, code: Code, message: str) -> None:
        """Take note that the run has ended, or is to end: nobody waits any longer.

        What came first counts.
        """
        with self._changed:
            self._end = self._end or Reply(code, message)
            self._due = None
            self._changed.notify_all()

    def perform(self, due: DueDecision) -> Call:
        """Hand a decision to whoever calls, and wait for what comes of it.

        Raises
        ------
        EnvironmentFailedError
            If the run is to end.
        """
        with self._changed:
            self._answer = None
            if self._end is None:
                self._due = due
                self._changed.notify_all()
            self._changed.wait_for(lambda: self._answer or self._end)
            answer: Call | None = self._answer
            if answer is None:
                raise EnvironmentFailedError("" if self._end is None else self._end.message)
            return answer

    def call(self, call: Call, within_s: float) -> Reply:
        """Take what came of a decision, and return the next one.

        Parameters
        ----------
        call : Call
        within_s : float
            If there is none by then, the reply says so.
        """
        deadline = monotonic() + within_s
        named = call.trial, call.number
        with self._changed:
            while self._end is None:
                due = self._due
                if due is not None:
                    if not call.number or self._precedes(named, due):
                        return Reply(Code.OK, due=due)
                    try:
                        self._check(call, due)
                    except InvalidValueError as error:
                        return Reply(Code.BAD_REQUEST, str(error), due)
                    self._answer, self._answered, self._due = call, named, None
                    self._changed.notify_all()
                elif call.number and self._answered not in (None, named):
                    return Reply(Code.BAD_REQUEST, self._wrong_number(named, self._answered))
                if not self._changed.wait(deadline - monotonic()) and monotonic() >= deadline:
                    return Reply(Code.HOLDING, "nothing is decided yet; make the same call again")
            return self._end

    def _precedes(self, named: tuple[int, int], due: DueDecision) -> bool:
        """Tell whether a decision is the one before the one that is due."""
        if due.number <= 1 or (due.number == 2 and not self._senses_at(0)):
            return named[0] == due.trial - 1
        by_sensing = due.sensing_action is None and self._senses_at(due.step)
        return named == (due.trial, due.number - 1 if by_sensing else 2 * due.step)

    def _senses_at(self, step: int) -> bool:
        return step % (self._interval + 1) == 0

    @staticmethod
    def _wrong_number(named: tuple[int, int], expected: tuple[int, int] | None) -> str:
        trial, number = expected or (0, 0)
        return (
            f"trial {named[0]}, number {named[1]}: trial {trial}, number {number} is to be "
            "answered, or was last; number 0 asks what is due"
        )

    def _check(self, call: Call, due: DueDecision) -> None:
        if (call.trial, call.number) != (due.trial, due.number):
            raise InvalidValueError(
                self._wrong_number((call.trial, call.number), (due.trial, due.number))
            )
        if call.reward is not None and not np.isfinite(call.reward):
            raise InvalidValueError(f"reward {call.reward}: must be a finite number")
        if due.sensing_action is None:
            if call.observation.size:
                raise InvalidValueError(
                    f"observation of {call.observation.size} values: number {due.number} is a task "
                    "action, of which there is none"
                )
            return
        if call.done is not False:
            said = "that the task has failed" if call.done == "failed" else "that it has succeeded"
            raise InvalidValueError(
                f"done says {said}: number {due.number} is a sensing action, after which the task "
                "goes on; say so with the task action that it ended with"
            )
        size = self._observation_size(due.sensing_action)
        if call.observation.size < 1 or size not in (None, call.observation.size):
            raise InvalidValueError(
                f"observation of {call.observation.size} values: sensing action "
                f"{due.sensing_action} of {self._problem.name} has {size or 'at least 1'}"
            )
        if not np.isfinite(call.observation).all():
            place = int(np.argmin(np.isfinite(call.observation)))
            raise InvalidValueError(
                f"observation[{place}] is {call.observation[place]}: must be a finite number"
            )

    def _observation_size(self, sensing_action: int) -> int | None:
        if sensing_action not in self._sizes:
            self._sizes[sensing_action] = observation_size(self._problem, sensing_action)
        return self._sizes[sensing_action]


class ExecutiveEnvironment:
    """One trial of a world that an executive stands for.

    Parameters
    ----------
    executive : Executive
    trial : int
    step : int
        Task actions that are known to have been performed in it.
    """

    def __init__(self, executive: Executive | None = None, trial: int = 0, step: int = 0) -> None:
        if executive is None:
            raise EnvironmentFailedError(
                "this run is driven by an executive that asks the node's service decide; go on "
                "with it there: python -m holdfast.ros.ros2"
            )
        self._executive = executive
        self._trial = trial
        self._step = step
        self._done: Done = False

    def perform_sensing(self, sensing_action: int) -> FloatArray:
        """Have the executive sense."""
        step = self._step
        due = DueDecision(self._trial, 2 * step + 1, step, sensing_action)
        return self._executive.perform(due).observation

    def perform(self, task_action: FloatArray) -> float | None:
        """Have the executive act."""
        step = self._step
        due = DueDecision(self._trial, 2 * step + 2, step, None, task_action)
        call = self._executive.perform(due)
        self._step = step + 1
        self._done = call.done
        return call.reward

    def is_done(self) -> Done:
        """Return what the executive said with the last task action."""
        return self._done

    def steps_performed(self) -> int:
        """Return how many task actions the journal knows to be performed.

        The one that it may have begun is handed out again, with its number: the executive knows
        whether it has performed that, and answers without doing it twice.
        """
        return self._step


class ExecutiveMaker(EnvironmentMaker):
    """Makes the environment of each trial.

    Parameters
    ----------
    executive : Executive
    problem : Problem
    timeout_ms : float
        Longest time that the executive may take for one decision.
    """

    def __init__(self, executive: Executive, problem: Problem, timeout_ms: float) -> None:
        super().__init__("the executive", problem, 0, timeout_ms)
        self.simulated = False
        self._executive = executive

    def __call__(
        self, trial: int, *, resumed: bool = False, performed: object = ()
    ) -> ExecutiveEnvironment:
        """Make the environment of a trial."""
        del resumed
        assert isinstance(performed, list | tuple)
        return ExecutiveEnvironment(self._executive, trial, len(performed))
