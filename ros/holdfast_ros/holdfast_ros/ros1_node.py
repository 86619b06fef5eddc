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
from typing import Any, Final

from holdfast.errors import DEFECT, TransportError, defect_fields
from holdfast.printable import brief
from holdfast.runtime.addresses import host_and_port, why_not_bound
from holdfast_ros.messages import MAX_BYTES
from holdfast_ros.ros1_environment import RosEnvironment, RosType
from ros1_master_guard.errors import CallError
from ros1_master_guard.headers import (
    ANY_TYPE,
    MAX_HEADER_BYTES,
    decode_header,
    encode_header,
    encode_message,
)
from ros1_master_guard.ros1_calls import MAX_SHORT_BYTES, Connection, HttpHead, decoded, message

ServiceHandler = Callable[[bytes], Awaitable[bytes]]
"""Takes a request's bytes and returns the response's."""

_OPENING_S: Final = 5.0
_IDLE_S: Final = 60.0  # an XML-RPC connection without a call for this long is closed
_REQUEST_S: Final = 10.0  # from a request's first byte to its last
_MASTER_S: Final = 1.0  # for one call to the master
_CHECK_INTERVAL_S: Final = 1.0
_RETRY_S: Final = 0.1  # after the master could not be reached
_MAX_UNREAD_BYTES: Final = 64 << 10
"""Bound on what waits for a subscriber; further messages are dropped."""

_MAX_CALL_BYTES: Final = 8 << 10
"""An XML-RPC call to a node has some hundred bytes. Parsing takes a microsecond for each of them,
during which nobody else is served."""

_TURNS_TO_BEGIN: Final = 4
"""Turns of the loop until asyncio serves a connection that it has accepted. Before that it is in no
list of ours, and would stay open."""

_UNKNOWN, _OK = -1, 1


class Topic:
    """A latched topic that this node publishes; made by :meth:`RosNode.publish`."""

    def __init__(self, name: str, type_: RosType) -> None:
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
        on_shutdown: Callable[[str], None] | None = None,
        on_event: Callable[..., None] | None = None,
    ) -> None:
        self.name = environment.resolved(name)
        self._environment = environment
        self._on_shutdown = on_shutdown
        self._on_event = on_event or (lambda _, **__: None)
        self._services: dict[str, tuple[RosType, ServiceHandler]] = {}
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

    def offer(self, name: str, type_: RosType, handler: ServiceHandler) -> None:
        """Offer a service, before the start; the caller and the log get the handler's errors."""
        self._services[self._environment.resolved(name)] = type_, handler

    def publish(self, name: str, type_: RosType) -> Topic:
        """Add a topic, before the start; new subscribers get its last message."""
        topic = Topic(self._environment.resolved(name), type_)
        self._topics[topic.name] = topic
        return topic

    async def start(self, within_s: float = 2.0) -> None:
        """Listen, and register with the master, after ``within_s`` in the background.

        Raises TransportError if it cannot listen.
        """
        environment = self._environment
        try:
            for serve, size in (
                (self._serve_node, _MAX_CALL_BYTES),
                (self._serve_tcpros, MAX_HEADER_BYTES),
            ):
                self._servers.append(
                    await asyncio.start_server(serve, environment.bind, 0, limit=size)
                )
        except OSError as error:
            self._stop()
            reason = f"cannot listen on {environment.bind}: {why_not_bound(error)}"
            raise TransportError(reason) from error
        ports = [server.sockets[0].getsockname()[1] for server in self._servers]
        self._uri = f"http://{host_and_port(environment.host, ports[0])}/"
        self._port = ports[1]
        registered = asyncio.Event()
        self._registration = asyncio.create_task(self._stay_registered(registered))
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(registered.wait(), within_s)

    async def close(self, within_s: float = 1.0) -> None:
        """Unregister, and end all connections; may be repeated."""
        loop = asyncio.get_running_loop()
        for server in self._servers:
            for listening in server.sockets:
                loop.remove_reader(listening.fileno())
        for _ in range(_TURNS_TO_BEGIN):
            await asyncio.sleep(0)
        self._stop()
        tasks = {*self._connections, *filter(None, [self._registration])}
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks, timeout=within_s)
        if self._is_known:
            self._is_known = False
            calls: list[tuple[str, tuple[object, ...]]] = [
                ("unregisterService", (self.name, *each)) for each in self._service_uris().items()
            ]
            calls += [
                ("unregisterPublisher", (self.name, name, self._uri)) for name in self._topics
            ]
            with contextlib.suppress(CallError):
                await self._master.calls(calls, within_s=within_s)
        self._master.close()

    def _stop(self) -> None:
        for server in self._servers:
            server.close()
        self._servers.clear()

    # -- the master --------------------------------------------------------------------------------

    def _service_uris(self) -> dict[str, str]:
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
        lookups = [("lookupNode", self.name), *(("lookupService", each) for each in self._services)]
        calls = [(method, (self.name, name)) for method, name in lookups]
        return None not in await self._master.calls(calls, within_s=_MASTER_S)

    async def _register(self) -> None:
        for name, uri in self._service_uris().items():
            what = "registerService", name, uri, self._uri
            await self._master.call(*what, within_s=_MASTER_S)
        for topic in self._topics.values():
            what = "registerPublisher", topic.name, topic.type.name, self._uri
            await self._master.call(*what, within_s=_MASTER_S)

    def _report_master(self, status: str, reason: str) -> None:
        if self._master_status != status:
            self._on_event("ros_master", status=status, reason=reason)
        self._master_status = status

    # -- XML-RPC ---------------------------------------------------------------------------------

    async def _serve_node(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with self._connected(writer):
            while await self._serve_request(reader, writer):
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
                return _UNKNOWN, f"{brief(method)} is no method of a node", 0

    # -- services and topics -----------------------------------------------------------------------

    async def _serve_tcpros(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        with self._connected(writer):
            async with asyncio.timeout(_OPENING_S):
                header = decode_header(await message(reader, MAX_HEADER_BYTES))
            service, topic = header.get("service"), header.get("topic")
            if service in self._services:
                type_, handler = self._services[service]
                more = {"request_type": f"{type_.name}Request"}
                more |= {"response_type": f"{type_.name}Response", "service": service}
                if self._agreed(header, type_, f"service [{service}]", more, writer):
                    await self._serve_calls(header, handler, reader, writer)
            elif topic in self._topics:
                type_ = self._topics[topic].type
                more = {"message_definition": type_.definition, "latching": "1", "topic": topic}
                if self._agreed(header, type_, f"topic [{topic}]", more, writer):
                    self._topics[topic].add(writer)
                    try:
                        await reader.read(1)  # a subscriber sends nothing more until it closes
                    finally:
                        self._topics[topic].subscribers.discard(writer)
            else:
                reason = "the header names no service and no topic"
                if service or topic:
                    verb = "has no service" if service else "does not publish"
                    reason = f"[{self.name}] {verb} [{service or topic:.200}]"
                writer.write(encode_header({"error": reason}))

    def _agreed(
        self,
        header: Mapping[str, str],
        type_: RosType,
        what: str,
        more: Mapping[str, str],
        writer: asyncio.StreamWriter,
    ) -> bool:
        """Answer a peer's header; return whether the peer expects this type."""
        digest = header.get("md5sum")
        agreed = digest in (type_.digest, ANY_TYPE)
        if agreed:
            fields = {"callerid": self.name, "type": type_.name, "md5sum": type_.digest, **more}
        else:
            reason = f"{what} is of type {type_.name} with MD5 {type_.digest}"
            fields = {"error": f"{reason}; {brief(digest)} was asked for"}
        writer.write(encode_header(fields))
        return agreed

    async def _serve_calls(
        self,
        header: Mapping[str, str],
        handler: ServiceHandler,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
    ) -> None:
        while header.get("probe") != "1":
            # A connection may stay idle between requests.
            first = await reader.readexactly(1)
            async with asyncio.timeout(_REQUEST_S):
                request = await message(reader, MAX_BYTES, first)
            try:
                # A byte for success, and the message or an error text.
                answer = b"\1" + encode_message(await handler(request))
            except Exception as error:  # noqa: BLE001 - only this request fails
                reason = f"{type(error).__name__}: {error}"
                self._on_event("ros_request_failed", service=header["service"], reason=reason)
                text = f"the service has failed: {reason:.500}"
                answer = b"\0" + encode_message(text.encode())
            writer.write(answer)
            await writer.drain()
            if header.get("persistent") != "1":
                return

    @contextlib.contextmanager
    def _connected(self, writer: asyncio.StreamWriter) -> Iterator[None]:
        """Keep a connection's task, and close the connection at the end."""
        task = asyncio.current_task()
        assert task is not None
        self._connections.add(task)
        # A connection to a machine that was switched off must end some day.
        stream = writer.get_extra_info("socket")
        stream.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        gone = OSError, EOFError, asyncio.LimitOverrunError, asyncio.CancelledError
        try:
            yield
        except (*gone, ValueError, TypeError, LookupError, CallError):
            pass  # the peer is gone, or breaks the protocol
        except Exception as error:  # noqa: BLE001 - what a peer sends may raise anything
            self._on_event(DEFECT, **defect_fields(error))
        finally:
            self._connections.discard(task)
            writer.close()
