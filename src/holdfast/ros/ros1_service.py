"""The typed service in ROS 1: a node that stock clients in rospy and roscpp call.

The loop speaks with the clients and the master; one thread decides, one request after another. Who
asks while too many wait is told so, and can ask the other service.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from holdfast.configuration import Configuration
from holdfast.errors import HoldfastError, TransportError
from holdfast.ros.active_sensing import ActiveSensing, Answer, ErrorCode
from holdfast.ros.loop_thread import LoopThread
from holdfast.ros.messages import MAX_BYTES, decode_request, encode_answer
from holdfast.ros.ros1 import service_type
from holdfast.transport.ros1_node import RosNode
from holdfast.transport.tcpros import Surroundings

__all__ = ["MAX_WAITING", "Ros1ActiveSensing", "Ros1Server"]

_START_S = 5.0

MAX_WAITING = 64
"""Requests that wait to be answered; who asks then is told that this service is busy."""


class Ros1ActiveSensing:
    """Answers by one configuration, in ROS 1; all methods are called on the loop's thread.

    Parameters
    ----------
    configuration : Configuration
    name : str
        Of the service, and of its node.
    surroundings : Surroundings or None
        None: what ROS's variables say.
    on_shutdown : callable or None
        Is told why this node is to end: ``rosnode kill`` asks for it, and so does the master when
        another node has this name.
    on_event : callable or None
        Is told how it stands with the master; see :class:`~holdfast.transport.ros1_node.RosNode`.

    Raises
    ------
    TransportError
        If the name is none.
    """

    def __init__(
        self,
        configuration: Configuration,
        name: str = "cloud_active_sensing",
        surroundings: Surroundings | None = None,
        *,
        on_shutdown: Callable[[str], None] | None = None,
        on_event: Callable[..., None] | None = None,
    ) -> None:
        self._answers = ActiveSensing(configuration)
        self._node = RosNode(
            name,
            surroundings or Surroundings.of(),
            on_shutdown=on_shutdown,
            on_event=on_event,
            max_message_bytes=MAX_BYTES,
        )
        self._node.offer(name, service_type(), self._answer)
        self._waiting = 0
        self._takes_more = True
        self._thread = ThreadPoolExecutor(1, "holdfast-ros1")

    @property
    def name(self) -> str:
        """Of the service, as the master knows it."""
        return self._node.name

    @property
    def is_busy(self) -> bool:
        """Whether it owes answers."""
        return self._waiting > 0

    def take_no_more(self) -> None:
        """Answer what is owed, and tell who asks from now on to ask somebody else."""
        self._takes_more = False

    async def start(self) -> bool:
        """Be there; return whether the master knows it, which is told again until it does.

        Raises
        ------
        TransportError
            If it cannot listen.
        """
        return await self._node.start()

    async def close(self, within_s: float = 1.0) -> None:
        """Take leave of the master; may be repeated."""
        await self._node.close(within_s)
        self._thread.shutdown(wait=False, cancel_futures=True)

    async def _answer(self, request: bytes) -> bytes:
        if not self._takes_more:
            return self._encoded(self._answers.refusal(ErrorCode.BUSY, "this service ends"))
        if self._waiting >= MAX_WAITING:
            return self._encoded(
                self._answers.refusal(
                    ErrorCode.BUSY, f"{self._waiting} requests wait, and {MAX_WAITING} are allowed"
                )
            )
        self._waiting += 1
        future = self._thread.submit(self._decide, request)
        # Until it is done it counts, whoever has asked may be gone long before.
        loop = asyncio.get_running_loop()
        future.add_done_callback(lambda _: _on_loop(loop, self._decided))
        return await asyncio.wrap_future(future)

    def _decided(self) -> None:
        self._waiting -= 1

    def _decide(self, request: bytes) -> bytes:
        try:
            answer = self._answers.answer(decode_request(request, "ros1"))
        except HoldfastError as error:
            answer = self._answers.refusal(ErrorCode.BAD_REQUEST, str(error))
        return self._encoded(answer)

    def _encoded(self, answer: Answer) -> bytes:
        try:
            return encode_answer(answer, "ros1")
        except HoldfastError as error:
            return encode_answer(
                self._answers.refusal(ErrorCode.PROBLEM_FAILED, str(error)), "ros1"
            )


def _on_loop(loop: asyncio.AbstractEventLoop, callback: Callable[[], None]) -> None:
    with contextlib.suppress(RuntimeError):  # the loop is closed
        loop.call_soon_threadsafe(callback)


class Ros1Server:
    """The typed service in ROS 1, for whoever has no loop: it runs on threads of its own.

    Parameters
    ----------
    service : Ros1ActiveSensing
        Which is not started.
    """

    def __init__(self, service: Ros1ActiveSensing) -> None:
        self._service = service
        self._thread: LoopThread | None = None

    @property
    def name(self) -> str:
        """Of the service, as the master knows it."""
        return self._service.name

    @property
    def is_busy(self) -> bool:
        """Whether it owes answers."""
        return self._service.is_busy

    def start(self) -> bool:
        """Be there; return whether the master knows it.

        Raises
        ------
        TransportError
            If it cannot listen.
        """
        self._thread = LoopThread("holdfast-ros1")
        try:
            return self._thread.run(self._service.start(), _START_S)
        except BaseException:
            self._thread.close(_START_S)
            raise

    def take_no_more(self) -> None:
        """Answer what is owed, and tell who asks from now on to ask somebody else."""
        if self._thread is not None:
            self._thread.call(self._service.take_no_more)

    def close(self, timeout_s: float) -> None:
        """End within this time; may be repeated."""
        thread, self._thread = self._thread, None
        if thread is not None:
            with contextlib.suppress(TransportError):
                thread.run(self._service.close(timeout_s / 2), timeout_s)
            thread.close(timeout_s)
