"""One stream to one peer: it speaks frames over a socket, and finds out when the peer is gone.

A stream that is closed is a peer that is gone: the system closes those of a process that dies. What
only falls silent is given up after a while, so each end says regularly that it lives. And a peer
that does not read must cost nobody else anything: what cannot be sent waits in a buffer with a
bound, nothing here waits for it, and who never empties it loses the link.

Each end opens with a hello. With TLS the robot speaks first, without it whoever dialled; the other
end answers, so that nothing is told to a port scanner.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import socket
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

from holdfast.transport.endpoints import host_and_port
from holdfast.transport.frames import (
    GOODBYE,
    HELLO,
    MAGIC,
    PING,
    Frame,
    FrameDecoder,
    FrameError,
    Hello,
    decode_hello,
    encode_frame,
    encode_goodbye,
    read_goodbye,
)
from holdfast.transport.turns import TURN_S, Turns

if TYPE_CHECKING:
    from holdfast.transport.tls import PeerCertificate, TlsStream

__all__ = ["HalfReceived", "Link", "LinkOwner", "LinkSettings", "receive_buffer"]

OPENING_TIMEOUT_S: Final = 5.0
"""For a connection to become a link: the handshake and the other end's hello."""

STALLED_S: Final = 10.0
"""A peer that takes nothing of what is to be sent to it for this long does not read."""

_UNSENT_BYTES_AT_LEAST: Final = 4 << 20
"""May wait for any peer, however small its messages must be."""

_UNSENT_IN_SYSTEM_BYTES: Final = 128 * 1024
"""May wait in the system: then even a slow link is seen to move every few seconds."""

_RECEIVED_AT_ONCE_BYTES: Final = 256 * 1024

_LOOKED_AT_ONCE_BYTES: Final = 16 * 1024
"""Of what was received: thousands of frames, or of TLS's records, fit into more."""

_PINGS_IN_LEASE: Final = 3
_CLOSE_TIMEOUT_S: Final = 1.0
_PING: Final = encode_frame(PING)

_NO_TLS: Final = "does not speak TLS; as at that end, write tls/... or udp/... with --tls DIR"
_EXPIRED: Final = "has a certificate that has expired"


def receive_buffer() -> memoryview:
    """Return what all links of one end receive into, by turns.

    What has come is copied out before anything else happens on the loop. To allocate as much for
    each message takes longer than all else that is done about a small one. Ends on loops of
    different threads must not share one.
    """
    return memoryview(bytearray(_RECEIVED_AT_ONCE_BYTES))


class HalfReceived:
    """Bounds the memory that half-received messages of all links together take.

    Parameters
    ----------
    max_bytes : int
        When they take more, a link is ended: of the owners that hold the most, or half of that, the
        one whose message began first. So whoever sends much, on many links, ends nobody's that
        holds little.
    """

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._sizes: dict[Link, int] = {}
        self._total = 0

    def note(self, link: Link, size_bytes: int) -> None:
        """Take note of what a link holds now."""
        before = self._sizes.get(link, 0)
        if size_bytes:
            self._sizes[link] = size_bytes
        elif before:
            del self._sizes[link]
        self._total += size_bytes - before
        while self._total > self._max_bytes:
            held: dict[object, int] = {}
            for each, its_bytes in self._sizes.items():
                held[each.owner] = held.get(each.owner, 0) + its_bytes
            least = max(held.values()) / 2
            oldest = next(each for each in self._sizes if held[each.owner] >= least)
            self._total -= self._sizes.pop(oldest)
            oldest.end("has not finished a message, and others need the memory")


class LinkSettings(NamedTuple):
    """What all links of one end have in common.

    Attributes
    ----------
    hello : callable
        Returns this end's first bytes.
    lease_ms : float
        This end lets itself be heard several times in this time.
    max_message_bytes : int
    half_received : HalfReceived
    turns : Turns
    buffer : memoryview
        From :func:`receive_buffer`.
    must_read : bool
        Whether nothing more is heard of an end that does not read what it is sent.
    """

    hello: Callable[[], bytes]
    lease_ms: float
    max_message_bytes: int
    half_received: HalfReceived
    turns: Turns
    buffer: memoryview
    must_read: bool


class LinkOwner(Protocol):
    """Who is told what happens on a link."""

    def established(self, link: Link) -> None:
        """Hear that the TLS handshake is complete at this end; not called without TLS."""
        ...

    def refusal(self, link: Link, hello: Hello) -> str | None:
        """Return why the other end is not wanted, as the rest of a sentence about it."""
        ...

    def greeted(self, link: Link, hello: Hello) -> None:
        """Hear who the other end is; now frames of calls may be sent."""
        ...

    def received(self, link: Link, frame: Frame) -> None:
        """Take a frame of a call."""
        ...

    def leaving(self, link: Link) -> None:
        """Hear that the other end is about to end the link, and has nothing against this one.

        It still answers what it is asked, for a while; who needs it no more ends the link.
        """
        ...

    def went_adrift(self, link: Link) -> None:
        """Hear that a link goes on without its stream, so that another one has to take its place.

        Only of links that have something beside the stream.
        """
        ...

    def closed_to_datagrams(self, link: Link) -> None:
        """Hear that no datagram gets through, so that all goes on the stream; told once."""
        ...

    def lost(self, link: Link) -> None:
        """Hear that the link has ended: once of each link, and nothing more of it after that."""
        ...


class Link(asyncio.BufferedProtocol):
    """One stream; a protocol for asyncio, to be connected by it.

    Parameters
    ----------
    owner : LinkOwner
    settings : LinkSettings
    speaks_first : bool
        Whether this end says who it is before it knows who the other one is.
    tls : TlsStream or None

    Attributes
    ----------
    tls : TlsStream or None
    began_at : float
        By the loop's clock.
    has_answered : bool
        Whether an answer came over it that was waited for; the owner notes that.
    connecting : Task or None
        Of an accepted connection, which asyncio needs somebody to hold.
    closed : Future
        Done when the connection is closed.
    hello : Hello or None
        The other end's, once it has come.
    peer : PeerCertificate or None
        The other end's, once TLS is established.
    address : str or None
        The other end's, HOST:PORT; None over a local socket, or not connected yet.
    reason : str
        Why the link has ended, as the rest of a sentence about the other end; empty if that has
        simply closed.
    said_goodbye : bool
        Whether the other end has said that it ends the link, now or soon; one that is killed does
        not.
    refused : bool
        Whether it has ended because one of the ends does not want the other, so that to try again
        at once is of no use.
    adrift : bool
        Whether it goes on without its stream.
    """

    def __init__(
        self,
        owner: LinkOwner,
        settings: LinkSettings,
        *,
        speaks_first: bool,
        tls: TlsStream | None = None,
    ) -> None:
        self._owner = owner
        self._settings = settings
        self._speaks_first = speaks_first
        self.tls = tls
        self._loop = asyncio.get_running_loop()
        self._transport: asyncio.Transport | None = None
        self._decoder = FrameDecoder(settings.max_message_bytes)
        self._max_unsent_bytes = max(2 * settings.max_message_bytes, _UNSENT_BYTES_AT_LEAST)
        self._ping_interval_s = 1e-3 * settings.lease_ms / _PINGS_IN_LEASE
        self.began_at = now = self._loop.time()
        self._silent_at = now + OPENING_TIMEOUT_S
        self._patience_s = 0.0
        self._moved_at = now
        self._said_hello = False
        self._holds = False
        # What has come and waits: bytes, from where on, and the frames that were in those before.
        self._unread, self._unread_at = b"", 0
        self._frames: deque[Frame] = deque()
        self._waits_for_turn = self._waits_for_reader = False
        self._spoke = False
        self._handed_over_bytes = self._moved_bytes = 0
        self._timer = self._loop.call_at(self._silent_at, self._tick)
        self._ended = False
        self._told = False
        self.closed: asyncio.Future[None] = self._loop.create_future()
        self.connecting: asyncio.Task[object] | None = None
        self.hello: Hello | None = None
        self.peer: PeerCertificate | None = None
        self.address: str | None = None
        self.reason = ""
        self.said_goodbye = False
        self.refused = False
        self.adrift = False
        self.has_answered = False

    @property
    def max_message_bytes(self) -> int:
        """A larger one is not sent."""
        return self._settings.max_message_bytes

    @property
    def ended(self) -> bool:
        """Whether nothing can be sent any more."""
        return self._ended

    @property
    def owner(self) -> object:
        """With whom it shares its turns and its memory.

        The name in the other end's certificate; None before there is one, and without TLS itself.
        """
        if self.tls is None:
            return self
        return None if self.peer is None else self.peer.name

    @property
    def sends_datagrams(self) -> bool:
        """Whether short messages go beside the stream."""
        return False

    def protocol(self) -> asyncio.BaseProtocol:
        """Return what asyncio is to connect: the link itself, unless something is in between."""
        return self

    async def connect(self, stream: socket.socket) -> None:
        """Begin to speak over a connection; never raises."""
        try:
            await self._loop.create_connection(self.protocol, sock=stream)
        except OSError as error:
            stream.close()
            self.connection_lost(error)

    def send(self, data: bytes) -> None:
        """Send frames; never waits. Nothing is sent before the handshake, or after the end."""
        transport = self._transport
        if self._ended or transport is None:
            return
        if self.tls is not None:
            if not self.tls.established:
                return
            self.tls.send(data)
            data = self.tls.take()
        transport.write(data)
        self._spoke = True
        self._handed_over_bytes += len(data)
        if transport.get_write_buffer_size() > self._max_unsent_bytes:
            self.end("does not read what it is sent", abort=True)

    def send_message(self, kind: int, call: int, payload: bytes = b"") -> None:
        """Send a frame of a call; never waits."""
        self.send(encode_frame(kind, call, payload))

    def say_goodbye(self) -> None:
        """Ask the other end to end the link as soon as it can do without."""
        self.send(encode_goodbye(""))

    def forget(self, call: int) -> None:
        """Take note that nobody wants to hear more of a call."""

    def end(
        self,
        reason: str,
        *,
        goodbye: str | None = None,
        refused: bool = False,
        abort: bool = False,
    ) -> None:
        """End the link; the owner hears so in a later turn of the loop. May be repeated.

        Parameters
        ----------
        reason : str
            About the other end, for :attr:`reason`.
        goodbye : str or None
            What the other end is told before; empty text says no more than that.
        refused : bool
            For :attr:`refused`.
        abort : bool
            Whether what is still to be sent is thrown away.
        """
        if self._ended:
            return
        if goodbye is not None:
            self.send(
                encode_goodbye(goodbye) if self._said_hello else MAGIC + encode_goodbye(goodbye)
            )
            if self.ended:  # it does not read
                return
        self._ended = True
        self.reason = reason
        self.refused = refused
        self._timer.cancel()
        self._unread = b""
        self._frames.clear()
        self._settings.half_received.note(self, 0)
        self._loop.call_soon(self._tell)
        transport = self._transport
        if transport is None:
            return
        if abort:
            transport.abort()
            return
        if self.tls is not None:
            self.tls.close()
            transport.write(self.tls.take())
        transport.close()
        self._timer = self._loop.call_later(_CLOSE_TIMEOUT_S, transport.abort)

    # -- what asyncio tells ----------------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin to speak, if that is this end's part."""
        assert isinstance(transport, asyncio.Transport)
        if self._ended:
            transport.abort()
            self._transport = transport
            return
        self._transport = transport
        stream = transport.get_extra_info("socket")
        if stream is not None and stream.family != socket.AF_UNIX:
            self.address = _address(transport.get_extra_info("peername"))
            with contextlib.suppress(OSError):
                # What is sent is meant to arrive now, although more may follow.
                stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                stream.setsockopt(
                    socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, _UNSENT_IN_SYSTEM_BYTES
                )
        if self.tls is None:
            if self._speaks_first:
                self._say_hello()
        elif self._speaks_first:
            self.tls.begin()
            transport.write(self.tls.take())

    def get_buffer(self, sizehint: int) -> memoryview:
        """Return where asyncio puts what comes next."""
        del sizehint
        return self._settings.buffer

    def buffer_updated(self, nbytes: int) -> None:
        """Take what has come."""
        if self._ended:
            return
        self._unread, self._unread_at = bytes(self._settings.buffer[:nbytes]), 0
        now = self._loop.time()
        if self.hello is not None:
            self._silent_at = now + self._patience_s
        if self._settings.turns.may_go_on(self.owner, now):
            self.go_on()
        else:
            self._wait_for_turn()

    def pause_writing(self) -> None:
        """Take note that the other end does not read as fast as it is sent to."""
        if self._settings.must_read:
            self._waits_for_reader = True
            self._pause_reading()

    def resume_writing(self) -> None:
        """Take note that the other end has read."""
        if self._waits_for_reader:
            self._waits_for_reader = False
            if not self._ended and not self._waits_for_turn:
                self._wait_for_turn()

    def eof_received(self) -> None:
        """Let asyncio close this end, as the other one has."""

    def connection_lost(self, exc: Exception | None) -> None:
        """Take note that the connection is gone, whoever has closed it."""
        self._transport = None
        self._timer.cancel()
        if not self._ended:
            self._ended = True
            # One that dies resets the connection if there is something that it has not read.
            if exc is not None and not isinstance(exc, (ConnectionResetError, BrokenPipeError)):
                self.reason = getattr(exc, "strerror", None) or str(exc)
            self._settings.half_received.note(self, 0)
        self._tell()
        if not self.closed.done():
            self.closed.set_result(None)

    # -- what comes ------------------------------------------------------------------------------

    def go_on(self) -> None:
        """Handle what has come, for one turn."""
        self._waits_for_turn = False
        if self._ended or self._waits_for_reader:
            return
        owner, began = self.owner, self._loop.time()
        try:
            while self._handle_next():
                if self.ended or self._waits_for_reader:
                    break
                if self._loop.time() >= began + TURN_S and (self._frames or self._unread):
                    self._wait_for_turn()
                    break
            else:
                if self._transport is not None:
                    self._transport.resume_reading()
        except FrameError as error:
            # Only one of our own kind is told why.
            self.end(
                str(error), goodbye=str(error) if self.hello is not None else None, refused=True
            )
        self._settings.turns.spend(owner, self._loop.time() - began)

    def _handle_next(self) -> bool:
        """Handle one frame, or look what frames have come; return whether there was anything."""
        if self._frames:
            self._take(self._frames.popleft())
            return True
        if self._decoder.error is not None:
            raise self._decoder.error
        tls, data, at = self.tls, self._unread, self._unread_at
        if tls is not None and tls.ended:
            self.end("")
            return True
        if not data:
            return False
        if len(data) > _LOOKED_AT_ONCE_BYTES:
            self._unread_at = at + _LOOKED_AT_ONCE_BYTES
            data = data[at : self._unread_at]
        if self._unread_at == at or self._unread_at >= len(self._unread):
            self._unread, self._unread_at = b"", 0
        if tls is not None:
            data = self._decrypted(tls, data)
            if self.ended:
                return True
        self._frames.extend(self._decoder.feed(data))
        self._note_what_is_held()
        return True

    def _note_what_is_held(self) -> None:
        held_bytes = self._decoder.held_bytes
        if self._waits_for_turn:
            held_bytes += len(self._unread) - self._unread_at
        if held_bytes or self._holds:
            self._holds = held_bytes > 0
            self._settings.half_received.note(self, held_bytes)

    def _wait_for_turn(self) -> None:
        self._waits_for_turn = True
        self._pause_reading()
        self._note_what_is_held()
        self._settings.turns.wait(self)

    def _pause_reading(self) -> None:
        if self._transport is not None:
            self._transport.pause_reading()

    def _decrypted(self, tls: TlsStream, data: bytes) -> bytes:
        was_established = tls.established
        try:
            data = tls.receive(data)
        except OSError as error:  # OpenSSL's: it is not imported here, for it takes long
            assert self._transport is not None
            self._transport.write(tls.take())  # it is told, in an alert
            self.end(tls.what_is_wrong(error), refused=True)
            return b""
        except FrameError:
            if data.startswith(MAGIC) and self._transport is not None:
                # One of our own kind is told, in clear as it has asked.
                self._transport.write(MAGIC + encode_goodbye(_NO_TLS))
            raise
        if was_established:
            return data
        assert self._transport is not None
        self._transport.write(tls.take())
        if tls.established:
            try:
                self.peer = tls.peer()
            except FrameError as error:
                self.end(str(error), goodbye=str(error), refused=True)
                return b""
            if self._speaks_first:
                self._say_hello()
            self._owner.established(self)
        return data

    def _take(self, frame: Frame) -> None:
        kind = frame.kind
        if kind == PING:
            return
        if kind == HELLO:
            try:
                hello = decode_hello(frame.payload)
                refusal = self._owner.refusal(self, hello)
            except FrameError as error:
                refusal = str(error)
            if refusal is not None:
                self.end(refusal, goodbye=refusal, refused=True)
                return
            if not self._speaks_first:
                self._say_hello()
            self.hello = hello
            self._patience_s = 1e-3 * hello.lease_ms
            self._silent_at = self._loop.time() + self._patience_s
            self._timer.cancel()
            self._tick()
            self._owner.greeted(self, hello)
        elif kind == GOODBYE:
            reason = read_goodbye(frame.payload)
            self.said_goodbye = True
            if reason:
                self.end(f"refuses this end, which {reason}", refused=True)
            else:
                self._owner.leaving(self)
        else:
            self._owner.received(self, frame)

    def _say_hello(self) -> None:
        self._said_hello = True
        self.send(self._settings.hello())

    def _tell(self) -> None:
        if not self._told:
            self._told = True
            self._owner.lost(self)

    # -- time ------------------------------------------------------------------------------------

    def _tick(self) -> None:
        """Look whether the other end lives and reads, and let it know that this one does."""
        now = self._loop.time()
        self._excuse(now)
        if now >= self._silent_at:
            # If it is this process that stood still, what came meanwhile is still to be read.
            self._loop.call_soon(self._loop.call_soon, self._give_up_if_silent)
            return
        valid_s = math.inf if self.peer is None else self.peer.expires_at - time.time()
        if valid_s <= 0.0:
            self.end(_EXPIRED, goodbye=_EXPIRED, refused=True)
            return
        transport = self._transport
        if self.hello is not None and transport is not None:
            if not self._spoke:
                self.send(_PING)
            self._spoke = False
            unsent = transport.get_write_buffer_size()
            moved_bytes = self._handed_over_bytes - unsent
            if unsent == 0 or moved_bytes != self._moved_bytes:
                self._moved_at, self._moved_bytes = now, moved_bytes
            elif now >= self._moved_at + STALLED_S:
                self.end("does not read what it is sent", abort=True)
            if self._ended:
                return
        due = self._silent_at
        if self.hello is not None:
            due = min(due, now + self._ping_interval_s, now + valid_s)
        self._timer = self._loop.call_at(due, self._tick)

    def _give_up_if_silent(self) -> None:
        if self._ended:
            return
        self._excuse(self._loop.time())
        if self._loop.time() < self._silent_at:
            self._tick()
        elif self.hello is None:
            self.end(f"has said no hello within {OPENING_TIMEOUT_S:g} s", abort=True)
        else:
            self.end(f"was silent for {1e3 * self._patience_s:g} ms", abort=True)

    def _excuse(self, now: float) -> None:
        """Take nobody for silent who is not listened to."""
        if self.hello is not None and (self._waits_for_turn or self._waits_for_reader):
            self._silent_at = now + self._patience_s


def _address(found: object) -> str | None:
    """Write the address of a socket as in an endpoint."""
    if not isinstance(found, tuple):
        return None
    return host_and_port(str(found[0]), found[1])
