"""The planner of a robot without services: on the robot's own loop, or on a thread.

To hand something over to another thread takes longer than many a decision. So what is brief is
computed on the loop, once nothing else has happened: the environment moves meanwhile, if it has a
thread of its own. What takes long is computed on a thread, so that the robot goes on here too while
the next sensing action is being computed.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from time import perf_counter

from holdfast.errors import HoldfastError
from holdfast.planning import Planner, choose_sensing_action
from holdfast.service.pool import ThreadPool
from holdfast.session.effects import Plan
from holdfast.session.events import Planned
from holdfast.session.messages import MAX_TASK_ACTIONS
from holdfast.session.usual_time import UsualTime

__all__ = ["OwnPlanner"]

_BRIEF_S = 0.001
"""What may take longer is computed on a thread: the loop hears nobody meanwhile."""


class OwnPlanner:
    """Computes answers to the robot's questions; its methods are called on the loop's thread.

    Parameters
    ----------
    make_planner : callable
        Builds the planner, with an instance of the problem of its own: the robot's is used at the
        same time by another thread. It is called on a thread, with the first question.
    deliver : callable
        Takes the answers, on the loop's thread.
    failed : callable
        Takes an error of the problem's code, on the loop's thread.
    may_be_brief : bool
        Whether what was brief before is so again. Other people's code may take any time at any
        call.
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
        self._threads = ThreadPool(1, "holdfast-own-planner", failed)
        self._may_be_brief = may_be_brief
        self._planner: Planner | None = None
        self._waiting: Plan | None = None
        # By whether it is a sensing action.
        self._usual = {False: UsualTime(), True: UsualTime()}

    def ask(self, plan: Plan) -> None:
        """Let a part of an answer be computed; what was asked before and not begun is forgotten."""
        self._waiting = None
        # Its problem is used by one thread at a time.
        if self._usual[plan.sensing].seconds <= _BRIEF_S and not self._threads.num_open:
            self._waiting = plan
        else:
            self._threads.submit(functools.partial(self._computed, plan), self._finished)

    def compute_brief(self) -> bool:
        """Compute what is asked for and brief, and deliver it; tell whether there was any."""
        plan, self._waiting = self._waiting, None
        if plan is None:
            return False
        self._finished(self._computed(plan))
        return True

    def close(self) -> None:
        """Compute nothing more; what is being computed is not waited for."""
        self._waiting = None
        self._threads.close()

    def _computed(self, plan: Plan) -> tuple[Plan, Planned]:
        """Return what was asked for and what it comes to."""
        planner = self._planner
        began = perf_counter()
        try:
            if planner is None:
                planner = self._planner = self._make_planner()
                # Building the problem is no measure of what comes next.
                began = perf_counter()
            planned = _answer(planner, plan)
        except HoldfastError as error:
            planned = Planned(plan.number, plan.state, error=error)
        computed_s = perf_counter() - began
        return plan, planned._replace(computed_s=computed_s)

    def _finished(self, computed: tuple[Plan, Planned]) -> None:
        plan, planned = computed
        if self._may_be_brief:
            self._usual[plan.sensing].learn(planned.computed_s)
        self._deliver(planned)


def _answer(planner: Planner, plan: Plan) -> Planned:
    number, state = plan.number, plan.state
    if plan.sensing:
        action, _ = choose_sensing_action(planner.problem, planner.settings, state)
        return Planned(number, state, ahead_digest=planner.digest(state), sensing_action=action)
    actions, ahead = planner.plan_until_sensing(state, MAX_TASK_ACTIONS)
    return Planned(number, ahead, actions)
