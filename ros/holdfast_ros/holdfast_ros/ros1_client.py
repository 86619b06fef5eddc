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
from holdfast.protocol.status import Cause, Status
from holdfast.runtime.addresses import system_words
from holdfast_ros.active_sensing import DecisionAnswer, DecisionRequest
from holdfast_ros.client import ActiveSensingClient
from holdfast_ros.loop_thread import LoopThread
from holdfast_ros.messages import MAX_BYTES, decode_answer, encode_request, md5_sum
from holdfast_ros.ros1_environment import RosEnvironment, RosType
from holdfast_ros.ros1_node import RosNode
from ros1_master_guard.errors import CallError, GoneError, ProtocolError
from ros1_master_guard.headers import MAX_HEADER_BYTES, decode_header, encode_header, encode_message
from ros1_master_guard.ros1_calls import call, connect, message

STATUS_WORDS: Final = {
    Status.STANDARD: "standard",
    Status.LOCAL_RECOVERY: "local recovery",
    Status.KEEP_ALIVE: "keep alive",
}
"""The first implementation's spelling of the statuses."""

_LOOKUP_S: Final = 1.0  # for the master, where the service is known to have been somewhere
_START_S: Final = 5.0
_CLOSE_S: Final = 1.0
_STATUS_TYPE: Final = RosType(
    "std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1", "string data\n"
)


def service_type() -> RosType:
    """Return the typed service's name, as ROS 1 writes it, and its digest."""
    return RosType("holdfast_interfaces/ActiveSensing", md5_sum())


class Ros1Service:
    """Asks one service in the name of a node; a :class:`~holdfast_ros.client.DecisionService`.

    Raises TransportError if one of the names is none.
    """

    def __init__(self, name: str, ros_environment: RosEnvironment, caller: str) -> None:
        self.name = ros_environment.resolved(name)
        self._master = ros_environment.master
        self._caller = ros_environment.resolved(caller)
        self._type = service_type()
        self._last_uri: str | None = None
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def ask(self, request: DecisionRequest, deadline_s: float) -> DecisionAnswer:
        """Ask, and wait at most ``deadline_s``; raise TransportError if there is no answer."""
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
            reader, writer = self._streams = await connect(uri)
        except GoneError:
            raise TransportError(f"nobody listens at {uri}, where {where}: it is dead") from None
        fields = {
            "callerid": self._caller,
            "service": self.name,
            "md5sum": self._type.digest,
            "type": self._type.name,
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
        lookup = self._master, "lookupService", self.name
        try:
            found = await call(*lookup, within_s=within_s, caller=self._caller)
            return str(found), "the master says it is"
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
        super().__init__(first, second, LoopThread("holdfast-ros1"), deadline_s, on_event)
        self._services = first, second
        self._is_unregistered = False
        self._node = RosNode(name, ros_environment)
        self._status_topic = self._node.publish(f"{name}/status", _STATUS_TYPE)
        self._thread.call(self._publish_status)
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

    def _change(self, cause: Cause, reason: str) -> None:
        super()._change(cause, reason)
        self._publish_status()

    def _publish_status(self) -> None:
        self._status_topic.send(encode_message(STATUS_WORDS[self.status].encode()))
