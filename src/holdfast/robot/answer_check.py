"""A thread that recomputes some of the services' answers with the robot's own planner.

It has its own instance of the problem, so the robot's loop continues meanwhile. Answers that the
robot waits for come before answers that are only verified. Thread and planner are made with the
first question: most runs of a few steps need neither, and start-up time is part of recovery time.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from time import monotonic

from holdfast.planning import Planner
from holdfast.protocol.events import ComputeOwnAnswer, OwnAnswer
from holdfast.protocol.messages import MAX_TASK_ACTIONS

__all__ = ["AnswerChecker"]


class AnswerChecker:
    """Answers questions with a planner, on its own thread."""

    def __init__(
        self,
        make_planner: Callable[[], Planner],
        describe_error: Callable[[BaseException], str],
        deliver: Callable[[OwnAnswer], None],
    ) -> None:
        self._make_planner = make_planner
        self._describe_error = describe_error
        self._deliver = deliver
        self._planner: Planner | None = None
        self._waiting: deque[ComputeOwnAnswer] = deque()
        self._changed = threading.Condition()
        self._closed = False
        self._thread: threading.Thread | None = None

    def ask(self, effect: ComputeOwnAnswer) -> None:
        """Queue a question; an urgent one goes first and replaces its earlier copy."""
        with self._changed:
            if effect.urgent:
                self._waiting = deque(
                    each for each in self._waiting if each.number != effect.number
                )
                self._waiting.appendleft(effect)
            else:
                self._waiting.append(effect)
            self._changed.notify()
            if self._thread is None:
                self._thread = threading.Thread(
                    target=self._work, name="holdfast-answer-check", daemon=True
                )
                self._thread.start()

    def close(self, timeout_s: float = 1.0) -> None:
        """Answer no more; wait at most ``timeout_s`` for a computation that runs."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        if self._thread is not None:
            self._thread.join(timeout_s)

    def _work(self) -> None:
        while True:
            with self._changed:
                while not self._waiting and not self._closed:
                    self._changed.wait()
                if self._closed:
                    return
                effect = self._waiting.popleft()
            decided = self._decided(effect)
            if not self._closed:
                self._deliver(decided)

    def _decided(self, effect: ComputeOwnAnswer) -> OwnAnswer:
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
