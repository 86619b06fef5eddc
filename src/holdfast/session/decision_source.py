"""Who answers a robot's questions: services, or nobody but its own planner.

The robot's machine asks one question at a time and looks at the question itself for what of the
answer has come. It does not know who gives it.
"""

from __future__ import annotations

from typing import Protocol

from holdfast.session.effects import Effect
from holdfast.session.events import Decided, Planned, TransportEvent
from holdfast.session.question import Question
from holdfast.session.status import Status

__all__ = ["DecisionSource"]


class DecisionSource(Protocol):
    """Gets a robot's questions answered; :class:`~holdfast.session.dispatcher.Dispatcher` is one.

    Attributes
    ----------
    effects : list of Effect
        What is to be done, in order; the robot adds its own.
    status : Status
    question : Question or None
        The one that is being asked or was answered last.
    stopped : bool
        Whether the robot must not go on.
    recoveries : int
        Times that the local service took over.
    """

    effects: list[Effect]
    status: Status
    question: Question | None
    stopped: bool
    recoveries: int

    @property
    def limits_tell(self) -> bool:
        """Whether an action that the problem's ``execute`` would change is a wrong one."""
        ...

    @property
    def is_holding(self) -> bool:
        """Whether the robot holds still because nobody can be asked."""
        ...

    @property
    def num_unverified(self) -> int:
        """Questions that the robot's own planner still has to answer again."""
        ...

    def start(self, now: float) -> None:
        """Begin the run."""
        ...

    def ask(self, question: Question, now: float) -> None:
        """Ask a new question; the one before is forgotten."""
        ...

    def drop(self) -> None:
        """Forget the question: the trial is over."""
        ...

    def need(self, now: float) -> None:
        """Say that the robot stands still until the rest of the answer is there."""
        ...

    def go_on(self) -> None:
        """Say that the robot stands still no more."""
        ...

    def check(self) -> None:
        """Take note that the answer was of no use in the state in which the robot arrived."""
        ...

    def dispute(self) -> None:
        """Let the robot's own planner answer the question before anything is done about it."""
        ...

    def handle(self, event: TransportEvent | Planned, now: float) -> None:
        """Take note of what a transport or the own planner delivered."""
        ...

    def decided(self, event: Decided, performed: int, now: float) -> None:
        """Take what the own planner answers to a question of which services know the answer."""
        ...

    def recovery_exited(self, launch: int, reason: str, now: float) -> None:
        """Take note that a process of the local service has ended."""
        ...

    def wake(self, now: float) -> None:
        """Time has passed."""
        ...

    def next_wakeup(self) -> float | None:
        """Return when :meth:`wake` must be called if nothing happens before."""
        ...

    def was_deaf(self, seconds: float) -> None:
        """Take note that for this long nothing that came could be heard."""
        ...

    def take(self) -> list[Effect]:
        """Return the effects so far, in order, and forget them."""
        ...
