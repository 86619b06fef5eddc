"""Some of the services' answers, recomputed with the robot's own planner on a thread.

It has its own instance of the problem, so the robot's loop continues meanwhile. Thread and planner
are made with the first question: most runs of a few steps need neither, and start-up time is part
of recovery time.
"""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable
from time import monotonic

from holdfast.planning.planner import Planner
from holdfast.protocol.events import ComputeOwnAnswer, OwnAnswer
from holdfast.protocol.messages import MAX_TASK_ACTIONS
from holdfast.runtime.pool import ThreadPool


class AnswerChecker:
    """Answers questions with a planner; all methods are called on the loop's thread.

    ``make_planner`` and ``describe_error``, which says what an error of the planner means, are
    called on the other thread; ``deliver`` and ``failed`` on the loop's.
    """

    def __init__(
        self,
        make_planner: Callable[[], Planner],
        describe_error: Callable[[BaseException], str],
        deliver: Callable[[OwnAnswer], None],
        failed: Callable[[BaseException], None],
    ) -> None:
        self._make_planner = make_planner
        self._describe_error = describe_error
        self._deliver = deliver
        self._thread = ThreadPool(1, "holdfast-answer-check", failed)
        self._planner: Planner | None = None
        self._waiting: deque[ComputeOwnAnswer] = deque()

    def ask(self, effect: ComputeOwnAnswer) -> None:
        """Queue a question; one that is asked again goes first."""
        if effect.again:
            self._waiting.appendleft(effect)
        else:
            self._waiting.append(effect)
        self._compute_next()

    def close(self, timeout_s: float = 1.0) -> None:
        """Answer no more; wait at most ``timeout_s`` for a computation that runs."""
        self._thread.close(timeout_s)

    def _compute_next(self) -> None:
        if self._waiting and not self._thread.num_open:
            effect = self._waiting.popleft()
            self._thread.submit(functools.partial(self._answer_of, effect), self._answered)

    def _answered(self, answer: OwnAnswer) -> None:
        self._compute_next()
        self._deliver(answer)

    def _answer_of(self, effect: ComputeOwnAnswer) -> OwnAnswer:
        began = monotonic()
        try:
            if self._planner is None or effect.again:
                self._planner = self._make_planner()
            planner = self._planner
            actions, sensing_action, ahead = planner.decide(effect.state, MAX_TASK_ACTIONS)
            digest = planner.digest(ahead)
        except BaseException as error:  # noqa: BLE001 - user code may raise anything
            return OwnAnswer(effect.number, failure=self._describe_error(error))
        return OwnAnswer(effect.number, actions, sensing_action, digest, monotonic() - began)
