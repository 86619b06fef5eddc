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
from holdfast.planning.planner import Planner
from holdfast.protocol.events import Plan, Planned
from holdfast.protocol.expected_time import ExpectedTime
from holdfast.protocol.messages import MAX_TASK_ACTIONS
from holdfast.runtime.pool import ThreadPool

_BRIEF_S = 0.001
"""Work that may take longer goes to a thread: the loop handles no event meanwhile."""


class InProcessPlanner:
    """Computes the parts of an answer; all methods are called on the loop's thread.

    ``deliver`` and ``failed`` (for an error of the problem's code) are called there, too.
    """

    def __init__(
        self,
        # Builds the planner with its own instance of the problem, because the loop's thread uses
        # the robot's instance at the same time. Called on a thread, with the first question.
        make_planner: Callable[[], Planner],
        deliver: Callable[[Planned], None],
        failed: Callable[[BaseException], None],
        *,
        # Whether work that was brief before is expected to be brief again. User code may take any
        # time at any call.
        may_be_brief: bool,
    ) -> None:
        self._make_planner = make_planner
        self._deliver = deliver
        self._threads = ThreadPool(1, "holdfast-in-process-planner", failed)
        self._may_be_brief = may_be_brief
        self._planner: Planner | None = None
        self._waiting: Plan | None = None
        # By whether it is a sensing action.
        self._usual = {False: ExpectedTime(), True: ExpectedTime()}

    def ask(self, plan: Plan) -> None:
        """Compute a part of an answer; an earlier request that has not begun is forgotten."""
        self._waiting = None
        # One thread at a time uses the planner's problem.
        if self._usual[plan.sensing].typical_s <= _BRIEF_S and not self._threads.num_open:
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
