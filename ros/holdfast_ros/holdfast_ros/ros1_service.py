"""The typed service in ROS 1: a node that stock clients in rospy and roscpp call.

A loop on its own thread serves the clients and the master. Another thread decides.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable

from holdfast.config.loader import Configuration
from holdfast.errors import TransportError
from holdfast_ros.active_sensing import ActiveSensing, ErrorCode
from holdfast_ros.decision_thread import DecisionThread
from holdfast_ros.loop_thread import LoopThread
from holdfast_ros.messages import MAX_BYTES, answer_message, encode_answer
from holdfast_ros.ros1_client import service_type
from holdfast_ros.ros1_node import RosNode
from holdfast_ros.tcpros import RosEnvironment

__all__ = ["MAX_WAITING", "Ros1Server"]

_START_S = 5.0

MAX_WAITING = 64
"""Requests that may wait besides the one that is being answered."""


class Ros1Server:
    """Offers a configuration's typed service in ROS 1, by a node of the same name.

    ``on_shutdown`` gets the reason when ``rosnode kill``, or the master for a name conflict, ends
    this node; ``on_event`` is that of a :class:`~holdfast_ros.ros1_node.RosNode`.

    Raises TransportError if the name is none.
    """

    def __init__(
        self,
        configuration: Configuration,
        name: str = "cloud_active_sensing",
        ros_environment: RosEnvironment | None = None,
        *,
        on_shutdown: Callable[[str], None] | None = None,
        on_event: Callable[..., None] | None = None,
    ) -> None:
        self._answers = ActiveSensing(configuration)
        self._decisions = DecisionThread(MAX_WAITING)
        self._node = RosNode(
            name,
            ros_environment or RosEnvironment.of(),
            on_shutdown=on_shutdown,
            on_event=on_event,
            max_message_bytes=MAX_BYTES,
        )
        self._node.offer(name, service_type(), self._answer)
        self._loop: LoopThread | None = None

    @property
    def name(self) -> str:
        """The service's name as the master knows it."""
        return self._node.name

    @property
    def is_busy(self) -> bool:
        """Whether answers are owed."""
        return self._decisions.is_busy

    def take_no_more(self) -> None:
        """Answer the waiting requests, and refuse later ones as busy."""
        self._decisions.take_no_more()

    def start(self) -> bool:
        """Offer the service; return whether the master knows it already.

        Raises TransportError if it cannot listen.
        """
        self._loop = LoopThread("holdfast-ros1")
        try:
            return self._loop.run(self._node.start(), _START_S)
        except BaseException:
            self._loop.close(_START_S)
            raise

    def close(self, timeout_s: float) -> None:
        """Unregister and stop, within this time; may be repeated."""
        loop, self._loop = self._loop, None
        if loop is not None:
            with contextlib.suppress(TransportError):
                loop.run(self._node.close(timeout_s / 2), timeout_s)
            self._decisions.close(0.0)
            loop.close(timeout_s)

    async def _answer(self, request: bytes) -> bytes:
        future = self._decisions.submit(
            lambda: answer_message(self._answers, request),
            lambda reason: encode_answer(self._answers.refusal(ErrorCode.BUSY, reason)),
        )
        return await asyncio.wrap_future(future)
