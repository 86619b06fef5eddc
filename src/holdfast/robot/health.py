"""A robot's condition and metrics for monitors: HTTP, and the service manager.

The robot's own event loop answers. So an answer proves that the loop runs, and it says whether a
service decides for the robot.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from holdfast.planning.outcome import TrialResult
from holdfast.protocol.robot import Robot
from holdfast.protocol.robot_events import Timing
from holdfast.runtime.events import EventSink
from holdfast.runtime.service_manager import ServiceManager

if TYPE_CHECKING:
    from holdfast.robot.metrics import RobotMetrics
    from holdfast.runtime.monitoring import HttpAddress, MonitoringServers, Pages


class Condition(NamedTuple):
    """A robot's condition: in a word, and the trial, None between two trials.

    The word is the :class:`~holdfast.protocol.status.Status` while a service decides; else
    ``starting``, ``holding still`` or ``ending``.
    """

    word: str
    is_deciding: bool
    trial: int | None

    def __str__(self) -> str:
        return self.word if self.trial is None else f"{self.word}, trial {self.trial}"


class RobotWatch:
    """Reports a robot's condition."""

    def __init__(
        self,
        manager: ServiceManager,
        health: HttpAddress | None,
        metrics: HttpAddress | None,
        events: EventSink,
    ) -> None:
        self._manager = manager
        self._health = health
        self._metrics_address = metrics
        self._metrics: RobotMetrics | None = None
        self._events = events
        self._watched: MonitoringServers | None = None
        self._has_begun = False

    async def start(self, condition: Callable[[], Condition], robot: Robot) -> None:
        """Answer from now on, in the running loop.

        Raises HealthError, which names the address, if it cannot listen there; MetricsError if
        metrics are to be offered and ``prometheus_client`` is not installed.
        """
        if self._health is not None or self._metrics_address is not None:
            await self._offer(condition, robot)
        loop = asyncio.get_running_loop()
        self._manager.watch(loop, self._events, lambda: str(condition()))

    async def _offer(self, condition: Callable[[], Condition], robot: Robot) -> None:
        from holdfast.runtime.monitoring import MonitoringServers, Page

        def ready() -> Page:
            now = condition()
            return Page(200 if now.is_deciding else 503, f"{now.word}\n".encode())

        offered: dict[str, tuple[HttpAddress, Pages]] = {}
        if self._health is not None:
            offered["health"] = self._health, {"/livez": lambda: Page.of(None), "/readyz": ready}
        if self._metrics_address is not None:
            from holdfast.robot.metrics import RobotMetrics
            from holdfast.runtime.exposition import CONTENT_TYPE

            self._metrics = counted = RobotMetrics()

            def metrics() -> Page:
                text = counted.text(robot, is_deciding=condition().is_deciding)
                return Page(200, text, CONTENT_TYPE)

            offered["metrics"] = self._metrics_address, {"/metrics": metrics}
        self._watched = MonitoringServers()
        self._events.event("offers", **await self._watched.start(offered))

    def timed(self, timing: Timing) -> None:
        """Count a decision."""
        if self._metrics is not None:
            self._metrics.timed(timing)

    def ended(self, result: TrialResult) -> None:
        """Count a trial."""
        if self._metrics is not None:
            self._metrics.ended(result)

    def begun(self) -> None:
        """Report that a trial has begun."""
        if not self._has_begun:
            self._has_begun = True
            self._manager.ready()

    def ending(self) -> None:
        """Report that the robot was asked to end."""
        self._manager.stopping()

    async def close(self) -> None:
        """Answer no more, and report that the process ends."""
        self._manager.stopping()
        self._manager.close()
        if self._watched is not None:
            await self._watched.close()
