"""Services are not trusted blindly: the robot checks limits, and recomputes a share of the answers.

The robot holds the true state and has a planner. Two rules follow:

- Task actions that the problem's ``limit_action`` would change are outside its limits. The own
  planner computes the same actions before the robot acts, and the robot performs its own.
- A random share of the questions, selected with the robot's secret so that no service can predict
  it, goes to the own planner as well, which computes while the robot moves. Recomputed are also a
  question to which two answers differ, and one whose sensing action was chosen for another state
  than the one in which the robot arrived.

Where an answer differs, the robot's own stands, and the service is not asked again in this run.

Before a service is blamed for an action within the limits, the planner decides a second time, with
a new instance of the problem. If it disagrees with itself, the problem is not deterministic and no
service is blamed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from holdfast.numerics.arrays import FloatArray
from holdfast.planning.planner import Planner
from holdfast.problems import checked
from holdfast.protocol.effects import Effects
from holdfast.protocol.messages import DIGEST_SIZE, SensingAnswer
from holdfast.protocol.question import OWN_PLANNER, Provenance, Question, same_actions
from holdfast.protocol.robot_events import (
    ComputeOwnAnswer,
    OwnAnswer,
    RobotEffect,
    VerificationNoted,
)

MAX_OPEN_CHECKS = 64
"""Bound on the questions that wait for the own planner; further ones are left out and counted."""

_Difference: TypeAlias = tuple[int, str, str]
"""Step of the first action that differs, the service's action, and the own planner's."""


class WrongAnswer(NamedTuple):
    """A service's answer that differs from the own planner's."""

    service: str
    kind: str  # task or sensing
    step: int  # of the first action that differs
    # answered, own: the service's action, and the own planner's; of sensing actions with the
    # state's digest.
    answered: str
    own: str


class Verification:
    """Takes answers, has some recomputed and finds the service that was wrong."""

    def __init__(
        self,
        share: float,  # of the questions that services answer, from 0 to 1
        secret: bytes,  # of the robot; selects the questions, together with their digests
        # A service that is not sampled: the local one, which runs the same code on the same
        # machine.
        exempt: str | None,
        planner: Planner,  # computes the task actions of a service that are outside the limits
        effects: Effects[RobotEffect],
    ) -> None:
        self._share = share
        self._secret = secret[:64]
        self._exempt = exempt
        self._planner = planner
        self._effects = effects
        self._asked: dict[int, Question] = {}
        # The own planner's answers, or None, to questions that it was asked or that were left out.
        self._own: dict[Question, OwnAnswer | None] = {}
        # Answers that differ from it, until the own planner has decided a second time.
        self._differing: dict[Question, list[WrongAnswer]] = {}
        self._number = 0
        self._wrong: list[WrongAnswer] = []
        self._limits_are_known = True

    def __len__(self) -> int:
        return len(self._asked)

    def take_wrong(self) -> list[WrongAnswer]:
        """Return the wrong answers found since the last call."""
        wrong, self._wrong = self._wrong, []
        return wrong

    def keep(self, questions: Collection[Question]) -> None:
        """Forget other questions: no service answers them any more, nor does the own planner."""
        kept = {*questions, *self._asked.values()}
        self._own = {question: own for question, own in self._own.items() if question in kept}

    # -- answers ---------------------------------------------------------------------------------

    def take_tasks(
        self, question: Question, actions: Sequence[FloatArray], provenance: Provenance
    ) -> None:
        """Take task actions of a service; the robot follows the first that come, or its own.

        Raises HoldfastError if they are outside the limits and the own planner fails.
        """
        if question.takes_tasks:
            return
        actions, provenance = self._within_limits(question, actions, provenance)
        followed = question.task_actions
        if followed is None:
            question.follow_tasks(actions, provenance)
            self._sample(question, "task", provenance.service)
        elif not same_actions(followed, actions):
            self._two_answers(question, "task", provenance.service)

    def take_sensing(
        self, question: Question, answer: SensingAnswer, provenance: Provenance
    ) -> None:
        """Take a sensing action of a service; the robot follows the first that comes."""
        followed = question.sensing
        if followed is None:
            question.follow_sensing(answer, provenance)
            self._sample(question, "sensing", provenance.service)
        elif (followed.sensing_action, followed.digest) != (answer.sensing_action, answer.digest):
            self._two_answers(question, "sensing", provenance.service)

    def _two_answers(self, question: Question, kind: str, service: str) -> None:
        if question in self._own:
            return
        self._effects.report(
            "disagreement",
            service=service,
            step=question.state.step,
            kind=kind,
            reason="two answers to one question differ; the robot follows the first, and its own "
            "planner computes it again",
        )
        self.check(question)

    def _within_limits(
        self, question: Question, actions: Sequence[FloatArray], provenance: Provenance
    ) -> tuple[Sequence[FloatArray], Provenance]:
        """Replace task actions outside the limits by the own planner's."""
        outside = self.outside_limits(np.array(actions))
        if outside is None:
            return actions, provenance
        own, _ = self._planner.plan_until_sensing(question.state, question.task_count)
        difference = _tasks_differ(question, actions, own)
        if difference is not None:
            self._blame(question, WrongAnswer(provenance.service, "task", *difference))
            return own, Provenance(OWN_PLANNER, 0.0, 0.0)
        if self._limits_are_known:
            self._limits_are_known = False
            self._effects.report(
                "limits_unknown",
                step=question.state.step,
                reason=f"{outside}; the robot's own planner comes to the same action, so "
                "limit_action does not say which actions are possible; the robot computes each "
                "task action itself, too, before it performs it",
            )
        return actions, provenance

    def outside_limits(self, actions: FloatArray) -> str | None:
        """Describe which task actions, one a row, the problem's ``limit_action`` would change."""
        limited = checked.executed_action(self._planner.problem, actions)
        # An action on a limit may be moved by a rounding error.
        slack = 1e-9 * np.maximum(1.0, np.abs(limited))
        outside = (np.abs(actions - limited) > slack).any(axis=-1)
        if not outside.any():
            return None
        first = int(np.argmax(outside))
        return (
            f"task action {_written(actions[first])} is outside the limits of the problem's "
            f"limit_action, which makes {_written(limited[first])} of it"
        )

    # -- the own planner's answers ---------------------------------------------------------------

    def check(self, question: Question) -> None:
        """Have the own planner answer a question when it has time."""
        if question in self._own:
            return
        self._own[question] = None
        # Before the answer is there: it may never come, and that is to be known.
        asks = len(self._asked) < MAX_OPEN_CHECKS
        _, service = question.followed()[-1]
        self._note(question, service, "question", "asked" if asks else "left_out")
        if asks:
            self._ask(question, again=False)

    def _sample(self, question: Question, kind: str, service: str) -> None:
        """Have a share of the questions answered by the own planner, too."""
        own = self._own.get(question)
        if own is not None:
            if not self._compare(question, kind, own):
                question.follow_own(own, own.computed_s)
        elif service != self._exempt and self._is_drawn(question):
            self.check(question)

    def _is_drawn(self, question: Question) -> bool:
        if self._share <= 0.0:
            return False
        drawn = hashlib.blake2b(question.digest, digest_size=8, key=self._secret).digest()
        return int.from_bytes(drawn, "big") < self._share * 2.0**64

    def _ask(self, question: Question, *, again: bool) -> None:
        self._number += 1
        self._asked[self._number] = question
        self._effects.append(ComputeOwnAnswer(self._number, question.state, again))

    def decided(self, event: OwnAnswer, current: Question | None) -> bool:
        """Take the own planner's answer; return whether the current question remains usable.

        Not if the performed actions differ from the right ones. The answer may belong to an earlier
        question.
        """
        question = self._asked.pop(event.number, None)
        if question is None:
            return True
        first = self._own[question]
        if first is not None:
            self._decided_again(question, first, event)
            return True
        if event.failure is not None:
            self._effects.report(
                "verification_failed", step=question.state.step, reason=str(event.failure)
            )
            for kind, service in question.followed():
                self._note(question, service, kind, "failed")
            return True
        self._own[question] = event
        agrees = [self._compare(question, kind, event) for kind, _ in question.followed()]
        if all(agrees) or question is not current:
            return True
        performed = question.num_ordered
        if not same_actions((question.task_actions or [])[:performed], event.actions[:performed]):
            return False
        question.follow_own(event, event.computed_s)
        return True

    def _decided_again(self, question: Question, first: OwnAnswer, second: OwnAnswer) -> None:
        # If the second decision failed, the first is all that there is.
        same = same_actions(first.actions, second.actions) and first[2:4] == second[2:4]
        is_certain = second.failure is not None or same
        if not is_certain:
            self._effects.report(
                "not_deterministic",
                step=question.state.step,
                reason="the robot's own planner came to two decisions in one state, so the "
                "problem is not deterministic; the first one stands",
            )
        for wrong in self._differing.pop(question):
            if is_certain:
                self._blame(question, wrong)
            else:
                self._note(question, wrong.service, wrong.kind, "not_deterministic")

    def _compare(self, question: Question, kind: str, own: OwnAnswer) -> bool:
        """Return whether a followed part is the own planner's; if not, have it decide again."""
        service = dict(question.followed())[kind]
        if service == OWN_PLANNER:
            return True
        if kind == "task":
            difference = _tasks_differ(question, question.task_actions or [], own.actions)
        else:
            difference = _sensing_differs(question, own)
        if difference is None:
            self._note(question, service, kind, "same")
            return True
        if question not in self._differing:
            self._differing[question] = []
            self._ask(question, again=True)
        self._differing[question].append(WrongAnswer(service, kind, *difference))
        return False

    def _blame(self, question: Question, wrong: WrongAnswer) -> None:
        self._note(question, wrong.service, wrong.kind, "different")
        self._wrong.append(wrong)

    def _note(self, question: Question, service: str, kind: str, verdict: str) -> None:
        state = question.state
        self._effects.append(VerificationNoted(state.trial, state.step, service, kind, verdict))


def _sensing_differs(question: Question, own: OwnAnswer) -> _Difference | None:
    sensing = question.sensing
    assert sensing is not None
    # Chosen in another state than the one in which the robot arrives, it would be of no use.
    answered = f"{sensing.sensing_action} in state {sensing.digest.hex()}"
    right = f"{own.sensing_action} in state {own.ahead_digest[:DIGEST_SIZE].hex()}"
    return None if answered == right else (sensing.step, answered, right)


def _tasks_differ(
    question: Question, answered: Sequence[FloatArray], own: Sequence[FloatArray]
) -> _Difference | None:
    for number, (one, other) in enumerate(zip(answered, own, strict=True)):
        if not same_actions([one], [other]):
            return question.state.step + number, _written(one), _written(other)
    return None


def _written(action: FloatArray) -> str:
    return f"({', '.join(repr(float(each)) for each in action[:8])})"
