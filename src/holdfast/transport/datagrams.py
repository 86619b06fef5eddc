"""A link whose short messages go as sealed datagrams, beside the TLS stream that it began with.

The stream proves who both ends are, hands over the keys of the datagrams, and carries what is
large. Everything else is sent as datagrams as soon as one has got through in both directions: a
datagram that is lost holds up nobody but itself. Where none gets through, all goes on the stream.

The link is what its owner knows from streams: it takes frames of calls, hands over frames of calls,
and is lost once. It is lost

- at once when the other end closes the stream, which the system does for a process that dies;
- when the service's host says that nobody has its port any more, and quotes a datagram that was
  sent there lately. Anybody can say the first (ICMP has no keys), but only who has seen the
  datagram can quote what was sealed; and who sees what is sent can reset a stream as well;
- when nothing comes for the lease, neither on the stream nor beside it.

It is not lost when the stream breaks in any other way while datagrams come: a robot's address has
changed, for instance. Then it is *adrift*: it goes on by datagrams alone, while its owner makes
another link. A service answers wherever the last new datagram has come from.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import socket
import struct
from collections import deque
from typing import Any, Final

from holdfast.transport.exchanges import MESSAGE_OVERHEAD, Answers, Part, Questions, Ways
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
    FrameError,
    encode_frame,
)
from holdfast.transport.links import Link, LinkOwner, LinkSettings
from holdfast.transport.sealing import Keys, KeysExhaustedError, Sealing, association_of
from holdfast.transport.tls import TlsStream
from holdfast.transport.turns import TURN_S

__all__ = ["DatagramSockets", "RobotDatagramLink", "ServiceDatagramLink"]

_KEYS: Final = struct.Struct(">I32s32sH")
"""Association, both keys, and the service's port; 0 is the one at which the stream was opened."""

_LARGEST_DATAGRAM: Final = 2048
_DATAGRAMS_AT_ONCE: Final = 64
"""Before streams are heard again."""

_STREAM_PING_S: Final = 1.5
"""So often a stream shows that it lives, while datagrams show that its ends do."""

_MAX_LATE: Final = 64
"""Messages of a link that wait for its turn; what is beyond is lost, as any datagram may be."""

_MAX_OVERRUN: Final = 4096
"""Who has lost so many of them loses the link as well."""

_WAITING_IN_SYSTEM_BYTES: Final = 1 << 20
"""Asked for: what one robot sends too much of is to be read, not to be in the way of others'."""

_STREAM_SILENT_S: Final = 5.0
_STREAM_SILENT_LEASES: Final = 3.0
"""For so long, and so many leases, nothing may come on a stream while datagrams do."""

_CLOSED_TO_DATAGRAMS_S: Final = 3.0
"""After so long somebody is told that none gets through."""

_PROBES_OF_DOUBT: Final = 3
_PROBE_DISTANCE_S: Final = 0.003
_PROBES_BEFORE_NEW_SOCKET: Final = 2

_REPORTS_ERRORS: Final = {
    socket.AF_INET: (socket.IPPROTO_IP, 11),
    socket.AF_INET6: (socket.IPPROTO_IPV6, 25),
}
"""Linux's IP_RECVERR and IPV6_RECVERR: errors are kept with what they quote."""

_ERROR: Final = struct.Struct("=I")
_ERROR_BYTES: Final = 512
_QUOTED_BYTES: Final = 32
"""Of a datagram: eight that can be guessed, and 24 sealed ones. None of ours is shorter."""

_QUOTABLE: Final = 64
"""The last datagrams, more than are on their way at a time."""

_OVERRUN: Final = "sends more datagrams than can be heard beside those of others"

_NO_WAY: Final = frozenset(
    {errno.EINVAL, errno.EADDRNOTAVAIL, errno.ENETUNREACH, errno.EHOSTUNREACH, errno.ENETDOWN}
)
"""What the system says of a socket whose own address is gone."""


class _Late:
    """Messages of a link that came in datagrams and wait for its turn."""

    def __init__(self, link: _DatagramLink) -> None:
        self._link = link
        self.messages: deque[bytes] = deque()
        self.overrun = 0

    @property
    def owner(self) -> object:
        return self._link.owner

    def go_on(self) -> None:
        self._link.take_late()


class _DatagramLink(Link):
    """What both ends have in common."""

    def __init__(
        self, owner: LinkOwner, settings: LinkSettings, *, speaks_first: bool, tls: TlsStream
    ) -> None:
        super().__init__(owner, settings, speaks_first=speaks_first, tls=tls)
        self._decoder = FrameDecoder(
            settings.max_message_bytes,
            more={KEYS: _KEYS.size, MESSAGE: settings.max_message_bytes + MESSAGE_OVERHEAD},
        )
        self._sealing: Sealing | None = None
        self._due_at = float("inf")
        self._due: asyncio.TimerHandle | None = None
        self._stream_heard_at = self._stream_spoke_at = self._loop.time()
        self._datagram_heard_at = self._datagram_sent_at = float("-inf")
        self._peer_address: Any = None
        self._late = _Late(self)
        self._ways = Ways(self._send_datagram, self._send_on_stream, self._lost_of_theirs)

    # -- sending ---------------------------------------------------------------------------------

    def send(self, data: bytes) -> None:
        """Send frames on the stream; never waits."""
        self._stream_spoke_at = self._loop.time()
        super().send(data)

    def _send_on_stream(self, number: int, message: bytes) -> None:
        self.send(encode_frame(MESSAGE, number, message))

    def _send_datagram(self, message: bytes) -> None:
        if self._ended or self._sealing is None:
            return
        try:
            datagram = self._sealing.seal(message)
        except KeysExhaustedError as error:
            self.end(f"has to be called anew: {error}")
            return
        self._datagram_sent_at = self._loop.time()
        self._put(datagram)

    def _put(self, datagram: bytes) -> None:
        raise NotImplementedError

    def _lost_of_theirs(self) -> int:
        return 1 if self._sealing is None else self._sealing.window.lost  # 1: nobody knows

    # -- receiving -------------------------------------------------------------------------------

    def buffer_updated(self, nbytes: int) -> None:
        """Take what has come on the stream."""
        self._stream_heard_at = self._loop.time()
        super().buffer_updated(nbytes)

    def take_datagram(self, datagram: bytes, address: Any) -> None:
        """Take a datagram that claims to be of this link."""
        sealing = self._sealing
        if self._ended or sealing is None:
            return
        newest = sealing.window.newest
        message = sealing.open(datagram)
        if message is None:
            return
        if sealing.window.newest > newest:
            # Of older ones, one that was held back could lead the answers to where nobody is.
            self._peer_address = address
        now = self._datagram_heard_at = self._loop.time()
        self._silent_at = max(self._silent_at, now + self._patience_s)
        # Only now, for by what is forged nobody is to lose a turn.
        late, turns = self._late, self._settings.turns
        if not late.messages and turns.may_go_on(self.owner, now):
            self._handle(message)
            turns.spend(self.owner, self._loop.time() - now)
        elif len(late.messages) < _MAX_LATE:
            late.messages.append(message)
            if len(late.messages) == 1:
                turns.wait(late)
        else:
            late.overrun += 1
            if late.overrun >= _MAX_OVERRUN:
                self.end(_OVERRUN, goodbye=_OVERRUN, refused=True)

    def take_late(self) -> None:
        """Take the messages that have waited, for one turn."""
        late, turns = self._late, self._settings.turns
        began = now = self._loop.time()
        while late.messages and not self._ended and now < began + TURN_S:
            self._handle(late.messages[0])
            late.messages.popleft()
            now = self._loop.time()
        turns.spend(self.owner, now - began)
        if self._ended:
            late.messages.clear()
        elif late.messages:
            turns.wait(late)

    def _handle(self, message: bytes) -> None:
        try:
            self._received(message, datagram=True)
        except FrameError as error:
            self.end(str(error), goodbye=str(error), refused=True)

    def _received(self, message: bytes, *, datagram: bool) -> None:
        raise NotImplementedError

    # -- the stream breaks -----------------------------------------------------------------------

    def connection_lost(self, exc: Exception | None) -> None:
        """Take note that the stream is gone."""
        if self.adrift or (exc is not None and not self._ended and self._drift()):
            self._transport = None
            if self._ended:
                super().connection_lost(exc)
            return
        super().connection_lost(exc)

    def _drift(self) -> bool:
        """Go on without the stream, if datagrams have come lately."""
        if self._loop.time() > self._datagram_heard_at + self._patience_s:
            return False
        self.adrift = True
        return True

    def _tick(self) -> None:
        transport = self._transport
        now = self._loop.time()
        longest_s = max(_STREAM_SILENT_S, _STREAM_SILENT_LEASES * self._patience_s)
        silent = now > self._stream_heard_at + longest_s
        if silent and transport is not None and not self.adrift and self._drift():
            transport.abort()
        heard_beside = now < self._datagram_heard_at + self._patience_s
        spoke_beside = now < self._datagram_sent_at + self._ping_interval_s
        if heard_beside and spoke_beside and now < self._stream_spoke_at + _STREAM_PING_S:
            self._spoke = True  # a datagram is a sign of life, and nothing holds it up
        super()._tick()

    def end(
        self,
        reason: str,
        *,
        goodbye: str | None = None,
        refused: bool = False,
        abort: bool = False,
    ) -> None:
        """End the link: see :class:`~holdfast.transport.links.Link`."""
        super().end(reason, goodbye=goodbye, refused=refused, abort=abort)
        if self._ended and self.adrift and self._transport is None and not self.closed.done():
            self.closed.set_result(None)

    def _tell(self) -> None:
        if self._due is not None:
            self._due.cancel()
            self._due = None
        self._sealing = None
        super()._tell()

    # -- time ------------------------------------------------------------------------------------

    def _plan(self, due_at: float) -> None:
        """See to it that something is done when it is due."""
        if self._ended or due_at >= self._due_at:
            return
        if self._due is not None:
            self._due.cancel()
        self._due_at = due_at
        self._due = self._loop.call_at(due_at, self._expire)

    def _expire(self) -> None:
        raise NotImplementedError


class RobotDatagramLink(_DatagramLink):
    """The robot's end; it asks."""

    def __init__(self, owner: LinkOwner, settings: LinkSettings, *, tls: TlsStream) -> None:
        super().__init__(owner, settings, speaks_first=True, tls=tls)
        self._questions = Questions(self._ways)
        self._socket: socket.socket | None = None
        self._sent: deque[bytes] = deque(maxlen=_QUOTABLE)
        self._closed_since: float | None = None
        self._told_closed = False

    @property
    def sends_datagrams(self) -> bool:
        """Whether short messages go beside the stream."""
        return self._questions.open

    def send_message(self, kind: int, call: int, payload: bytes = b"") -> None:
        """Ask."""
        if kind != CALL:
            super().send_message(kind, call, payload)
            return
        self._questions.ask(call, payload, self._loop.time())
        self._plan(self._questions.due)

    def forget(self, call: int) -> None:
        """Ask no more for what is still to come of a call."""
        self._questions.forget(call)

    def _take(self, frame: Frame) -> None:
        if frame.kind == KEYS:
            self._take_keys(frame.payload)
        elif frame.kind == MESSAGE:
            if frame.passed_over_bytes:
                self._hand_over(self._questions.passed_over(frame.call))
            else:
                self._received(frame.payload, datagram=False)
        else:
            super()._take(frame)

    def _take_keys(self, payload: bytes) -> None:
        if self._sealing is not None or len(payload) != _KEYS.size or self._transport is None:
            raise FrameError("hands over keys that were not awaited")
        association, to_service, to_robot, port = _KEYS.unpack(payload)
        self._sealing = Sealing(Keys(association, to_service, to_robot), service=False)
        address = self._transport.get_extra_info("peername")
        self._peer_address = (address[0], port or address[1], *address[2:])
        self._closed_since = self._loop.time()
        self._open_socket()
        self._questions.begin(self._loop.time())
        self._plan(self._questions.due)

    # -- the socket ------------------------------------------------------------------------------

    def _open_socket(self) -> None:
        """Open a socket from whatever address the robot has now."""
        self._close_socket()
        family = socket.AF_INET6 if len(self._peer_address) == 4 else socket.AF_INET
        opened = socket.socket(family, socket.SOCK_DGRAM)
        try:
            opened.setblocking(False)
            # Connected, it hears from nobody else, and hears when nobody has the service's port.
            opened.connect(self._peer_address)
            opened.setsockopt(*_REPORTS_ERRORS[family], 1)
        except OSError:
            opened.close()
            return  # it is tried again with the next probe
        self._socket = opened
        self._loop.add_reader(opened, self._readable, opened)

    def _close_socket(self) -> None:
        if self._socket is not None:
            self._loop.remove_reader(self._socket)
            self._socket.close()
            self._socket = None

    def _put(self, datagram: bytes) -> None:
        self._sent.append(datagram[:_QUOTED_BYTES])
        for _ in range(2):
            if self._socket is None:
                return
            try:
                self._socket.send(datagram)
            except OSError as error:
                # What became of an earlier one is told instead of sending this one.
                if self._failed(error):
                    continue
            return  # else it is lost, as any datagram may be

    def _readable(self, opened: socket.socket) -> None:
        for _ in range(_DATAGRAMS_AT_ONCE):
            if self._socket is not opened:
                return
            try:
                datagram = opened.recv(_LARGEST_DATAGRAM)
            except (BlockingIOError, InterruptedError):
                break
            except OSError as error:
                if self._failed(error):
                    continue
                return
            self.take_datagram(datagram, self._peer_address)

    def _failed(self, error: OSError) -> bool:
        """Find out what an error is about; return whether it is about a datagram of before."""
        about_earlier = False
        for _ in range(_DATAGRAMS_AT_ONCE):
            if self._socket is None:
                return False
            try:
                quoted, told, _, _ = self._socket.recvmsg(
                    _QUOTED_BYTES, _ERROR_BYTES, socket.MSG_ERRQUEUE
                )
            except OSError:
                break
            about_earlier = True
            refused = any(_ERROR.unpack_from(each)[0] == errno.ECONNREFUSED for *_, each in told)
            if refused and quoted in self._sent and self._questions.open:
                self.end("is gone: nobody has its port any more", abort=True)
                return False
        if not about_earlier and error.errno in _NO_WAY:
            self._close_socket()
        return about_earlier

    def _received(self, message: bytes, *, datagram: bool) -> None:
        self._hand_over(self._questions.received(message, self._loop.time(), datagram=datagram))
        self._plan(self._questions.due)

    def _hand_over(self, parts: list[Part]) -> None:
        for call, payload, last in parts:
            if self._ended:
                return
            if payload is None:
                self._owner.received(self, Frame(END, call, b""))
            else:
                self._owner.received(self, Frame(LAST if last else REPLY, call, payload))

    def _doubt(self) -> None:
        """End the link if no datagram is answered now."""
        now = self._loop.time()
        for k in range(_PROBES_OF_DOUBT):
            self._loop.call_later(k * _PROBE_DISTANCE_S, self._probe)
        self._loop.call_later(
            self._questions.round_trips.patience_s + _PROBES_OF_DOUBT * _PROBE_DISTANCE_S,
            self._decide,
            now,
        )

    def _probe(self) -> None:
        if not self._ended:
            self._questions.probe(self._loop.time())

    def _decide(self, since: float) -> None:
        if not self._ended and self._datagram_heard_at <= since:
            self.end("has broken the connection, and answers no datagram", abort=True)

    # -- the stream breaks -----------------------------------------------------------------------

    def _drift(self) -> bool:
        if not self._questions.open or not super()._drift():
            return False
        self._doubt()
        self._owner.went_adrift(self)
        return True

    def _tick(self) -> None:
        now = self._loop.time()
        due = now >= self._datagram_sent_at + 0.9 * self._ping_interval_s
        if due and (self._questions.open or self.adrift):
            self._probe()
        super()._tick()
        if self._questions.open:
            self._closed_since = None
        elif self._sealing is not None and not self._ended:
            if self._closed_since is None:
                self._closed_since = now
            elif now > self._closed_since + _CLOSED_TO_DATAGRAMS_S and not self._told_closed:
                self._told_closed = True
                self._owner.closed_to_datagrams(self)

    def _expire(self) -> None:
        self._due, self._due_at = None, float("inf")
        if self._questions.unanswered_probes >= _PROBES_BEFORE_NEW_SOCKET:
            self._open_socket()
        self._questions.expire(self._loop.time())
        self._plan(self._questions.due)

    def _tell(self) -> None:
        self._close_socket()
        super()._tell()


class ServiceDatagramLink(_DatagramLink):
    """The service's end; it answers."""

    def __init__(
        self,
        owner: LinkOwner,
        settings: LinkSettings,
        *,
        tls: TlsStream,
        sockets: DatagramSockets,
    ) -> None:
        super().__init__(owner, settings, speaks_first=False, tls=tls)
        self._answers = Answers(self._ways)
        self._sockets = sockets
        self._socket: _DatagramSocket | None = None

    def send_message(self, kind: int, call: int, payload: bytes = b"") -> None:
        """Answer."""
        if kind not in (REPLY, LAST, END):
            super().send_message(kind, call, payload)
            return
        self._answers.reply(
            call, None if kind == END else payload, self._loop.time(), last=kind != REPLY
        )
        self._plan(self._answers.due)

    def _take(self, frame: Frame) -> None:
        if frame.kind == MESSAGE:
            if not frame.passed_over_bytes:
                self._received(frame.payload, datagram=False)
            elif self._answers.passed_over(frame.call):
                self._owner.received(self, Frame(CALL, frame.call, b"", frame.passed_over_bytes))
        elif frame.kind == CALL:
            raise FrameError(
                "is at tls/..., and the other end at udp/...: write the same at both ends"
            )
        elif frame.kind == KEYS:
            raise FrameError(f"is a robot and sends a frame of kind {frame.kind}")
        else:
            super()._take(frame)
            if frame.kind == HELLO and not self._ended:
                self._hand_over_keys()

    def _hand_over_keys(self) -> None:
        assert self._transport is not None and self.peer is not None  # as TLS has proved
        address = self._transport.get_extra_info("sockname")
        try:
            self._socket = self._sockets.at(address)
        except OSError:
            return  # the system has no socket left; the stream carries all
        keys = self._socket.add(self)
        self._sealing = Sealing(keys, service=True)
        port = self._socket.port
        content = _KEYS.pack(*keys, 0 if port == address[1] else port)
        self.send(encode_frame(KEYS, 0, content))

    def _received(self, message: bytes, *, datagram: bool) -> None:
        arrived = self._answers.received(message, datagram=datagram)
        if arrived is None:
            return
        if len(arrived.payload) > self.max_message_bytes:
            frame = Frame(CALL, arrived.number, b"", len(arrived.payload))
        else:
            frame = Frame(CALL, arrived.number, arrived.payload)
        self._owner.received(self, frame)

    def _put(self, datagram: bytes) -> None:
        if self._socket is not None and self._peer_address is not None:
            self._socket.send(datagram, self._peer_address)

    def _expire(self) -> None:
        self._due, self._due_at = None, float("inf")
        self._answers.expire(self._loop.time())
        self._plan(self._answers.due)

    def end(
        self,
        reason: str,
        *,
        goodbye: str | None = None,
        refused: bool = False,
        abort: bool = False,
    ) -> None:
        """End the link; what was answered is on the stream before it closes."""
        if not self._ended and not abort and not refused:
            self._answers.flush()
        super().end(reason, goodbye=goodbye, refused=refused, abort=abort)

    def _tell(self) -> None:
        if self._socket is not None and self._sealing is not None:
            self._socket.remove(self._sealing.association)
        super()._tell()


class DatagramSockets:
    """The sockets for datagrams of one listening service: one for each of its own addresses.

    A socket that is bound to all addresses would answer from any of them, and a robot hears only
    from the one that it has called. So there is a socket at each address at which robots have
    called; it has the port of the stream, or another one if somebody has that.
    """

    def __init__(self) -> None:
        self._sockets: dict[Any, _DatagramSocket] = {}

    def at(self, address: Any) -> _DatagramSocket:
        """Return the socket at the address of a stream's own end.

        Raises
        ------
        OSError
            If the system has none left.
        """
        if address not in self._sockets:
            self._sockets[address] = _DatagramSocket(address)
        return self._sockets[address]

    def close(self) -> None:
        """Close all of them. May be repeated."""
        for each in self._sockets.values():
            each.close()
        self._sockets.clear()


class _DatagramSocket:
    """A socket at one address, for the links of many robots."""

    def __init__(self, address: Any) -> None:
        self._loop = asyncio.get_running_loop()
        self._links: dict[int, ServiceDatagramLink] = {}
        family = socket.AF_INET6 if len(address) == 4 else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _WAITING_IN_SYSTEM_BYTES)
            try:
                self._socket.bind(address)
            except OSError:
                self._socket.bind((address[0], 0, *address[2:]))
        except BaseException:
            self._socket.close()
            raise
        self.port: int = self._socket.getsockname()[1]
        self._loop.add_reader(self._socket, self._readable)

    def add(self, link: ServiceDatagramLink) -> Keys:
        """Draw keys for a link."""
        # Whoever sees no datagram cannot name one: what is forged blindly is not even deciphered.
        while (association := int.from_bytes(os.urandom(4))) in self._links:
            pass
        self._links[association] = link
        return Keys.draw(association)

    def remove(self, association: int) -> None:
        """Take no more datagrams of an association."""
        self._links.pop(association, None)

    def send(self, datagram: bytes, address: Any) -> None:
        """Send a datagram; it may be lost here as well as anywhere."""
        with contextlib.suppress(OSError):
            self._socket.sendto(datagram, address)

    def close(self) -> None:
        if self._socket.fileno() >= 0:
            self._loop.remove_reader(self._socket)
            self._socket.close()

    def _readable(self) -> None:
        for _ in range(_DATAGRAMS_AT_ONCE):
            try:
                datagram, address = self._socket.recvfrom(_LARGEST_DATAGRAM)
            except (BlockingIOError, InterruptedError):
                return
            except OSError:
                continue  # a robot is gone
            association = association_of(datagram)
            if association is None:
                continue
            link = self._links.get(association)
            if link is not None:
                link.take_datagram(datagram, address)
