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
import ipaddress
import queue
import socket
import struct
import threading
from collections.abc import Callable
from time import monotonic
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

import numpy as np

from holdfast.errors import TransportError
from holdfast.numerics.arrays import FloatArray
from holdfast.protocol.status import Status
from holdfast.runtime.addresses import host_and_port, system_words
from holdfast_ros.active_sensing import DecisionAnswer, DecisionRequest, ErrorCode, RequestKind
from holdfast_ros.client import ActiveSensingClient
from holdfast_ros.loop_thread import LoopThread
from holdfast_ros.messages import MAX_BYTES, decode_answer, encode_request, md5_sum
from holdfast_ros.ros1_node import RosNode, Topic, TopicType
from holdfast_ros.tcpros import RosEnvironment, ServiceType, place_of_service
from ros1_master_guard.errors import CallError, GoneError, ProtocolError
from ros1_master_guard.headers import (
    MAX_HEADER_BYTES,
    decode_header,
    encode_header,
    encode_message,
)
from ros1_master_guard.ros1_calls import call

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

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
_MAX_WAITING: Final = 256


def service_type() -> ServiceType:
    """Return the typed service's name and digest in ROS 1."""
    return ServiceType(SERVICE_TYPE, md5_sum())


class _LostError(TransportError):
    """The connection has ended."""


class Ros1Service:
    """A client of one service; a :class:`~holdfast_ros.client.DecisionService`.

    Parameters
    ----------
    name : str
        Of the service, such as ``cloud_active_sensing``.
    ros_environment : RosEnvironment or None
        None reads ROS's variables.
    caller : str
        Name of the asking node.

    Raises
    ------
    TransportError
        If the name is none.
    """

    def __init__(
        self,
        name: str,
        ros_environment: RosEnvironment | None = None,
        caller: str = "holdfast_robot",
    ) -> None:
        self._ros_environment = ros_environment or RosEnvironment.of()
        self.name = self._ros_environment.resolved(name)
        self._caller = self._ros_environment.resolved(caller)
        self._digest = md5_sum()
        self._last_place: tuple[str, int] | None = None
        self._socket: socket.socket | None = None
        self._is_closed = False
        self._lock = threading.Lock()

    def ask(self, request: DecisionRequest, deadline_s: float) -> DecisionAnswer:
        """Ask, and wait at most ``deadline_s`` for the answer.

        Raises
        ------
        TransportError
            If there is no answer; the message gives the reason.
        """
        until = monotonic() + deadline_s
        message = encode_message(encode_request(request))
        try:
            return decode_answer(self._exchange(message, until))
        except TimeoutError:
            self._disconnect()
            raise TransportError(f"no answer in {deadline_s:g} s") from None
        except TransportError:
            self._disconnect()
            raise
        except OSError as error:
            self._disconnect()
            raise TransportError(system_words(error.errno)) from error

    def close(self) -> None:
        """End all requests; may be called from another thread, and repeated."""
        self._is_closed = True
        self._disconnect()

    def _exchange(self, message: bytes, until: float) -> bytes:
        if self._socket is not None:
            # The service may have been restarted since. Requests change nothing there, so they can
            # be repeated.
            with contextlib.suppress(_LostError, ConnectionError):
                return self._exchange_over(self._socket, message, until)
            self._disconnect()
        return self._exchange_over(self._connected(until), message, until)

    def _exchange_over(self, stream: socket.socket, message: bytes, until: float) -> bytes:
        _send(stream, message, until)
        is_done = _receive(stream, 1, until) == b"\x01"
        answer = _receive_message(stream, MAX_BYTES, until)
        if not is_done:
            raise TransportError(f"it answers: {answer[:500].decode(errors='replace')}")
        return answer

    # -- the connection ----------------------------------------------------------------------------

    def _connected(self, until: float) -> socket.socket:
        place, where = self._found(until)
        try:
            stream = socket.create_connection(place, _left(until))
        except ConnectionRefusedError:
            raise TransportError(
                f"nobody listens at {host_and_port(*place)}, where {where}: it is dead"
            ) from None
        try:
            stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._take(stream)
            fields = {
                "callerid": self._caller,
                "service": self.name,
                "md5sum": self._digest,
                "type": SERVICE_TYPE,
                "persistent": "1",
            }
            _send(stream, encode_header(fields), until)
            header = decode_header(_receive_message(stream, MAX_HEADER_BYTES, until))
        except ProtocolError as error:
            stream.close()
            raise TransportError(f"it {error}") from error
        except BaseException:
            stream.close()
            raise
        if "error" in header:
            raise TransportError(f"it refuses: {header['error']:.500}")
        self._last_place = place
        return stream

    def _take(self, stream: socket.socket) -> None:
        """Have a connection that :meth:`close` ends."""
        with self._lock:
            if self._is_closed:
                raise TransportError("it is not asked any more")
            self._socket = stream

    def _found(self, until: float) -> tuple[tuple[str, int], str]:
        """Return where the service is, and who says so."""
        last = self._last_place
        within_s = _left(until)
        if last is not None:
            within_s = min(within_s / 2, _LOOKUP_S)
        try:
            host, port = place_of_service(self._looked_up(within_s))
        except GoneError:
            reason = f"there is no master at {self._ros_environment.master}"
        except CallError as error:
            reason = str(error)
        else:
            return (_address(host, until), port), "the master says it is"
        if last is None:
            raise TransportError(reason)
        return last, f"it was last ({reason})"

    def _looked_up(self, within_s: float) -> str:
        ros_environment = self._ros_environment
        parts = urlsplit(ros_environment.master)
        until = monotonic() + within_s
        assert parts.hostname is not None and parts.port is not None
        master = f"http://{host_and_port(_address(parts.hostname, until), parts.port)}/"
        asked = call(master, "lookupService", self.name, within_s=_left(until), caller=self._caller)
        return str(asyncio.run(asked))

    def _disconnect(self) -> None:
        with self._lock:
            stream, self._socket = self._socket, None
        if stream is not None:
            with contextlib.suppress(OSError):
                stream.shutdown(socket.SHUT_RDWR)  # wakes a waiting thread
            stream.close()


def _left(until: float) -> float:
    left = until - monotonic()
    if left <= 0:
        raise TimeoutError
    return left


def _address(host: str, until: float) -> str:
    """Return the address of a host; its look-up, which nothing can break off, is left behind."""
    with contextlib.suppress(ValueError):
        return str(ipaddress.ip_address(host))
    found: queue.SimpleQueue[str] = queue.SimpleQueue()

    def look_up() -> None:
        try:
            # ROS 1 uses IPv4 by default.
            found.put(socket.getaddrinfo(host, None, socket.AF_INET)[0][4][0])  # type: ignore[arg-type]
        except (OSError, UnicodeError):
            found.put("")

    threading.Thread(target=look_up, name="holdfast-resolve", daemon=True).start()
    try:
        address = found.get(timeout=_left(until))
    except queue.Empty:
        raise TimeoutError from None
    if not address:
        raise TransportError(f"host name not found: {host}")
    return address


def _send(stream: socket.socket, data: bytes, until: float) -> None:
    stream.settimeout(_left(until))
    stream.sendall(data)


def _receive(stream: socket.socket, size: int, until: float) -> bytes:
    data = bytearray(size)
    view = memoryview(data)
    place = 0
    while place < size:
        stream.settimeout(_left(until))
        received = stream.recv_into(view[place:])
        if not received:
            raise _LostError("it has ended the connection")
        place += received
    return bytes(data)


def _receive_message(stream: socket.socket, max_bytes: int, until: float) -> bytes:
    (size,) = struct.unpack("<I", _receive(stream, 4, until))
    if size > max_bytes:
        raise TransportError(f"it answers with {size} bytes; {max_bytes} are allowed")
    return _receive(stream, size, until)


class Ros1Client(ActiveSensingClient):
    """The thesis's client: asks the cloud, and the recovery service if the cloud fails.

    It is a node that publishes ``status`` and ``decided_by`` (``std_msgs/String``),
    ``sensing_action`` (``std_msgs/UInt32``) and ``task_actions`` (``std_msgs/Float64MultiArray``,
    one action after another), each under the node's name.

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
        from rosbags.typesys import Stores, get_typestore

        ros_environment = ros_environment or RosEnvironment.of()
        first, second = (Ros1Service(each, ros_environment, name) for each in (cloud, recovery))
        self._store: Typestore = get_typestore(Stores.ROS1_NOETIC)
        self._node = RosNode(name, ros_environment)
        self._waiting = 0
        self._is_unregistered = False
        self._topics: dict[str, tuple[Topic, str]] = {}
        for topic, kind, latched in (
            ("status", "std_msgs/msg/String", True),
            ("decided_by", "std_msgs/msg/String", True),
            ("sensing_action", "std_msgs/msg/UInt32", False),
            ("task_actions", "std_msgs/msg/Float64MultiArray", False),
        ):
            definition, digest = self._store.generate_msgdef(kind)
            type_ = TopicType(kind.replace("/msg/", "/"), digest, definition)
            published = self._node.publish(f"{name}/{topic}", type_, latched=latched)
            self._topics[topic] = published, kind
        self._thread = LoopThread("holdfast-ros1")
        try:
            self._thread.run(self._node.start(), _START_S)
        except BaseException:
            self._thread.close(_START_S)
            raise
        self._send("status", data=STATUS_WORDS[Status.STANDARD])
        self._published_decider = ""
        self._own_on_event = on_event
        super().__init__(first, second, deadline_s, self._tell)

    def close(self) -> None:
        """End all requests, and unregister the node, within a second; may be repeated."""
        super().close()
        if not self._is_unregistered:
            self._is_unregistered = True
            with contextlib.suppress(TransportError):
                self._thread.run(self._node.close(_CLOSE_S), 2 * _CLOSE_S)
            self._thread.close(_CLOSE_S)

    def topic(self, name: str) -> Topic:
        """Return one of the topics that are published, by the last part of its name."""
        return self._topics[name][0]

    def decide(self, request: DecisionRequest, give_up_s: float | None = None) -> DecisionAnswer:
        """Return a service's answer; see :meth:`ActiveSensingClient.decide`."""
        answer = super().decide(request, give_up_s)
        if self.decided_by != self._published_decider:
            self._published_decider = self.decided_by
            self._send("decided_by", data=self.decided_by)
        if answer.error is ErrorCode.OK and request.kind == RequestKind.CHOOSE_SENSING_ACTION:
            self._send("sensing_action", data=answer.sensing_action)
        elif len(answer.task_actions):
            self._send("task_actions", **self._array(answer.task_actions))
        return answer

    def _tell(self, name: str, **fields: object) -> None:
        if name == "status":
            self._send("status", data=STATUS_WORDS[Status(fields["status"])])
        if self._own_on_event is not None:
            self._own_on_event(name, **fields)

    def _send(self, topic: str, **fields: Any) -> None:
        """Publish without waiting; messages beyond a limit are dropped."""
        to, kind = self._topics[topic]
        message = self._store.types[kind](**fields)
        data = bytes(self._store.serialize_ros1(message, kind))
        if self._waiting >= _MAX_WAITING:
            return
        self._waiting += 1

        def send() -> None:
            self._waiting -= 1
            to.send(data)

        self._thread.call(send)

    def _array(self, numbers: FloatArray) -> dict[str, Any]:
        """Return the fields of a Float64MultiArray."""
        types = self._store.types
        dimension = types["std_msgs/msg/MultiArrayDimension"]
        rows, columns = numbers.shape
        layout = types["std_msgs/msg/MultiArrayLayout"](
            dim=[
                dimension(label="action", size=rows, stride=rows * columns),
                dimension(label="coordinate", size=columns, stride=columns),
            ],
            data_offset=0,
        )
        return {"layout": layout, "data": np.ascontiguousarray(numbers, np.float64).ravel()}
