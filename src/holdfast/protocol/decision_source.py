"""What the robot's loop asks of its source of decisions: services, or its own planner."""

from __future__ import annotations

from holdfast.protocol.events import (
    Effects,
    Halt,
    OwnAnswer,
    Plan,
    Planned,
    RobotEffect,
    TransportEvent,
)
from holdfast.protocol.messages import DIGEST_SIZE, SensingAnswer
from holdfast.protocol.question import Provenance, Question
from holdfast.protocol.status import Status
from holdfast.protocol.verification import OWN_PLANNER

__all__ = ["DecisionSource", "InProcessSource"]


class DecisionSource:
    """What answers a robot's questions.

    :class:`~holdfast.protocol.dispatcher.Dispatcher` asks services; :class:`InProcessSource` asks
    only the robot's own planner. What only services need does nothing here: there is no service to
    be lost, timed or verified.

    Attributes
    ----------
    effects : Effects
        To be carried out in order; the robot appends its own.
    question : Question or None
        The current question, answered or not.
    stopped : bool
        Whether the robot must not continue.
    """

    def __init__(self) -> None:
        self.effects: Effects[RobotEffect] = Effects()
        self.question: Question | None = None
        self.stopped = False

    @property
    def status(self) -> Status:
        """Which service decides."""
        return Status.STANDARD

    @property
    def recoveries(self) -> int:
        """Times that the cloud was lost."""
        return 0

    @property
    def limits_are_reliable(self) -> bool:
        """Whether an action that the problem's ``execute`` would change must be wrong."""
        return True

    @property
    def is_holding(self) -> bool:
        """Whether the robot holds still: no service is usable, or its own planner has to decide."""
        return False

    @property
    def num_unverified(self) -> int:
        """Questions that the own planner still has to recompute."""
        return 0

    def start(self, now: float) -> None:
        """Begin the run."""

    def ask(self, question: Question, now: float) -> None:
        """Replace the question."""
        raise NotImplementedError

    def drop(self) -> None:
        """Drop the question: the trial has ended, or its answer is of no use."""
        self.question = None

    def need(self, now: float) -> None:
        """Note that the robot waits for the rest of the answer."""
        if self.question is not None:
            self.question.wait(now)

    def go_on(self) -> None:
        """Note that the robot no longer waits."""
        if self.question is not None:
            self.question.stop_waiting()

    def check(self) -> None:
        """Note that the answer did not fit the state in which the robot arrived."""

    def dispute(self) -> None:
        """Have the own planner answer before the robot acts."""

    def handle(self, event: TransportEvent | Planned, now: float) -> None:
        """Handle an event of the transport or the in-process planner."""
        raise NotImplementedError

    def decided(self, event: OwnAnswer, performed: int, now: float) -> None:
        """Take the own planner's answer to a question that services have answered.

        Parameters
        ----------
        performed : int
            Task actions of the current question that are performed or ordered.
        """

    def recovery_exited(self, launch: int, reason: str, now: float) -> None:
        """Handle the end of a local service's process, or its failure to start."""

    def wake(self, now: float) -> None:
        """Do what is due now."""

    def next_wakeup(self) -> float | None:
        """Return when :meth:`wake` is due if nothing happens before; None if never."""
        return None

    def event_loop_stalled(self, seconds: float) -> None:
        """Note that for so long the robot's process could not receive."""


class InProcessSource(DecisionSource):
    """Decisions without services.

    Its only effects are :class:`Plan` and :class:`Halt`; the shell computes each :class:`Plan` and
    passes the result back to :meth:`handle`.
    """

    def __init__(self) -> None:
        super().__init__()
        self._number = 0
        self._asked_at = 0.0

    def ask(self, question: Question, now: float) -> None:
        """Ask a new question; the one before is forgotten."""
        self.question = question
        self._number += 1
        self._asked_at = now
        self.effects.append(Plan(self._number, question.state, question.task_count == 0))

    def handle(self, event: TransportEvent | Planned, now: float) -> None:
        """Take a part of the answer; results of earlier questions are ignored."""
        question = self.question
        if not isinstance(event, Planned) or event.number != self._number or question is None:
            return
        if event.error is not None:
            self.stopped = True
            self.effects.append(Halt(event.error))
            return
        source = Provenance(OWN_PLANNER, now - self._asked_at, event.computed_s)
        if event.sensing_action is None:
            question.task_actions = event.actions
            question.task_provenance = source
            if question.sensing_step is not None:
                self.effects.append(Plan(self._number, event.ahead, sensing=True))
        else:
            assert question.sensing_step is not None
            digest = event.ahead_digest[:DIGEST_SIZE]
            question.sensing = SensingAnswer(
                0, question.sensing_step, event.sensing_action, digest, 0
            )
            question.sensing_provenance = source
