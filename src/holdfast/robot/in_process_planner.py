"""A robot without services: a planner in its own process answers.

The answer comes in the same two parts as a service's. First the task actions up to the next sensing
step, for which the robot stands still; then that step's sensing action, computed while the robot
moves. There are no messages and no second party, so nothing is timed, checked or asked again.

Handing work to another thread takes longer than many decisions. So brief work is computed on the
robot's loop once no event waits: the environment moves meanwhile if it has its own thread. Long
work is computed on a thread, so the loop keeps reacting.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from time import perf_counter

from holdfast.errors import HoldfastError
from holdfast.planning import Planner
from holdfast.protocol.events import (
    Effects,
    Halt,
    OwnAnswer,
    Plan,
    Planned,
    RobotEffect,
    TransportEvent,
)
from holdfast.protocol.expected_time import TypicalTime
from holdfast.protocol.messages import DIGEST_SIZE, MAX_TASK_ACTIONS, SensingAnswer
from holdfast.protocol.question import Provenance, Question
from holdfast.protocol.status import Status
from holdfast.protocol.verification import OWN_PLANNER
from holdfast.service.pool import ThreadPool

__all__ = ["InProcessPlanner", "InProcessSource"]

_BRIEF_S = 0.001
"""Work that may take longer goes to a thread: the loop handles no event meanwhile."""


class InProcessSource:
    """A :class:`~holdfast.protocol.decision_source.DecisionSource` without services.

    Its only effects are :class:`Plan` and :class:`Halt`; the shell passes each :class:`Plan` to an
    :class:`InProcessPlanner` and the result back to :meth:`handle`.
    """

    limits_are_reliable = True
    is_holding = False
    num_unverified = 0

    def __init__(self) -> None:
        self.effects: Effects[RobotEffect] = Effects()
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
        """Note that the robot stands still until the rest of the answer is there."""
        if self.question is not None:
            self.question.wait(now)

    def go_on(self) -> None:
        """Note that the robot moves again."""
        if self.question is not None:
            self.question.stop_waiting()

    def check(self) -> None:
        """Do nothing: the planner's own answer needs no check."""

    def dispute(self) -> None:
        """Do nothing: there is no other answer."""

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

    def decided(self, event: OwnAnswer, performed: int, now: float) -> None:
        """Do nothing: no answer is verified."""

    def recovery_exited(self, launch: int, reason: str, now: float) -> None:
        """Do nothing: there is no local service."""

    def wake(self, now: float) -> None:
        """Do nothing: no timer is set."""

    def next_wakeup(self) -> float | None:
        """Return None."""
        return None

    def event_loop_stalled(self, seconds: float) -> None:
        """Do nothing: no service is timed."""


class InProcessPlanner:
    """Computes the parts of an answer; all methods are called on the loop's thread.

    Parameters
    ----------
    make_planner : callable
        Builds the planner with its own instance of the problem, because the loop's thread uses the
        robot's instance at the same time. Called on a thread, with the first question.
    deliver : callable
        Takes the results, on the loop's thread.
    failed : callable
        Takes an error of the problem's code, on the loop's thread.
    may_be_brief : bool
        Whether work that was brief before is expected to be brief again. User code may take any
        time at any call.
    """

    def __init__(
        self,
        make_planner: Callable[[], Planner],
        deliver: Callable[[Planned], None],
        failed: Callable[[BaseException], None],
        *,
        may_be_brief: bool,
    ) -> None:
        self._make_planner = make_planner
        self._deliver = deliver
        self._threads = ThreadPool(1, "holdfast-in-process-planner", failed)
        self._may_be_brief = may_be_brief
        self._planner: Planner | None = None
        self._waiting: Plan | None = None
        # By whether it is a sensing action.
        self._usual = {False: TypicalTime(), True: TypicalTime()}

    def ask(self, plan: Plan) -> None:
        """Compute a part of an answer; an earlier request that has not begun is forgotten."""
        self._waiting = None
        # One thread at a time uses the planner's problem.
        if self._usual[plan.sensing].seconds <= _BRIEF_S and not self._threads.num_open:
            self._waiting = plan
        else:
            self._threads.submit(functools.partial(self._computed, plan), self._finished)

    def compute_brief(self) -> bool:
        """Compute and deliver the waiting brief request; return whether there was one."""
        plan, self._waiting = self._waiting, None
        if plan is None:
            return False
        self._finished(self._computed(plan))
        return True

    def close(self) -> None:
        """Compute nothing more, without waiting for a computation that runs."""
        self._waiting = None
        self._threads.close()

    def _computed(self, plan: Plan) -> tuple[Plan, Planned]:
        planner = self._planner
        began = perf_counter()
        try:
            if planner is None:
                planner = self._planner = self._make_planner()
                # The time for building the problem predicts nothing.
                began = perf_counter()
            planned = _answer(planner, plan)
        except HoldfastError as error:
            planned = Planned(plan.number, plan.state, error=error)
        return plan, planned._replace(computed_s=perf_counter() - began)

    def _finished(self, computed: tuple[Plan, Planned]) -> None:
        plan, planned = computed
        if self._may_be_brief:
            self._usual[plan.sensing].learn(planned.computed_s)
        self._deliver(planned)


def _answer(planner: Planner, plan: Plan) -> Planned:
    number, state = plan.number, plan.state
    if plan.sensing:
        action, _ = planner.choose_sensing_action(state)
        return Planned(number, state, ahead_digest=planner.digest(state), sensing_action=action)
    actions, ahead = planner.plan_until_sensing(state, MAX_TASK_ACTIONS)
    return Planned(number, ahead, actions)
