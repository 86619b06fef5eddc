"""An environment for robots with an executive: a program that drives the robot and asks to decide.

Such a program calls; it does not want to be called. So this environment's ``perform_sensing`` and
``perform`` publish the decision, and wait until a call of :meth:`DecisionHandover.call` reports its
outcome.

Calls may be repeated after a lost reply or a crash. So a decision's number follows from its place
in the trial: the sensing action of step t is number 2 t + 1, the task action is 2 t + 2. A resumed
run gives the same decisions the same numbers.
"""

from __future__ import annotations

import enum
import threading
from collections.abc import Sequence
from time import monotonic
from typing import NamedTuple

import numpy as np

from holdfast.errors import EnvironmentFailedError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.outcome import Done
from holdfast.problems.problem import Problem
from holdfast.robot.environment import ObservationSizes, is_no_reading

_NO_NUMBERS: FloatArray = np.empty(0)


class DecideCode(enum.IntEnum):
    """The result of a call."""

    OK = 0
    HOLDING = 1  # there is no decision yet: repeat the call
    FINISHED = 2  # all trials are finished
    BAD_REQUEST = 3  # the reported outcome was refused; the decision is still due
    INACTIVE = 4  # no run is active
    ENDED = 5  # the run has ended early


class DueDecision(NamedTuple):
    """A decision whose outcome is awaited; ``trial`` and ``number`` identify it."""

    trial: int
    number: int
    step: int  # task actions before it
    sensing_action: int | None  # None for a task action
    task_action: FloatArray = _NO_NUMBERS  # of shape (action_size,); empty for a sensing action


class DecideRequest(NamedTuple):
    """The outcome of a decision; number 0 reports none. The observation has shape ``(n,)``."""

    trial: int = 0
    number: int = 0
    observation: FloatArray = _NO_NUMBERS
    reward: float | None = None
    done: Done = False


class DecideReply(NamedTuple):
    """The reply to a call."""

    code: DecideCode
    message: str = ""
    due: DueDecision | None = None


class DecisionHandover:
    """Hands a run's decisions to an executive and its outcomes back; usable from any thread.

    It serves one run, until that ends or is held. Only callers' threads may use ``problem``.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._sizes = ObservationSizes(problem)
        self._changed = threading.Condition()
        self._due: DueDecision | None = None
        self._answer: DecideRequest | None = None
        self._answered: tuple[int, int] | None = None
        self._end: DecideReply | None = None

    def end(self, code: DecideCode, message: str) -> None:
        """End all waits, because the run has ended or will end. The first call counts."""
        with self._changed:
            self._end = self._end or DecideReply(code, message)
            self._due = None
            self._changed.notify_all()

    def perform(self, due: DueDecision) -> DecideRequest:
        """Publish a decision and wait for its outcome; raise an error if the run ends first."""
        with self._changed:
            self._answer = None
            if self._end is None:
                self._due = due
                self._changed.notify_all()
            self._changed.wait_for(lambda: self._answer or self._end)
            answer: DecideRequest | None = self._answer
            if answer is None:
                raise EnvironmentFailedError("" if self._end is None else self._end.message)
            return answer

    def call(self, call: DecideRequest, within_s: float) -> DecideReply:
        """Take the outcome of a decision, and return the next one; HOLDING after ``within_s``."""
        deadline = monotonic() + within_s
        named = call.trial, call.number
        with self._changed:
            while self._end is None:
                due = self._due
                if due is not None:
                    # An outcome of before was taken; this is a repeated call.
                    if not call.number or named < (due.trial, due.number):
                        return DecideReply(DecideCode.OK, due=due)
                    if refusal := self._refusal(call, due):
                        return DecideReply(DecideCode.BAD_REQUEST, refusal, due)
                    self._answer, self._answered, self._due = call, named, None
                    self._changed.notify_all()
                elif call.number and self._answered not in (None, named):
                    refusal = self._wrong_number(named, self._answered)
                    return DecideReply(DecideCode.BAD_REQUEST, refusal)
                if not self._changed.wait(deadline - monotonic()) and monotonic() >= deadline:
                    return DecideReply(
                        DecideCode.HOLDING, "nothing is decided yet; make the same call again"
                    )
            return self._end

    @staticmethod
    def _wrong_number(named: tuple[int, int], expected: tuple[int, int] | None) -> str:
        trial, number = expected or (0, 0)
        return (
            f"trial {named[0]}, number {named[1]}: trial {trial}, number {number} is to be "
            "answered, or was last; number 0 asks what is due"
        )

    def _refusal(self, call: DecideRequest, due: DueDecision) -> str:
        """Return why an outcome cannot be taken; empty if it can."""
        named, expected = (call.trial, call.number), (due.trial, due.number)
        shown = call.observation
        if named != expected:
            return self._wrong_number(named, expected)
        if call.done not in (False, True, "failed"):
            return f"done {call.done}: allowed are 0 to 2"
        if call.reward is not None and not np.isfinite(call.reward):
            return f"reward {call.reward}: must be a finite number"
        if due.sensing_action is None:
            reason = f"number {due.number} is a task action, of which there is none"
            return f"observation of {shown.size} values: {reason}" if shown.size else ""
        if call.done is not False:
            said = "that the task has failed" if call.done == "failed" else "that it has succeeded"
            return (
                f"done says {said}: number {due.number} is a sensing action, after which the task "
                "goes on; say so with the task action that it ended with"
            )
        size = self._sizes[due.sensing_action]
        if not shown.size or size not in (None, shown.size):
            return (
                f"observation of {shown.size} values: sensing action {due.sensing_action} of "
                f"{self._problem.name} has {size or 'at least 1'}"
            )
        if not np.isfinite(shown).all() and not is_no_reading(shown):
            place = int(np.argmin(np.isfinite(shown)))
            return f"observation[{place}] is {shown[place]}: must be a finite number"
        return ""


class ExecutiveEnvironment:
    """One trial that an executive performs; the journal has ``performed`` task actions of it."""

    def __init__(
        self, executive: DecisionHandover, trial: int = 0, performed: Sequence[FloatArray] = ()
    ) -> None:
        self._executive = executive
        self._trial = trial
        self._step = len(performed)
        self._done: Done = False

    def perform_sensing(self, sensing_action: int) -> FloatArray:
        """Have the executive sense."""
        due = DueDecision(self._trial, 2 * self._step + 1, self._step, sensing_action)
        return self._executive.perform(due).observation

    def perform(self, task_action: FloatArray) -> float | None:
        """Have the executive act."""
        due = DueDecision(self._trial, 2 * self._step + 2, self._step, None, task_action)
        call = self._executive.perform(due)
        self._step += 1
        self._done = call.done
        return call.reward

    def is_done(self) -> Done:
        """Return what the executive said with the last task action."""
        return self._done

    def steps_performed(self) -> int:
        """Return how many task actions the journal knows to be performed.

        The executive, which is given the next one again, knows whether it has performed that.
        """
        return self._step
