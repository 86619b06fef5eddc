"""The service's end of streams: links of many robots, and the calls that come over them.

A reply is sent when the call ends or this turn of the loop does, whichever comes first: so the last
reply and the end of a call are one frame.
"""

from __future__ import annotations

import asyncio
import socket
import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Final

from holdfast.errors import TransportError
from holdfast.transport.calls import too_large
from holdfast.transport.contract import DEFAULT_MAX_MESSAGE_BYTES, IncomingCall
from holdfast.transport.dialer import Dialer
from holdfast.transport.endpoints import (
    Endpoint,
    TlsFiles,
    check_credentials,
    check_direction,
    check_endpoint,
    check_name,
)
from holdfast.transport.frames import (
    CALL,
    END,
    HEADER_BYTES,
    LAST,
    REPLY,
    Frame,
    FrameError,
    Hello,
    encode_hello,
)
from holdfast.transport.links import HalfReceived, Link, LinkSettings, receive_buffer
from holdfast.transport.listener import MAX_SILENT, Listener, one_too_many
from holdfast.transport.revocation import REVOKED_FILE, revoked_serials
from holdfast.transport.turns import Turns

if TYPE_CHECKING:
    import ssl

    from holdfast.transport.tls import PeerCertificate

if TYPE_CHECKING:
    from holdfast.transport.datagrams import DatagramSockets
    from holdfast.transport.ros1_node import RosNode

__all__ = ["MAX_LINKS", "MAX_UNKNOWN", "StreamServiceTransport"]

MAX_LINKS: Final = 4096
"""Of robots, at the same time. If there are more, who has the most loses one."""

_SAID_GOODBYE: Final = "said goodbye"
_NO_GOODBYE: Final = "closed the connection without a goodbye, as one that is killed does"
_SERVICE_ENDS: Final = "this service ends"
_REVOKED: Final = "has a certificate that has been revoked"
_FOREIGN: Final = "has a certificate of an authority that is not believed any more"

_MAX_UNGREETED: Final = 256
"""Connections that have sent something, but no hello yet."""

MAX_UNKNOWN: Final = MAX_SILENT + _MAX_UNGREETED
"""Connections of which nobody knows yet who they are: so many sockets more than links."""


class _StreamCall:
    """A request as the service sees it; see :class:`~holdfast.transport.contract.IncomingCall`."""

    __slots__ = (
        "_calls",
        "_link",
        "_loop",
        "_number",
        "_open",
        "_reply",
        "is_being_delivered",
        "payload",
        "robot",
    )

    def __init__(
        self,
        link: Link,
        number: int,
        payload: bytes,
        calls: set[_StreamCall],
        loop: asyncio.AbstractEventLoop,
    ) -> None:
        self._link = link
        self._number = number
        self._calls = calls
        self._loop = loop
        self._reply: bytes | None = None
        self._open = True
        self.is_being_delivered = False
        self.payload = payload
        self.robot = _certified(link)

    def reply(self, payload: bytes) -> None:
        """Send a reply. A robot that is gone is no error."""
        if not self._open or len(payload) > self._link.max_message_bytes:
            return
        if self._reply is not None:
            self.flush()
        elif not self.is_being_delivered:
            self._loop.call_soon(self.flush)
        self._reply = payload

    def end(self) -> None:
        """End the call. May be repeated."""
        if not self._open:
            return
        self._open = False
        self._calls.discard(self)
        reply, self._reply = self._reply, None
        if reply is None:
            self._link.send_message(END, self._number)
        else:
            self._link.send_message(LAST, self._number, reply)

    def flush(self) -> None:
        """Send a reply that waits for the end."""
        reply, self._reply = self._reply, None
        if reply is not None:
            self._link.send_message(REPLY, self._number, reply)


class StreamServiceTransport:
    """The service's end: see :class:`~holdfast.transport.contract.ServiceTransport`.

    Parameters
    ----------
    name : str
        Under which robots know the service.
    boot : str
        Of this process; no other one may ever have had it.
    listen, connect : sequence of str
        Endpoints at which robots connect, and of robots that listen.
    listening : sequence of socket
        If given, a socket for each of ``listen`` that listens there already, for the process that
        made it as well.
    lease_ms : float
        Robots give this service up when nothing comes from it for this long; it lets itself be
        heard more often. How long a robot may be silent, the robot says.
    max_message_bytes : int
        A larger request is refused and not kept.
    max_links : int or None
        Of robots, at the same time; None: :data:`MAX_LINKS`.
    tls : TlsFiles or None
        The service's credentials, for ``tls``.
    on_event : callable or None
        Is told what is worth a line of a log: ``link_refused`` with ``reason`` and, if it is known,
        ``robot``; ``robot_connected`` with ``robot``; ``robot_disconnected`` with ``robot`` and
        ``reason``. Each has the robot's ``address``, None over a local socket.
    on_shutdown : callable or None
        Is told why this process is to end where ROS asks that, or another one takes its name there.

    Raises
    ------
    TransportError
        If an endpoint, the name, the boot or the credentials cannot be used.
    """

    def __init__(
        self,
        name: str,
        *,
        boot: str,
        listen: Sequence[str] = (),
        connect: Sequence[str] = (),
        listening: Sequence[socket.socket] = (),
        lease_ms: float = 400.0,
        max_message_bytes: int = DEFAULT_MAX_MESSAGE_BYTES,
        max_links: int | None = None,
        tls: TlsFiles | None = None,
        on_event: Callable[..., None] | None = None,
        on_shutdown: Callable[[str], None] | None = None,
        needs_endpoint: bool = True,
    ) -> None:
        check_name("name of a service", name)
        check_name("boot of a service", boot)
        if needs_endpoint and not listen and not connect:
            raise TransportError(
                f"service {name} has no endpoint: give one, as in tcp/127.0.0.1:7447"
            )
        self._listen = [check_endpoint(text, listens=True) for text in listen]
        self._connect = [check_endpoint(text, listens=False) for text in connect]
        for endpoint in (*self._listen, *self._connect):
            check_credentials(endpoint, tls)
        for endpoint in self._connect:
            check_direction(endpoint, service_listens=False)
        self._listening: Sequence[socket.socket | None] = listening or [None] * len(listen)
        self._sockets: DatagramSockets | None = None
        if any(endpoint.protocol == "udp" for endpoint in self._listen):
            from holdfast.transport.datagrams import DatagramSockets
            from holdfast.transport.sealing import require_cryptography

            require_cryptography()
            self._sockets = DatagramSockets()
        self._boot = boot
        self._max_links = MAX_LINKS if max_links is None else max_links
        self._tls = tls
        self._context: ssl.SSLContext | None = None
        # Who has shaken hands is looked up here; a handshake knows the files of when it began.
        self._revoked: frozenset[int] = frozenset()
        self._believed: frozenset[bytes] = frozenset()
        if tls is not None:
            self._read_credentials(tls)
        self._settings = LinkSettings(
            lambda: encode_hello("service", name, boot, lease_ms, time.time()),
            lease_ms,
            max_message_bytes,
            HalfReceived(2 * (max_message_bytes + HEADER_BYTES)),
            Turns(),
            receive_buffer(),
            must_read=True,
        )
        self._on_event = on_event
        self._on_shutdown = on_shutdown
        self._deliver: Callable[[IncomingCall], None] | None = None
        self._started = False
        self._takes_links = True
        self._listeners: list[Listener] = []
        self._dialers: dict[Endpoint, Dialer] = {}
        self._dialled: dict[Link, Dialer] = {}
        self._ungreeted: dict[Link, bytes] = {}
        self._links: dict[Link, set[_StreamCall]] = {}
        self._closing: set[asyncio.Future[None]] = set()
        self._gone: asyncio.Future[None] | None = None
        self._node: RosNode | None = None

    @property
    def endpoints(self) -> tuple[str, ...]:
        """Where robots can connect; once started, with the ports that were free instead of 0."""
        return tuple(str(endpoint) for endpoint in self._listen)

    async def start(self, deliver: Callable[[IncomingCall], None]) -> None:
        """Listen, be seen, and deliver calls; returns when robots can connect.

        Raises
        ------
        TransportError
            If it cannot listen there; the message names the endpoint.
        """
        if self._started:
            raise TransportError("this transport was started before; make another one")
        self._started = True
        self._deliver = deliver
        try:
            for endpoint, listening in zip(self._listen, self._listening, strict=True):
                accepted = partial(self._accepted, endpoint)
                place = endpoint
                if endpoint.is_ros1:
                    from holdfast.transport.ros1 import place_to_listen

                    place = place_to_listen()
                self._listeners.append(Listener(place, accepted, listening=listening))
        except TransportError:
            self._stop_listening()
            raise
        ports = {
            endpoint: listener.endpoint.port
            for endpoint, listener in zip(self._listen, self._listeners, strict=True)
            if endpoint.is_ros1
        }
        self._listen = [
            endpoint if endpoint.is_ros1 else listener.endpoint
            for endpoint, listener in zip(self._listen, self._listeners, strict=True)
        ]
        for endpoint in self._connect:
            dialer = Dialer(endpoint, partial(self._make_dialled, endpoint))
            self._dialers[endpoint] = dialer
            dialer.start()
        if ports:
            from holdfast.transport.ros1 import make_node

            self._node = make_node(ports, self._on_event, self._on_shutdown)
            await self._node.start()

    def dismiss(self) -> asyncio.Future[None]:
        """Take no new links, and ask the robots to go elsewhere.

        A robot leaves once it is owed nothing and has found another process, or nobody at all.
        Until then it is answered: so it loses no time by the search.

        Returns
        -------
        Future
            Done when all have gone.
        """
        self._stop_listening()
        self._gone = asyncio.get_running_loop().create_future()
        for link in list(self._ungreeted):
            link.end("")
        for link in list(self._links):
            link.say_goodbye()
        self._note_gone()
        return self._gone

    def _note_gone(self) -> None:
        if self._gone is not None and not self._links and not self._gone.done():
            self._gone.set_result(None)

    def _stop_listening(self) -> None:
        for listener in self._listeners:
            listener.close()
        for dialer in self._dialers.values():
            dialer.stop()
        self._takes_links = False

    async def close(self, timeout_s: float = 1.0) -> None:
        """End all calls, send what was to be sent, and close all links, within this time."""
        self._deliver = None
        self._started = True
        self._stop_listening()
        for link, calls in list(self._links.items()):
            for call in list(calls):
                call.end()
            link.end(_SERVICE_ENDS, goodbye="")
        for link in list(self._ungreeted):
            link.end("")
        node, self._node = self._node, None
        closing = set(self._closing)
        if node is not None:
            closing.add(asyncio.ensure_future(node.close(timeout_s)))
        if closing:
            await asyncio.wait(closing, timeout=timeout_s)
        if self._sockets is not None:
            self._sockets.close()

    def end_links(self, objection: Callable[[PeerCertificate], str | None]) -> int:
        """End the links of robots whose certificate there is something to be said against.

        Parameters
        ----------
        objection : callable
            Returns what such a robot is told, as the rest of a sentence about it; else None.

        Returns
        -------
        int
            How many there were.
        """
        ended = 0
        for link in (*self._links, *self._ungreeted):
            reason = None if link.peer is None or link.ended else objection(link.peer)
            if reason is not None:
                link.end(reason, goodbye=reason, refused=True)
                ended += 1
        return ended

    @property
    def num_revoked(self) -> int:
        """How many certificates are in the list of revoked ones."""
        return len(self._revoked)

    def reload_credentials(self) -> int:
        """Read the credentials anew, and end the links of robots that are not believed any more.

        They are those that are revoked now, and those that an authority has signed which was
        replaced.

        Returns
        -------
        int
            How many links were ended; all others go on as they are.

        Raises
        ------
        TransportError
            If they cannot be used; then those of before are kept.
        """
        if self._tls is None:
            return 0
        self._read_credentials(self._tls)
        return self.end_links(self._objection)

    def _objection(self, peer: PeerCertificate) -> str | None:
        """Return why a certificate is believed no more, as the rest of a sentence about a robot."""
        if peer.serial_number in self._revoked:
            return _REVOKED
        if not peer.authorities <= self._believed:
            return _FOREIGN
        return None

    # -- links -----------------------------------------------------------------------------------

    def _read_credentials(self, tls: TlsFiles) -> None:
        # OpenSSL takes long to load, which counts in the time that a service takes to be ready.
        from holdfast.transport.tls import server_context

        context = server_context(tls, self._boot)
        self._revoked = revoked_serials(tls.authority.with_name(REVOKED_FILE))
        self._believed = frozenset(context.get_ca_certs(binary_form=True))
        self._context = context

    def _make_link(self, endpoint: Endpoint, network: bytes = b"", *, dialled: bool) -> Link:
        tls = None
        if endpoint.is_encrypted:
            from holdfast.transport.tls import TlsStream

            assert self._context is not None
            tls = TlsStream(self._context)
        link: Link
        if endpoint.protocol == "udp":
            from holdfast.transport.datagrams import ServiceDatagramLink

            assert tls is not None and self._sockets is not None
            link = ServiceDatagramLink(self, self._settings, tls=tls, sockets=self._sockets)
        elif endpoint.is_ros1:
            from holdfast.transport.ros1 import ServiceRosLink

            link = ServiceRosLink(self, self._settings, endpoint)
        else:
            link = Link(self, self._settings, speaks_first=dialled and tls is None, tls=tls)
        if len(self._ungreeted) >= _MAX_UNGREETED:
            other = one_too_many(self._ungreeted)
            del self._ungreeted[other]
            other.end("has said no hello, and others wait", abort=True)
        self._ungreeted[link] = network
        self._closing.add(link.closed)
        link.closed.add_done_callback(self._closing.discard)
        return link

    def _make_dialled(self, endpoint: Endpoint) -> Link:
        link = self._make_link(endpoint, dialled=True)
        self._dialled[link] = self._dialers[endpoint]
        return link

    def _accepted(self, endpoint: Endpoint, connection: socket.socket, network: bytes) -> None:
        link = self._make_link(endpoint, network, dialled=False)
        link.connecting = asyncio.get_running_loop().create_task(link.connect(connection))

    def established(self, link: Link) -> None:
        """Refuse who is not believed any more, before anything of it is read."""
        assert link.peer is not None
        objection = self._objection(link.peer)
        if objection is not None:
            link.end(objection, goodbye=objection, refused=True)

    def refusal(self, link: Link, hello: Hello) -> str | None:
        """Refuse what is no robot, and who would have more than a share of room."""
        if hello.role != "robot":
            return "is a service, and a robot was expected"
        if link.peer is not None and hello.name not in ("", link.peer.name):
            return f"says that it is {hello.name}, and shows the certificate of {link.peer.name}"
        if len(self._links) >= self._max_links and not self._make_room(_certified(link)):
            return f"is one too many: {self._max_links} robots are connected"
        return None

    def _make_room(self, name: str | None) -> bool:
        """End a link of whoever has the most, if that leaves them no fewer than this one then has.

        So a certificate cannot keep others out, however many links are made with it.
        """
        standing = [link for link in self._links if not link.ended]
        if len(standing) < self._max_links:
            return True
        numbers = Counter(map(_certified, standing))
        (most, number), *_ = numbers.most_common(1)
        if number <= numbers[name] + 1:
            return False
        oldest = next(link for link in standing if _certified(link) == most)
        reason = f"has {number} links, and another robot needs one of {self._max_links}"
        oldest.end(reason, goodbye=reason, refused=True)
        return True

    def greeted(self, link: Link, hello: Hello) -> None:
        """Take note of a robot."""
        self._ungreeted.pop(link, None)
        self._links[link] = set()
        dialer = self._dialled.get(link)
        if dialer is not None:
            dialer.succeeded()
            dialer.won(link)
        self._tell("robot_connected", robot=_name(link, hello), address=link.address)

    def received(self, link: Link, frame: Frame) -> None:
        """Take a request."""
        calls = self._links.get(link)
        if calls is None:
            return
        if frame.kind != CALL:
            raise FrameError(f"is a robot and sends a frame of kind {frame.kind}")
        if frame.passed_over_bytes:
            refusal = too_large(frame.passed_over_bytes, self._settings.max_message_bytes)
            link.send_message(LAST, frame.call, refusal)
            return
        deliver = self._deliver
        if deliver is None:
            link.send_message(END, frame.call)
            return
        call = _StreamCall(link, frame.call, frame.payload, calls, asyncio.get_running_loop())
        calls.add(call)
        call.is_being_delivered = True
        deliver(call)
        call.is_being_delivered = False
        call.flush()

    def leaving(self, link: Link) -> None:
        """End the link: a robot that goes is owed nothing."""
        link.end("")

    def went_adrift(self, link: Link) -> None:
        """Nothing: it is the robot that makes another link."""

    def closed_to_datagrams(self, link: Link) -> None:
        """Nothing: it is the robot that finds out."""

    def lost(self, link: Link) -> None:
        """Take note that a link has ended."""
        self._ungreeted.pop(link, None)
        was_there = self._links.pop(link, None) is not None
        if was_there and link.hello is not None:
            reason = link.reason or (_SAID_GOODBYE if link.said_goodbye else _NO_GOODBYE)
            robot = _name(link, link.hello)
            self._tell("robot_disconnected", robot=robot, reason=reason, address=link.address)
        elif link.reason:
            fields = {"robot": link.peer.name} if link.peer is not None else {}
            self._tell("link_refused", reason=link.reason, address=link.address, **fields)
        self._note_gone()
        dialer = self._dialled.pop(link, None)
        if dialer is not None:
            dialer.ended(link)
            if self._takes_links and (was_there or link.refused):
                dialer.start(refused=link.refused)

    def _tell(self, name: str, **fields: object) -> None:
        if self._on_event is not None:
            self._on_event(name, **fields)


def _certified(link: Link) -> str | None:
    """Return the name in a robot's certificate; None without TLS."""
    return None if link.peer is None else link.peer.name


def _name(link: Link, hello: Hello) -> str:
    """Return a robot's name; a certificate's counts for more than its own word."""
    return link.peer.name if link.peer is not None else hello.name
