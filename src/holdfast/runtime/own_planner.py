"""The planner in the robot's own process, behind the same wire as any other service.

A robot that offloads nothing runs the same loop, with the same journal, as one that does; its only
service is this one. It computes on a thread of its own, so that the next sensing action is computed
while the robot moves here too. It cannot be lost, for its process is the robot's.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from queue import SimpleQueue
from time import monotonic
from typing import NamedTuple

from holdfast.problems.problem import Problem
from holdfast.protocol.verification import OWN_PLANNER
from holdfast.session.events import Appeared, Ended, Replied, TransportEvent, Vanished
from holdfast.session.messages import Opening
from holdfast.session.service import Service
from holdfast.session.service_effects import Answer, Effect, End, Run
from holdfast.session.service_limits import ServiceLimits

__all__ = ["OWN_PLANNER", "OwnPlanner"]

# A robot is never too large for itself.
_NO_LIMITS = ServiceLimits(max_particles=2**62, max_work=2**62, max_state_bytes=2**62)


class _Request(NamedTuple):
    call: int
    payload: bytes


class OwnPlanner:
    """A :class:`~holdfast.runtime.transport.contract.RobotTransport` that leads nowhere else.

    Parameters
    ----------
    problem : Problem
        It answers for this one only. An instance of its own: the robot's is used at the same time
        by another thread.
    describe_error : callable
        Puts an error that the problem raised into words.
    """

    def __init__(
        self, problem: Problem, describe_error: Callable[[BaseException], str] = repr
    ) -> None:
        def make_problem(opening: Opening) -> Problem:
            del opening
            return problem

        self._service = Service(make_problem, 1, _NO_LIMITS, describe_error)
        self._requests: SimpleQueue[_Request | None] = SimpleQueue()
        self._open: set[int] = set()
        self._deliver: Callable[[TransportEvent], None] | None = None
        self._thread = threading.Thread(target=self._work, name="holdfast-planner", daemon=True)

    def start(self, deliver: Callable[[TransportEvent], None]) -> None:
        """Begin to answer."""
        self._deliver = deliver
        self._thread.start()
        deliver(Appeared(OWN_PLANNER, "own"))

    def call(self, service: str, call: int, payload: bytes) -> None:
        """Take a request."""
        del service
        self._open.add(call)
        self._requests.put(_Request(call, payload))

    def abandon(self, call: int) -> None:
        """Deliver nothing more of a call."""
        self._open.discard(call)

    def close(self, timeout_s: float = 1.0) -> None:
        """Answer no more."""
        self._deliver = None
        if self._thread.is_alive():
            self._requests.put(None)
            self._thread.join(timeout_s)

    def _work(self) -> None:
        service = self._service
        try:
            while (request := self._requests.get()) is not None:
                effects = service.receive(request.call, request.payload, monotonic())
                while effects:
                    effects += self._carry_out(effects.pop(0))
        finally:
            # If this is a defect of ours, the robot shall not wait for ever.
            deliver = self._deliver
            if deliver is not None:
                deliver(Vanished(OWN_PLANNER, "own"))

    def _carry_out(self, effect: Effect) -> list[Effect]:
        deliver = self._deliver
        if isinstance(effect, Run) and deliver is not None:
            return self._service.finished(effect.job, effect.job.run(), monotonic())
        if isinstance(effect, Answer | End) and deliver is not None and effect.call in self._open:
            if isinstance(effect, Answer):
                deliver(Replied(effect.call, effect.payload))
            else:
                self._open.discard(effect.call)
                deliver(Ended(effect.call))
        return []
