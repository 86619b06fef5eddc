"""A robot without services: its own planner answers, in the same two parts as a service would.

First come the task actions up to the next sensing step, for which the robot stands still; then the
sensing action of that step, which is computed while the robot moves. There is no message, and
nobody who could be lost, slow or wrong: so there is nothing to time, to check or to ask again.
"""

from __future__ import annotations

from holdfast.protocol.verification import OWN_PLANNER
from holdfast.session.effects import Effect, Plan, Stop
from holdfast.session.events import Decided, Planned, TransportEvent
from holdfast.session.messages import DIGEST_SIZE, SensingAnswer
from holdfast.session.question import Provenance, Question
from holdfast.session.status import Status

__all__ = ["OwnPlanning"]


class OwnPlanning:
    """A :class:`~holdfast.session.decision_source.DecisionSource` that asks nobody else."""

    limits_tell = True
    is_holding = False
    num_unverified = 0

    def __init__(self) -> None:
        self.effects: list[Effect] = []
        self.status = Status.STANDARD
        self.question: Question | None = None
        self.stopped = False
        self.recoveries = 0
        self._number = 0
        self._asked_at = 0.0

    def start(self, now: float) -> None:
        """Begin the run."""

    def ask(self, question: Question, now: float) -> None:
        """Ask a new question; the one before is forgotten."""
        self.question = question
        self._number += 1
        self._asked_at = now
        self.effects.append(Plan(self._number, question.state, question.task_count == 0))

    def drop(self) -> None:
        """Forget the question: the trial is over."""
        self.question = None

    def need(self, now: float) -> None:
        """Say that the robot stands still until the rest of the answer is there."""
        if self.question is not None and self.question.needed_at is None:
            self.question.needed_at = now

    def go_on(self) -> None:
        """Say that the robot stands still no more."""
        if self.question is not None:
            self.question.needed_at = None

    def check(self) -> None:
        """Do nothing: that was the planner's own answer."""

    def dispute(self) -> None:
        """Do nothing: nobody else has answered."""

    def handle(self, event: TransportEvent | Planned, now: float) -> None:
        """Take a part of the answer."""
        question = self.question
        if not isinstance(event, Planned) or event.number != self._number or question is None:
            return
        if event.error is not None:
            self.stopped = True
            self.effects.append(Stop(event.error))
            return
        source = Provenance(OWN_PLANNER, now - self._asked_at, event.computed_s)
        if event.sensing_action is None:
            question.tasks = event.actions
            question.task_source = source
            if question.sensing_step is not None:
                self.effects.append(Plan(self._number, event.ahead, sensing=True))
        else:
            assert question.sensing_step is not None
            digest = event.ahead_digest[:DIGEST_SIZE]
            question.sensing = SensingAnswer(
                0, question.sensing_step, event.sensing_action, digest, 0
            )
            question.sensing_source = source

    def decided(self, event: Decided, performed: int, now: float) -> None:
        """Do nothing: there is nothing to be verified."""

    def recovery_exited(self, launch: int, reason: str, now: float) -> None:
        """Do nothing: there is no local service."""

    def wake(self, now: float) -> None:
        """Do nothing: it waits for no time."""

    def next_wakeup(self) -> float | None:
        """Return None."""
        return None

    def was_deaf(self, seconds: float) -> None:
        """Do nothing: there is nobody to blame."""

    def take(self) -> list[Effect]:
        """Return the effects so far, in order, and forget them."""
        effects = self.effects.copy()
        self.effects.clear()
        return effects
