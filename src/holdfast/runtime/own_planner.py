"""The planner in the robot's own process, behind the same wire as any other service.

A robot that offloads nothing runs the same loop, with the same journal, as one that does; its only
service is this one. It cannot be lost, for its process is the robot's.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from time import monotonic

from holdfast.problems.problem import Problem
from holdfast.protocol.verification import OWN_PLANNER
from holdfast.session.events import TransportEvent
from holdfast.session.messages import Opening
from holdfast.session.service import Service
from holdfast.session.service_effects import Answer, Effect, End, Run
from holdfast.session.service_jobs import Job, Outcome
from holdfast.session.service_limits import ServiceLimits
from holdfast.transport.contract import IncomingCall
from holdfast.transport.in_process import InProcessNetwork

__all__ = ["OWN_PLANNER", "OwnPlanner"]

# A robot is never too large for itself.
_NO_LIMITS = ServiceLimits(max_particles=2**62, max_work=2**62, max_state_bytes=2**62)
_BRIEF_S = 0.002


class OwnPlanner:
    def __init__(
        self, problem: Problem, describe_error: Callable[[BaseException], str] = repr
    ) -> None:
        def make_problem(opening: Opening) -> Problem:
            del opening
            return problem

        self._service = Service(make_problem, 1, _NO_LIMITS, describe_error)
        network = InProcessNetwork(max_message_bytes=2**62)
        self._robot_end = network.robot([OWN_PLANNER])
        self._service_end = network.service(OWN_PLANNER, "own")
        self._calls: dict[int, IncomingCall] = {}
        self._next_call = 0
        self._pool = ThreadPoolExecutor(1, "holdfast-planner")
        self.call = self._robot_end.call
        self.abandon = self._robot_end.abandon

    def start(self, deliver: Callable[[TransportEvent], None]) -> None:
        """Begin to answer."""
        self._robot_end.start(deliver)
        self._task = asyncio.get_running_loop().create_task(self._service_end.start(self._received))

    async def close(self, timeout_s: float = 1.0) -> None:
        """Answer no more."""
        del timeout_s
        await self._robot_end.close()
        await self._service_end.close()
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _received(self, call: IncomingCall) -> None:
        self._next_call += 1
        self._calls[self._next_call] = call
        self._carry_out(self._service.receive(self._next_call, call.payload, monotonic()))

    def _carry_out(self, effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, Answer):
                self._calls[effect.call].reply(effect.payload)
            elif isinstance(effect, End):
                self._calls.pop(effect.call).end()
            elif isinstance(effect, Run):
                loop = asyncio.get_running_loop()
                if effect.expected_s < _BRIEF_S:
                    loop.call_soon(self._run, effect.job)
                else:
                    self._pool.submit(self._work, loop, effect.job)

    def _work(self, loop: asyncio.AbstractEventLoop, job: Job) -> None:
        began = monotonic()
        outcome = job.run()
        loop.call_soon_threadsafe(self._finished, job, outcome, began, monotonic())

    def _run(self, job: Job) -> None:
        began = monotonic()
        outcome = job.run()
        self._finished(job, outcome, began, monotonic())

    def _finished(self, job: Job, outcome: Outcome, began: float, ended: float) -> None:
        self._service.begun(job, began)
        self._carry_out(self._service.finished(job, outcome, ended))
