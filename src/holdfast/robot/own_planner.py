"""The planner in the robot's own process: it answers where no service does, and checks services.

Without services an answer comes in the same two parts as a service's: first the task actions up to
the next sensing step, for which the robot stands still; then that step's sensing action, computed
while the robot moves. With services, whole answers to some questions are computed again.

Handing work to another thread takes longer than many decisions. So a brief part is computed on the
robot's loop once no event waits. All else is computed on a thread, so the loop keeps reacting.
Thread and planner are made with the first question, because start-up time is part of recovery time.
"""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable
from time import perf_counter, thread_time

from holdfast.errors import HoldfastError
from holdfast.planning.planner import Planner
from holdfast.protocol.computing_time import ExpectedTime
from holdfast.protocol.messages import MAX_TASK_ACTIONS
from holdfast.protocol.robot_events import ComputeOwnAnswer, OwnAnswer
from holdfast.runtime.pool import ThreadPool

_BRIEF_S = 0.001
"""Work that may take longer goes to a thread: the loop handles no event meanwhile."""


class OwnPlanner:
    """Computes answers; all methods are called on the loop's thread.

    So are ``deliver``, and ``failed`` for an error of the problem's code in a part of an answer.
    """

    def __init__(
        self,
        # Builds the planner, on the thread, with its own instance of the problem: the loop's thread
        # uses the robot's at the same time.
        make_planner: Callable[[], Planner],
        describe_error: Callable[[BaseException], str],  # on the thread
        deliver: Callable[[OwnAnswer], None],
        failed: Callable[[BaseException], None],
        *,
        # Whether work that was brief before is expected to be brief again. User code may take any
        # time at any call.
        may_be_brief: bool,
    ) -> None:
        self._make_planner = make_planner
        self._describe_error = describe_error
        self._deliver = deliver
        self._thread = ThreadPool(1, "holdfast-own-planner", failed)
        self._may_be_brief = may_be_brief
        self._planner: Planner | None = None
        self._brief: ComputeOwnAnswer | None = None
        self._waiting: deque[ComputeOwnAnswer] = deque()
        self._usual = {"task": ExpectedTime(), "sensing": ExpectedTime()}

    def ask(self, effect: ComputeOwnAnswer) -> None:
        """Compute a part of an answer, instead of one that has not begun; or queue a question.

        One that is asked again goes first.
        """
        if effect.part is None:
            (self._waiting.appendleft if effect.again else self._waiting.append)(effect)
            self._compute_next()
            return
        self._brief = None
        # One thread at a time uses the planner's problem.
        if self._usual[effect.part].typical_s <= _BRIEF_S and not self._thread.num_open:
            self._brief = effect
        else:
            self._submit(effect)

    def compute_brief(self) -> bool:
        """Compute and deliver the waiting brief part; return whether there was one."""
        effect, self._brief = self._brief, None
        if effect is not None:
            self._finished(effect, *self._computed(effect))
        return effect is not None

    def close(self, timeout_s: float = 1.0) -> None:
        """Answer no more; wait at most ``timeout_s`` for a computation that runs."""
        self._brief = None
        self._thread.close(timeout_s)

    def _compute_next(self) -> None:
        if self._waiting and not self._thread.num_open:
            self._submit(self._waiting.popleft())

    def _submit(self, effect: ComputeOwnAnswer) -> None:
        compute = functools.partial(self._computed, effect)
        self._thread.submit(compute, lambda computed: self._finished(effect, *computed))

    def _finished(self, effect: ComputeOwnAnswer, answer: OwnAnswer, processor_s: float) -> None:
        if effect.part is not None and self._may_be_brief:
            self._usual[effect.part].learn(answer.computed_s, processor_s)
        self._compute_next()
        self._deliver(answer)

    def _computed(self, effect: ComputeOwnAnswer) -> tuple[OwnAnswer, float]:
        """Return the answer, and the processor time that it took."""
        began, used_s = perf_counter(), thread_time()
        try:
            if self._planner is None or effect.again:
                self._planner = self._make_planner()
                # The time for building the problem predicts nothing.
                began, used_s = perf_counter(), thread_time()
            answer = _answer(self._planner, effect)
        except BaseException as error:
            if effect.part is None:  # user code may raise anything
                answer = OwnAnswer(
                    effect.number, failure=HoldfastError(self._describe_error(error))
                )
            elif isinstance(error, HoldfastError):
                answer = OwnAnswer(effect.number, failure=error)
            else:
                raise
        return answer._replace(computed_s=perf_counter() - began), thread_time() - used_s


def _answer(planner: Planner, effect: ComputeOwnAnswer) -> OwnAnswer:
    number, state = effect.number, effect.state
    if effect.part == "task":
        planned, ahead = planner.plan_until_sensing(state, MAX_TASK_ACTIONS)
        return OwnAnswer(number, tuple(planned), ahead=ahead)
    if effect.part == "sensing":
        chosen, _ = planner.choose_sensing_action(state)
        return OwnAnswer(number, (), chosen, planner.digest(state), ahead=state)
    actions, sensing_action, ahead = planner.decide(state, MAX_TASK_ACTIONS)
    return OwnAnswer(number, actions, sensing_action, planner.digest(ahead), ahead=ahead)
