"""One stream to one peer: it carries frames over a socket, and detects that the peer is gone.

A closed stream means a dead peer: the system closes the sockets of a process that dies. A peer that
falls silent is considered lost after its lease, so each end sends pings. A peer that does not read
must not delay others: unsent bytes wait in a bounded buffer, nothing waits for them, and a peer
that never empties it loses the link. Whatever exception a peer's bytes lead to ends its own link
(:func:`ends_link`).

Each end opens with a hello. With TLS the robot speaks first, without it the end that dialled. The
other end only answers, so a port scanner learns nothing.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import math
import os
import socket
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from time import thread_time, time
from typing import TYPE_CHECKING, Concatenate, Final, ParamSpec, TypeVar

from holdfast.errors import FrameError
from holdfast.runtime.addresses import host_and_port
from holdfast.transport.frames import (
    GOODBYE,
    HELLO,
    MAGIC,
    PING,
    Frame,
    FrameDecoder,
    Hello,
    decode_hello,
    encode_frame,
    encode_goodbye,
    read_goodbye,
)
from holdfast.transport.link_settings import SLICE_S, LinkSettings

if TYPE_CHECKING:
    from holdfast.transport.tls import PeerCertificate, TlsStream

_Arguments = ParamSpec("_Arguments")
_AnyLink = TypeVar("_AnyLink", bound="Link")

OPENING_TIMEOUT_S: Final = 5.0
"""For the handshake and the other end's hello."""

STALLED_S: Final = 10.0
"""A peer that reads nothing for this long, while bytes wait, loses the link."""

_UNSENT_BYTES_AT_LEAST: Final = 4 << 20
"""Least bound on the bytes that wait for a peer."""

_UNSENT_IN_SYSTEM_BYTES: Final = 128 * 1024
"""In the system's buffer: small, so that even a slow link shows progress every few seconds."""

_DECODED_AT_ONCE_BYTES: Final = 16 * 1024
"""Received bytes that are decoded at once: more can hold thousands of frames or TLS records."""

_LAST_WORDS_BYTES: Final = 64 * 1024

_PINGS_IN_LEASE: Final = 3
_CLOSE_TIMEOUT_S: Final = 1.0
_PING: Final = encode_frame(PING)

_NO_TLS: Final = "does not speak TLS; as at that end, write tls/... or udp/... with --tls DIR"
_EXPIRED: Final = "has a certificate that has expired"
_NO_GOODBYE: Final = (
    "closed the connection without a goodbye: was killed, or heard nothing from here"
)


class LinkOwner(ABC):
    """The end of a transport to which a link belongs; the link calls it."""

    def on_handshake(self, link: Link) -> None:  # noqa: B027 - optional
        """Handle the end of the TLS handshake at this end."""

    @abstractmethod
    def refusal(self, link: Link, hello: Hello) -> str | None:
        """Return why the peer is refused, as the rest of a sentence about it; None if welcome."""

    @abstractmethod
    def on_hello(self, link: Link, hello: Hello) -> None:
        """Handle the peer's hello; from now on frames of calls may be sent."""

    @abstractmethod
    def on_frame(self, link: Link, frame: Frame) -> None:
        """Handle a frame of a call."""

    def on_goodbye(self, link: Link) -> None:  # noqa: B027 - optional
        """Handle a goodbye without a reason: the peer will end the link, but still replies.

        This end closes the link when it needs no more replies.
        """

    def on_stream_lost(self, link: Link) -> None:  # noqa: B027 - optional
        """Replace a link that goes on with datagrams alone."""

    def on_datagrams_blocked(self, link: Link) -> None:  # noqa: B027 - optional
        """Note that no datagram gets through, so that everything goes on the stream."""

    def on_defect(self, link: Link, error: Exception) -> None:  # noqa: B027 - optional
        """Report an exception that no code here expects; it has ended the link."""

    @abstractmethod
    def on_ended(self, link: Link) -> None:
        """Handle the end of the link: called once, and last."""


def ends_link(
    method: Callable[Concatenate[_AnyLink, _Arguments], None],
) -> Callable[Concatenate[_AnyLink, _Arguments], None]:
    """Have an exception of a method end its link, by :meth:`Link.fail`.

    For the methods by which anything else enters a link: the event loop, the scheduler, the owner.
    """

    @functools.wraps(method)
    def guarded(link: _AnyLink, /, *arguments: _Arguments.args, **named: _Arguments.kwargs) -> None:
        try:
            method(link, *arguments, **named)
        except Exception as error:  # noqa: BLE001 - what a peer sends may raise anything
            link.fail(error)

    return guarded


class Link(asyncio.BufferedProtocol):
    """One stream; a protocol for asyncio, to be connected by it.

    ``speaks_first`` says whether this end sends its hello first.
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
        self.max_message_bytes = settings.max_message_bytes  # larger messages are not sent
        self._loop = asyncio.get_running_loop()
        self._transport: asyncio.Transport | None = None
        self._decoder = FrameDecoder(settings.max_message_bytes)
        self._max_unsent_bytes = max(2 * settings.max_message_bytes, _UNSENT_BYTES_AT_LEAST)
        self._ping_interval_s = 1e-3 * settings.lease_ms / _PINGS_IN_LEASE
        self.began_at = now = self._loop.time()
        self._lease_ends_at = now + OPENING_TIMEOUT_S
        self._peer_lease_s = 0.0
        self._progress_at = now
        self._said_hello = False
        self._holds = False
        # Received: undecoded bytes, the offset of the next one, and decoded frames.
        self._unread, self._unread_at = b"", 0
        self._frames: deque[Frame] = deque()
        self._is_queued = self._is_paused = False
        self._spoke_at = self._heard_at = now
        self._handed_over_bytes = self._progress_bytes = 0
        self._timer = self._loop.call_at(self._lease_ends_at, self._tick)
        self._ended = False
        self._notified = False
        self._connecting: asyncio.Task[None] | None = None
        # Done when the connection is closed.
        self.closed: asyncio.Future[None] = self._loop.create_future()
        # The other end's, as soon as they are known; over a local socket there is no address.
        self.hello: Hello | None = None
        self.peer: PeerCertificate | None = None
        self.address: str | None = None
        # Why the link has ended, as the rest of a sentence about the other end; "" if it was closed
        # normally.
        self.reason = ""
        # Whether the other end has announced that it ends the link, now or soon.
        self.said_goodbye = False
        # Whether one end has refused the other, so that an immediate retry is of no use.
        self.refused = False
        # Whether it goes on without its stream.
        self.without_stream = False
        # Whether an awaited reply came over it; set by the owner.
        self.has_answered = False

    @property
    def ended(self) -> bool:
        """Whether nothing can be sent any more."""
        return self._ended

    @property
    def why_ended(self) -> str:
        """Why the link has ended, as the rest of a sentence about the other end."""
        return self.reason or ("said goodbye" if self.said_goodbye else _NO_GOODBYE)

    @property
    def owner(self) -> object:
        """What shares time slices and memory: the name in the other end's certificate.

        None before there is a certificate; without TLS the link itself.
        """
        if self.tls is None:
            return self
        return None if self.peer is None else self.peer.name

    @property
    def unsent_bytes(self) -> int:
        """Bytes that wait until the other end reads."""
        return 0 if self._transport is None else self._transport.get_write_buffer_size()

    @property
    def sends_datagrams(self) -> bool:
        """Whether short messages go beside the stream."""
        return False

    def begin(self, stream: socket.socket) -> None:
        """Take over a connection, from the next turn of the loop on."""
        self._connecting = self._loop.create_task(self.connect(stream))  # asyncio's are weak

    async def connect(self, stream: socket.socket) -> None:
        """Take over a connection; never raises."""
        try:
            await self._loop.create_connection(lambda: self, sock=stream)
        except OSError as error:
            stream.close()
            self.connection_lost(error)

    @ends_link
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
        self._spoke_at = self._loop.time()
        self._handed_over_bytes += len(data)
        self._note_unsent()

    def _note_unsent(self) -> None:
        if (unsent_bytes := self.unsent_bytes) > self._max_unsent_bytes:
            self.end("does not read what it is sent", abort=True)
        else:
            self._settings.unsent.note(self, unsent_bytes)

    def send_message(self, kind: int, call: int, payload: bytes = b"") -> None:
        """Send a frame of a call; never waits."""
        self.send(encode_frame(kind, call, payload))

    def forget(self, call: int) -> None:
        """Ignore what still comes of a call."""

    def end(
        self, reason: str, *, goodbye: str | None = None, refused: bool = False, abort: bool = False
    ) -> None:
        """End the link; the owner is notified in a later turn of the loop. May be repeated.

        ``reason`` is about the other end, which gets ``goodbye`` as the reason before, unless it is
        None. ``abort`` drops unsent bytes.
        """
        if self._ended:
            return
        if not (abort or refused):
            self._flush()
            if self.ended:
                return
        if goodbye is not None:
            self.send(
                encode_goodbye(goodbye) if self._said_hello else MAGIC + encode_goodbye(goodbye)
            )
            if self.ended:  # the other end does not read
                return
        self._ended = True
        self.reason = reason
        self.refused = refused
        self._timer.cancel()
        self._unread = b""
        self._frames.clear()
        self._release_memory()
        self._loop.call_soon(self._notify_owner)
        transport = self._transport
        if transport is None:
            if self.without_stream and not self.closed.done():
                self.closed.set_result(None)
            return
        if abort:
            transport.abort()
            return
        if self.tls is not None:
            self.tls.close()
            transport.write(self.tls.take())
        transport.close()
        self._timer = self._loop.call_later(_CLOSE_TIMEOUT_S, transport.abort)

    def fail(self, error: Exception) -> None:
        """End the link after an exception that no code here expects."""
        self.end(f"has led to an error here ({type(error).__name__})", abort=True)
        self._owner.on_defect(self, error)

    def _release_memory(self) -> None:
        self._settings.partial_messages.note(self, 0)
        self._settings.unsent.note(self, 0)

    def refuse(self, reason: str) -> None:
        """End the link, and tell the other end why."""
        self.end(reason, goodbye=reason, refused=True)

    def _flush(self) -> None:
        """Send what only a stream can still deliver, before the link ends."""

    # -- callbacks of asyncio --------------------------------------------------------------------

    @ends_link
    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Send the hello or begin the handshake, if this end speaks first."""
        assert isinstance(transport, asyncio.Transport)
        if self._ended:
            transport.abort()
            self._transport = transport
            return
        self._transport = transport
        stream = transport.get_extra_info("socket")
        if stream is not None and stream.family != socket.AF_UNIX:
            if peer := transport.get_extra_info("peername"):
                self.address = host_and_port(str(peer[0]), peer[1])
            with contextlib.suppress(OSError):
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
        """Return the buffer for the next bytes."""
        del sizehint
        return self._settings.buffer

    @ends_link
    def buffer_updated(self, nbytes: int) -> None:
        """Take received bytes."""
        if self._ended:
            return
        self._unread, self._unread_at = bytes(self._settings.buffer[:nbytes]), 0
        now = self._heard_at = self._loop.time()
        if self.hello is not None:
            self._lease_ends_at = now + self._peer_lease_s
        if self._settings.scheduler.may_run(self.owner, now):
            self._run_slice()
        else:
            self._enqueue()

    def pause_writing(self) -> None:
        """Stop reading from an end that does not read."""
        if self._settings.pauses_for_readers:
            self._is_paused = True
            self._pause_reading()

    @ends_link
    def resume_writing(self) -> None:
        """Go on reading."""
        if self._is_paused:
            self._is_paused = False
            if not self._ended and not self._is_queued:
                self._enqueue()

    def eof_received(self) -> None:
        """Let asyncio close this end, as the other one has."""

    @ends_link
    def connection_lost(self, exc: Exception | None) -> None:
        """Handle the end of the connection."""
        if not self._ended and isinstance(exc, (ConnectionResetError, BrokenPipeError)):
            self._read_last_words()
        self._transport = None
        self._timer.cancel()
        if not self._ended:
            self._ended = True
            # A dying process resets the connection if it has unread bytes.
            if exc is not None and not isinstance(exc, (ConnectionResetError, BrokenPipeError)):
                self.reason = getattr(exc, "strerror", None) or str(exc)
            self._release_memory()
        self._notify_owner()
        if not self.closed.done():
            self.closed.set_result(None)

    def _read_last_words(self) -> None:
        """Look for a goodbye in what was received before a write noticed that the peer is gone."""
        stream = None if self._transport is None else self._transport.get_extra_info("socket")
        if stream is None:
            return
        # FrameError and OSError: an end that is gone may also have said nonsense.
        with contextlib.suppress(FrameError, OSError):
            data = self._unread[self._unread_at :] + os.read(stream.fileno(), _LAST_WORDS_BYTES)
            self._frames.extend(self._decoder.feed(self.tls.receive(data) if self.tls else data))
        self.said_goodbye |= any(frame.kind == GOODBYE for frame in self._frames)

    # -- receiving -------------------------------------------------------------------------------

    @ends_link
    def _run_slice(self) -> None:
        """Handle received bytes for one slice."""
        self._is_queued = False
        if self._ended or self._is_paused:
            return
        owner, began = self.owner, thread_time()
        try:
            while self._handle_next():
                if self.ended or self._is_paused:
                    break
                if (self._frames or self._unread) and thread_time() >= began + SLICE_S:
                    self._enqueue()
                    break
            else:
                if self._transport is not None:
                    self._transport.resume_reading()
        except FrameError as error:
            # Only a peer that speaks holdfast gets the reason.
            self.end(
                str(error), goodbye=str(error) if self.hello is not None else None, refused=True
            )
        self._settings.scheduler.charge(owner, thread_time() - began)

    def _handle_next(self) -> bool:
        """Handle one frame, decoded if need be; return whether there was anything."""
        frames, decoder = self._frames, self._decoder
        if frames:
            self._take(frames.popleft())
            return True
        if decoder.error is not None:
            raise decoder.error
        tls, data, at = self.tls, self._unread, self._unread_at
        if tls is not None and tls.ended:
            self.end("")
            return True
        if not data:
            return False
        if len(data) > _DECODED_AT_ONCE_BYTES:
            self._unread_at = at + _DECODED_AT_ONCE_BYTES
            data = data[at : self._unread_at]
        if self._unread_at == at or self._unread_at >= len(self._unread):
            self._unread, self._unread_at = b"", 0
        if tls is not None:
            data = self._decrypted(tls, data)
            if self.ended:
                return True
        frames.extend(decoder.feed(data))
        self._note_held_bytes()
        if frames:
            self._take(frames.popleft())
        return True

    def _note_held_bytes(self) -> None:
        held_bytes = self._decoder.held_bytes
        if self._is_queued:
            held_bytes += len(self._unread) - self._unread_at
        if held_bytes or self._holds:
            self._holds = held_bytes > 0
            self._settings.partial_messages.note(self, held_bytes)

    def _enqueue(self) -> None:
        self._is_queued = True
        self._pause_reading()
        self._note_held_bytes()
        self._settings.scheduler.enqueue(self.owner, self._run_slice)

    def _pause_reading(self) -> None:
        if self._transport is not None:
            self._transport.pause_reading()

    def _decrypted(self, tls: TlsStream, data: bytes) -> bytes:
        was_established = tls.established
        try:
            data = tls.receive(data)
        except OSError as error:  # ssl.SSLError; importing ssl is slow
            assert self._transport is not None
            self._transport.write(tls.take())  # the alert
            self.end(tls.describe_error(error), refused=True)
            return b""
        except FrameError:
            if data.startswith(MAGIC) and self._transport is not None:
                # A holdfast peer without TLS gets the reason in clear.
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
                self.refuse(str(error))
                return b""
            if self._speaks_first:
                self._say_hello()
            self._owner.on_handshake(self)
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
                self.refuse(refusal)
                return
            if not self._speaks_first:
                self._say_hello()
            self.hello = hello
            self._peer_lease_s = 1e-3 * hello.lease_ms
            self._lease_ends_at = self._loop.time() + self._peer_lease_s
            self._timer.cancel()
            self._tick()
            self._owner.on_hello(self, hello)
        elif kind == GOODBYE:
            reason = read_goodbye(frame.payload)
            self.said_goodbye = True
            if reason:
                self.end(f"refuses this end, which {reason}", refused=True)
            else:
                self._owner.on_goodbye(self)
        else:
            self._owner.on_frame(self, frame)

    def _say_hello(self) -> None:
        self._said_hello = True
        self.send(self._settings.hello())

    @ends_link
    def _notify_owner(self) -> None:
        if not self._notified:
            self._notified = True
            self._owner.on_ended(self)

    # -- time ------------------------------------------------------------------------------------

    @ends_link
    def _tick(self) -> None:
        """Check that the other end lives and reads, and send a ping if this end was silent."""
        now = self._loop.time()
        self._extend_lease_if_unread(now)
        if now >= self._lease_ends_at:
            # If this process has stalled, first read what came meanwhile.
            self._loop.call_soon(self._loop.call_soon, self._end_if_silent, now)
            return
        valid_s = math.inf if self.peer is None else self.peer.expires_at - time()
        if valid_s <= 0.0:
            self.refuse(_EXPIRED)
            return
        transport = self._transport
        if self.hello is not None and transport is not None:
            if self._owes_ping(now):
                self.send(_PING)
            self._note_unsent()
            unsent = transport.get_write_buffer_size()
            sent_bytes = self._handed_over_bytes - unsent
            if unsent == 0 or sent_bytes != self._progress_bytes:
                self._progress_at, self._progress_bytes = now, sent_bytes
            elif now >= self._progress_at + STALLED_S:
                self.end("does not read what it is sent", abort=True)
            if self._ended:
                return
        due = self._lease_ends_at
        if self.hello is not None:
            due = min(due, now + self._ping_interval_s, now + valid_s)
        self._timer = self._loop.call_at(due, self._tick)

    def _owes_ping(self, now: float) -> bool:
        """Whether nothing was sent since the last tick, or little later."""
        return self._spoke_at < now - 0.9 * self._ping_interval_s

    @ends_link
    def _end_if_silent(self, checked_at: float) -> None:
        if self._ended:
            return
        self._extend_lease_if_unread(self._loop.time())
        # Not the time of now: this process may have stalled again since it has read.
        if checked_at < self._lease_ends_at:
            self._tick()
        elif self.hello is None:
            self.end(f"has said no hello within {OPENING_TIMEOUT_S:g} s", abort=True)
        else:
            self.end(f"was silent for {1e3 * self._peer_lease_s:g} ms", abort=True)

    def _extend_lease_if_unread(self, now: float) -> None:
        """Extend the lease of a peer from which this end does not read."""
        if self.hello is not None and (self._is_queued or self._is_paused):
            self._lease_ends_at = now + self._peer_lease_s
