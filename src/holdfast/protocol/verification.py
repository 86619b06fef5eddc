"""Services are not trusted blindly: the robot's own planner recomputes some of their answers.

A service can be faulty, outdated or in the wrong hands. The robot holds the true state and has a
planner, so it can check. In these cases it waits for its own planner, and follows that:

- an action that the problem's ``execute`` would change (it is outside the limits);
- two answers to one question that differ;
- an answer of a service that is under suspicion (see below).

In these it follows the service, and the planner computes while the robot moves:

- a random share of the questions, selected with the robot's secret, so no service can predict it;
- a sensing action that was chosen for another state than the one in which the robot arrived.

A service whose answer differs from the own planner's is not asked again in this run.

Before a service is blamed for an action within the limits, the planner decides a second time, with
a new instance of the problem. If it disagrees with itself, the problem is not deterministic and no
service is blamed. Until that is known, every answer of the service is disputed.
"""

from __future__ import annotations

import hashlib
from typing import NamedTuple

import numpy as np

from holdfast.errors import OwnDecisionError
from holdfast.numerics.arrays import FloatArray
from holdfast.problems import checked
from holdfast.problems.problem import Problem
from holdfast.protocol.events import (
    ComputeOwnAnswer,
    Effects,
    OwnAnswer,
    RobotEffect,
    VerificationNoted,
)
from holdfast.protocol.messages import DIGEST_SIZE, SensingAnswer
from holdfast.protocol.question import (
    OWN_PLANNER,
    AnswerPart,
    Provenance,
    Question,
    same_actions,
)

__all__ = ["Verification", "WrongAnswer"]


_MAX_PARTS = 64
"""Bound on the parts of one question's answer that are kept to be compared."""

MAX_OPEN_CHECKS = 64
"""Bound on the questions that wait for the own planner; further ones are left out and counted."""


class WrongAnswer(NamedTuple):
    """A service's answer that differs from the own planner's.

    Attributes
    ----------
    step : int
        Of the question.
    kind : {"task", "sensing"}
    """

    service: str
    step: int
    kind: str


class Verification:
    """Takes the parts of answers, has some recomputed and finds the service that was wrong.

    It alone writes into the answer of a question that services answer.

    Parameters
    ----------
    share : float
        Of the questions that services answer, from 0 to 1.
    secret : bytes
        Of the robot; selects the questions, together with their digests.
    exempt : str or None
        A service that is not sampled: the local one, which runs the same code on the same machine.

    Attributes
    ----------
    limits_are_reliable : bool
        Whether an action that ``execute`` would change must be wrong. False once ``execute`` has
        changed a correct one; then the robot compares each action with its own planner's.
    """

    def __init__(
        self,
        share: float,
        secret: bytes,
        exempt: str | None,
        problem: Problem,
        effects: Effects[RobotEffect],
    ) -> None:
        self._share = share
        self._secret = secret[:64]
        self._exempt = exempt
        self._problem = problem
        self._effects = effects
        self._asked: dict[int, Question] = {}
        self._number = 0
        # By the question in which they differed from the robot's own planner.
        self._suspects: dict[str, Question] = {}
        self._wrong: list[WrongAnswer] = []
        self.limits_are_reliable = True

    def __len__(self) -> int:
        return len(self._asked)

    def take_wrong(self) -> list[WrongAnswer]:
        """Return the wrong answers found since the last call."""
        wrong, self._wrong = self._wrong, []
        return wrong

    # -- answers ---------------------------------------------------------------------------------

    def outside_limits(self, actions: FloatArray) -> str | None:
        """Describe task actions that the problem's ``execute`` would change.

        Parameters
        ----------
        actions : array of shape (count, action_size)

        Returns
        -------
        str or None
            None if all are within the limits.
        """
        if not self.limits_are_reliable:
            return None
        limited = checked.executed_action(self._problem, actions)
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

    def take(self, question: Question, part: AnswerPart, provenance: Provenance) -> None:
        """Take a part of the answer to a question.

        The robot follows the first part within the limits. A part that is outside the limits, or
        differs from another, disputes the question.
        """
        outside = (
            None if part.task_actions is None else self.outside_limits(np.array(part.task_actions))
        )
        part.outside_limits = outside is not None
        agrees = _keep_and_follow_first(question, part, provenance)
        if not agrees:
            if not question.disputed and question.own is None:
                why = outside or "two answers to one question differ"
                self._effects.report(
                    "disagreement",
                    service=part.service,
                    step=question.state.step,
                    kind=part.kind,
                    reason=f"{why}; the robot's own planner decides",
                )
            self.dispute(question, part.service)
        if question.own is not None:
            if self._judge(question):
                _use(question, question.own)
        elif part.service in self._suspects:
            self.dispute(question, part.service)
        elif part.service != self._exempt and self._is_drawn(question):
            self.check(question, part.service)

    def check(self, question: Question, service: str) -> None:
        """Have the own planner answer a question when it has time.

        Parameters
        ----------
        service : str
            Whose answer is to be compared.
        """
        if question.check_decided:
            return
        question.check_decided = True
        if len(self._asked) < MAX_OPEN_CHECKS:
            self._ask(question, service)
        else:
            self._note(question, service, "question", "left_out")

    def dispute(self, question: Question, service: str) -> None:
        """Have the own planner answer a question before the robot acts on it."""
        if question.disputed or question.own is not None:
            return
        question.disputed = question.check_decided = True
        for number, asked in self._asked.items():
            if asked is question:
                # It waits for the planner already, perhaps behind others.
                self._effects.append(
                    ComputeOwnAnswer(number, question.state, urgent=True, again=False)
                )
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
        self._effects.append(ComputeOwnAnswer(self._number, question.state, urgent, again))

    # -- the robot's own decisions ---------------------------------------------------------------

    def decided(self, event: OwnAnswer, current: Question | None) -> bool:
        """Take the own planner's answer.

        Parameters
        ----------
        current : Question or None
            The robot's current question; this answer may belong to an earlier one.

        Returns
        -------
        bool
            Whether the current question remains usable: False if the performed actions differ from
            the correct ones.

        Raises
        ------
        OwnDecisionError
            If the robot waits for the planner and it failed.
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
            task_actions, performed = question.task_actions or [], question.num_ordered
            if not same_actions(task_actions[:performed], event.actions[:performed]):
                return False
            _use(question, event)
            if not performed:
                question.task_provenance = Provenance(
                    OWN_PLANNER, event.computed_s, event.computed_s
                )
            return True
        # It was asked again. If that failed, what it said first is all that there is.
        question.own_is_certain = event.failure is not None or _same(question.own, event)
        if not question.own_is_certain:
            self._effects.report(
                "not_deterministic",
                step=question.state.step,
                reason="the robot's own planner came to two decisions in one state, so the "
                "problem is not deterministic; the first one stands",
            )
        self._judge(question)
        return True

    def _judge(self, question: Question) -> bool:
        """Compare the services' parts with the own answer; return whether any differs."""
        own = question.own
        assert own is not None
        any_differs = False
        for part in question.parts:
            if part.judged:
                continue
            same = _agrees(part, own)
            any_differs = any_differs or not same
            if same and part.outside_limits:
                self._note_limits(question)
            certain = True if part.outside_limits else question.own_is_certain
            if not same and certain is None:
                self._suspects[part.service] = question
                if question not in self._asked.values():
                    self._ask(question, part.service, again=True)
                continue
            part.judged = True
            verdict = "same" if same else "different" if certain else "not_deterministic"
            self._note(question, part.service, part.kind, verdict)
            if verdict == "different":
                self._wrong.append(WrongAnswer(part.service, question.state.step, part.kind))
        if question.own_is_certain is not None:
            self._suspects = {
                service: about for service, about in self._suspects.items() if about is not question
            }
        return any_differs

    def _note_limits(self, question: Question) -> None:
        if self.limits_are_reliable:
            self.limits_are_reliable = False
            self._effects.report(
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
        self._effects.report("verification_failed", step=state.step, reason=text)
        for part in question.parts:
            if not part.judged:
                part.judged = True
                self._note(question, part.service, part.kind, "failed")

    def _note(self, question: Question, service: str, kind: str, verdict: str) -> None:
        state = question.state
        self._effects.append(VerificationNoted(state.trial, state.step, service, kind, verdict))


def _keep_and_follow_first(question: Question, part: AnswerPart, provenance: Provenance) -> bool:
    """Keep a part of the answer, and follow it if it is the first; return whether all parts agree.

    A part outside the limits is only kept for comparison.
    """
    others = [each for each in question.parts if each.kind == part.kind]
    known = any(each.service == part.service and each.agrees_with(part) for each in others)
    if not known and len(question.parts) < _MAX_PARTS:
        question.parts.append(part)
    if part.outside_limits:
        return False
    if part.task_actions is not None and question.task_actions is None:
        question.task_actions = part.task_actions
        question.task_provenance = provenance
    elif part.sensing is not None and question.sensing is None:
        question.sensing = part.sensing
        question.sensing_provenance = provenance
    return all(part.agrees_with(each) for each in others)


def _use(question: Question, own: OwnAnswer) -> None:
    """Make the own planner's answer the one that the robot follows."""
    if question.task_count:
        question.task_actions = list(own.actions)
    if question.sensing_step is not None and own.sensing_action is not None:
        digest = own.ahead_digest[:DIGEST_SIZE]
        question.sensing = SensingAnswer(0, question.sensing_step, own.sensing_action, digest, 0)
        question.sensing_provenance = Provenance(OWN_PLANNER, own.computed_s, own.computed_s)


def _agrees(part: AnswerPart, own: OwnAnswer) -> bool:
    if part.task_actions is not None:
        return same_actions(part.task_actions, own.actions)
    sensing = part.sensing
    assert sensing is not None
    # Chosen in another state than the one in which the robot arrives, it would be of no use.
    arrives = sensing.digest == own.ahead_digest[:DIGEST_SIZE]
    return arrives and sensing.sensing_action == own.sensing_action


def _same(first: OwnAnswer, second: OwnAnswer) -> bool:
    return (
        same_actions(first.actions, second.actions)
        and first.sensing_action == second.sensing_action
        and first.ahead_digest == second.ahead_digest
    )


def _written(action: FloatArray) -> str:
    return f"({', '.join(f'{float(each):.6g}' for each in action[:8])})"
