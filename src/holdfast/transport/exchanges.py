"""Requests and replies over a path that loses datagrams, without clock or socket.

There are two paths to the other end. *Datagrams* are fast and may be lost. *The stream* loses
nothing, but a lost packet delays everything behind it. Short messages go as datagrams once these
are known to get through. Long ones, and all while datagrams are blocked, go on the stream.

A request is retransmitted until it is answered, and replies are kept until the robot acknowledges
them. So the service needs no retransmission timer: whatever was lost, the robot misses a reply,
sends the request again with the number of replies that it has, and gets the rest. The
retransmission timeout follows the measured round trips, as in TCP (RFC 6298).

A retransmission costs a round trip, so while a path is losing datagrams each message is sent twice
(:mod:`~holdfast.transport.redundancy`). The receiver counts the losses, and each message carries
that count back. A new link starts with a few dozen probes, and assumes loss until they have come
back.

Under heavy loss, as while the service's port is flooded, the copy goes on the stream instead, and
so do those of its replies (a *hedge*): when a request has been sent twice and nothing was heard; at
once if a quarter of the last datagrams were lost, and after such a request until a probe returns.
The first reply to arrive counts. ``docs/datagrams.md`` has the bytes of each message.
"""

from __future__ import annotations

import math
import struct
from typing import Final, NamedTuple, cast

import msgspec

from holdfast.transport.datagram_cipher import KNOWN_AFTER, LOSS_SAMPLE, OVERHEAD
from holdfast.transport.redundancy import Paths, RedundantSender

_REQUEST, _REPLY, _WORKING, PROBE, ECHO, _HEDGE = range(1, 7)

_REQUEST_HEAD: Final = struct.Struct(">IIH")
_REPLY_HEAD: Final = struct.Struct(">IH")
_WORKING_HEAD: Final = struct.Struct(">I")
_PROBE_HEAD: Final = struct.Struct(">d")
_LAST, _END_ALONE = 1 << 15, 1 << 14
_MAX_REPLIES: Final = 1 << 14

MESSAGE_OVERHEAD: Final = 2 + _REQUEST_HEAD.size
"""Bytes that a message is longer than its payload, at most."""

MAX_DATAGRAM_BYTES: Final = 1200
"""Fits into one packet on every path (IPv6 carries 1,280 bytes everywhere)."""

MAX_PAYLOAD_BYTES: Final = MAX_DATAGRAM_BYTES - OVERHEAD - MESSAGE_OVERHEAD
"""Larger payloads go on the stream."""

KEEP_ALIVE_S: Final = 5.0
"""After so much silence the robot probes the path; address translation in a router forgets an
unused one, after 30 s and more."""

MAX_CACHED_REQUESTS: Final = 1024
"""Bound on a robot's requests whose replies are kept, and on replies that came out of order."""

MAX_REORDERED_BYTES: Final = 16 << 20
"""Bound on replies that wait for earlier ones; a hostile service may send nothing else."""

_SENT_BEFORE_FALLBACK: Final = 2
_MIN_SILENCE_S: Final = 0.1
_SILENCE_IN_TIMEOUTS: Final = 2.9
"""After so many datagrams and so much time without an answer, requests go on the stream."""

_PROBES_BEFORE_FALLBACK: Final = 3

_LARGE_BYTES: Final = 1 << 20

_HEDGED_LOSS: Final = LOSS_SAMPLE // 4
_SENT_BEFORE_HEDGE: Final = 2

_NEWEST: Final = 4
_FIRST_PROBE_INTERVAL_S: Final = 0.005
"""At the start, between the probes that it takes to know whether the path loses any."""

_PROGRESS_INTERVAL_S: Final = 0.06
"""A service that computes an answer says so every 50 ms."""


MAX_TIMEOUT_S: Final = 1.0
_INITIAL_TIMEOUT_S: Final = 0.2
_MIN_MARGIN_S: Final = 0.01
"""Over the mean round trip: a busy machine replies a few milliseconds late."""


class RoundTripEstimator:
    """Mean and variation of round trips (RFC 6298), with a least margin of 10 ms."""

    def __init__(self) -> None:
        self.smoothed_s: float | None = None  # the exponentially weighted mean, once measured
        self._variation_s = 0.0

    def add(self, seconds: float) -> None:
        """Add a measurement."""
        if self.smoothed_s is None:
            self.smoothed_s = seconds
            self._variation_s = 0.5 * seconds
        else:
            self._variation_s += 0.25 * (abs(seconds - self.smoothed_s) - self._variation_s)
            self.smoothed_s += 0.125 * (seconds - self.smoothed_s)

    @property
    def timeout_s(self) -> float:
        """The retransmission timeout."""
        if self.smoothed_s is None:
            return _INITIAL_TIMEOUT_S
        return min(MAX_TIMEOUT_S, self.smoothed_s + max(_MIN_MARGIN_S, 4.0 * self._variation_s))


class ReceivedReply(NamedTuple):
    """A reply, as it arrives at the robot."""

    call: int  # as the robot has named it
    payload: bytes | None  # None if the call ends without a further reply
    last: bool  # whether nothing more comes of the call


class ReceivedRequest(NamedTuple):
    """A request, as it arrives at the service; the payload of a large one is a view of it."""

    number: int
    payload: bytes


class _PendingRequest(msgspec.Struct, eq=False):
    """A request of the robot that is not answered in full."""

    call: int
    number: int
    payload: bytes
    sent_at: float
    retransmitted_at: float
    num_sent: int = 1
    have: int = 0
    heard: bool = False
    reordered: dict[int, tuple[bytes | None, bool]] = {}
    on_stream: bool = False
    hedged: bool = False
    timeout_s: float = 0.0
    due_at: float = math.inf


class RobotExchange:
    """The robot's end: it sends requests, and retransmits them.

    The owner calls :meth:`expire` when :attr:`due` has come, and :meth:`received` with each
    message; each method may send. Times are seconds of any clock that never goes back.

    Before :meth:`begin`, only the stream is used.
    """

    def __init__(self, paths: Paths) -> None:
        self._sender = RedundantSender(paths)
        self._requests: dict[int, _PendingRequest] = {}
        self._number = 0
        self.unanswered_probes = 0  # since the last datagram came
        self._probe_at = math.inf
        self._first_probes = 0
        self._unheard = 0
        self._unheard_since = math.inf
        self._hedges = False
        self.open = False  # whether datagrams are known to get through, in both directions
        self.round_trip = RoundTripEstimator()

    @property
    def due(self) -> float:
        """When :meth:`expire` is to be called."""
        due = min(self._probe_at, self._sender.due)
        for request in self._requests.values():
            due = min(due, request.due_at)
        return due

    def begin(self, now: float) -> None:
        """Begin to probe: datagrams can be sent from now on."""
        self._first_probes = KNOWN_AFTER + _NEWEST
        self.probe(now)

    def send(self, call: int, payload: bytes, now: float) -> None:
        """Send a request; ``call`` names it in its replies."""
        self._number += 1
        request = _PendingRequest(call, self._number, payload, now, now)
        self._requests[request.number] = request
        if not self.open or len(payload) > MAX_PAYLOAD_BYTES:
            self._put_on_stream(request)
            return
        request.timeout_s = self.round_trip.timeout_s
        self._note_sent(request, now)
        self._sender.send_first(
            _REQUEST,
            self._body(request),
            now,
            lambda: request.number in self._requests and not (request.heard or request.hedged),
        )
        if self._hedges or self._sender.num_lost >= _HEDGED_LOSS:
            self._hedge(request)

    def abandon(self, call: int) -> None:
        """Wait for no more replies of a call."""
        for number, request in list(self._requests.items()):
            if request.call == call:
                del self._requests[number]

    def probe(self, now: float, *, counted: bool = True) -> None:
        """Check at once whether datagrams get through; ``counted`` if a reply is due."""
        self._sender.send_unbudgeted(PROBE, _PROBE_HEAD.pack(now))
        if not counted:
            return
        if self._first_probes > 0:
            self._first_probes -= 1
            self._probe_at = now + _FIRST_PROBE_INTERVAL_S
            return
        self.unanswered_probes += 1
        wait_s = self.round_trip.timeout_s * 2.0 ** min(self.unanswered_probes - 1, 10)
        self._probe_at = now + min(MAX_TIMEOUT_S, wait_s)

    def received(self, message: bytes, now: float, *, datagram: bool) -> list[ReceivedReply]:
        """Take a message of the authenticated service; return the replies in it, in order.

        A malformed message is ignored. ``datagram`` tells the path on which it came.
        """
        if len(message) < 2:
            return []
        kind, body = message[0], message[2:]
        if kind == PROBE:
            # It shows that both directions work, but not that replies come to this address.
            if datagram and len(body) == _PROBE_HEAD.size:
                self.unanswered_probes = 0
                self._sender.send_unbudgeted(ECHO, body)
            return []
        if datagram:
            self.open = True
            self.unanswered_probes = self._unheard = 0
            if not self._first_probes:
                self._probe_at = now + KEEP_ALIVE_S
        self._sender.num_lost = message[1]
        if kind == _REPLY and len(body) >= _REPLY_HEAD.size:
            number, index = _REPLY_HEAD.unpack_from(body)
            request = self._requests.get(number)
            if request is not None:
                return self._replied(request, index, body[_REPLY_HEAD.size :], now)
        elif kind == _WORKING and len(body) == _WORKING_HEAD.size:
            request = self._requests.get(_WORKING_HEAD.unpack(body)[0])
            if request is not None and not request.on_stream:
                request.heard = True
                request.timeout_s = max(request.timeout_s, _PROGRESS_INTERVAL_S)
                request.due_at = now + request.timeout_s
        elif kind == ECHO and len(body) == _PROBE_HEAD.size:
            self._hedges = False
            round_trip_s = now - _PROBE_HEAD.unpack(body)[0]
            if self.round_trip.smoothed_s is None and 0.0 <= round_trip_s <= 60.0:
                self.round_trip.add(round_trip_s)
        return []

    def oversized(self, number: int) -> list[ReceivedReply]:
        """End a call of which a reply came on the stream that is larger than allowed."""
        request = self._requests.pop(number, None)
        return [] if request is None else [ReceivedReply(request.call, None, True)]

    def expire(self, now: float) -> None:
        """Send the copies, retransmissions and probes that are due."""
        self._sender.expire(now)
        for request in list(self._requests.values()):
            if request.due_at > now:
                continue
            silent_s = now - self._unheard_since
            if self._unheard >= _SENT_BEFORE_FALLBACK and silent_s >= self._max_silence_s:
                self._fall_back_to_stream(now)
                return
            request.timeout_s = min(MAX_TIMEOUT_S, 2.0 * request.timeout_s)
            if request.num_sent >= _SENT_BEFORE_HEDGE and not request.heard:
                self._hedges = True
                self._hedge(request)
            self._retransmit(request, now)
        if self._probe_at <= now:
            if self.open and self.unanswered_probes >= _PROBES_BEFORE_FALLBACK:
                self._fall_back_to_stream(now)
            else:
                self.probe(now)

    @property
    def _max_silence_s(self) -> float:
        return max(_MIN_SILENCE_S, _SILENCE_IN_TIMEOUTS * self.round_trip.timeout_s)

    def _fall_back_to_stream(self, now: float) -> None:
        """Send unanswered requests on the stream, until datagrams get through again."""
        self.open = False
        for request in self._requests.values():
            if not request.on_stream:
                self._put_on_stream(request)
        self.unanswered_probes = self._unheard = 0
        self.probe(now)

    def _hedge(self, request: _PendingRequest) -> None:
        """Send the request on the stream as well, once."""
        if not request.hedged:
            request.hedged = True
            self._sender.hedge(request.number, _HEDGE, self._body(request))

    def _put_on_stream(self, request: _PendingRequest) -> None:
        request.on_stream = True
        request.due_at = math.inf
        self._sender.send_on_stream(request.number, _REQUEST, self._body(request))
        request.payload = b""  # the stream loses nothing

    def _replied(
        self, request: _PendingRequest, index: int, payload: bytes, now: float
    ) -> list[ReceivedReply]:
        self._note_heard(request, now)
        last, end_alone = bool(index & _LAST), bool(index & _END_ALONE)
        index &= _MAX_REPLIES - 1
        if not request.have <= index < request.have + MAX_CACHED_REQUESTS:
            return []  # a duplicate
        request.reordered[index] = (None if end_alone else payload, last)
        if index > request.have and self._reordered_bytes > MAX_REORDERED_BYTES:
            return self.oversized(request.number)
        replies = []
        while request.have in request.reordered:
            reply = ReceivedReply(request.call, *request.reordered.pop(request.have))
            request.have += 1
            replies.append(reply)
            if reply.last:
                del self._requests[request.number]
                return replies
        waited_s = now - request.retransmitted_at
        if request.reordered and waited_s > self.round_trip.timeout_s and not request.on_stream:
            self._retransmit(request, now)  # an earlier reply is lost, or late
        return replies

    @property
    def _reordered_bytes(self) -> int:
        return sum(
            len(payload or b"")
            for request in self._requests.values()
            for payload, _ in request.reordered.values()
        )

    def _note_heard(self, request: _PendingRequest, now: float) -> None:
        if request.on_stream:
            return
        if not request.heard and request.num_sent == 1:
            # A retransmitted request has no unambiguous round trip (Karn's algorithm).
            self.round_trip.add(now - request.sent_at)
        request.heard = True
        request.timeout_s = max(_PROGRESS_INTERVAL_S, self.round_trip.timeout_s)
        request.due_at = now + request.timeout_s

    def _retransmit(self, request: _PendingRequest, now: float) -> None:
        request.num_sent += 1
        request.retransmitted_at = now
        self._note_sent(request, now)
        self._sender.retransmit(_REQUEST, self._body(request))

    def _note_sent(self, request: _PendingRequest, now: float) -> None:
        request.due_at = now + request.timeout_s
        if self._unheard == 0:
            self._unheard_since = now
        self._unheard += 1

    def _body(self, request: _PendingRequest) -> bytes:
        settled = next(iter(self._requests))
        return _REQUEST_HEAD.pack(request.number, settled, request.have) + request.payload


class _CachedReplies(msgspec.Struct, eq=False):
    """The replies to one request, until the robot has them all."""

    on_stream: bool
    hedged: bool = False
    bodies: list[bytes | None] = []
    done: bool = False


class ServiceExchange:
    """The service's end: it replies, and never speaks first."""

    def __init__(self, paths: Paths) -> None:
        self._sender = RedundantSender(paths)
        self._cached: dict[int, _CachedReplies] = {}
        self._settled = 0
        self.held_bytes = 0  # of replies that the robot may lack

    @property
    def due(self) -> float:
        """When :meth:`expire` is to be called."""
        return self._sender.due

    def received(self, message: bytes, *, datagram: bool) -> ReceivedRequest | None:
        """Take a message of the authenticated robot; return the request if it is a new one.

        A malformed message is ignored. ``datagram`` tells the path on which it came.
        """
        if len(message) < 2:
            return None
        self._sender.num_lost = message[1]
        # Copying a large message would delay all others.
        view = message if len(message) < _LARGE_BYTES else cast(bytes, memoryview(message))
        kind, body = message[0], view[2:]
        if kind == PROBE and len(body) == _PROBE_HEAD.size and datagram:
            self._sender.send_unbudgeted(ECHO, body)
        hedge = kind == _HEDGE and not datagram
        if not (hedge or kind == _REQUEST) or len(body) < _REQUEST_HEAD.size:
            return None
        number, settled, have = _REQUEST_HEAD.unpack_from(body)
        self._settle(min(settled, number))
        cached = self._cached.get(number)
        if cached is not None:
            if hedge:
                self._hedge(number, cached, have)
            else:
                self._repeat(number, cached, have, datagram=datagram)
            return None
        if not self._enter(number, on_stream=not (datagram or hedge)):
            return None
        self._cached[number].hedged = hedge
        return ReceivedRequest(number, body[_REQUEST_HEAD.size :])

    def oversized(self, number: int) -> bool:
        """Enter a request that is larger than allowed; return whether it can be answered."""
        return self._enter(number, on_stream=True)

    def flush(self) -> None:
        """Send on the stream all replies that the robot may lack, before the link closes."""
        for number, cached in self._cached.items():
            self._repeat(number, cached, 0, datagram=False)

    def reply(self, number: int, payload: bytes | None, now: float, *, last: bool) -> None:
        """Send a reply, if the robot still waits for it; without a payload it is the end alone."""
        cached = self._cached.get(number)
        if cached is None or cached.done:
            return
        index = len(cached.bodies)
        if index >= _MAX_REPLIES - 1:
            last, payload = True, None
        cached.done = last
        index |= (_LAST if last else 0) | (_END_ALONE if payload is None else 0)
        body = _REPLY_HEAD.pack(number, index) + (payload or b"")
        if cached.on_stream or len(body) > MAX_PAYLOAD_BYTES + _REPLY_HEAD.size:
            cached.bodies.append(None)
            self._sender.send_on_stream(number, _REPLY, body)
            return
        cached.bodies.append(body)
        self.held_bytes += len(body)
        self._sender.send_first(
            _REPLY, body, now, lambda: number in self._cached and not cached.hedged
        )
        if cached.hedged:
            self._sender.hedge(number, _REPLY, body)

    def expire(self, now: float) -> None:
        """Send the copies that are due."""
        self._sender.expire(now)

    def _hedge(self, number: int, cached: _CachedReplies, have: int) -> None:
        """Send the replies on the stream as well, those to come included."""
        cached.hedged = True
        for body in cached.bodies[have:]:
            if body is not None:
                self._sender.hedge(number, _REPLY, body)

    def _repeat(self, number: int, cached: _CachedReplies, have: int, *, datagram: bool) -> None:
        """Send again the replies that the robot lacks."""
        lacks = [body for body in cached.bodies[have:] if body is not None]
        if not datagram:
            cached.on_stream = True
            for body in lacks:
                self._sender.send_on_stream(number, _REPLY, body)
            self.held_bytes -= sum(map(len, lacks))
            cached.bodies[have:] = [None] * len(cached.bodies[have:])
            return
        for body in lacks:
            self._sender.retransmit(_REPLY, body)
        if not lacks:
            self._sender.send_unbudgeted(_WORKING, _WORKING_HEAD.pack(number))

    def _enter(self, number: int, *, on_stream: bool) -> bool:
        if number < self._settled or number in self._cached:
            return False  # late: the robot has its answer, or has abandoned the request
        # The service bounds requests that are not done; here the oldest answered one makes room.
        if len(self._cached) >= MAX_CACHED_REQUESTS:
            done = (known for known, cached in self._cached.items() if cached.done)
            self._forget(next(done, -1))
        self._cached[number] = _CachedReplies(on_stream)
        return True

    def _settle(self, settled: int) -> None:
        if settled <= self._settled:
            return
        self._settled = settled
        for number in [number for number in self._cached if number < settled]:
            self._forget(number)

    def _forget(self, number: int) -> None:
        cached = self._cached.pop(number, None)
        if cached is not None:
            self.held_bytes -= sum(len(body) for body in cached.bodies if body is not None)
