"""The typed service in ROS 1: a node that stock clients in rospy and roscpp call.

A loop on its own thread serves the clients and the master. Another thread decides.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor

from holdfast.config.loader import Configuration
from holdfast.errors import TransportError
from holdfast_ros.active_sensing import ActiveSensing, ErrorCode
from holdfast_ros.loop_thread import LoopThread
from holdfast_ros.messages import answer_message, encode_answer
from holdfast_ros.ros1_client import service_type
from holdfast_ros.ros1_environment import RosEnvironment
from holdfast_ros.ros1_node import RosNode

_START_S = 5.0

MAX_WAITING = 64
"""Requests that may wait besides the one that is being answered, before others are refused."""


class Ros1Server:
    """A configuration's typed service in ROS 1, offered by a node of the same name.

    Another thread than the node's calls its methods. Raises TransportError if the name is none.
    """

    def __init__(
        self,
        configuration: Configuration,
        name: str = "cloud_active_sensing",
        ros_environment: RosEnvironment | None = None,
    ) -> None:
        self._ros_environment = ros_environment or RosEnvironment.of()
        self.name = self._ros_environment.resolved(name)
        self._answers = ActiveSensing(configuration)
        self._decisions = ThreadPoolExecutor(1, "holdfast-ros-decisions")
        self._owed = 0
        self._takes_more = True
        self._node: RosNode | None = None
        self._loop: LoopThread | None = None

    @property
    def is_busy(self) -> bool:
        """Whether answers are owed."""
        return self._owed > 0

    def take_no_more(self) -> None:
        """Answer the waiting requests, and refuse later ones as busy."""
        self._takes_more = False

    def start(
        self,
        on_event: Callable[..., None] | None = None,
        on_shutdown: Callable[[str], None] | None = None,
    ) -> Mapping[str, str]:
        """Offer the service; return where. The callables are those of a :class:`RosNode`.

        Raises TransportError if it cannot listen.
        """
        self._node = RosNode(self.name, self._ros_environment, on_shutdown, on_event)
        self._node.offer(self.name, service_type(), self._answer)
        self._loop = LoopThread("holdfast-ros1")
        try:
            self._loop.run(self._node.start(), _START_S)
        except BaseException:
            self._loop.close(_START_S)
            raise
        return {"ros1": f"{self.name} (master {self._ros_environment.master})"}

    def close(self, timeout_s: float) -> None:
        """Unregister and stop, within this time; may be repeated."""
        loop, self._loop = self._loop, None
        if loop is not None and self._node is not None:
            with contextlib.suppress(TransportError):
                loop.run(self._node.close(timeout_s / 2), timeout_s)
            self._decisions.shutdown(wait=False, cancel_futures=True)
            loop.close(timeout_s)

    async def _answer(self, request: bytes) -> bytes:
        self._owed += 1  # before it looks whether it may
        try:
            if self._takes_more and self._owed <= MAX_WAITING + 1:
                work = functools.partial(answer_message, self._answers, request)
                return await asyncio.get_running_loop().run_in_executor(self._decisions, work)
            busy = f"{MAX_WAITING} requests are waiting already"
            reason = busy if self._takes_more else "this service ends"
            return encode_answer(self._answers.refusal(ErrorCode.BUSY, reason))
        finally:
            self._owed -= 1
