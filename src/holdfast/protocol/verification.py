"""What services answer is not taken on trust: the robot computes some of it again.

A service is a calculator, and a calculator can be faulty, out of date or in the wrong hands. The
robot holds the truth and has a planner of its own, so it can tell. Three things make it look:

- an action that the problem's own ``execute`` would not let through;
- two answers to one question that are not the same;
- chance: a share of the questions, drawn with a secret of the robot, so no service knows which.

In the first two cases the robot waits for its own planner and does what that says. In the third it
goes on, and its planner computes while the robot moves. Whoever answered otherwise than the robot's
own planner is not asked again in this run.

Before a service is blamed the planner decides a second time. If it comes to something else than the
first time, the problem itself is not deterministic, and nobody is to blame.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from holdfast.errors import HoldfastError
from holdfast.session.effects import Decide, Effect, Report, Verified
from holdfast.session.events import Decided
from holdfast.session.messages import DIGEST_SIZE, SensingAnswer
from holdfast.session.question import Given, Provenance, Question

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
    left_out : int
        Questions that were drawn, but not computed again because too many waited.
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
        self._wrong: list[WrongAnswer] = []
        # Some problems' limits also change what they have let through: then they tell nothing.
        self._limits_tell = True
        self.left_out = 0

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
        if not self._limits_tell:
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
            self._judge(question)
        elif not question.checked and service != self._exempt and self._is_drawn(question):
            self.check(question)

    def check(self, question: Question) -> None:
        """Let the robot's own planner answer a question when it has time."""
        if question.checked:
            return
        question.checked = True
        if len(self._asked) < MAX_OPEN_CHECKS:
            self._ask(question, urgent=False)
        else:
            self.left_out += 1

    def dispute(self, question: Question) -> None:
        """Let the robot's own planner answer a question before anything is done about it."""
        if not question.disputed and question.own is None:
            question.disputed = question.checked = True
            # If it waits for the planner already, it may stand behind others.
            self._ask(question, urgent=True)

    def _is_drawn(self, question: Question) -> bool:
        if self._share <= 0.0:
            return False
        drawn = hashlib.blake2b(question.digest, digest_size=8, key=self._secret).digest()
        return int.from_bytes(drawn, "big") < self._share * 2.0**64

    def _ask(self, question: Question, *, urgent: bool) -> None:
        self._number += 1
        self._asked[self._number] = question
        self._effects.append(Decide(self._number, question.state, urgent))

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
        if event.failure is not None:
            self._failed(question, event.failure)
            return True
        before = question.own
        question.own = event
        if before is not None:
            question.own_is_certain = _same(before, event)
            if not question.own_is_certain:
                self._report(
                    "not_deterministic",
                    step=question.state.step,
                    reason="the robot's own planner came to two decisions in one state, so the "
                    "problem is not deterministic; the last one stands",
                )
        self._judge(question)
        return question is not current or self._settle(question, event, performed)

    def _judge(self, question: Question) -> None:
        """Compare what services gave with the robot's own answer."""
        own, certain = question.own, question.own_is_certain
        assert own is not None
        state = question.state
        for given in question.given:
            if given.judged:
                continue
            same = _agrees(given, own)
            if same and given.outside_limits:
                self._limits_tell = False
            if not same and certain is None:
                # Perhaps the problem is not deterministic: the planner is asked once more.
                if question not in self._asked.values():
                    question.disputed = True
                    self._ask(question, urgent=True)
                return
            given.judged = True
            verdict = "same" if same else "different" if certain else "not_deterministic"
            self._effects.append(
                Verified(state.trial, state.step, given.service, given.kind, verdict)
            )
            if verdict == "different":
                self._wrong.append(WrongAnswer(given.service, state.step, given.kind))

    def _settle(self, question: Question, own: Decided, performed: int) -> bool:
        """Let a disputed question have the robot's own answer."""
        if not question.disputed or question in self._asked.values():
            return True
        question.disputed = False
        tasks = question.tasks or []
        if not _equal(tasks[:performed], own.actions[:performed]):
            return False
        source = Provenance(OWN_PLANNER, own.computed_s, own.computed_s)
        if question.task_count:
            question.tasks = list(own.actions)
            question.task_source = None if performed else source
        if question.sensing_step is not None and own.sensing_action is not None:
            digest = own.ahead_digest[:DIGEST_SIZE]
            question.sensing = SensingAnswer(
                0, question.sensing_step, own.sensing_action, digest, 0
            )
            question.sensing_source = source
        return True

    def _failed(self, question: Question, text: str) -> None:
        state = question.state
        if question.disputed:
            raise OwnDecisionError(
                f"trial {state.trial}, step {state.step}: services answer differently, or outside "
                f"the problem's limits, and the robot's own planner cannot decide: {text}"
            )
        self._report("verification_failed", step=state.step, reason=text)
        for given in question.given:
            if not given.judged:
                given.judged = True
                self._effects.append(
                    Verified(state.trial, state.step, given.service, given.kind, "failed")
                )

    def _report(self, name: str, **fields: object) -> None:
        self._effects.append(Report(name, fields))


def _agrees(given: Given, own: Decided) -> bool:
    if given.tasks is not None:
        return _equal(given.tasks, own.actions)
    sensing = given.sensing
    assert sensing is not None
    # Chosen in another state than the one in which the robot arrives, it would be of no use.
    arrives = sensing.digest == own.ahead_digest[:DIGEST_SIZE]
    return arrives and sensing.sensing_action == own.sensing_action


def _same(first: Decided, second: Decided) -> bool:
    return (
        _equal(first.actions, second.actions)
        and first.sensing_action == second.sensing_action
        and first.ahead_digest == second.ahead_digest
    )


def _equal(first: Sequence[FloatArray], second: Sequence[FloatArray]) -> bool:
    return len(first) == len(second) and all(map(np.array_equal, first, second))


def _written(action: FloatArray) -> str:
    return f"({', '.join(f'{float(each):.6g}' for each in action[:8])})"
