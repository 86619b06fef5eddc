"""``udp``: a link whose short messages go as encrypted datagrams, beside its TLS stream.

The stream proves who both ends are, transports the keys of the datagrams, and carries long
messages. Everything else goes as datagrams once one has got through in both directions: a lost
datagram delays nothing but itself. Where none gets through, everything goes on the stream.

For its owner the link is like any other: it takes and delivers frames of calls, and is lost once:

- at once when the other end closes the stream, which the system does for a process that dies;
- a round trip after a report that the service's port is closed (anybody can forge one), unless a
  datagram comes meanwhile;
- when nothing comes for the lease on either path.

When the stream breaks in another way while datagrams still come, the link goes on with datagrams
alone (``without_stream``), while its owner makes another. A service replies to the address that
was proved last (:mod:`~holdfast.transport.return_path`).
"""

from __future__ import annotations

import asyncio
import errno
import socket
import struct
from collections import deque
from time import thread_time
from typing import Any, Final

from holdfast.errors import FrameError, KeysExhaustedError
from holdfast.transport.datagram_cipher import AssociationKeys, DatagramCipher
from holdfast.transport.datagram_sockets import (
    DATAGRAMS_AT_ONCE,
    LARGEST_DATAGRAM,
    QUOTED_BYTES,
    DatagramSocket,
    connected_socket,
    reported_errors,
)
from holdfast.transport.exchanges import (
    ECHO,
    MESSAGE_OVERHEAD,
    PROBE,
    ReceivedReply,
    RobotExchange,
    ServiceExchange,
)
from holdfast.transport.frames import (
    CALL,
    END,
    HELLO,
    KEYS,
    LAST,
    MESSAGE,
    REPLY,
    Frame,
    FrameDecoder,
    encode_frame,
)
from holdfast.transport.link_settings import SLICE_S, LinkSettings
from holdfast.transport.links import Link, LinkOwner, ends_link
from holdfast.transport.redundancy import Paths
from holdfast.transport.return_path import SECRET_BYTES, ReturnPath
from holdfast.transport.tls import TlsStream

_KEYS: Final = struct.Struct(">I32s32sH")
"""Association, both keys, and the service's port; 0 is the stream's."""

_STREAM_PING_S: Final = 1.5
"""Between pings on the stream while datagrams show that both ends live."""

_MAX_BACKLOG: Final = 64
"""Messages of a link that wait for the scheduler; further ones are dropped."""

_MAX_DROPPED: Final = 4096
"""A link that has had so many messages dropped is ended."""

_STREAM_SILENT_S: Final = 5.0
_STREAM_SILENT_LEASES: Final = 3.0
"""A stream that is silent for so long, and so many leases, while datagrams come is given up."""

_BLOCKED_AFTER_S: Final = 3.0
"""Without a datagram from the service for this long, datagrams count as blocked."""

_VERIFYING_PROBES: Final = 5
_PROBE_DISTANCE_S: Final = 0.003
_PROBES_BEFORE_NEW_SOCKET: Final = 2

_BROKEN: Final = "has broken the connection, and answers no datagram"
_CLOSED: Final = "is gone: its port is closed"

_REMEMBERED_DATAGRAMS: Final = 64
"""More than are in flight at a time."""

_OVERRUN: Final = "sends more datagrams than can be heard beside those of others"

_ADDRESS_GONE: Final = frozenset(
    {errno.EINVAL, errno.EADDRNOTAVAIL, errno.ENETUNREACH, errno.EHOSTUNREACH, errno.ENETDOWN}
)
"""Errors of a socket whose own address has disappeared."""


class _DatagramLink(Link):
    """Common to both ends."""

    _exchange: RobotExchange | ServiceExchange

    def __init__(
        self, owner: LinkOwner, settings: LinkSettings, *, speaks_first: bool, tls: TlsStream
    ) -> None:
        super().__init__(owner, settings, speaks_first=speaks_first, tls=tls)
        self._decoder = FrameDecoder(
            settings.max_message_bytes,
            more={KEYS: _KEYS.size, MESSAGE: settings.max_message_bytes + MESSAGE_OVERHEAD},
        )
        self._cipher: DatagramCipher | None = None
        self._due_at = float("inf")
        self._due: asyncio.TimerHandle | None = None
        self._datagram_heard_at = self._datagram_sent_at = float("-inf")
        self._backlog: deque[bytes] = deque()  # messages that wait for the scheduler
        self._num_dropped = 0
        self._paths = Paths(self._send_datagram, self._send_on_stream, self._num_lost)

    # -- sending ---------------------------------------------------------------------------------

    def _send_on_stream(self, number: int, message: bytes) -> None:
        self.send(encode_frame(MESSAGE, number, message))

    def _send_datagram(self, message: bytes) -> None:
        datagram = self._encrypted(message)
        if datagram is not None:
            self._datagram_sent_at = self._loop.time()
            self._put(datagram)

    def _encrypted(self, message: bytes) -> bytes | None:
        """Return the datagram of a message; None if nothing can be sent any more."""
        if self._ended or self._cipher is None:
            return None
        try:
            return self._cipher.encrypt(message)
        except KeysExhaustedError as error:
            self.end(f"needs a new link: {error}")
            return None

    def _put(self, datagram: bytes) -> None:
        raise NotImplementedError

    def _num_lost(self) -> int:
        return 1 if self._cipher is None else self._cipher.window.num_lost  # 1: unknown

    # -- receiving -------------------------------------------------------------------------------

    @ends_link
    def take_datagram(self, datagram: bytes, address: Any) -> None:
        """Take a datagram with this link's association; it may be forged."""
        cipher = self._cipher
        if self._ended or cipher is None:
            return
        newest = cipher.window.newest
        message = cipher.decrypt(datagram)
        if message is None:
            return
        now = self._datagram_heard_at = self._loop.time()
        self._lease_ends_at = max(self._lease_ends_at, now + self._peer_lease_s)
        self._note_address(message, address, now, newest=cipher.window.newest > newest)
        if self.ended:
            return
        # Charged after decryption: forged datagrams must not use up the owner's slices.
        backlog, scheduler = self._backlog, self._settings.scheduler
        if not backlog and scheduler.may_run(self.owner, now):
            began = thread_time()
            self._handle(message)
            scheduler.charge(self.owner, thread_time() - began)
        elif len(backlog) < _MAX_BACKLOG:
            backlog.append(message)
            if len(backlog) == 1:
                scheduler.enqueue(self.owner, self._handle_backlog)
        else:
            self._num_dropped += 1
            if self._num_dropped >= _MAX_DROPPED:
                self.refuse(_OVERRUN)

    def _note_address(self, message: bytes, address: Any, now: float, *, newest: bool) -> None:
        """Take note of where an authentic datagram has come from."""

    @ends_link
    def _handle_backlog(self) -> None:
        """Handle waiting messages for one slice."""
        backlog, scheduler = self._backlog, self._settings.scheduler
        began = now = thread_time()
        while backlog and not self._ended and now < began + SLICE_S:
            self._handle(backlog[0])
            backlog.popleft()
            now = thread_time()
        scheduler.charge(self.owner, now - began)
        if self._ended:
            backlog.clear()
        elif backlog:
            scheduler.enqueue(self.owner, self._handle_backlog)

    def _handle(self, message: bytes) -> None:
        try:
            self._received(message, datagram=True)
        except FrameError as error:
            self.refuse(str(error))

    def _received(self, message: bytes, *, datagram: bool) -> None:
        raise NotImplementedError

    # -- the stream breaks -----------------------------------------------------------------------

    def connection_lost(self, exc: Exception | None) -> None:
        """Take note that the stream is gone."""
        if self.without_stream or (exc is not None and not self._ended and self._detach()):
            self._transport = None
            if self._ended:
                super().connection_lost(exc)
            return
        super().connection_lost(exc)

    def _detach(self) -> bool:
        """Go on with datagrams alone, if some have come lately; return whether it does."""
        if self._loop.time() > self._datagram_heard_at + self._peer_lease_s:
            return False
        self.without_stream = True
        return True

    def _tick(self) -> None:
        transport = self._transport
        now = self._loop.time()
        longest_s = max(_STREAM_SILENT_S, _STREAM_SILENT_LEASES * self._peer_lease_s)
        silent = now > self._heard_at + longest_s
        if silent and transport is not None and not self.without_stream and self._detach():
            transport.abort()
        super()._tick()

    def _owes_ping(self, now: float) -> bool:
        heard_beside = now < self._datagram_heard_at + self._peer_lease_s
        spoke_beside = now < self._datagram_sent_at + self._ping_interval_s
        if heard_beside and spoke_beside:  # datagrams show that this end lives
            return now >= self._spoke_at + _STREAM_PING_S
        return super()._owes_ping(now)

    def _notify_owner(self) -> None:
        if self._due is not None:
            self._due.cancel()
            self._due = None
        self._cipher = None
        super()._notify_owner()

    # -- time ------------------------------------------------------------------------------------

    def _plan(self, due_at: float) -> None:
        """Have :meth:`_expire` called when the exchange has something due."""
        if self._ended or due_at >= self._due_at:
            return
        if self._due is not None:
            self._due.cancel()
        self._due_at = due_at
        self._due = self._loop.call_at(due_at, self._expire)

    @ends_link
    def _expire(self) -> None:
        self._due, self._due_at = None, float("inf")
        self._exchange.expire(self._loop.time())
        self._plan(self._exchange.due)


class RobotDatagramLink(_DatagramLink):
    """The robot's end: it sends requests."""

    _exchange: RobotExchange

    def __init__(self, owner: LinkOwner, settings: LinkSettings, *, tls: TlsStream) -> None:
        super().__init__(owner, settings, speaks_first=True, tls=tls)
        self._exchange = RobotExchange(self._paths)
        self._socket: socket.socket | None = None
        self._service_address: Any = None
        self._sent: deque[bytes] = deque(maxlen=_REMEMBERED_DATAGRAMS)
        self._verifies = False
        self._blocked_since: float | None = None

    @property
    def sends_datagrams(self) -> bool:
        """Whether short messages go beside the stream."""
        return self._exchange.open

    @ends_link
    def send_message(self, kind: int, call: int, payload: bytes = b"") -> None:
        """Send a request."""
        if kind != CALL:
            super().send_message(kind, call, payload)
            return
        self._exchange.send(call, payload, self._loop.time())
        self._plan(self._exchange.due)

    def forget(self, call: int) -> None:
        """Abandon a call."""
        self._exchange.abandon(call)

    def _take(self, frame: Frame) -> None:
        if frame.kind == KEYS:
            self._take_keys(frame.payload)
        elif frame.kind == MESSAGE:
            if frame.skipped_bytes:
                self._deliver(self._exchange.oversized(frame.call))
            else:
                self._received(frame.payload, datagram=False)
        else:
            super()._take(frame)

    def _take_keys(self, payload: bytes) -> None:
        if self._cipher is not None or len(payload) != _KEYS.size or self._transport is None:
            raise FrameError("sends unexpected keys")
        association, to_service, to_robot, port = _KEYS.unpack(payload)
        self._cipher = DatagramCipher(
            AssociationKeys(association, to_service, to_robot), service=False
        )
        address = self._transport.get_extra_info("peername")
        self._service_address = (address[0], port or address[1], *address[2:])
        self._blocked_since = self._loop.time()
        self._open_socket()
        self._exchange.begin(self._loop.time())
        self._plan(self._exchange.due)

    # -- the socket ------------------------------------------------------------------------------

    def _open_socket(self) -> None:
        """Open a socket, from the address that the robot has now."""
        self._close_socket()
        self._socket = connected_socket(self._service_address)
        if self._socket is not None:  # else the next probe tries again
            self._loop.add_reader(self._socket, self._readable, self._socket)

    def _close_socket(self) -> None:
        if self._socket is not None:
            self._loop.remove_reader(self._socket)
            self._socket.close()
            self._socket = None

    def _put(self, datagram: bytes) -> None:
        self._sent.append(datagram[:QUOTED_BYTES])
        for _ in range(2):
            if self._socket is None:
                return
            try:
                self._socket.send(datagram)
            except OSError as error:
                # An error of an earlier datagram is reported instead of sending this one.
                if self._failed(error):
                    continue
            return

    @ends_link
    def _readable(self, opened: socket.socket) -> None:
        for _ in range(DATAGRAMS_AT_ONCE):
            if self._socket is not opened:
                return
            try:
                datagram = opened.recv(LARGEST_DATAGRAM)
            except (BlockingIOError, InterruptedError):
                break
            except OSError as error:
                if self._failed(error):
                    continue
                return
            self.take_datagram(datagram, self._service_address)

    def _failed(self, error: OSError) -> bool:
        """Handle a socket's error; return whether it is about an earlier datagram."""
        if self._socket is None:
            return False
        about_earlier = False
        for quoted, is_closed in reported_errors(self._socket):
            about_earlier = True
            if is_closed and quoted in self._sent and self._exchange.open:
                self._loop.call_soon(self._verify_path, _CLOSED)
        if not about_earlier and error.errno in _ADDRESS_GONE:
            self._close_socket()
        return about_earlier

    def _received(self, message: bytes, *, datagram: bool) -> None:
        self._deliver(self._exchange.received(message, self._loop.time(), datagram=datagram))
        self._plan(self._exchange.due)

    def _deliver(self, replies: list[ReceivedReply]) -> None:
        for call, payload, last in replies:
            if self._ended:
                return
            if payload is None:
                self._owner.on_frame(self, Frame(END, call, b""))
            else:
                self._owner.on_frame(self, Frame(LAST if last else REPLY, call, payload))

    def _verify_path(self, reason: str) -> None:
        """Probe, and end the link for this reason if no datagram comes."""
        if not self._verifies:
            self._verifies = True
            if self._socket is not None:
                self._readable(self._socket)  # what lies there came before
            self._verify(reason, self._loop.time(), _VERIFYING_PROBES)

    @ends_link
    def _verify(self, reason: str, since: float, num_probes: int) -> None:
        if num_probes > 0 and not self._ended:
            if self._socket is None:
                self._open_socket()
            # A report of a router is no reason to take another socket.
            self._exchange.probe(self._loop.time(), counted=reason is not _CLOSED)
            # The last one has time to be answered, even if this process has stood still.
            wait_s = _PROBE_DISTANCE_S if num_probes > 1 else self._exchange.round_trip.timeout_s
            self._loop.call_later(wait_s, self._verify, reason, since, num_probes - 1)
            return
        self._verifies = False
        if self._socket is not None:
            self._readable(self._socket)
        if self._datagram_heard_at <= since:
            self.end(reason, abort=True)

    # -- the stream breaks -----------------------------------------------------------------------

    def _detach(self) -> bool:
        if not self._exchange.open or not super()._detach():
            return False
        self._loop.call_soon(self._verify_path, _BROKEN)
        self._owner.on_stream_lost(self)
        return True

    def _tick(self) -> None:
        now = self._loop.time()
        due = now >= self._datagram_sent_at + 0.9 * self._ping_interval_s
        if due and (self._exchange.open or self.without_stream):
            self._exchange.probe(now)
        super()._tick()
        if self._exchange.open:
            self._blocked_since = None
        elif self._cipher is not None and not self._ended:
            if self._blocked_since is None:
                self._blocked_since = now
            elif now > self._blocked_since + _BLOCKED_AFTER_S:
                self._owner.on_datagrams_blocked(self)

    def _expire(self) -> None:
        if self._exchange.unanswered_probes >= _PROBES_BEFORE_NEW_SOCKET:
            self._open_socket()
        super()._expire()

    def _notify_owner(self) -> None:
        self._close_socket()
        super()._notify_owner()


class ServiceDatagramLink(_DatagramLink):
    """The service's end: it replies."""

    _exchange: ServiceExchange

    def __init__(
        self,
        owner: LinkOwner,
        settings: LinkSettings,
        *,
        tls: TlsStream,
        sockets: dict[Any, DatagramSocket],
    ) -> None:
        super().__init__(owner, settings, speaks_first=False, tls=tls)
        self._exchange = ServiceExchange(self._paths)
        self._sockets = sockets
        self._socket: DatagramSocket | None = None
        self._return_path = ReturnPath()

    @property
    def unsent_bytes(self) -> int:
        """Bytes that wait until the other end reads, or confirms that it has them."""
        return super().unsent_bytes + self._exchange.held_bytes

    @ends_link
    def send_message(self, kind: int, call: int, payload: bytes = b"") -> None:
        """Send a reply."""
        if kind not in (REPLY, LAST, END):
            super().send_message(kind, call, payload)
            return
        self._exchange.reply(
            call, None if kind == END else payload, self._loop.time(), last=kind != REPLY
        )
        self._note_unsent()
        self._plan(self._exchange.due)

    def _take(self, frame: Frame) -> None:
        if frame.kind == MESSAGE:
            if not frame.skipped_bytes:
                self._received(frame.payload, datagram=False)
            elif self._exchange.oversized(frame.call):
                self._owner.on_frame(self, Frame(CALL, frame.call, b"", frame.skipped_bytes))
        elif frame.kind == CALL:
            raise FrameError(
                "is at tls/..., and the other end at udp/...: write the same at both ends"
            )
        elif frame.kind == KEYS:
            raise FrameError(f"is a robot and sends a frame of kind {frame.kind}")
        else:
            super()._take(frame)
            if frame.kind == HELLO and not self._ended:
                self._send_keys()

    def _send_keys(self) -> None:
        assert self._transport is not None and self.peer is not None  # as TLS has proved
        address = self._transport.get_extra_info("sockname")
        try:
            self._socket = self._sockets.get(address) or DatagramSocket(address)
        except OSError:
            return  # the system has no socket left; the stream carries all
        self._sockets[address] = self._socket
        keys = self._socket.add(self.take_datagram)
        self._cipher = DatagramCipher(keys, service=True)
        port = self._socket.port
        content = _KEYS.pack(*keys, 0 if port == address[1] else port)
        self.send(encode_frame(KEYS, 0, content))

    def _received(self, message: bytes, *, datagram: bool) -> None:
        arrived = self._exchange.received(message, datagram=datagram)
        if arrived is not None:
            self._owner.on_frame(self, Frame(CALL, arrived.number, arrived.payload))

    def _note_address(self, message: bytes, address: Any, now: float, *, newest: bool) -> None:
        if message[:1] == bytes((ECHO,)):
            self._return_path.echoed(message[-SECRET_BYTES:], address, now)
            return
        for probe in self._return_path.heard(address, now, newest=newest):
            lost = min(255, self._num_lost())
            datagram = self._encrypted(bytes((PROBE, lost)) + probe.secret)
            if datagram is not None and self._socket is not None:
                self._socket.send(datagram, probe.address)

    def _send_datagram(self, message: bytes) -> None:
        # Without an address nothing is encrypted: a counter that goes nowhere would count as lost.
        if self._return_path.address is not None:
            super()._send_datagram(message)

    def _put(self, datagram: bytes) -> None:
        if self._socket is not None:
            self._socket.send(datagram, self._return_path.address)

    @ends_link
    def _flush(self) -> None:
        self._exchange.flush()

    def _notify_owner(self) -> None:
        if self._socket is not None and self._cipher is not None:
            self._socket.remove(self._cipher.association)
            if self._socket.is_idle:
                self._socket.close()
                self._sockets.pop(self._socket.address, None)
        super()._notify_owner()
