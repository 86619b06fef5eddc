"""Links over ROS 1: the same frames as over TCP, as calls of a service that the master lists.

A ROS 1 service sends one response to each request, in order, and cannot send unasked. So a robot
always keeps at least one request pending there: a new call goes as one more request, and its reply
comes in the response to an older one. A call then takes one round trip, as over TCP, and the
service can send a ping at any time. Calls, leases and goodbyes are those of every link.

The master is only needed to find a service the first time. Without a master, a robot tries the last
known address.
"""

from __future__ import annotations

import asyncio
import socket
import struct
from typing import TYPE_CHECKING, Any, ClassVar, Final

from holdfast.errors import CallError, GoneError, TransportError
from holdfast.transport.endpoints import Endpoint, Role
from holdfast.transport.link_settings import LinkSettings
from holdfast.transport.links import Link, LinkOwner
from holdfast.transport.ros1_calls import call
from holdfast.transport.schemes import Scheme
from holdfast.transport.tcpros import (
    ANY_TYPE,
    MAX_HEADER_BYTES,
    RosEnvironment,
    ServiceType,
    decode_header,
    encode_header,
    header_of_service,
    place_of_service,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from holdfast.transport.ros1_node import RosNode
    from holdfast.transport.tls import TlsStream

__all__ = [
    "EXCHANGE",
    "RosScheme",
    "exchange_name",
]

EXCHANGE: Final = ServiceType("holdfast_interfaces/Exchange", "07ca5999d9d671038b26b777e731c7f0")
"""The service's type, ``interfaces/srv/Exchange.srv``."""

_LOOKUP_S: Final = 2.0
_MAX_PENDING: Final = 2
"""Requests that a service keeps pending while it has nothing to send."""

_COUNT = struct.Struct("<I")
_REQUEST = struct.Struct("<II")
_RESPONSE = struct.Struct("<BII")
_REFUSAL_BYTES: Final = 5


def exchange_name(endpoint: Endpoint) -> str:
    """Return the name of the service in ROS 1 behind an endpoint ``ros1/NAME``.

    ``NAME`` itself is the typed service, so that one process can offer both.
    """
    return RosEnvironment.of().resolved(f"{endpoint.host}/exchange")


def _node_of(service: str) -> str:
    """Return the name of the node that offers a service."""
    return f"{service}_node"


class _Stream(asyncio.Transport, asyncio.Protocol):
    """Makes a ROS 1 connection a stream: asyncio's protocol, and the link's transport."""

    def __init__(self, link: Link) -> None:
        super().__init__()
        self._link = link
        self._loop = asyncio.get_running_loop()
        self._below: asyncio.Transport | None = None
        self._is_open = False  # the peer's connection header has arrived
        self._raw = bytearray()
        self._is_refused = False
        self._left = 0  # payload bytes of this message that have not arrived
        self._inbox = bytearray()  # payload bytes for the link
        self._is_paused = self._is_delivering = False

    # -- callbacks of asyncio --------------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._below = transport
        self._send_header()
        self._link.connection_made(self)

    def data_received(self, data: bytes) -> None:
        if self._is_refused:
            return
        self._raw += data
        try:
            while self._read():
                pass
        except TransportError as error:
            self._is_refused = True
            self._raw.clear()
            self._link.end(str(error), refused=True)
            return
        except Exception as error:  # noqa: BLE001 - what a peer sends may raise anything
            self._is_refused = True
            self._raw.clear()
            self._link.fail(error)
            return
        self._deliver()

    def pause_writing(self) -> None:
        self._link.pause_writing()

    def resume_writing(self) -> None:
        self._link.resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        self._below = None
        self._link.connection_lost(exc)

    # -- the transport of the link ---------------------------------------------------------------

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        return default if self._below is None else self._below.get_extra_info(name, default)

    def get_write_buffer_size(self) -> int:
        return 0 if self._below is None else self._below.get_write_buffer_size()

    def pause_reading(self) -> None:
        self._is_paused = True
        if self._below is not None and not self._below.is_closing():
            self._below.pause_reading()

    def resume_reading(self) -> None:
        self._is_paused = False
        if self._below is not None and not self._below.is_closing():
            self._below.resume_reading()
        if self._inbox and not self._is_delivering:
            self._loop.call_soon(self._deliver)

    def close(self) -> None:
        if self._below is not None:
            self._below.close()

    def abort(self) -> None:
        if self._below is not None:
            self._below.abort()

    # -- messages --------------------------------------------------------------------------------

    def _send_header(self) -> None:
        """Send the connection header, if this end sends first."""

    def _take_header(self, fields: dict[str, str]) -> None:
        raise NotImplementedError

    def _read_head(self) -> bool:
        """Read a message's header; return whether it was complete."""
        raise NotImplementedError

    def _message_ended(self, *, is_empty: bool) -> None:
        """Handle the end of a message; raise TransportError if it is not allowed."""

    def _read(self) -> bool:
        """Read the next part of the received bytes; return whether there may be more."""
        if not self._is_open:
            if len(self._raw) < _COUNT.size:
                return False
            (size,) = _COUNT.unpack_from(self._raw)
            if size > MAX_HEADER_BYTES:
                raise TransportError("has sent no connection header of ROS 1")
            if len(self._raw) < _COUNT.size + size:
                return False
            header = bytes(self._raw[_COUNT.size : _COUNT.size + size])
            del self._raw[: _COUNT.size + size]
            self._is_open = True
            self._take_header(decode_header(header))
            return True
        if not self._left:
            return self._read_head()
        if not self._raw:
            return False
        size = min(self._left, len(self._raw))
        with memoryview(self._raw) as raw:
            self._inbox += raw[:size]
        del self._raw[:size]
        self._left -= size
        if not self._left:
            self._message_ended(is_empty=False)
        return True

    def _begin_message(self, head: struct.Struct, size: int, count: int) -> None:
        if size != count + _COUNT.size:
            raise TransportError("has sent a message that is not of this service's type")
        del self._raw[: head.size]
        self._left = count
        if not count:
            self._message_ended(is_empty=True)

    def _deliver(self) -> None:
        """Pass payload bytes to the link until it pauses."""
        if self._is_delivering:
            return
        self._is_delivering = True
        try:
            while self._inbox and not self._is_paused and not self._link.ended:
                buffer = self._link.get_buffer(-1)
                size = min(len(buffer), len(self._inbox))
                buffer[:size] = self._inbox[:size]
                del self._inbox[:size]
                self._link.buffer_updated(size)
        finally:
            self._is_delivering = False


class _RobotStream(_Stream):
    """The robot's end: it sends requests, and always keeps one pending."""

    def __init__(self, link: Link, service: str) -> None:
        super().__init__(link)
        self._service = service
        self._num_pending = 0

    def write(self, data: bytes | bytearray | memoryview) -> None:
        if self._below is not None:
            self._num_pending += 1
            size = len(data)
            self._below.write(_REQUEST.pack(size + _COUNT.size, size) + bytes(data))

    def _send_header(self) -> None:
        assert self._below is not None
        fields = {
            "callerid": "/holdfast_robot",
            "service": self._service,
            "md5sum": EXCHANGE.digest,
            "type": EXCHANGE.name,
            "persistent": "1",
        }
        # Requests follow without waiting for the service's header.
        self._below.write(encode_header(fields))

    def _take_header(self, fields: dict[str, str]) -> None:
        if "error" in fields:
            raise TransportError(f"refuses this robot: {fields['error']:.500}")

    def _read_head(self) -> bool:
        if self._raw[:1] == b"\x00":
            raise TransportError(
                f"has no answer: {self._raw[_REFUSAL_BYTES:500].decode(errors='replace')}"
            )
        if len(self._raw) < _RESPONSE.size:
            return False
        _, size, count = _RESPONSE.unpack_from(self._raw)
        if not self._num_pending:
            raise TransportError("replies without a request")
        self._num_pending -= 1
        if not self._num_pending:
            self.write(b"")
        self._begin_message(_RESPONSE, size, count)
        return True


class _ServiceStream(_Stream):
    """The service's end: bytes to send wait for a request to which they can be the response."""

    def __init__(self, link: Link, service: str) -> None:
        super().__init__(link)
        self._service = service
        self._num_pending = 0
        self._outbox = bytearray()
        self._closes = False

    def write(self, data: bytes | bytearray | memoryview) -> None:
        self._outbox += data
        self._flush()

    def get_write_buffer_size(self) -> int:
        return super().get_write_buffer_size() + len(self._outbox)

    def close(self) -> None:
        # Unsent bytes wait for a request until the link aborts.
        self._closes = True
        if not self._outbox:
            super().close()

    def _flush(self) -> None:
        if self._below is None or not self._num_pending or not self._outbox:
            return
        self._respond(bytes(self._outbox))
        self._outbox.clear()
        if self._closes:
            super().close()

    def _respond(self, data: bytes) -> None:
        assert self._below is not None
        self._num_pending -= 1
        self._below.write(_RESPONSE.pack(1, len(data) + _COUNT.size, len(data)) + data)

    def _take_header(self, fields: dict[str, str]) -> None:
        reason = None
        is_probe = fields.get("probe") == "1"
        if fields.get("service") != self._service:
            reason = f"only the service {self._service} is here"
        elif fields.get("md5sum") not in (EXCHANGE.digest, ANY_TYPE):
            reason = f"{self._service} is of type {EXCHANGE.name} with MD5 {EXCHANGE.digest}"
        assert self._below is not None
        if reason is not None:
            self._below.write(encode_header({"error": reason}))
            raise TransportError(f"asks for something else: {reason}")
        fields = header_of_service(_node_of(self._service), self._service, EXCHANGE)
        self._below.write(encode_header(fields))
        if is_probe:
            self._link.end("")

    def _read_head(self) -> bool:
        if len(self._raw) < _REQUEST.size:
            return False
        size, count = _REQUEST.unpack_from(self._raw)
        self._begin_message(_REQUEST, size, count)
        return True

    def _message_ended(self, *, is_empty: bool) -> None:
        # A robot sends an empty request only when none is pending.
        if is_empty and self._num_pending >= _MAX_PENDING:
            raise TransportError(f"sends requests without bytes while {_MAX_PENDING} wait")
        self._num_pending += 1
        self._flush()
        if self._num_pending > _MAX_PENDING and self._below is not None:
            self._respond(b"")


class _RosLink(Link):
    """A link whose stream is a ROS 1 connection."""

    def __init__(
        self, owner: LinkOwner, settings: LinkSettings, endpoint: Endpoint, role: Role
    ) -> None:
        super().__init__(owner, settings, speaks_first=role == "robot")
        self._stream = _RobotStream if role == "robot" else _ServiceStream
        self._service = exchange_name(endpoint)

    def protocol(self) -> asyncio.BaseProtocol:
        return self._stream(self, self._service)


class RosScheme(Scheme):
    """``ros1``: a service of ROS 1, found through the master."""

    lookup_interval_s: ClassVar[float] = 0.1

    def __init__(self) -> None:
        self._node: RosNode | None = None

    def make_link(
        self,
        owner: LinkOwner,
        settings: LinkSettings,
        endpoint: Endpoint,
        tls: TlsStream | None,
        *,
        role: Role,
        dialled: bool,
    ) -> Link:
        """Make the link of a new connection."""
        del tls, dialled
        return _RosLink(owner, settings, endpoint, role)

    def look_up(self, endpoint: Endpoint) -> tuple[str, int, socket.AddressFamily]:
        """Ask the master where a service is; takes at most two seconds.

        Raises TransportError if that is not known; the message gives the reason.
        """
        master = RosEnvironment.of().master
        # Not asyncio.run, which waits without bound for a look-up of the master's name.
        loop = asyncio.new_event_loop()
        try:
            lookup = call(master, "lookupService", exchange_name(endpoint), within_s=_LOOKUP_S)
            return *place_of_service(loop.run_until_complete(lookup)), socket.AF_INET
        except GoneError:
            raise TransportError(f"there is no ROS master at {master}") from None
        except CallError as error:
            raise TransportError(f"the ROS master does not say where it is: {error}") from error
        finally:
            loop.close()

    def listening_endpoint(self, endpoint: Endpoint) -> Endpoint:
        """Return the address of this machine in ROS, with any free port."""
        del endpoint
        return Endpoint("tcp", RosEnvironment.of().bind, 0)

    def bound_endpoint(self, endpoint: Endpoint, listening: Endpoint) -> Endpoint:
        """Return the endpoint unchanged: the master knows the port."""
        del listening
        return endpoint

    async def announce(
        self,
        ports: Mapping[Endpoint, int],
        on_event: Callable[..., None] | None,
        on_shutdown: Callable[[str], None] | None,
    ) -> None:
        """Start a node that registers the endpoints with the master."""
        from holdfast.transport.ros1_node import RosNode

        self._node = RosNode(
            _node_of(exchange_name(next(iter(ports)))),
            RosEnvironment.of(),
            on_event=on_event,
            on_shutdown=on_shutdown,
        )
        for endpoint, port in ports.items():
            self._node.offer_at(exchange_name(endpoint), port)
        await self._node.start()

    async def withdraw(self, timeout_s: float) -> None:
        """Unregister from the master, within this time."""
        node, self._node = self._node, None
        if node is not None:
            await node.close(timeout_s)
