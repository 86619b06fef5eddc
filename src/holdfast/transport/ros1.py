"""Links over ROS 1: the same frames as over TCP, as requests to a service that the master lists.

ROS 1's services have one answer to each request, in order, and a service cannot speak unasked. So a
robot always has at least one request there that is not answered: a question goes as one more
request, and the answer to it comes in answer to the older one. That is one round trip, as over TCP,
and the service can say at any time that it lives. Everything above that is the streams' own: calls,
leases, goodbyes.

The master is needed to find a service that nobody has found before. While there is none, a robot
looks where the service was last.
"""

from __future__ import annotations

import asyncio
import struct
from typing import TYPE_CHECKING, Any, Final

from holdfast.errors import TransportError
from holdfast.transport.endpoints import Endpoint
from holdfast.transport.links import Link, LinkOwner, LinkSettings
from holdfast.transport.ros1_calls import CallError, GoneError, call
from holdfast.transport.tcpros import (
    ANY_TYPE,
    MAX_HEADER_BYTES,
    ServiceType,
    Surroundings,
    decode_header,
    encode_header,
    header_of_service,
    place_of_service,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from holdfast.transport.ros1_node import RosNode

__all__ = [
    "EXCHANGE",
    "RobotRosLink",
    "ServiceRosLink",
    "exchange_name",
    "look_up",
    "make_node",
    "place_to_listen",
]

EXCHANGE: Final = ServiceType("holdfast_interfaces/Exchange", "07ca5999d9d671038b26b777e731c7f0")
"""The service's type, ``interfaces/srv/Exchange.srv``."""

_LOOKUP_S: Final = 2.0
_MAX_HELD: Final = 2
"""Requests that a service leaves unanswered while it has nothing to say."""

_COUNT = struct.Struct("<I")
_REQUEST = struct.Struct("<II")
_ANSWER = struct.Struct("<BII")
_REFUSAL_BYTES: Final = 5


def exchange_name(endpoint: Endpoint) -> str:
    """Return the name of the service in ROS 1 behind an endpoint ``ros1/NAME``.

    ``NAME`` itself is the typed service, so that one process can offer both.
    """
    return Surroundings.of().resolved(f"{endpoint.host}/exchange")


def place_to_listen() -> Endpoint:
    """Return where a service listens, at a port that is free."""
    return Endpoint("tcp", Surroundings.of().bind, 0)


def look_up(endpoint: Endpoint) -> tuple[str, int]:
    """Ask the master where a service is; on a thread of its own, for two seconds at most.

    Raises
    ------
    TransportError
        If that is not known; the message says why.
    """
    master = Surroundings.of().master
    loop = asyncio.new_event_loop()
    try:
        asked = call(master, "lookupService", exchange_name(endpoint), within_s=_LOOKUP_S)
        return place_of_service(loop.run_until_complete(asked))
    except GoneError:
        raise TransportError(f"there is no ROS master at {master}") from None
    except CallError as error:
        raise TransportError(f"the ROS master does not say where it is: {error}") from error
    finally:
        loop.close()


def make_node(
    ports: Mapping[Endpoint, int],
    on_event: Callable[..., None] | None,
    on_shutdown: Callable[[str], None] | None,
) -> RosNode:
    """Return a node that says where the services behind some endpoints listen."""
    from holdfast.transport.ros1_node import RosNode

    first = next(iter(ports))
    node = RosNode(
        _node_of(exchange_name(first)),
        Surroundings.of(),
        on_event=on_event,
        on_shutdown=on_shutdown,
    )
    for endpoint, port in ports.items():
        node.offer_at(exchange_name(endpoint), port)
    return node


def _node_of(service: str) -> str:
    """Return the name of the node that offers a service."""
    return f"{service}_node"


class _Stream(asyncio.Transport, asyncio.Protocol):
    """A connection of ROS 1 that is a stream to a link: a protocol below, a transport above."""

    def __init__(self, link: Link) -> None:
        super().__init__()
        self._link = link
        self._loop = asyncio.get_running_loop()
        self._below: asyncio.Transport | None = None
        self._is_open = False  # the other end's header has come
        # Of what has come, what is not read yet; from its front bytes go without a copy.
        self._raw = bytearray()
        self._is_refused = False
        self._left = 0  # bytes of the link's that are still to come in this message
        self._inbox = bytearray()  # bytes for the link
        self._is_paused = self._is_delivering = False

    # -- what asyncio tells ------------------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._below = transport
        self._greet()
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
        self._deliver()

    def pause_writing(self) -> None:
        self._link.pause_writing()

    def resume_writing(self) -> None:
        self._link.resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        self._below = None
        self._link.connection_lost(exc)

    # -- what the link sees ------------------------------------------------------------------------

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

    def is_closing(self) -> bool:
        return self._below is None or self._below.is_closing()

    def close(self) -> None:
        if self._below is not None:
            self._below.close()

    def abort(self) -> None:
        if self._below is not None:
            self._below.abort()

    # -- both directions ---------------------------------------------------------------------------

    def _greet(self) -> None:
        """Say what comes first, if anything does."""

    def _take_header(self, fields: dict[str, str]) -> None:
        raise NotImplementedError

    def _read_head(self) -> bool:
        """Read what stands before a message's bytes; return whether it was there."""
        raise NotImplementedError

    def _message_ended(self, *, is_empty: bool) -> None:
        """Take note that a whole message has come.

        Raises
        ------
        TransportError
            If it may not.
        """

    def _read(self) -> bool:
        """Read a part of what has come; return whether there may be more."""
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
        """Hand over to the link what it will take."""
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
    """The robot's end: it sends requests, and always has one there that waits."""

    def __init__(self, link: Link, service: str) -> None:
        super().__init__(link)
        self._service = service
        self._unanswered = 0

    def write(self, data: bytes | bytearray | memoryview) -> None:
        if self._below is not None:
            self._unanswered += 1
            size = len(data)
            self._below.write(_REQUEST.pack(size + _COUNT.size, size) + bytes(data))

    def _greet(self) -> None:
        assert self._below is not None
        fields = {
            "callerid": "/holdfast_robot",
            "service": self._service,
            "md5sum": EXCHANGE.digest,
            "type": EXCHANGE.name,
            "persistent": "1",
        }
        # Requests follow at once: if the service refuses them, it says so.
        self._below.write(encode_header(fields))

    def _take_header(self, fields: dict[str, str]) -> None:
        if "error" in fields:
            raise TransportError(f"refuses this robot: {fields['error']:.500}")

    def _read_head(self) -> bool:
        if self._raw[:1] == b"\x00":
            raise TransportError(
                f"has no answer: {self._raw[_REFUSAL_BYTES:500].decode(errors='replace')}"
            )
        if len(self._raw) < _ANSWER.size:
            return False
        _, size, count = _ANSWER.unpack_from(self._raw)
        if not self._unanswered:
            raise TransportError("answers what was not asked")
        self._unanswered -= 1
        if not self._unanswered:
            self.write(b"")
        self._begin_message(_ANSWER, size, count)
        return True


class _ServiceStream(_Stream):
    """The service's end: what it has to say waits for a request that it can answer."""

    def __init__(self, link: Link, service: str) -> None:
        super().__init__(link)
        self._service = service
        self._held = 0
        self._outbox = bytearray()
        self._closes = False

    def write(self, data: bytes | bytearray | memoryview) -> None:
        self._outbox += data
        self._flush()

    def get_write_buffer_size(self) -> int:
        return super().get_write_buffer_size() + len(self._outbox)

    def close(self) -> None:
        # What is still to be said waits for a request, for as long as the link lets it.
        self._closes = True
        if not self._outbox:
            super().close()

    def _flush(self) -> None:
        if self._below is None or not self._held or not self._outbox:
            return
        self._answer(bytes(self._outbox))
        self._outbox.clear()
        if self._closes:
            super().close()

    def _answer(self, data: bytes) -> None:
        assert self._below is not None
        self._held -= 1
        self._below.write(_ANSWER.pack(1, len(data) + _COUNT.size, len(data)) + data)

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
        # A robot sends one without bytes only when none waits.
        if is_empty and self._held >= _MAX_HELD:
            raise TransportError(f"sends requests without bytes while {_MAX_HELD} wait")
        self._held += 1
        self._flush()
        if self._held > _MAX_HELD and self._below is not None:
            self._answer(b"")


class RobotRosLink(Link):
    """The robot's end of a link over ROS 1."""

    def __init__(self, owner: LinkOwner, settings: LinkSettings, endpoint: Endpoint) -> None:
        super().__init__(owner, settings, speaks_first=True)
        self._service = exchange_name(endpoint)

    def protocol(self) -> asyncio.BaseProtocol:
        """Return what asyncio is to connect."""
        return _RobotStream(self, self._service)


class ServiceRosLink(Link):
    """The service's end of a link over ROS 1."""

    def __init__(self, owner: LinkOwner, settings: LinkSettings, endpoint: Endpoint) -> None:
        super().__init__(owner, settings, speaks_first=False)
        self._service = exchange_name(endpoint)

    def protocol(self) -> asyncio.BaseProtocol:
        """Return what asyncio is to connect."""
        return _ServiceStream(self, self._service)
