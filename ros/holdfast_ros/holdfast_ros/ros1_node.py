"""A ROS 1 node without ROS: it offers services and topics in an asyncio loop.

``rosnode``, ``rosservice`` and ``rostopic`` find it, and clients in rospy and roscpp call it. Three
things differ from other nodes: every wait has a deadline, a peer that does not read delays no other
peer, and the node survives its master: it checks every second whether the master knows it, and
registers again if not.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import xmlrpc.client
from collections.abc import Awaitable, Callable, Iterator, Mapping
from typing import Any, Final, NamedTuple

from holdfast.errors import DEFECT, TransportError, defect_fields
from holdfast.runtime.addresses import host_and_port, why_not_bound
from holdfast.transport.contract import DEFAULT_MAX_MESSAGE_BYTES
from holdfast_ros.ros1_environment import RosEnvironment, ServiceType
from ros1_master_guard.errors import CallError
from ros1_master_guard.headers import (
    ANY_TYPE,
    MAX_HEADER_BYTES,
    decode_header,
    encode_header,
    encode_message,
)
from ros1_master_guard.ros1_calls import (
    MAX_SHORT_BYTES,
    Connection,
    HttpHead,
    decoded,
    message,
)

ServiceHandler = Callable[[bytes], Awaitable[bytes]]
"""Takes a request's bytes and returns the response's."""

MAX_CONNECTIONS: Final = 1024
"""From clients, subscribers and tools together."""

_OPENING_S: Final = 5.0
_IDLE_S: Final = 60.0
"""An XML-RPC connection without a call for this long is closed."""

_REQUEST_S: Final = 10.0
"""From a request's first byte to its last; a slower caller loses the connection."""

_MASTER_S: Final = 1.0
"""For one call to the master."""

_CHECK_INTERVAL_S: Final = 1.0
_RETRY_S: Final = 0.1
"""After the master could not be reached."""

_MAX_CALL_BYTES: Final = 8 << 10
"""An XML-RPC call to a node has some hundred bytes. Parsing takes a microsecond for each of them,
during which nobody else is served."""

_MAX_UNREAD_BYTES: Final = 64 << 10
"""Bound on what waits for a subscriber; further messages are dropped."""

_TURNS_TO_BEGIN: Final = 4
"""Turns of the loop until asyncio serves a connection that it has accepted. Before that it is in no
list of ours, and would stay open."""

_UNKNOWN: Final = -1
_OK: Final = 1


class TopicType(NamedTuple):
    """A topic's type: its name, its MD5 and its whole definition."""

    name: str
    digest: str
    definition: str


class _Offer(NamedTuple):
    type: ServiceType
    handler: ServiceHandler


class Topic:
    """A latched topic that this node publishes; made by :meth:`RosNode.publish`."""

    def __init__(self, name: str, type_: TopicType) -> None:
        self.name = name
        self.type = type_
        self._last: bytes | None = None
        self.subscribers: set[asyncio.StreamWriter] = set()

    def send(self, payload: bytes) -> None:
        """Send a message to all subscribers; never waits."""
        self._last = encode_message(payload)
        for writer in list(self.subscribers):
            self._write(writer)

    def add(self, writer: asyncio.StreamWriter) -> None:
        """Add a subscriber; it gets the last message."""
        self.subscribers.add(writer)
        self._write(writer)

    def _write(self, writer: asyncio.StreamWriter) -> None:
        if self._last and writer.transport.get_write_buffer_size() < _MAX_UNREAD_BYTES:
            writer.write(self._last)


class RosNode:
    """A node; all methods are called on the loop's thread.

    ``on_shutdown`` gets the reason when this node has to end: on request, or because another node
    has taken its name. ``on_event`` is called with ``ros_master``, ``status`` (``registered``,
    ``unreachable``) and ``reason``; and with ``ros_request_failed``, ``service`` and ``reason``.
    """

    def __init__(
        self,
        name: str,
        environment: RosEnvironment,
        *,
        on_shutdown: Callable[[str], None] | None = None,
        on_event: Callable[..., None] | None = None,
        max_message_bytes: int = DEFAULT_MAX_MESSAGE_BYTES,
    ) -> None:
        self.name = environment.resolved(name)
        self._environment = environment
        self._on_shutdown = on_shutdown
        self._on_event = on_event
        self._max_message_bytes = max_message_bytes
        self._services: dict[str, _Offer] = {}
        self._topics: dict[str, Topic] = {}
        self._master = Connection(environment.master, self.name, MAX_SHORT_BYTES)
        self._parsing = asyncio.Lock()
        self._servers: list[asyncio.Server] = []
        self._uri = ""
        self._port = 0
        self._connections: set[asyncio.Task[None]] = set()
        self._registration: asyncio.Task[None] | None = None
        self._is_known = False
        self._master_status: str | None = None

    def offer(self, name: str, type_: ServiceType, handler: ServiceHandler) -> None:
        """Offer a service, before the start; the caller and the log get the handler's errors."""
        self._services[self._environment.resolved(name)] = _Offer(type_, handler)

    def publish(self, name: str, type_: TopicType) -> Topic:
        """Add a topic, before the start; new subscribers get its last message."""
        topic = Topic(self._environment.resolved(name), type_)
        self._topics[topic.name] = topic
        return topic

    async def start(self, within_s: float = 2.0) -> bool:
        """Listen, and register with the master; return whether the master knows this node.

        After ``within_s`` without an answer, registration goes on in the background.

        Raises TransportError if it cannot listen.
        """
        environment = self._environment
        try:
            for serve, limit in (
                (self._serve_node, _MAX_CALL_BYTES),
                (self._serve_tcpros, MAX_HEADER_BYTES),
            ):
                server = await asyncio.start_server(serve, environment.bind, 0, limit=limit)
                self._servers.append(server)
        except OSError as error:
            self._stop()
            raise TransportError(
                f"cannot listen on {environment.bind}: {why_not_bound(error)}"
            ) from error
        ports = [server.sockets[0].getsockname()[1] for server in self._servers]
        self._uri = f"http://{host_and_port(environment.host, ports[0])}/"
        self._port = ports[1]
        registered = asyncio.Event()
        self._registration = asyncio.create_task(self._stay_registered(registered))
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(registered.wait(), within_s)
        return self._is_known

    async def close(self, within_s: float = 1.0) -> None:
        """Unregister, and end all connections; may be repeated."""
        registration, self._registration = self._registration, None
        loop = asyncio.get_running_loop()
        for server in self._servers:
            for listening in server.sockets:
                loop.remove_reader(listening.fileno())
        for _ in range(_TURNS_TO_BEGIN):
            await asyncio.sleep(0)
        self._stop()
        tasks = [*self._connections, *([] if registration is None else [registration])]
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks, timeout=within_s)
        if self._is_known:
            self._is_known = False
            with contextlib.suppress(CallError):
                await self._master.calls(self._unregistrations(), within_s=within_s)
        self._master.close()

    def _stop(self) -> None:
        for server in self._servers:
            server.close()
        self._servers.clear()

    # -- the master --------------------------------------------------------------------------------

    def _uris_of_services(self) -> dict[str, str]:
        place = host_and_port(self._environment.host, self._port)
        return dict.fromkeys(self._services, f"rosrpc://{place}")

    async def _stay_registered(self, registered: asyncio.Event) -> None:
        """Register with each master that does not know this node."""
        while True:
            try:
                # At first the names may still belong to a dead process.
                if not self._is_known or not await self._is_known_to_master():
                    await self._register()
                self._is_known = True
                self._report_master("registered", self._environment.master)
                registered.set()
                pause_s = _CHECK_INTERVAL_S
            except CallError as error:
                self._report_master("unreachable", str(error))
                pause_s = _RETRY_S
            except Exception as error:  # noqa: BLE001 - registration must go on
                self._report_master("unreachable", f"{type(error).__name__}: {error}")
                pause_s = _CHECK_INTERVAL_S
            await asyncio.sleep(pause_s)

    async def _is_known_to_master(self) -> bool:
        services = self._uris_of_services()
        lookups = [
            ("lookupNode", (self.name, self.name)),
            *(("lookupService", (self.name, name)) for name in services),
        ]
        return None not in await self._master.calls(lookups, within_s=_MASTER_S)

    async def _register(self) -> None:
        calls: list[tuple[str, tuple[object, ...]]] = [
            ("registerService", (name, uri, self._uri))
            for name, uri in self._uris_of_services().items()
        ]
        calls += [
            ("registerPublisher", (topic.name, topic.type.name, self._uri))
            for topic in self._topics.values()
        ]
        for method, arguments in calls:
            await self._master.call(method, *arguments, within_s=_MASTER_S)

    def _unregistrations(self) -> list[tuple[str, tuple[object, ...]]]:
        return [
            *(
                ("unregisterService", (self.name, *each))
                for each in self._uris_of_services().items()
            ),
            *(("unregisterPublisher", (self.name, name, self._uri)) for name in self._topics),
        ]

    def _report_master(self, status: str, reason: str) -> None:
        if self._on_event is not None and self._master_status != status:
            self._on_event("ros_master", status=status, reason=reason)
        self._master_status = status

    # -- XML-RPC ---------------------------------------------------------------------------------

    async def _serve_node(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with self._connected(writer) as has_room:
            while has_room and await self._serve_request(reader, writer):
                pass

    async def _serve_request(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> bool:
        """Answer one XML-RPC call; return whether another may follow."""
        async with asyncio.timeout(_IDLE_S):
            head = await HttpHead.read(reader)
        async with asyncio.timeout(_OPENING_S):
            if not 0 <= head.size <= _MAX_CALL_BYTES:
                return False
            content = await reader.readexactly(head.size)
            answer: tuple[tuple[int, str, Any]] | xmlrpc.client.Fault
            async with self._parsing:
                await asyncio.sleep(0)  # one call in each turn of the loop, however many wait
                try:
                    arguments, method = decoded(content)
                    answer = (self._answer(str(method), arguments),)
                except Exception as error:  # noqa: BLE001 - the parser may raise anything
                    reason = f"{type(error).__name__}: {error}"
                    answer = xmlrpc.client.Fault(1, f"this is no method of a node: {reason:.500}")
            body = xmlrpc.client.dumps(answer, methodresponse=True).encode()
            writer.write(
                b"HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\n"
                + (b"Connection: close\r\n" if head.ends else b"")
                + f"Content-Length: {len(body)}\r\n\r\n".encode()
                + body
            )
            await writer.drain()
        return not head.ends

    def _answer(self, method: str, arguments: tuple[Any, ...]) -> tuple[int, str, Any]:
        match method:
            case "getPid":
                return _OK, "", os.getpid()
            case "getMasterUri":
                return _OK, "", self._environment.master
            case "getBusStats":
                return _OK, "", [[], [], []]
            case "getBusInfo" | "getSubscriptions":
                return _OK, "", []
            case "getPublications":
                return _OK, "", [[each.name, each.type.name] for each in self._topics.values()]
            case "publisherUpdate" | "paramUpdate":
                return _OK, "", 0
            case "shutdown":
                reason = str(arguments[1]) if len(arguments) > 1 else ""
                if self._on_shutdown is not None:
                    asyncio.get_running_loop().call_soon(
                        self._on_shutdown, f"asked to by ROS ({reason:.200})"
                    )
                return _OK, "", 0
            case "requestTopic" if len(arguments) == 3:
                if arguments[1] not in self._topics:
                    return _UNKNOWN, f"{arguments[1]} is not published here", []
                if not any(list(each)[:1] == ["TCPROS"] for each in arguments[2]):
                    return 0, "no protocol but TCPROS is spoken here", []
                return _OK, "", ["TCPROS", self._environment.host, self._port]
            case _:
                return _UNKNOWN, f"{method!r:.100} is no method of a node", 0

    # -- services and topics -----------------------------------------------------------------------

    async def _serve_tcpros(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        with self._connected(writer) as has_room:
            if not has_room:
                return
            async with asyncio.timeout(_OPENING_S):
                header = decode_header(await message(reader, MAX_HEADER_BYTES))
            if "service" in header:
                await self._serve_calls(header, reader, writer)
            elif "topic" in header:
                await self._serve_subscriber(header, reader, writer)
            else:
                _refuse(writer, "the header names no service and no topic")

    async def _serve_calls(
        self, header: Mapping[str, str], reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        offer = self._services.get(header["service"])
        if offer is None:
            _refuse(writer, f"[{self.name}] has no service [{header['service']:.200}]")
            return
        if _refuse_other_type(header, offer.type, f"service [{header['service']}]", writer):
            return
        fields = {
            "callerid": self.name,
            "service": header["service"],
            "type": offer.type.name,
            "md5sum": offer.type.digest,
            "request_type": f"{offer.type.name}Request",
            "response_type": f"{offer.type.name}Response",
        }
        writer.write(encode_header(fields))
        if header.get("probe") == "1":
            await writer.drain()
            return
        while True:
            # A connection may stay idle between requests.
            first = await reader.readexactly(1)
            async with asyncio.timeout(_REQUEST_S):
                request = await message(reader, self._max_message_bytes, first)
            try:
                # A byte for success, and the message or an error text.
                answer = b"\1" + encode_message(await offer.handler(request))
            except Exception as error:  # noqa: BLE001 - only this request fails
                reason = f"{type(error).__name__}: {error}"
                if self._on_event is not None:
                    self._on_event("ros_request_failed", service=header["service"], reason=reason)
                text = f"the service has failed: {reason:.500}"
                answer = b"\0" + encode_message(text.encode())
            writer.write(answer)
            await writer.drain()
            if header.get("persistent") != "1":
                return

    async def _serve_subscriber(
        self, header: Mapping[str, str], reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        topic = self._topics.get(header["topic"])
        if topic is None:
            _refuse(writer, f"[{self.name}] does not publish [{header['topic']:.200}]")
            return
        if _refuse_other_type(header, topic.type, f"topic [{topic.name}]", writer):
            return
        writer.write(
            encode_header(
                {
                    "callerid": self.name,
                    "topic": topic.name,
                    "type": topic.type.name,
                    "md5sum": topic.type.digest,
                    "message_definition": topic.type.definition,
                    "latching": "1",
                }
            )
        )
        topic.add(writer)
        try:
            await reader.read(1)  # a subscriber sends nothing more until it closes
        finally:
            topic.subscribers.discard(writer)

    @contextlib.contextmanager
    def _connected(self, writer: asyncio.StreamWriter) -> Iterator[bool]:
        """Count a connection, and close it at the end; yield whether there is room for it."""
        task = asyncio.current_task()
        assert task is not None
        has_room = len(self._connections) < MAX_CONNECTIONS
        self._connections.add(task)
        # A connection to a machine that was switched off must end some day.
        stream = writer.get_extra_info("socket")
        stream.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        try:
            yield has_room
        except (
            *(OSError, EOFError, ValueError, TypeError),
            *(TimeoutError, CallError, LookupError),
            *(asyncio.LimitOverrunError, asyncio.CancelledError),
        ):
            pass  # the peer is gone, or breaks the protocol
        except Exception as error:  # noqa: BLE001 - what a peer sends may raise anything
            if self._on_event is not None:
                self._on_event(DEFECT, **defect_fields(error))
        finally:
            self._connections.discard(task)
            writer.close()


def _refuse_other_type(
    header: Mapping[str, str],
    type_: ServiceType | TopicType,
    what: str,
    writer: asyncio.StreamWriter,
) -> bool:
    """Refuse a peer that expects another type; return whether it was refused."""
    digest = header.get("md5sum")
    if digest in (type_.digest, ANY_TYPE):
        return False
    _refuse(
        writer,
        f"{what} is of type {type_.name} with MD5 {type_.digest}; {digest!r:.60} was asked for",
    )
    return True


def _refuse(writer: asyncio.StreamWriter, reason: str) -> None:
    writer.write(encode_header({"error": reason}))
