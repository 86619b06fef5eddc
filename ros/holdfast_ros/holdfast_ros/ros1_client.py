"""A client of the typed service in ROS 1 that keeps its deadlines.

rospy's proxies ask the master at each call and wait forever for a stopped process, and
``wait_for_service`` cannot distinguish a dead service from a slow one. This client keeps a
connection. It asks the master only without one, and uses the last known address if the master does
not answer. A refused connection means a dead service, which is noticed at once.

It needs neither rospy nor a node, and also works inside a node of rospy.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Final

from holdfast.errors import TransportError
from holdfast.protocol.status import Status
from holdfast.runtime.addresses import system_words
from holdfast_ros.active_sensing import DecisionAnswer, DecisionRequest
from holdfast_ros.client import ActiveSensingClient, log_event
from holdfast_ros.loop_thread import LoopThread
from holdfast_ros.messages import MAX_BYTES, decode_answer, encode_request, md5_sum
from holdfast_ros.ros1_environment import RosEnvironment, ServiceType
from holdfast_ros.ros1_node import RosNode, TopicType
from ros1_master_guard.errors import CallError, GoneError, ProtocolError
from ros1_master_guard.headers import (
    MAX_HEADER_BYTES,
    decode_header,
    encode_header,
    encode_message,
)
from ros1_master_guard.ros1_calls import call, connect, message

__all__ = ["SERVICE_TYPE", "STATUS_WORDS", "Ros1Client", "Ros1Service", "service_type"]

SERVICE_TYPE: Final = "holdfast_interfaces/ActiveSensing"
"""As ROS 1 writes it."""

STATUS_WORDS: Final = {
    Status.STANDARD: "standard",
    Status.LOCAL_RECOVERY: "local recovery",
    Status.KEEP_ALIVE: "keep alive",
}
"""The first implementation's spelling of the statuses."""

_LOOKUP_S: Final = 1.0
"""For the master, where the service is known to have been somewhere."""

_START_S: Final = 5.0
_CLOSE_S: Final = 1.0

STATUS_TYPE: Final = TopicType(
    "std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1", "string data\n"
)


def service_type() -> ServiceType:
    """Return the typed service's name and digest in ROS 1."""
    return ServiceType(SERVICE_TYPE, md5_sum())


class Ros1Service:
    """A client of one service; a :class:`~holdfast_ros.client.DecisionService`.

    Parameters
    ----------
    name : str
        Of the service, such as ``cloud_active_sensing``.
    ros_environment : RosEnvironment
        Where the master is.
    caller : str
        Name of the asking node.

    Raises
    ------
    TransportError
        If the name is none.
    """

    def __init__(self, name: str, ros_environment: RosEnvironment, caller: str) -> None:
        self.name = ros_environment.resolved(name)
        self._master = ros_environment.master
        self._caller = ros_environment.resolved(caller)
        self._digest = md5_sum()
        self._last_uri: str | None = None
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def ask(self, request: DecisionRequest, deadline_s: float) -> DecisionAnswer:
        """Ask, and wait at most ``deadline_s`` for the answer.

        Raises
        ------
        TransportError
            If there is no answer; the message gives the reason.
        """
        asked = encode_message(encode_request(request))
        try:
            async with asyncio.timeout(deadline_s):
                return decode_answer(await self._exchange(asked, deadline_s))
        except BaseException as error:
            self.disconnect()
            match error:
                case TimeoutError():
                    reason = f"no answer in {deadline_s:g} s"
                case asyncio.IncompleteReadError():
                    reason = "it has ended the connection"
                case ProtocolError():
                    reason = f"it {error}"
                case OSError():
                    reason = system_words(error.errno)
                case CallError():
                    reason = str(error)
                case _:
                    raise
            raise TransportError(reason) from error

    def disconnect(self) -> None:
        """End the connection; the next request opens another."""
        if self._streams is not None:
            self._streams[1].close()
            self._streams = None

    async def _exchange(self, asked: bytes, deadline_s: float) -> bytes:
        if self._streams is not None:
            # The service may have been restarted since. Requests change nothing there, so they can
            # be repeated.
            with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
                return await self._exchange_over(*self._streams, asked)
            self.disconnect()
        return await self._exchange_over(*await self._connected(deadline_s), asked)

    async def _exchange_over(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, asked: bytes
    ) -> bytes:
        writer.write(asked)
        is_done = await reader.readexactly(1) == b"\x01"
        answer = await message(reader, MAX_BYTES)
        if not is_done:
            raise TransportError(f"it answers: {answer[:500].decode(errors='replace')}")
        return answer

    async def _connected(
        self, deadline_s: float
    ) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        uri, where = await self._found(deadline_s)
        try:
            reader, writer = await connect(uri)
        except GoneError:
            raise TransportError(f"nobody listens at {uri}, where {where}: it is dead") from None
        self._streams = reader, writer
        fields = {
            "callerid": self._caller,
            "service": self.name,
            "md5sum": self._digest,
            "type": SERVICE_TYPE,
            "persistent": "1",
        }
        writer.write(encode_header(fields))
        header = decode_header(await message(reader, MAX_HEADER_BYTES))
        if "error" in header:
            raise TransportError(f"it refuses: {header['error']:.500}")
        self._last_uri = uri
        return reader, writer

    async def _found(self, deadline_s: float) -> tuple[str, str]:
        """Return where the service is, and who says so."""
        within_s = deadline_s if self._last_uri is None else min(deadline_s / 2, _LOOKUP_S)
        try:
            asked = call(
                *(self._master, "lookupService", self.name), within_s=within_s, caller=self._caller
            )
            return str(await asked), "the master says it is"
        except GoneError:
            reason = f"there is no master at {self._master}"
        except CallError as error:
            reason = str(error)
        if self._last_uri is None:
            raise TransportError(reason)
        return self._last_uri, f"it was last ({reason})"


class Ros1Client(ActiveSensingClient):
    """The thesis's client: asks the cloud, and the recovery service if the cloud fails.

    It is a node that publishes its status (``std_msgs/String``) as ``status`` under its name.

    Parameters
    ----------
    name : str
        Of the node.
    cloud, recovery : str
        Names of the services.
    deadline_s : float
        Longest time for a service's answer to a decision.
    ros_environment : RosEnvironment or None
        None reads ROS's variables.
    on_event : callable or None
        As for :class:`~holdfast_ros.client.ActiveSensingClient`.
    """

    def __init__(
        self,
        name: str = "active_sensing",
        cloud: str = "cloud_active_sensing",
        recovery: str = "cloud_active_sensing_recovery",
        deadline_s: float = 1.0,
        ros_environment: RosEnvironment | None = None,
        on_event: Callable[..., None] | None = None,
    ) -> None:
        ros_environment = ros_environment or RosEnvironment.of()
        first, second = (Ros1Service(each, ros_environment, name) for each in (cloud, recovery))
        super().__init__(first, second, LoopThread("holdfast-ros1"), deadline_s, self._tell)
        self._services = first, second
        self._own_on_event = on_event or log_event
        self._is_unregistered = False
        self._node = RosNode(name, ros_environment)
        self._status_topic = self._node.publish(f"{name}/status", STATUS_TYPE)
        self._publish(Status.STANDARD)
        try:
            self._thread.run(self._node.start(), _START_S)
        except BaseException:
            self._thread.close(_START_S)
            raise

    def close(self) -> None:
        """End all requests, and unregister the node, within a second; may be repeated."""
        if not self._is_unregistered:
            self._is_unregistered = True
            with contextlib.suppress(TransportError):
                self._thread.run(self._node.close(_CLOSE_S), 2 * _CLOSE_S)
            for service in self._services:
                self._thread.call(service.disconnect)
        super().close()

    def _tell(self, name: str, **fields: object) -> None:
        if name == "status":
            self._publish(Status(fields["status"]))
        self._own_on_event(name, **fields)

    def _publish(self, status: Status) -> None:
        text = STATUS_WORDS[status].encode()
        self._thread.call(self._status_topic.send, encode_message(text))
