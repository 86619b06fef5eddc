"""The robot's own planner, which computes some of the services' answers again.

It has a thread and an instance of the problem to itself, so the robot's loop goes on while it
computes. What the robot waits for comes before what is only verified. Nothing is made before
it is needed: most runs of a few steps never need it, and start-up time is part of recovery time.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from time import monotonic

from holdfast.planning import Planner
from holdfast.session.effects import Decide
from holdfast.session.events import Decided
from holdfast.session.messages import MAX_TASK_ACTIONS

__all__ = ["OwnDecisions"]


class OwnDecisions:
    """A thread that answers questions with the robot's own planner.

    Parameters
    ----------
    make_planner : callable
        Builds it, with an instance of the problem of its own: the robot's is used at the same time
        by another thread.
    describe_error : callable
        Puts an error that the problem raised into words.
    deliver : callable
        Gets each answer, on that thread.
    """

    def __init__(
        self,
        make_planner: Callable[[], Planner],
        describe_error: Callable[[BaseException], str],
        deliver: Callable[[Decided], None],
    ) -> None:
        self._make_planner = make_planner
        self._describe_error = describe_error
        self._deliver = deliver
        self._planner: Planner | None = None
        self._waiting: deque[Decide] = deque()
        self._changed = threading.Condition()
        self._closed = False
        self._thread: threading.Thread | None = None

    def ask(self, effect: Decide) -> None:
        """Let a question be answered; one that is urgent before those that are not."""
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
                    target=self._work, name="holdfast-own-decisions", daemon=True
                )
                self._thread.start()

    def close(self, timeout_s: float = 1.0) -> None:
        """Answer no more; what is being computed is waited for only so long."""
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

    def _decided(self, effect: Decide) -> Decided:
        began = monotonic()
        try:
            if self._planner is None or effect.again:
                self._planner = self._make_planner()
            planner = self._planner
            actions, sensing_action, ahead = planner.decide(effect.state, MAX_TASK_ACTIONS)
            digest = planner.digest(ahead)
        except BaseException as error:  # noqa: BLE001 - the problem is anybody's code
            return Decided(effect.number, failure=self._describe_error(error))
        return Decided(effect.number, actions, sensing_action, digest, monotonic() - began)
