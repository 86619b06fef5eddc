"""What services answer is not taken on trust: the robot computes some of it again.

A service is a calculator, and a calculator can be faulty, out of date or in the wrong hands. The
robot holds the truth and has a planner of its own, so it can tell. Three things make it look:

- an action that the problem's own ``execute`` would not let through;
- two answers to one question that are not the same;
- chance: a share of the questions, drawn with a secret of the robot, so no service knows which.

In the first two cases the robot waits for its own planner and does what that says. In the third it
goes on, and its planner computes while the robot moves. Whoever answered otherwise than the robot's
own planner is not asked again in this run.

Before a service is blamed for an action that was possible, the planner decides a second time, with
an instance of the problem made anew. If it comes to something else than the first time, the problem
itself is not deterministic, and nobody is to blame. Until then nothing that the service says is
followed without asking the planner.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from holdfast.errors import HoldfastError
from holdfast.session.effects import Decide, Effect, Report, Verified
from holdfast.session.events import Decided
from holdfast.session.messages import DIGEST_SIZE, SensingAnswer
from holdfast.session.question import Given, Provenance, Question, same_actions

__all__ = ["OWN_PLANNER", "OwnDecisionError", "Verification", "WrongAnswer"]

FloatArray = npt.NDArray[np.float64]

OWN_PLANNER = "in_process"
"""What the planner in the robot's own process is called where services have names."""

MAX_OPEN_CHECKS = 64
"""Bound on the questions that wait for the robot's own planner; more are left out, and counted."""


class OwnDecisionError(HoldfastError):
    """Answers disagree, and the robot's own planner cannot say which is right."""


class WrongAnswer(NamedTuple):
    """A service answered otherwise than the robot's own planner.

    Attributes
    ----------
    service : str
    step : int
        Of the question.
    kind : {"task", "sensing"}
    """

    service: str
    step: int
    kind: str


class Verification:
    """Decides what is computed again, and who was wrong.

    Parameters
    ----------
    share : float
        Of the questions that services answer, from 0 to 1.
    secret : bytes
        Of the robot: with it, and the question's digest, it is drawn which ones.
    exempt : str or None
        A service that is not drawn: the local one, which is the same code on the same machine.
    limited : callable
        What the problem's ``execute`` makes of actions, shape ``(count, action_size)`` in and out.
    effects : list of Effect
        What is to be computed and told is added to it.

    Attributes
    ----------
    limits_tell : bool
        Whether an action that ``execute`` would change is a wrong one. False once a right one was
        changed: the robot has to compare each action with its own planner's then.
    """

    def __init__(
        self,
        share: float,
        secret: bytes,
        exempt: str | None,
        limited: Callable[[FloatArray], FloatArray],
        effects: list[Effect],
    ) -> None:
        self._share = share
        self._secret = secret[:64]
        self._exempt = exempt
        self._limited = limited
        self._effects = effects
        self._asked: dict[int, Question] = {}
        self._number = 0
        # By the question in which they differed from the robot's own planner.
        self._suspects: dict[str, Question] = {}
        self._wrong: list[WrongAnswer] = []
        self.limits_tell = True

    def __len__(self) -> int:
        return len(self._asked)

    def take_wrong(self) -> list[WrongAnswer]:
        """Return the wrong answers found since the last time."""
        wrong, self._wrong = self._wrong, []
        return wrong

    # -- answers ---------------------------------------------------------------------------------

    def outside_limits(self, actions: FloatArray) -> str | None:
        """Say what is wrong with task actions that the problem's ``execute`` would change.

        Parameters
        ----------
        actions : array of shape (count, action_size)

        Returns
        -------
        str or None
            None if they are within the limits.
        """
        if not self.limits_tell:
            return None
        limited = self._limited(actions)
        # An action on a limit may be moved by a rounding error.
        slack = 1e-9 * np.maximum(1.0, np.abs(limited))
        outside = (np.abs(actions - limited) > slack).any(axis=-1)
        if not outside.any():
            return None
        first = int(np.argmax(outside))
        return (
            f"task action {_written(actions[first])} is outside the limits of the problem's "
            f"execute, which makes {_written(limited[first])} of it"
        )

    def answered(self, question: Question, service: str) -> None:
        """Take note that a service has given a part of the answer to a question."""
        if question.own is not None:
            if self._judge(question):
                _use(question, question.own)
        elif service in self._suspects:
            self.dispute(question, service)
        elif service != self._exempt and self._is_drawn(question):
            self.check(question, service)

    def check(self, question: Question, service: str) -> None:
        """Let the robot's own planner answer a question when it has time.

        Parameters
        ----------
        question : Question
        service : str
            Whose answer it is to be compared with.
        """
        if question.checked:
            return
        question.checked = True
        if len(self._asked) < MAX_OPEN_CHECKS:
            self._ask(question, service)
        else:
            self._note(question, service, "question", "left_out")

    def dispute(self, question: Question, service: str) -> None:
        """Let the robot's own planner answer a question before anything is done about it."""
        if question.disputed or question.own is not None:
            return
        question.disputed = question.checked = True
        for number, asked in self._asked.items():
            if asked is question:
                # It waits for the planner already, perhaps behind others.
                self._effects.append(Decide(number, question.state, urgent=True, again=False))
                return
        self._ask(question, service, urgent=True)

    def _is_drawn(self, question: Question) -> bool:
        if self._share <= 0.0:
            return False
        drawn = hashlib.blake2b(question.digest, digest_size=8, key=self._secret).digest()
        return int.from_bytes(drawn, "big") < self._share * 2.0**64

    def _ask(
        self, question: Question, service: str, *, urgent: bool = False, again: bool = False
    ) -> None:
        self._number += 1
        self._asked[self._number] = question
        if not again:
            # Before the answer is there: it may never come, and that is to be known.
            self._note(question, service, "question", "asked")
        self._effects.append(Decide(self._number, question.state, urgent, again))

    # -- the robot's own decisions ---------------------------------------------------------------

    def decided(self, event: Decided, current: Question | None, performed: int) -> bool:
        """Take the own planner's answer.

        Parameters
        ----------
        event : Decided
        current : Question or None
            The one that the robot is at; this answer may be to an earlier one.
        performed : int
            Task actions of the current question that are performed, or ordered.

        Returns
        -------
        bool
            Whether the current question can be gone on with; False if what was performed differs
            from what should have been, so that its answer leads nowhere any more.

        Raises
        ------
        OwnDecisionError
            If the robot waits for it, and the planner failed.
        """
        question = self._asked.pop(event.number, None)
        if question is None:
            return True
        if question.own is None:
            if event.failure is not None:
                self._failed(question, event.failure, waits=question is current)
                return True
            question.own = event
            differs = self._judge(question)
            if question is not current or not (differs or question.disputed):
                return True
            question.disputed = False
            tasks = question.tasks or []
            if not same_actions(tasks[:performed], event.actions[:performed]):
                return False
            _use(question, event)
            if not performed:
                question.task_source = Provenance(OWN_PLANNER, event.computed_s, event.computed_s)
            return True
        # It was asked again. If that failed, what it said first is all that there is.
        question.own_is_certain = event.failure is not None or _same(question.own, event)
        if not question.own_is_certain:
            self._report(
                "not_deterministic",
                step=question.state.step,
                reason="the robot's own planner came to two decisions in one state, so the "
                "problem is not deterministic; the first one stands",
            )
        self._judge(question)
        return True

    def _judge(self, question: Question) -> bool:
        """Compare what services gave with the robot's own answer; tell whether any differs."""
        own = question.own
        assert own is not None
        any_differs = False
        for given in question.given:
            if given.judged:
                continue
            same = _agrees(given, own)
            any_differs = any_differs or not same
            if same and given.outside_limits:
                self._note_limits(question)
            certain = True if given.outside_limits else question.own_is_certain
            if not same and certain is None:
                self._suspects[given.service] = question
                if question not in self._asked.values():
                    self._ask(question, given.service, again=True)
                continue
            given.judged = True
            verdict = "same" if same else "different" if certain else "not_deterministic"
            self._note(question, given.service, given.kind, verdict)
            if verdict == "different":
                self._wrong.append(WrongAnswer(given.service, question.state.step, given.kind))
        if question.own_is_certain is not None:
            self._suspects = {
                service: about for service, about in self._suspects.items() if about is not question
            }
        return any_differs

    def _note_limits(self, question: Question) -> None:
        if self.limits_tell:
            self.limits_tell = False
            self._report(
                "limits_unknown",
                step=question.state.step,
                reason="the problem's execute changes what it has let through, so it does not say "
                "which actions are possible; each task action of a service is compared with that "
                "of the robot's own planner before it is performed",
            )

    def _failed(self, question: Question, text: str, *, waits: bool) -> None:
        state = question.state
        if waits and question.disputed:
            raise OwnDecisionError(
                f"trial {state.trial}, step {state.step}: services answer differently, or outside "
                f"the problem's limits, and the robot's own planner cannot decide: {text}"
            )
        self._report("verification_failed", step=state.step, reason=text)
        for given in question.given:
            if not given.judged:
                given.judged = True
                self._note(question, given.service, given.kind, "failed")

    def _note(self, question: Question, service: str, kind: str, verdict: str) -> None:
        state = question.state
        self._effects.append(Verified(state.trial, state.step, service, kind, verdict))

    def _report(self, name: str, **fields: object) -> None:
        self._effects.append(Report(name, fields))


def _use(question: Question, own: Decided) -> None:
    """Give a question the robot's own answer."""
    if question.task_count:
        question.tasks = list(own.actions)
    if question.sensing_step is not None and own.sensing_action is not None:
        digest = own.ahead_digest[:DIGEST_SIZE]
        question.sensing = SensingAnswer(0, question.sensing_step, own.sensing_action, digest, 0)
        question.sensing_source = Provenance(OWN_PLANNER, own.computed_s, own.computed_s)


def _agrees(given: Given, own: Decided) -> bool:
    if given.tasks is not None:
        return same_actions(given.tasks, own.actions)
    sensing = given.sensing
    assert sensing is not None
    # Chosen in another state than the one in which the robot arrives, it would be of no use.
    arrives = sensing.digest == own.ahead_digest[:DIGEST_SIZE]
    return arrives and sensing.sensing_action == own.sensing_action


def _same(first: Decided, second: Decided) -> bool:
    return (
        same_actions(first.actions, second.actions)
        and first.sensing_action == second.sensing_action
        and first.ahead_digest == second.ahead_digest
    )


def _written(action: FloatArray) -> str:
    return f"({', '.join(f'{float(each):.6g}' for each in action[:8])})"
