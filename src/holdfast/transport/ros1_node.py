"""A node of ROS 1 that needs nothing of ROS: it offers services and topics in an asyncio loop.

It is a node as any other: ``rosnode``, ``rosservice`` and ``rostopic`` find it, and clients in
rospy and roscpp call it. Three things are different. Nothing in it waits for longer than it may.
Whoever does not read what is sent holds nobody else up. And it does not matter whether the master
lives: the node looks every second whether the master still knows it, and says it all again to one
that does not.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import xmlrpc.client
from collections.abc import Awaitable, Callable, Iterator, Mapping
from typing import Any, Final, NamedTuple

from holdfast.errors import TransportError
from holdfast.transport.contract import DEFAULT_MAX_MESSAGE_BYTES
from holdfast.transport.endpoints import host_and_port, why_not_bound
from holdfast.transport.ros1_calls import (
    CallError,
    Connection,
    HttpHead,
    message,
    offers_service,
)
from holdfast.transport.tcpros import (
    ANY_TYPE,
    MAX_HEADER_BYTES,
    ServiceType,
    Surroundings,
    decode_header,
    encode_answer,
    encode_header,
    encode_message,
    encode_refusal,
    header_of_service,
)

__all__ = ["RosNode", "ServiceHandler", "Topic", "TopicType"]

ServiceHandler = Callable[[bytes], Awaitable[bytes]]
"""Gets a request's bytes and returns the answer's."""

MAX_CONNECTIONS: Final = 1024
"""From clients, subscribers and tools together."""

_OPENING_S: Final = 5.0
_IDLE_S: Final = 60.0
"""A connection for questions to a node on which nothing is asked for so long is closed."""

_REQUEST_S: Final = 10.0
"""From a request's first byte to its last: who takes longer loses the connection."""

_MASTER_S: Final = 1.0
"""For one question to the master."""

_LOOK_EVERY_S: Final = 1.0
_AGAIN_S: Final = 0.1
"""After the master could not be reached."""

_MAX_CALL_BYTES: Final = 1 << 20
_MAX_UNREAD_BYTES: Final = 1 << 20
"""Of messages that wait for one subscriber; then it misses some."""

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
    """A topic that this node publishes; made by :meth:`RosNode.publish`."""

    def __init__(self, name: str, type_: TopicType, latched: bool) -> None:
        self.name = name
        self.type = type_
        self._latched = latched
        self._last: bytes | None = None
        self._subscribers: set[asyncio.StreamWriter] = set()

    def send(self, payload: bytes) -> None:
        """Send a message to all that are subscribed; never waits."""
        message = encode_message(payload)
        if self._latched:
            self._last = message
        for writer in list(self._subscribers):
            self._write(writer, message)

    def add(self, writer: asyncio.StreamWriter) -> None:
        """Take a subscriber, which then gets the last message of a latched topic."""
        self._subscribers.add(writer)
        if self._last is not None:
            self._write(writer, self._last)

    @property
    def num_subscribers(self) -> int:
        """How many there are."""
        return len(self._subscribers)

    def remove(self, writer: asyncio.StreamWriter) -> None:
        """Send a subscriber nothing more."""
        self._subscribers.discard(writer)

    @property
    def is_latched(self) -> bool:
        """Whether who comes late gets the last message."""
        return self._latched

    @staticmethod
    def _write(writer: asyncio.StreamWriter, message: bytes) -> None:
        waiting = writer.transport.get_write_buffer_size()
        if waiting == 0 or waiting + len(message) <= _MAX_UNREAD_BYTES:
            writer.write(message)


class RosNode:
    """A node; all methods are called on the loop's thread.

    Parameters
    ----------
    name : str
        As the master is to know it.
    surroundings : Surroundings
    on_shutdown : callable or None
        Is told why this node is to end: somebody has asked for it, or another one has its name.
    on_event : callable or None
        Is told ``ros_master`` with ``status`` (``registered``, ``unreachable``) and ``reason``, and
        ``ros_request_failed`` with ``service`` and ``reason``.
    max_message_bytes : int
        Who sends a larger request loses the connection.
    """

    def __init__(
        self,
        name: str,
        surroundings: Surroundings,
        *,
        on_shutdown: Callable[[str], None] | None = None,
        on_event: Callable[..., None] | None = None,
        max_message_bytes: int = DEFAULT_MAX_MESSAGE_BYTES,
    ) -> None:
        self.name = surroundings.resolved(name)
        self._surroundings = surroundings
        self._on_shutdown = on_shutdown
        self._on_event = on_event
        self._max_message_bytes = max_message_bytes
        self._services: dict[str, _Offer] = {}
        self._elsewhere: dict[str, int] = {}
        self._topics: dict[str, Topic] = {}
        self._master = Connection(surroundings.master, self.name)
        self._servers: list[asyncio.Server] = []
        self._uri = self._service_uri = ""
        self._port = 0
        self._connections: set[asyncio.Task[None]] = set()
        self._keeping: asyncio.Task[None] | None = None
        self._is_known = False
        self._told: str | None = None

    def offer(self, name: str, type_: ServiceType, handler: ServiceHandler) -> None:
        """Offer a service; before the start.

        Parameters
        ----------
        name : str
        type_ : ServiceType
        handler : callable
            What it raises, the caller gets in words, and the log.
        """
        self._services[self._surroundings.resolved(name)] = _Offer(type_, handler)

    def offer_at(self, name: str, port: int) -> None:
        """Say that somebody else in this process offers a service; before the start.

        Parameters
        ----------
        name : str
        port : int
            Where that one listens.
        """
        self._elsewhere[self._surroundings.resolved(name)] = port

    def publish(self, name: str, type_: TopicType, *, latched: bool = False) -> Topic:
        """Return a topic to publish on; before the start.

        Parameters
        ----------
        name : str
        type_ : TopicType
        latched : bool
            Whether who subscribes late gets the last message.
        """
        topic = Topic(self._surroundings.resolved(name), type_, latched)
        self._topics[topic.name] = topic
        return topic

    async def start(self, within_s: float = 2.0) -> bool:
        """Listen, and register with the master.

        Parameters
        ----------
        within_s : float
            Wait for the master so long; after that it is asked again and again meanwhile.

        Returns
        -------
        bool
            Whether the master knows this node.

        Raises
        ------
        TransportError
            If it cannot listen.
        """
        surroundings = self._surroundings
        try:
            for serve in (self._serve_node, self._serve_tcpros):
                server = await asyncio.start_server(
                    serve, surroundings.bind, 0, limit=MAX_HEADER_BYTES
                )
                self._servers.append(server)
        except OSError as error:
            self._stop()
            raise TransportError(
                f"cannot listen on {surroundings.bind}: {why_not_bound(error)}"
            ) from error
        ports = [server.sockets[0].getsockname()[1] for server in self._servers]
        self._uri = f"http://{host_and_port(surroundings.host, ports[0])}/"
        self._port = ports[1]
        registered = asyncio.Event()
        self._keeping = asyncio.create_task(self._keep_known(registered))
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(registered.wait(), within_s)
        return self._is_known

    async def close(self, within_s: float = 1.0) -> None:
        """Take leave of the master, and end all connections; may be repeated."""
        keeping, self._keeping = self._keeping, None
        self._stop()
        tasks = [*self._connections, *([] if keeping is None else [keeping])]
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks, timeout=within_s)
        if self._is_known:
            self._is_known = False
            with contextlib.suppress(CallError):
                await self._master.calls(self._farewell(), within_s=within_s)
        self._master.close()

    def _stop(self) -> None:
        for server in self._servers:
            server.close()
        self._servers.clear()

    # -- the master --------------------------------------------------------------------------------

    def _uris_of_services(self) -> dict[str, str]:
        host = self._surroundings.host
        ports = {**dict.fromkeys(self._services, self._port), **self._elsewhere}
        return {name: f"rosrpc://{host_and_port(host, port)}" for name, port in ports.items()}

    async def _keep_known(self, registered: asyncio.Event) -> None:
        """Register with each master that does not know this node."""
        while True:
            try:
                # At first a process that has died may still stand there under these names.
                if not self._is_known or not await self._is_known_to_master():
                    await self._register()
                self._is_known = True
                self._tell("registered", self._surroundings.master)
                registered.set()
                pause_s = _LOOK_EVERY_S
            except CallError as error:
                self._tell("unreachable", str(error))
                pause_s = _AGAIN_S
            except Exception as error:  # noqa: BLE001 - nothing ends the node's registration
                self._tell("unreachable", f"{type(error).__name__}: {error}")
                pause_s = _LOOK_EVERY_S
            await asyncio.sleep(pause_s)

    async def _is_known_to_master(self) -> bool:
        services = self._uris_of_services()
        asked = [
            ("lookupNode", (self.name, self.name)),
            *(("lookupService", (self.name, name)) for name in services),
        ]
        node, *found = await self._master.calls(asked, within_s=_MASTER_S)
        if node is None or None in found:
            return False
        # What another node has taken over since is that one's, for as long as it offers it.
        others = [
            offers_service(str(uri), name, within_s=_MASTER_S)
            for (name, own), uri in zip(services.items(), found, strict=True)
            if uri != own
        ]
        return False not in await asyncio.gather(*others)

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

    def _farewell(self) -> list[tuple[str, tuple[object, ...]]]:
        return [
            *(
                ("unregisterService", (self.name, *each))
                for each in self._uris_of_services().items()
            ),
            *(("unregisterPublisher", (self.name, name, self._uri)) for name in self._topics),
        ]

    def _tell(self, status: str, reason: str) -> None:
        if self._on_event is not None and self._told != status:
            self._on_event("ros_master", status=status, reason=reason)
        self._told = status

    # -- what others ask a node --------------------------------------------------------------------

    async def _serve_node(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with self._connected(writer) as is_welcome:
            while is_welcome and await self._answer_one(reader, writer):
                pass

    async def _answer_one(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> bool:
        """Answer one question; return whether another one may follow."""
        async with asyncio.timeout(_IDLE_S):
            head = await HttpHead.read(reader)
        async with asyncio.timeout(_OPENING_S):
            if not 0 <= head.size <= _MAX_CALL_BYTES:
                return False
            content = await reader.readexactly(head.size)
            answer: tuple[tuple[int, str, Any]] | xmlrpc.client.Fault
            try:
                arguments, method = xmlrpc.client.loads(content)
                answer = (self._answer(str(method), arguments),)
            except Exception as error:  # noqa: BLE001 - however the parser takes it, it is none
                reason = f"{type(error).__name__}: {error}"
                answer = xmlrpc.client.Fault(1, f"this is no question to a node: {reason:.500}")
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
                return _OK, "", self._surroundings.master
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
                return _OK, "", ["TCPROS", self._surroundings.host, self._port]
            case _:
                return _UNKNOWN, f"{method!r:.100} is no question to a node", 0

    # -- services and topics -----------------------------------------------------------------------

    async def _serve_tcpros(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        with self._connected(writer) as is_welcome:
            if not is_welcome:
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
        if _means_another_type(header, offer.type, f"service [{header['service']}]", writer):
            return
        writer.write(encode_header(header_of_service(self.name, header["service"], offer.type)))
        if header.get("probe") == "1":
            await writer.drain()
            return
        while True:
            # Who has begun no request may wait for ever.
            first = await reader.readexactly(1)
            async with asyncio.timeout(_REQUEST_S):
                request = await message(reader, self._max_message_bytes, first)
            try:
                answer = encode_answer(await offer.handler(request))
            except Exception as error:  # noqa: BLE001 - a defect costs its request alone
                reason = f"{type(error).__name__}: {error}"
                if self._on_event is not None:
                    self._on_event("ros_request_failed", service=header["service"], reason=reason)
                answer = encode_refusal(f"the service has failed: {reason:.500}")
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
        if _means_another_type(header, topic.type, f"topic [{topic.name}]", writer):
            return
        writer.write(
            encode_header(
                {
                    "callerid": self.name,
                    "topic": topic.name,
                    "type": topic.type.name,
                    "md5sum": topic.type.digest,
                    "message_definition": topic.type.definition,
                    "latching": "1" if topic.is_latched else "0",
                }
            )
        )
        topic.add(writer)
        try:
            await reader.read(1)  # it says nothing more, and then it is gone
        finally:
            topic.remove(writer)

    @contextlib.contextmanager
    def _connected(self, writer: asyncio.StreamWriter) -> Iterator[bool]:
        """Hold a connection, and close it whatever happens on it."""
        task = asyncio.current_task()
        assert task is not None
        is_welcome = len(self._connections) < MAX_CONNECTIONS
        self._connections.add(task)
        # A machine that is switched off says nothing, and leaves no connection here for ever.
        stream = writer.get_extra_info("socket")
        stream.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        try:
            yield is_welcome
        except (
            *(OSError, EOFError, ValueError, TypeError),
            *(TimeoutError, TransportError, LookupError),
            *(asyncio.LimitOverrunError, asyncio.CancelledError),
        ):
            pass  # whoever it was has gone, or does not speak as it should
        finally:
            self._connections.discard(task)
            writer.close()


def _means_another_type(
    header: Mapping[str, str],
    type_: ServiceType | TopicType,
    what: str,
    writer: asyncio.StreamWriter,
) -> bool:
    """Tell whether somebody asks for another type than there is; then refuse."""
    asked = header.get("md5sum")
    if asked in (type_.digest, ANY_TYPE):
        return False
    _refuse(
        writer,
        f"{what} is of type {type_.name} with MD5 {type_.digest}; {asked!r:.60} was asked for",
    )
    return True


def _refuse(writer: asyncio.StreamWriter, reason: str) -> None:
    writer.write(encode_header({"error": reason}))
