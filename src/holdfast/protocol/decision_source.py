"""What the robot's loop asks of its source of decisions: services, or its own planner."""

from __future__ import annotations

from typing import Protocol

from holdfast.protocol.events import Effects, OwnAnswer, Planned, RobotEffect, TransportEvent
from holdfast.protocol.question import Question
from holdfast.protocol.status import Status

__all__ = ["DecisionSource"]


class DecisionSource(Protocol):
    """What answers a robot's questions.

    :class:`~holdfast.protocol.dispatcher.Dispatcher` asks services;
    :class:`~holdfast.robot.in_process_planner.InProcessSource` asks only the robot's own planner.

    Attributes
    ----------
    effects : Effects
        To be carried out in order; the robot appends its own.
    question : Question or None
        The current question, answered or not.
    stopped : bool
        Whether the robot must not continue.
    """

    effects: Effects[RobotEffect]
    question: Question | None
    stopped: bool

    @property
    def status(self) -> Status:
        """Which service decides."""
        ...

    @property
    def recoveries(self) -> int:
        """Times that the local service took over."""
        ...

    @property
    def limits_are_reliable(self) -> bool:
        """Whether an action that the problem's ``execute`` would change must be wrong."""
        ...

    @property
    def is_holding(self) -> bool:
        """Whether the robot holds still because no service is usable."""
        ...

    @property
    def num_unverified(self) -> int:
        """Questions that the own planner still has to recompute."""
        ...

    def start(self, now: float) -> None:
        """Begin the run."""
        ...

    def ask(self, question: Question, now: float) -> None:
        """Replace the question."""
        ...

    def drop(self) -> None:
        """Drop the question: the trial has ended, or its answer is of no use."""
        ...

    def need(self, now: float) -> None:
        """Note that the robot waits for the rest of the answer."""
        ...

    def go_on(self) -> None:
        """Note that the robot no longer waits."""
        ...

    def check(self) -> None:
        """Note that the answer did not fit the state in which the robot arrived."""
        ...

    def dispute(self) -> None:
        """Have the own planner answer before the robot acts."""
        ...

    def handle(self, event: TransportEvent | Planned, now: float) -> None:
        """Handle an event of the transport or the in-process planner."""
        ...

    def decided(self, event: OwnAnswer, performed: int, now: float) -> None:
        """Take the own planner's answer to a question that services have answered."""
        ...

    def recovery_exited(self, launch: int, reason: str, now: float) -> None:
        """Handle the end of a local service's process."""
        ...

    def wake(self, now: float) -> None:
        """Handle the passing of time."""
        ...

    def next_wakeup(self) -> float | None:
        """Return when :meth:`wake` is due if nothing happens before; None if never."""
        ...

    def event_loop_stalled(self, seconds: float) -> None:
        """Note that for so long the robot's process could not receive."""
        ...
