"""The service's end: links of many robots, and the calls on them.

A reply is sent when the call ends or this turn of the event loop ends, whichever comes first. So
the last reply and the end of a call are usually one frame.
"""

from __future__ import annotations

import asyncio
import socket
import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Final

import msgspec

from holdfast.errors import DEFECT, FrameError, TransportError, defect_fields
from holdfast.transport.contract import DEFAULT_MAX_MESSAGE_BYTES, IncomingCall, too_large
from holdfast.transport.endpoints import (
    REVOKED_FILE,
    Endpoint,
    TlsFiles,
    check_credentials,
    check_endpoint,
    check_name,
)
from holdfast.transport.frames import (
    CALL,
    END,
    LAST,
    REPLY,
    Frame,
    Hello,
    encode_goodbye,
    encode_hello,
)
from holdfast.transport.link_settings import LinkSettings
from holdfast.transport.links import Link, LinkOwner
from holdfast.transport.listener import MAX_SILENT, MAX_WAITING, Listener, connection_to_drop
from holdfast.transport.schemes import link_maker

if TYPE_CHECKING:
    import ssl

    from holdfast.transport.tls import PeerCertificate

MAX_LINKS: Final = 4096
"""Links of robots at the same time. Above it the owner of the most links loses one."""

MAX_UNSENT_BYTES: Final = 32 << 20
"""Bound on all replies together that wait until robots read: the largest has 2 MiB."""

_SERVICE_ENDS: Final = "this service ends"
_REVOKED: Final = "has a certificate that has been revoked"
_FOREIGN: Final = "has a certificate of an authority that is no longer trusted"

_MAX_WITHOUT_HELLO: Final = 256
"""Connections that have sent bytes, but no hello yet."""

_MAX_UNCOMPUTED: Final = 8
"""Handshakes that wait for the processor before others are begun."""

_HELLO_S: Final = 0.5
"""For its handshake and hello a connection has so long before it must make room for another."""

MAX_UNKNOWN: Final = MAX_SILENT + MAX_WAITING + _MAX_WITHOUT_HELLO
"""Connections without a hello: the number of sockets beyond the links."""


class _StreamCall(msgspec.Struct, eq=False):
    """A request as the service sees it; see :class:`~holdfast.transport.contract.IncomingCall`."""

    link: Link
    number: int
    payload: bytes
    calls: set[_StreamCall]
    is_open: bool = True
    on_gone: Callable[[], object] | None = None

    @property
    def robot(self) -> str | None:
        """The name in the robot's certificate."""
        return _certified(self.link)

    def reply(self, payload: bytes, *, last: bool = False) -> None:
        """Send a reply, and end the call with the last one. A robot that is gone is no error."""
        if len(payload) <= self.link.max_message_bytes:
            self._send(LAST if last else REPLY, payload)
        elif last:
            self._send(END)

    def end(self) -> None:
        """End the call. May be repeated."""
        self._send(END)

    def _send(self, kind: int, payload: bytes = b"") -> None:
        if self.is_open:
            if kind != REPLY:
                self.is_open = False
                self.calls.discard(self)
            self.link.send_message(kind, self.number, payload)


class StreamServiceTransport(LinkOwner):
    """The service's end: see :class:`~holdfast.transport.contract.ServiceTransport`.

    Raises TransportError if an endpoint, the name, the incarnation or the credentials cannot be
    used.
    """

    def __init__(
        self,
        name: str,
        *,
        incarnation: str,
        listen: Sequence[str] = (),  # endpoints at which robots connect
        # The connection to the robot that has launched this service.
        robot: socket.socket | None = None,
        # A socket for each of ``listen``, which listens or is bound there; None: make it.
        shared: Sequence[socket.socket | None] = (),
        # After this much silence robots consider this service lost. A robot's own lease is in its
        # hello.
        lease_ms: float = 400.0,
        # A larger request is refused and not kept.
        max_message_bytes: int = DEFAULT_MAX_MESSAGE_BYTES,
        max_links: int | None = None,  # of robots, at the same time; None: :data:`MAX_LINKS`
        tls: TlsFiles | None = None,  # the service's credentials, for ``tls`` and ``udp``
        # Called for the log: ``defect`` with ``robot``, ``reason`` and ``traceback``, when an
        # exception that no code here expects has ended a link; ``link_refused`` with ``reason``
        # and, if known, ``robot``; ``robot_connected`` with ``robot``; ``robot_disconnected`` with
        # ``robot`` and ``reason``. Each has the robot's ``address``, None over a local socket.
        on_event: Callable[..., None] = lambda _, **__: None,
    ) -> None:
        check_name("name of a service", name)
        check_name("incarnation of a service", incarnation)
        self._listen = [check_endpoint(text, "service") for text in listen]
        for endpoint in self._listen:
            check_credentials(endpoint, tls)
        self._robot = robot
        self._shared = shared or [None] * len(listen)
        self._makers = {at.protocol: link_maker(at.protocol, "service") for at in self._listen}
        self._incarnation = incarnation
        self._max_links = MAX_LINKS if max_links is None else max_links
        self._tls = tls
        self._context: ssl.SSLContext | None = None
        # Checked after each handshake, which may have used older files.
        self._revoked: frozenset[int] = frozenset()
        self._trusted: frozenset[bytes] = frozenset()
        if tls is not None:
            self._read_credentials(tls)
        self._settings = LinkSettings(
            lambda: encode_hello("service", name, incarnation, lease_ms, time.time()),
            lease_ms,
            max_message_bytes,
            pauses_for_readers=True,
            max_unsent_bytes=MAX_UNSENT_BYTES,
        )
        self._on_event = on_event
        self._deliver: Callable[[IncomingCall], None] | None = None
        self._started = False
        self._listeners: list[Listener] = []
        self._without_hello: dict[Link, bytes] = {}
        self._links: dict[Link, set[_StreamCall]] = {}
        self._closing: set[asyncio.Future[None]] = set()
        self._gone: asyncio.Future[None] | None = None

    @property
    def endpoints(self) -> tuple[str, ...]:
        """Where robots can connect; once started, with the ports that were free instead of 0."""
        return tuple(str(endpoint) for endpoint in self._listen)

    async def start(self, deliver: Callable[[IncomingCall], None]) -> None:
        """Listen and deliver calls; returns when robots can connect.

        Raises TransportError if it cannot listen there; the message names the endpoint.
        """
        if self._started:
            raise TransportError("this transport was started before; make another one")
        self._started = True
        self._deliver = deliver
        try:
            for endpoint, shared in zip(self._listen, self._shared, strict=True):
                accepted = partial(self._accepted, endpoint)
                self._listeners.append(
                    Listener(endpoint, accepted, may_deliver=self._may_shake_hands, shared=shared)
                )
        except TransportError:
            self._stop_listening()
            raise
        self._listen = [listener.endpoint for listener in self._listeners]
        if self._robot is not None:
            link = Link(self, self._settings, speaks_first=True)
            self._add(link, b"")
            link.begin(self._robot)
            self._robot = None

    def dismiss(self) -> asyncio.Future[None]:
        """Take no new links, and ask the robots to leave; the result is done when all have left.

        A robot leaves once it has its replies and has found another process, or none. Until then
        the service still replies, so the search costs the robot no time.
        """
        self._stop_listening()
        self._gone = asyncio.get_running_loop().create_future()
        for link in list(self._without_hello):
            link.end("")
        for link in list(self._links):
            link.send(encode_goodbye(""))
        self._resolve_if_all_gone()
        return self._gone

    def _resolve_if_all_gone(self) -> None:
        if self._gone is not None and not self._links and not self._gone.done():
            self._gone.set_result(None)

    def _stop_listening(self) -> None:
        for listener in self._listeners:
            listener.close()

    async def close(self, timeout_s: float = 1.0) -> None:
        """End all calls, send what was to be sent, and close all links, within this time."""
        self._deliver = None
        self._started = True
        self._stop_listening()
        for link in (*self._links, *self._without_hello):
            self._end(link)
        if self._closing:
            await asyncio.wait(self._closing, timeout=timeout_s)
        if self._robot is not None:
            self._robot.close()

    def _end(self, link: Link) -> None:
        """End a link in order, because this service ends."""
        calls = self._links.get(link)
        if calls is None:
            link.end("")
            return
        for call in list(calls):
            call.end()
        link.end(_SERVICE_ENDS, goodbye="")

    def end_links(self, objection: Callable[[PeerCertificate], str | None]) -> int:
        """End the links of robots whose certificate is not accepted; return their number.

        ``objection`` returns the reason, as the rest of a sentence about the robot, or None.
        """
        ended = 0
        for link in (*self._links, *self._without_hello):
            reason = None if link.peer is None or link.ended else objection(link.peer)
            if reason is not None:
                link.refuse(reason)
                ended += 1
        return ended

    @property
    def num_revoked(self) -> int:
        """How many certificates are in the list of revoked ones."""
        return len(self._revoked)

    def reload_credentials(self) -> int:
        """Read the credentials again; return the number of links that this has ended.

        Links end if their certificate is now revoked, or its authority was replaced.

        Raises TransportError if the files cannot be used; then the previous credentials stay in
        use.
        """
        if self._tls is None:
            return 0
        self._read_credentials(self._tls)
        return self.end_links(self._objection)

    def _objection(self, peer: PeerCertificate) -> str | None:
        """Return why a certificate is not trusted, as the rest of a sentence about a robot."""
        if peer.serial_number in self._revoked:
            return _REVOKED
        return None if peer.authorities <= self._trusted else _FOREIGN

    # -- links -----------------------------------------------------------------------------------

    def _read_credentials(self, tls: TlsFiles) -> None:
        # Imported here, because OpenSSL is slow to load.
        from holdfast.transport.revocation import revoked_serials
        from holdfast.transport.tls import server_context

        context = server_context(tls, self._incarnation)
        path = tls.authority.with_name(REVOKED_FILE)
        revoked = revoked_serials(path)
        trusted = frozenset(context.get_ca_certs(binary_form=True))
        if self._trusted <= trusted and (absent := self._revoked - revoked):
            raise TransportError(
                f"{path}: lacks {len(absent)} of the {len(self._revoked)} certificates that it "
                "revoked before; a list only grows, so this is an older one, or it is gone"
            )
        self._revoked, self._trusted, self._context = revoked, trusted, context

    def _may_shake_hands(self) -> bool:
        """Return whether another handshake would be computed soon, and ends none just begun."""
        if self._settings.scheduler.num_waiting(None) >= _MAX_UNCOMPUTED:
            return False
        if len(self._without_hello) < _MAX_WITHOUT_HELLO:
            return True
        oldest = next(iter(self._without_hello))
        return asyncio.get_running_loop().time() >= oldest.began_at + _HELLO_S

    def _accepted(self, endpoint: Endpoint, connection: socket.socket, network: bytes) -> None:
        tls = None
        if endpoint.is_encrypted:
            from holdfast.transport.tls import TlsStream

            assert self._context is not None
            tls = TlsStream(self._context)
        link = self._makers[endpoint.protocol](self, self._settings, tls=tls)
        self._add(link, network)
        link.begin(connection)

    def _add(self, link: Link, network: bytes) -> None:
        """Keep a new link, until it has ended."""
        if len(self._without_hello) >= _MAX_WITHOUT_HELLO:
            other = connection_to_drop(self._without_hello)
            del self._without_hello[other]
            other.end("has said no hello, and others wait", abort=True)
        self._without_hello[link] = network
        self._closing.add(link.closed)
        link.closed.add_done_callback(self._closing.discard)

    def on_handshake(self, link: Link) -> None:
        """Refuse a robot that is no longer trusted, before anything of it is read."""
        assert link.peer is not None
        objection = self._objection(link.peer)
        if objection is not None:
            link.refuse(objection)

    def refusal(self, link: Link, hello: Hello) -> str | None:
        """Refuse a peer that is no robot, or that would exceed its share of links."""
        if hello.role != "robot":
            return "is a service, and a robot was expected"
        if link.peer is not None and hello.name not in ("", link.peer.name):
            return f"says that it is {hello.name}, and shows the certificate of {link.peer.name}"
        if len(self._links) >= self._max_links and not self._make_room(_certified(link)):
            limited = self._max_links < MAX_LINKS
            more = "; with a higher limit on open files (ulimit -Hn) it takes more" * limited
            return f"is one too many: {self._max_links} robots are connected{more}"
        return None

    def _make_room(self, name: str | None) -> bool:
        """End a link of the name with the most, if it then still has at least as many as this one.

        So one certificate cannot lock others out, however many links it makes.
        """
        standing = [link for link in self._links if not link.ended]
        if len(standing) < self._max_links:
            return True
        numbers = Counter(map(_certified, standing))
        (most, number), *_ = numbers.most_common(1)
        if number <= numbers[name] + 1:
            return False
        oldest = next(link for link in standing if _certified(link) == most)
        oldest.refuse(f"has {number} links, and another robot needs one of {self._max_links}")
        return True

    def on_hello(self, link: Link, hello: Hello) -> None:
        """Take a robot's hello."""
        self._without_hello.pop(link, None)
        self._links[link] = set()
        self._on_event("robot_connected", robot=_name(link, hello), address=link.address)

    def on_frame(self, link: Link, frame: Frame) -> None:
        """Take a request."""
        calls = self._links.get(link)
        if calls is None:
            return
        if frame.kind != CALL:
            raise FrameError(f"is a robot and sends a frame of kind {frame.kind}")
        if frame.skipped_bytes:
            refusal = too_large(frame.skipped_bytes, self._settings.max_message_bytes)
            link.send_message(LAST, frame.call, refusal)
            return
        deliver = self._deliver
        if deliver is None:
            link.send_message(END, frame.call)
            return
        call = _StreamCall(link, frame.call, frame.payload, calls)
        calls.add(call)
        deliver(call)

    def on_goodbye(self, link: Link) -> None:
        """End the link: a robot that leaves waits for no reply."""
        link.end("")

    def on_defect(self, link: Link, error: Exception) -> None:
        """Report an exception."""
        self._on_event(DEFECT, robot=_certified(link), address=link.address, **defect_fields(error))

    def on_ended(self, link: Link) -> None:
        """Note that a link has ended."""
        self._without_hello.pop(link, None)
        calls = self._links.pop(link, None)
        for call in calls or ():
            call.is_open = False
            if call.on_gone is not None:
                call.on_gone()
        if calls is not None and link.hello is not None:
            robot, why = _name(link, link.hello), link.why_ended
            self._on_event("robot_disconnected", robot=robot, reason=why, address=link.address)
        elif link.reason:
            fields = {"robot": link.peer.name} if link.peer is not None else {}
            self._on_event("link_refused", reason=link.reason, address=link.address, **fields)
        self._resolve_if_all_gone()


def _certified(link: Link) -> str | None:
    """Return the name in a robot's certificate; None without TLS."""
    return None if link.peer is None else link.peer.name


def _name(link: Link, hello: Hello) -> str:
    """Return a robot's name: the certificate's, if there is one."""
    return link.peer.name if link.peer is not None else hello.name
