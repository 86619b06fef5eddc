"""Questions and answers over a way that loses some of what is sent, without a clock or a socket.

There are two ways to the other end. *Datagrams* are fast and may be lost, *the stream* loses
nothing, but what is lost under it holds up all that follows. Short messages go as datagrams once it
is known that these get through; what does not fit, and all if datagrams do not get through, goes on
the stream.

A question is sent again until it is answered, and an answer is kept until the robot has said that
it has it. So the service needs no timer for what is lost: whatever was lost, the robot misses an
answer, asks again, says how many parts of the answer it has, and is sent the rest.

*When* it asks again is set by the round trips that were measured, as TCP does it (RFC 6298): a
smoothed mean, and a margin for how much they vary; twice as long each time.

To ask again takes a round trip, which on a long way is dear, and these messages are short. So while
the way is seen to lose any, each message is sent twice, a few milliseconds apart, for losses come
in bunches. What is lost is measured where it should have arrived, over the last 128 datagrams
(:class:`~holdfast.transport.sealing.ReplayWindow`), and each message carries the count back; where
nothing is lost, nothing is sent twice. Nobody knows in the beginning, so a link begins with a few
dozen probes, and as if some were lost. All that is sent again is paid for from a budget of twice
the bytes that were sent for the first time, so a way in trouble is never given more than three
times the load.

Where many are lost, as while somebody floods the service's port, the copy goes on the stream
instead, and so do those of the answer (a *hedge*): when a question has been asked twice and nothing
was heard of it; at once if a quarter of the last datagrams did not come, and after such a question
until a probe comes back. Whichever comes first counts.

A message is::

    kind       1 byte
    lost       1 byte: of the last 128 datagrams of the other end, how many did not come
    question:  number (4), settled (4): all below it are answered, have (2): parts of the answer
               that the robot has, then the payload
    hedge:     a question that was sent as a datagram, too
    reply:     number (4), index (2): of the part, with two bits that say whether it is the last,
               and the end alone, then the payload
    working:   number (4): the question has come, and there is no part yet that the robot lacks
    probe, echo: 8 bytes that are sent back
"""

from __future__ import annotations

import heapq
import math
import struct
from collections.abc import Callable
from typing import Final, NamedTuple, cast

from holdfast.transport.sealing import KNOWN_AFTER, LOSS_SAMPLE, OVERHEAD

__all__ = [
    "COPY_DELAY_S",
    "KEEP_ALIVE_S",
    "MAX_ANSWERS",
    "MAX_DATAGRAM_BYTES",
    "MAX_EARLY_BYTES",
    "MAX_PAYLOAD_BYTES",
    "MESSAGE_OVERHEAD",
    "Answers",
    "Arrived",
    "Part",
    "Questions",
    "RoundTrips",
    "Ways",
]

_QUESTION, _REPLY, _WORKING, _PROBE, _ECHO, _HEDGE = range(1, 7)

_QUESTION_HEAD: Final = struct.Struct(">IIH")
_REPLY_HEAD: Final = struct.Struct(">IH")
_WORKING_HEAD: Final = struct.Struct(">I")
_PROBE_HEAD: Final = struct.Struct(">d")
_LAST, _END_ALONE = 1 << 15, 1 << 14
_MAX_PARTS: Final = 1 << 14

MESSAGE_OVERHEAD: Final = 2 + _QUESTION_HEAD.size
"""Bytes that a message is longer than its payload, at most."""

MAX_DATAGRAM_BYTES: Final = 1200
"""Fits into one packet on every way (IPv6 carries 1,280 bytes everywhere)."""

MAX_PAYLOAD_BYTES: Final = MAX_DATAGRAM_BYTES - OVERHEAD - MESSAGE_OVERHEAD
"""What is larger goes on the stream."""

COPY_DELAY_S: Final = 0.003
"""Between a message and its copy, while some are lost."""

KEEP_ALIVE_S: Final = 5.0
"""After so much silence the robot asks whether datagrams still get through; routers that translate
addresses forget a way that is not used, after 30 s and more."""

MAX_ANSWERS: Final = 1024
"""Bound on the questions of a robot whose answers are kept, and on parts that came too early."""

MAX_EARLY_BYTES: Final = 16 << 20
"""Bound on the parts of answers that came before others which are missing: few come so, but a
service that means harm may send nothing else."""

_EXTRA_SHARE: Final = 2
"""Bytes that may be sent again for each that was sent for the first time."""

_EXTRA_BURST: Final = 8192
_HEADERS_BELOW: Final = 28  # of IPv4 and UDP

_SENT_BEFORE_SILENCE: Final = 2
_SILENCE_S: Final = 0.1
_SILENCE_IN_PATIENCES: Final = 2.9
"""So many questions, and for so long at least, may be sent as datagrams while nothing at all is
heard; then they take the stream."""

_PROBES_BEFORE_SILENCE: Final = 3

_LARGE_BYTES: Final = 1 << 20

_HEDGED_LOSS: Final = LOSS_SAMPLE // 4
_ASKED_BEFORE_HEDGE: Final = 2

_NEWEST: Final = 4
_FIRST_PROBES_S: Final = 0.005
"""In the beginning as many probes as it takes to know whether the way loses any, so far apart."""

_FIRST_GUESS_S: Final = 0.2
_MARGIN_S: Final = 0.01
"""Least margin over the mean round trip: a busy machine answers a few milliseconds late."""

_SIGNS_S: Final = 0.06
"""Who works on a question says so every 50 ms."""

_LONGEST_WAIT_S: Final = 1.0


class RoundTrips:
    """How long answers take: RFC 6298, with a least margin of 10 ms and no least sum.

    Attributes
    ----------
    smoothed_s : float or None
        Mean, in which the last ones count most; None before the first.
    """

    __slots__ = ("_variation_s", "smoothed_s")

    def __init__(self) -> None:
        self.smoothed_s: float | None = None
        self._variation_s = 0.0

    def add(self, seconds: float) -> None:
        """Take one that was measured."""
        if self.smoothed_s is None:
            self.smoothed_s = seconds
            self._variation_s = 0.5 * seconds
        else:
            self._variation_s += 0.25 * (abs(seconds - self.smoothed_s) - self._variation_s)
            self.smoothed_s += 0.125 * (seconds - self.smoothed_s)

    @property
    def patience_s(self) -> float:
        """After how long an answer is taken for lost."""
        if self.smoothed_s is None:
            return _FIRST_GUESS_S
        return min(_LONGEST_WAIT_S, self.smoothed_s + max(_MARGIN_S, 4.0 * self._variation_s))


class Ways(NamedTuple):
    """The two ways to the other end.

    Attributes
    ----------
    datagram : callable
        Takes a message of at most :data:`MAX_DATAGRAM_BYTES` less what sealing adds.
    stream : callable
        Takes the number of the question that a message belongs to, and the message.
    lost : callable
        Returns how many of the other end's last datagrams have not come.
    """

    datagram: Callable[[bytes], None]
    stream: Callable[[int, bytes], None]
    lost: Callable[[], int]


class Part(NamedTuple):
    """A part of an answer, as it arrives at the robot.

    Attributes
    ----------
    call : int
        As the robot has named it.
    payload : bytes or None
        None if the call ends without a further reply.
    last : bool
        Whether nothing more comes of the call.
    """

    call: int
    payload: bytes | None
    last: bool


class Arrived(NamedTuple):
    """A question, as it arrives at the service; the payload of a large one is a view of it."""

    number: int
    payload: bytes


class _Sender:
    """What both ends have in common: the copies, and the budget of all that is sent again."""

    def __init__(self, ways: Ways) -> None:
        self.ways = ways
        self.lost_of_ours = 1  # as long as nobody knows
        self._copies: list[tuple[float, int, int, bytes, Callable[[], bool]]] = []
        self._num_copies = 0
        self._budget_bytes = _EXTRA_BURST

    @property
    def due(self) -> float:
        return self._copies[0][0] if self._copies else math.inf

    def stream(self, number: int, kind: int, body: bytes) -> None:
        self.ways.stream(number, bytes((kind, min(255, self.ways.lost()))) + body)

    def first(self, kind: int, body: bytes, now: float, wanted: Callable[[], bool]) -> None:
        """Send a datagram for the first time, and plan a copy while the way loses some."""
        earned = _EXTRA_SHARE * _size(body)
        self._budget_bytes = min(_EXTRA_BURST, self._budget_bytes + earned)
        self.small(kind, body)
        if self.lost_of_ours:
            self._num_copies += 1
            copy = (now + COPY_DELAY_S, self._num_copies, kind, body, wanted)
            heapq.heappush(self._copies, copy)

    def hedge(self, number: int, kind: int, body: bytes) -> None:
        """Send on the stream what was sent as a datagram; it is paid for as a copy is."""
        self._budget_bytes -= _size(body)
        self.stream(number, kind, body)

    def again(self, kind: int, body: bytes) -> None:
        """Send a datagram again, if the budget allows it."""
        size = _size(body)
        if size <= self._budget_bytes:
            self._budget_bytes -= size
            self.small(kind, body)

    def small(self, kind: int, body: bytes) -> None:
        """Send a datagram outside of the budget."""
        self.ways.datagram(bytes((kind, min(255, self.ways.lost()))) + body)

    def expire(self, now: float) -> None:
        """Send the copies that are due."""
        while self._copies and self._copies[0][0] <= now:
            _, _, kind, body, wanted = heapq.heappop(self._copies)
            if wanted():
                self.again(kind, body)


def _size(body: bytes) -> int:
    """Return the bytes of a packet."""
    return len(body) + 2 + OVERHEAD + _HEADERS_BELOW


class _Question:
    """A question that the robot has asked and that is not answered in full."""

    __slots__ = (
        "asked_again_at",
        "call",
        "due_at",
        "early",
        "have",
        "heard",
        "hedged",
        "number",
        "on_stream",
        "payload",
        "sent_at",
        "times",
        "wait_s",
    )

    def __init__(self, call: int, number: int, payload: bytes, now: float) -> None:
        self.call = call
        self.number = number
        self.payload = payload
        self.sent_at = self.asked_again_at = now
        self.times = 1
        self.have = 0
        self.heard = False
        self.early: dict[int, tuple[bytes | None, bool]] = {}
        self.on_stream = self.hedged = False
        self.wait_s = 0.0
        self.due_at = math.inf


class Questions:
    """The robot's end: it asks, and asks again.

    Whoever uses it calls :meth:`expire` when :attr:`due` has come, and :meth:`received` with each
    message; each method may send.

    Parameters
    ----------
    ways : Ways
        Before :meth:`begin`, only the stream is used.

    Attributes
    ----------
    open : bool
        Whether datagrams are known to get through, in both directions.
    round_trips : RoundTrips
    heard_at : float
        When the last datagram came; minus infinity if none has.
    """

    def __init__(self, ways: Ways) -> None:
        self._sender = _Sender(ways)
        self._questions: dict[int, _Question] = {}
        self._number = 0
        self._probes = 0
        self._probe_at = math.inf
        self._first_probes = 0
        self._unheard = 0
        self._unheard_since = math.inf
        self._hedges = False
        self.open = False
        self.round_trips = RoundTrips()
        self.heard_at = -math.inf

    @property
    def due(self) -> float:
        """When :meth:`expire` is to be called."""
        due = min(self._probe_at, self._sender.due)
        for question in self._questions.values():
            due = min(due, question.due_at)
        return due

    @property
    def calls(self) -> list[int]:
        """Those that are not answered in full."""
        return [question.call for question in self._questions.values()]

    @property
    def unanswered_probes(self) -> int:
        """How many times it was asked, since the last datagram came, whether they get through."""
        return self._probes

    def begin(self, now: float) -> None:
        """Take note that datagrams can be sent, and find out whether they get through.

        Parameters
        ----------
        now : float
            Seconds of any clock that never goes back, here and below.
        """
        self._first_probes = KNOWN_AFTER + _NEWEST
        self.probe(now)

    def ask(self, call: int, payload: bytes, now: float) -> None:
        """Ask a question.

        Parameters
        ----------
        call : int
            Names it in what comes of it.
        payload : bytes
        now : float
        """
        self._number += 1
        question = _Question(call, self._number, payload, now)
        self._questions[question.number] = question
        if not self.open or len(payload) > MAX_PAYLOAD_BYTES:
            self._put_on_stream(question)
            return
        question.wait_s = self.round_trips.patience_s
        self._sends(question, now)
        self._sender.first(
            _QUESTION,
            self._body(question),
            now,
            lambda: question.number in self._questions and not (question.heard or question.hedged),
        )
        if self._hedges or self._sender.lost_of_ours >= _HEDGED_LOSS:
            self._hedge(question)

    def forget(self, call: int) -> None:
        """Ask no more for what is still to come of a call."""
        for number, question in list(self._questions.items()):
            if question.call == call:
                del self._questions[number]

    def probe(self, now: float) -> None:
        """Ask at once whether datagrams get through; the answer shows in ``heard_at``."""
        self._sender.small(_PROBE, _PROBE_HEAD.pack(now))
        if self._first_probes > 0:
            self._first_probes -= 1
            self._probe_at = now + _FIRST_PROBES_S
            return
        self._probes += 1
        wait_s = self.round_trips.patience_s * 2.0 ** min(self._probes - 1, 10)
        self._probe_at = now + min(_LONGEST_WAIT_S, wait_s)

    def received(self, message: bytes, now: float, *, datagram: bool) -> list[Part]:
        """Take a message; return what it brings, in order.

        Parameters
        ----------
        message : bytes
            Of the service, which has proved who it is; still it may be malformed.
        now : float
        datagram : bool
            Which way it came.
        """
        if len(message) < 2:
            return []
        if datagram:
            self.heard_at = now
            self.open = True
            self._probes = self._unheard = 0
            if not self._first_probes:
                self._probe_at = now + KEEP_ALIVE_S
        self._sender.lost_of_ours = message[1]
        kind, body = message[0], message[2:]
        if kind == _REPLY and len(body) >= _REPLY_HEAD.size:
            number, index = _REPLY_HEAD.unpack_from(body)
            question = self._questions.get(number)
            if question is not None:
                return self._replied(question, index, body[_REPLY_HEAD.size :], now)
        elif kind == _WORKING and len(body) == _WORKING_HEAD.size:
            question = self._questions.get(_WORKING_HEAD.unpack(body)[0])
            if question is not None and not question.on_stream:
                question.heard = True
                question.wait_s = max(question.wait_s, _SIGNS_S)
                question.due_at = now + question.wait_s
        elif kind == _ECHO and len(body) == _PROBE_HEAD.size:
            self._hedges = False
            round_trip_s = now - _PROBE_HEAD.unpack(body)[0]
            if self.round_trips.smoothed_s is None and 0.0 <= round_trip_s <= 60.0:
                self.round_trips.add(round_trip_s)
        return []

    def passed_over(self, number: int) -> list[Part]:
        """Take note that a part came on the stream that is larger than allowed: the call ends."""
        question = self._questions.pop(number, None)
        return [] if question is None else [Part(question.call, None, True)]

    def expire(self, now: float) -> None:
        """Do what is due."""
        self._sender.expire(now)
        for question in list(self._questions.values()):
            if question.due_at > now:
                continue
            silent_s = now - self._unheard_since
            if self._unheard >= _SENT_BEFORE_SILENCE and silent_s >= self._longest_silence_s:
                self._fall_silent(now)
                return
            question.wait_s = min(_LONGEST_WAIT_S, 2.0 * question.wait_s)
            if question.times >= _ASKED_BEFORE_HEDGE and not question.heard:
                self._hedges = True
                self._hedge(question)
            self._ask_again(question, now)
        if self._probe_at <= now:
            if self.open and self._probes >= _PROBES_BEFORE_SILENCE:
                self._fall_silent(now)
            else:
                self.probe(now)

    @property
    def _longest_silence_s(self) -> float:
        return max(_SILENCE_S, _SILENCE_IN_PATIENCES * self.round_trips.patience_s)

    def _fall_silent(self, now: float) -> None:
        """Ask on the stream what is not answered, until datagrams get through again."""
        self.open = False
        for question in self._questions.values():
            if not question.on_stream:
                self._put_on_stream(question)
        self._probes = self._unheard = 0
        self.probe(now)

    def _hedge(self, question: _Question) -> None:
        """Ask on the stream as well, once."""
        if not question.hedged:
            question.hedged = True
            self._sender.hedge(question.number, _HEDGE, self._body(question))

    def _put_on_stream(self, question: _Question) -> None:
        question.on_stream = True
        question.due_at = math.inf
        self._sender.stream(question.number, _QUESTION, self._body(question))
        question.payload = b""  # the stream loses nothing

    def _replied(self, question: _Question, index: int, payload: bytes, now: float) -> list[Part]:
        self._heard_of(question, now)
        last, end_alone = bool(index & _LAST), bool(index & _END_ALONE)
        index &= _MAX_PARTS - 1
        if not question.have <= index < question.have + MAX_ANSWERS:
            return []  # it is there already
        question.early[index] = (None if end_alone else payload, last)
        if index > question.have and self._early_bytes > MAX_EARLY_BYTES:
            return self.passed_over(question.number)
        parts = []
        while question.have in question.early:
            part = Part(question.call, *question.early.pop(question.have))
            question.have += 1
            parts.append(part)
            if part.last:
                del self._questions[question.number]
                return parts
        waited_s = now - question.asked_again_at
        if question.early and waited_s > self.round_trips.patience_s and not question.on_stream:
            self._ask_again(question, now)  # the one before it is lost, or late
        return parts

    @property
    def _early_bytes(self) -> int:
        return sum(
            len(payload or b"")
            for question in self._questions.values()
            for payload, _ in question.early.values()
        )

    def _heard_of(self, question: _Question, now: float) -> None:
        if question.on_stream:
            return
        if not question.heard and question.times == 1:
            # Of one that was asked again nobody knows which of the two is answered (Karn).
            self.round_trips.add(now - question.sent_at)
        question.heard = True
        question.wait_s = max(_SIGNS_S, self.round_trips.patience_s)
        question.due_at = now + question.wait_s

    def _ask_again(self, question: _Question, now: float) -> None:
        question.times += 1
        question.asked_again_at = now
        self._sends(question, now)
        self._sender.again(_QUESTION, self._body(question))

    def _sends(self, question: _Question, now: float) -> None:
        question.due_at = now + question.wait_s
        if self._unheard == 0:
            self._unheard_since = now
        self._unheard += 1

    def _body(self, question: _Question) -> bytes:
        settled = next(iter(self._questions))
        return _QUESTION_HEAD.pack(question.number, settled, question.have) + question.payload


class _Answer:
    """What a service has answered so far."""

    __slots__ = ("done", "hedged", "on_stream", "parts")

    def __init__(self, on_stream: bool) -> None:
        self.on_stream = on_stream
        self.hedged = False
        self.parts: list[bytes | None] = []
        self.done = False


class Answers:
    """The service's end: it answers, and never speaks first.

    Parameters
    ----------
    ways : Ways
    """

    def __init__(self, ways: Ways) -> None:
        self._sender = _Sender(ways)
        self._answers: dict[int, _Answer] = {}
        self._settled = 0

    @property
    def due(self) -> float:
        """When :meth:`expire` is to be called."""
        return self._sender.due

    def received(self, message: bytes, *, datagram: bool) -> Arrived | None:
        """Take a message; return the question if it is a new one.

        Parameters
        ----------
        message : bytes
            Of the robot, which has proved who it is; still it may be malformed.
        datagram : bool
            Which way it came.
        """
        if len(message) < 2:
            return None
        self._sender.lost_of_ours = message[1]
        # A copy of a large one would hold up all others.
        view = message if len(message) < _LARGE_BYTES else cast(bytes, memoryview(message))
        kind, body = message[0], view[2:]
        if kind == _PROBE and len(body) == _PROBE_HEAD.size and datagram:
            self._sender.small(_ECHO, body)
        hedge = kind == _HEDGE and not datagram
        if not (hedge or kind == _QUESTION) or len(body) < _QUESTION_HEAD.size:
            return None
        number, settled, have = _QUESTION_HEAD.unpack_from(body)
        self._settle(min(settled, number))
        answer = self._answers.get(number)
        if answer is not None:
            if hedge:
                self._hedge(number, answer, have)
            else:
                self._asked_again(number, answer, have, datagram=datagram)
            return None
        if not self._enter(number, on_stream=not (datagram or hedge)):
            return None
        self._answers[number].hedged = hedge
        return Arrived(number, body[_QUESTION_HEAD.size :])

    def passed_over(self, number: int) -> bool:
        """Take note that a question came on the stream that is larger than allowed.

        Returns
        -------
        bool
            Whether it can be answered.
        """
        return self._enter(number, on_stream=True)

    def flush(self) -> None:
        """Send on the stream what the robot may lack: nobody will be there to be asked again."""
        for number, answer in self._answers.items():
            self._asked_again(number, answer, 0, datagram=False)

    def reply(self, number: int, payload: bytes | None, now: float, *, last: bool) -> None:
        """Answer a question, or a part of it; what is not awaited any more goes nowhere.

        Parameters
        ----------
        number : int
            Of the question.
        payload : bytes or None
            None is the end alone.
        now : float
        last : bool
            Whether nothing more will come.
        """
        answer = self._answers.get(number)
        if answer is None or answer.done:
            return
        index = len(answer.parts)
        if index >= _MAX_PARTS - 1:
            last, payload = True, None
        answer.done = last
        index |= (_LAST if last else 0) | (_END_ALONE if payload is None else 0)
        body = _REPLY_HEAD.pack(number, index) + (payload or b"")
        if answer.on_stream or len(body) > MAX_PAYLOAD_BYTES + _REPLY_HEAD.size:
            answer.parts.append(None)  # the stream loses nothing
            self._sender.stream(number, _REPLY, body)
            return
        answer.parts.append(body)
        self._sender.first(_REPLY, body, now, lambda: number in self._answers and not answer.hedged)
        if answer.hedged:
            self._sender.hedge(number, _REPLY, body)

    def expire(self, now: float) -> None:
        """Do what is due."""
        self._sender.expire(now)

    def _hedge(self, number: int, answer: _Answer, have: int) -> None:
        """Answer on the stream as well, and go on so."""
        answer.hedged = True
        for body in answer.parts[have:]:
            if body is not None:
                self._sender.hedge(number, _REPLY, body)

    def _asked_again(self, number: int, answer: _Answer, have: int, *, datagram: bool) -> None:
        lacks = [part for part in answer.parts[have:] if part is not None]
        if not datagram:
            answer.on_stream = True
            for body in lacks:
                self._sender.stream(number, _REPLY, body)
            answer.parts[have:] = [None] * len(answer.parts[have:])
            return
        for body in lacks:
            self._sender.again(_REPLY, body)
        if not lacks:
            self._sender.small(_WORKING, _WORKING_HEAD.pack(number))

    def _enter(self, number: int, *, on_stream: bool) -> bool:
        if number < self._settled or number in self._answers:
            return False  # late: the robot has its answer, or has given it up
        # Those that are not done are the service's to bound: it says when it has too many.
        if len(self._answers) >= MAX_ANSWERS:
            done = (known for known, answer in self._answers.items() if answer.done)
            self._answers.pop(next(done, -1), None)
        self._answers[number] = _Answer(on_stream)
        return True

    def _settle(self, settled: int) -> None:
        if settled <= self._settled:
            return
        self._settled = settled
        for number in [number for number in self._answers if number < settled]:
            del self._answers[number]
