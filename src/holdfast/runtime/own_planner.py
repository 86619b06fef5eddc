"""The planner in the robot's own process, behind the same wire as any other service.

A robot that offloads nothing runs the same loop, with the same journal, as one that does; its only
service is this one, on that loop. What takes long is computed on a thread, so that the next sensing
action is computed while the robot moves here too. It cannot be lost: its process is the robot's.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from holdfast.planning import Planner
from holdfast.problems.problem import Problem
from holdfast.protocol.verification import OWN_PLANNER
from holdfast.service.shell import ServiceShell
from holdfast.session.events import TransportEvent
from holdfast.session.messages import Opening
from holdfast.session.service import Service
from holdfast.session.service_limits import ServiceLimits
from holdfast.settings import PlanningSettings
from holdfast.transport.in_process import InProcessNetwork

__all__ = ["OWN_PLANNER", "OwnPlanner"]

# A robot is never too large for itself.
_NO_LIMITS = ServiceLimits(max_particles=2**62, max_work=2**62, max_state_bytes=2**62)
_ANY_SIZE = 2**62


class OwnPlanner:
    """A :class:`~holdfast.transport.contract.RobotTransport` that leads nowhere else.

    Parameters
    ----------
    problem : Problem
        It answers for this one only. An instance of its own: the robot's is used at the same time
        by another thread.
    describe_error : callable
        Puts an error that the problem raised into words.
    make_planner : callable
        Joins the problem and the robot's settings to the functions that lead from state to state.
    """

    def __init__(
        self,
        problem: Problem,
        describe_error: Callable[[BaseException], str] = repr,
        make_planner: Callable[[Problem, PlanningSettings], Planner] = Planner,
    ) -> None:
        def make_problem(opening: Opening) -> Problem:
            del opening
            return problem

        network = InProcessNetwork(max_message_bytes=_ANY_SIZE)
        self._robot_end = network.robot([OWN_PLANNER])
        self._shell = ServiceShell(
            Service(make_problem, 1, _NO_LIMITS, describe_error, make_planner),
            network.service(OWN_PLANNER, "own"),
            workers=1,
        )
        self._serving: asyncio.Task[None] | None = None
        self.call = self._robot_end.call
        self.abandon = self._robot_end.abandon

    def start(self, deliver: Callable[[TransportEvent], None]) -> None:
        """Begin to answer; see :mod:`~holdfast.transport.contract`."""
        self._robot_end.start(deliver)
        self._serving = asyncio.get_running_loop().create_task(self._serve())
        self._serving.add_done_callback(_raise_error)

    async def close(self, timeout_s: float = 1.0) -> None:
        """Answer no more; what is being computed is not waited for. May be repeated."""
        serving, self._serving = self._serving, None
        if serving is None:
            return
        serving.cancel()
        await self._robot_end.close(timeout_s)
        await self._shell.close(timeout_s)

    async def _serve(self) -> None:
        await self._shell.start()
        await self._shell.wait()


def _raise_error(serving: asyncio.Task[None]) -> None:
    """Let the loop hear of a defect of ours: the robot shall not wait for ever."""
    if not serving.cancelled():
        serving.result()
