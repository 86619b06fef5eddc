"""A client of an honest service that means harm, with all that a stolen robot has.

It has the service's address, a valid certificate of another robot, the honest robot's problem and
settings, so all questions that it will ask, and even its session. It says each message at each
moment of a link, over plain sockets (:mod:`tests.wire`), and notes whatever it is told that it
should not be.
"""

import contextlib
import itertools
import random
import socket
import ssl
import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec
from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from tests.wire import (
    CALL,
    END,
    GOODBYE,
    HELLO,
    KEYS,
    LAST,
    MAGIC,
    MESSAGE,
    PATIENCE_S,
    PING,
    REPLY,
    Frame,
    RawLink,
    frame_of,
    hello_of,
)

from holdfast.errors import MessageError
from holdfast.planning.inputs import encode_floats
from holdfast.protocol.messages import (
    NeedState,
    Progress,
    Refused,
    Reply,
    Request,
    SensingAnswer,
    TaskAnswer,
    decode_reply,
    encode,
)

_PROBE = 0x7FFF_0001
"""Number of the call with which the intruder finds out that all before it was read."""

_OTHERS_CALLS = 40
"""Calls of robots are counted from 1 on: so many of them are aimed at."""

_QUESTION_MESSAGE, _REPLY_MESSAGE = 1, 2
"""Kinds of datagrams: the kind stands first."""

_HALF = 40
"""Bytes of a frame that is begun and not ended."""

_ACTION_SIZE = 3
_LAST_EPOCH = 2**32 - 1


class Message(NamedTuple):
    """Something to be said."""

    name: str
    data: bytes
    is_whole: bool = True


def wrong_actions(number: int) -> bytes:
    """Return moves that are nearly eighty times as long as the problem's longest."""
    return encode(TaskAnswer(number, 9, encode_floats([7.77] * (_ACTION_SIZE * 9)), 1))


def _stale(number: int) -> bytes:
    """Return what stops a robot: that another process has taken its run over."""
    return encode(Refused(number, "stale_epoch", "epoch 1: epoch 2 is there"))


def messages(
    questions: Sequence[Request],
    service: str,
    incarnation: str,
    call_of: Callable[[int, bytes], bytes],
) -> list[Message]:
    """Return all that can be said."""
    chance = random.Random(7)
    garbage = chance.randbytes(80)
    found = [
        Message("nothing", b""),
        Message("random bytes", garbage, is_whole=False),
        Message("an HTTP request", b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n", is_whole=False),
        Message("a TLS greeting", b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03", is_whole=False),
        Message("the beginning again", hello_of()),
        Message("a service's beginning", hello_of("service", service, incarnation), is_whole=False),
    ]
    for role in ("robot", "service", "router", ""):
        said = hello_of(role, service, incarnation).removeprefix(MAGIC)
        found.append(Message(f"a hello as {role or 'nobody'}", said))
    for kind in (*range(10), 255):
        for call in (0, 1, 2, _LAST_EPOCH):
            found.append(Message(f"kind {kind} of call {call}, empty", frame_of(kind, call)))
            found.append(
                Message(f"kind {kind} of call {call}, garbage", frame_of(kind, call, garbage))
            )
        too_long = (2**32 - 1).to_bytes(4, "little") + bytes([kind]) + bytes(4)
        found.append(Message(f"kind {kind}, four gigabytes", too_long, is_whole=False))
        found.append(Message(f"kind {kind}, half", frame_of(kind, 1, garbage)[:-9], is_whole=False))
    calls = range(1, _OTHERS_CALLS + 1)
    for name, kind, forge in (
        ("wrong actions", REPLY, wrong_actions),
        ("wrong actions, the last", LAST, wrong_actions),
        ("a stale epoch", LAST, _stale),
        ("an end", END, lambda _: b""),
    ):
        forged = b"".join(frame_of(kind, call, forge(call)) for call in calls)
        found.append(Message(f"{name} for the calls of others", forged))
    found.append(Message("goodbye", frame_of(GOODBYE, 0, b"the service ends"), is_whole=False))
    for what, changes in (
        ("as it is", {}),
        ("of a later process", {"epoch": 2}),
        ("of the last process of all", {"epoch": _LAST_EPOCH}),
        ("of an earlier process", {"epoch": 0}),
        ("with other numbers", {"number": 2**31}),
    ):
        asked = [
            encode(
                msgspec.structs.replace(
                    question, session_configuration=None, checkpoint=None, **changes
                )
            )
            for question in questions
        ]
        said = b"".join(call_of(1000 + number, payload) for number, payload in enumerate(asked))
        found.append(Message(f"all questions of the robot, {what}", said))
    return found


MOMENTS = (
    "before the handshake",
    "instead of the beginning",
    "before the hello",
    "after the hello",
    "in the middle of a call",
    "in the middle of a frame",
)


class Intruder:
    """Says each message at each moment, a link for each, and notes what it should not be told."""

    def __init__(
        self, endpoint: str, keys: Path | None, questions: Sequence[Request], own: Request
    ) -> None:
        self._endpoint = endpoint
        self._keys = keys
        self._own = encode(own)
        self._own_number = own.number
        self.links = 0
        self.told: list[str] = []
        self.answered = 0
        with RawLink(endpoint, keys) as link:
            link.say(hello_of())
            frame = link.receive()
            assert frame is not None and frame.kind == HELLO, "the intruder was not let in"
            hello = msgspec.msgpack.decode(frame.payload)
        self._messages = messages(questions, hello["name"], hello["incarnation"], self._call)

    def run(self, enough: Callable[[], bool]) -> None:
        """Say all messages at all moments, once, or until it is enough."""
        for moment, message in itertools.product(MOMENTS, self._messages):
            if enough():
                return
            if moment == "before the handshake" and self._keys is None:
                continue
            self._say(moment, message)
        if self._endpoint.startswith("udp/"):
            self._send_datagrams()

    def _send_datagrams(self) -> None:
        """Say everything in datagrams, too: sealed with its own keys, in its own name and others'.

        It proves its address, as a robot does. What comes here and is not of its association was
        meant for another robot.
        """
        host, _, port = self._endpoint.removeprefix("udp/").rpartition(":")
        self.links += 1
        with (
            RawLink(self._endpoint, self._keys) as link,
            socket.socket(type=socket.SOCK_DGRAM) as datagrams,
        ):
            datagrams.connect((host, int(port)))
            link.say(hello_of(incarnation=f"intruder-{self.links}"))
            handed_over = next(frame for frame in link.until_the_end() if frame.kind == KEYS)
            own, to_service, to_robot = struct.unpack_from(">I32s32s", handed_over.payload)
            counters = itertools.count()
            keys = to_service, to_robot
            self._prove_address(datagrams, own, to_service, to_robot, counters)
            names = [own, *((own + step) % 2**32 for step in range(-20, 20) if step), 0, 2**32 - 1]
            for name, message, key in itertools.product(names, self._messages, keys):
                if name != own and len(message.data) > 200:
                    continue
                header = struct.pack(">II", name, next(counters))
                sealed = AESGCM(key).encrypt(bytes(4) + header, message.data[:1200], None)
                with contextlib.suppress(OSError):
                    datagrams.send(header + sealed)
                    if name != own:
                        datagrams.send(header + bytes(len(sealed)))
            datagrams.settimeout(0.3)
            with contextlib.suppress(OSError):
                while True:
                    answer = datagrams.recv(65_536)
                    if int.from_bytes(answer[:4], "big") != own:
                        self.told.append("a datagram for another robot")

    @staticmethod
    def _prove_address(
        datagrams: socket.socket,
        own: int,
        to_service: bytes,
        to_robot: bytes,
        counters: Iterator[int],
    ) -> None:
        """Have the service probe this address, and send back what the probe holds."""

        def send(message: bytes) -> None:
            header = struct.pack(">II", own, next(counters))
            datagrams.send(header + AESGCM(to_service).encrypt(bytes(4) + header, message, None))

        send(b"\4\0" + bytes(8))
        datagrams.settimeout(PATIENCE_S)
        probe = datagrams.recv(65_536)
        send(b"\5\0" + AESGCM(to_robot).decrypt(bytes(4) + probe[:8], probe[8:], None)[2:])
        send(b"\4\0" + bytes(8))
        assert len(datagrams.recv(65_536)) == len(probe)  # the echo: it is answered from now on

    def _call(self, number: int, request: bytes) -> bytes:
        """Return the frame of a call; over udp it is what else would be a datagram."""
        if self._endpoint.startswith("udp/"):
            head = struct.pack(">BBIIH", _QUESTION_MESSAGE, 0, number, 0, 0)
            return frame_of(MESSAGE, number, head + request)
        return frame_of(CALL, number, request)

    def _say(self, moment: str, message: Message) -> None:
        """Have a link, bring it to a moment, say something and note all that comes."""
        self.links += 1
        calls: set[int] = set()
        # Whatever the service does to a link, at whatever moment, is its right.
        with contextlib.suppress(OSError, ssl.SSLError):
            shakes = moment != "before the handshake"
            with RawLink(self._endpoint, self._keys, shakes_hands=shakes) as link:
                try:
                    greeted = self._bring(link, moment, calls)
                    link.say(message.data)
                    eaten = 0
                    if moment == "in the middle of a frame":
                        calls.add(1)
                        eaten = len(self._call(1, self._own)) - _HALF
                    calls.update(_calls_in(message.data[eaten:]))
                    if greeted and message.is_whole:
                        calls.add(_PROBE)
                        link.say(self._call(_PROBE, b"junk"))
                    else:
                        # Past TLS, for which a half-closed stream is none.
                        socket.socket.shutdown(link.socket, socket.SHUT_WR)
                finally:
                    self._listen(link, f"{message.name}, {moment}", calls)

    def _bring(self, link: RawLink, moment: str, calls: set[int]) -> bool:
        """Bring a link to a moment; return whether it is one on which calls are answered."""
        if moment in ("before the handshake", "instead of the beginning"):
            return False
        if moment == "before the hello":
            link.say(MAGIC)
            return False
        link.say(hello_of(incarnation=f"intruder-{self.links}"))
        if moment == "in the middle of a call":
            calls.add(1)
            link.say(self._call(1, self._own))
        if moment == "in the middle of a frame":
            link.say(self._call(1, self._own)[:_HALF])
            return False
        return True

    def _listen(self, link: RawLink, when: str, calls: set[int]) -> None:
        for frame in _until_the_end(link):
            if frame.kind == MESSAGE:
                if frame.payload[0] != _REPLY_MESSAGE:
                    continue
                # What would be a datagram, with a number of the call and the part.
                call = int.from_bytes(frame.payload[2:6], "big")
                is_last = bool(frame.payload[6] & 0x80)
                frame = Frame(LAST if is_last else REPLY, call, frame.payload[8:])
            if frame.kind in (HELLO, KEYS, PING, GOODBYE):
                continue
            if frame.kind not in (REPLY, LAST, END) or frame.call not in calls:
                self.told.append(f"{when}: kind {frame.kind} of call {frame.call}")
                continue
            if frame.kind != END:
                self._judge(when, frame)
            if frame.kind != REPLY:
                self.answered += 1
                if frame.call == _PROBE:
                    return

    def _judge(self, when: str, frame: Frame) -> None:
        """Note a reply that holds anything of somebody else's."""
        reply: Reply
        try:
            reply = decode_reply(frame.payload)
        except MessageError as error:
            self.told.append(f"{when}: {error}")
            return
        if isinstance(reply, NeedState | Progress):
            return  # of the session it knows nothing
        if isinstance(reply, Refused) and reply.code != "stale_epoch":
            return
        own = isinstance(reply, TaskAnswer | SensingAnswer) and reply.number == self._own_number
        if not (own and frame.call == 1):
            self.told.append(f"{when}: {reply}")


def _calls_in(data: bytes) -> Iterator[int]:
    """Yield the calls that bytes make, or begin to make."""
    at = 0
    data = data.removeprefix(MAGIC)
    while at + 9 <= len(data):
        if data[at + 4] in (CALL, MESSAGE):
            yield int.from_bytes(data[at + 5 : at + 9], "little")
        at += 9 + int.from_bytes(data[at : at + 4], "little")


def _until_the_end(link: RawLink) -> Iterator[Frame]:
    """Yield frames until the other end hangs up, or says what is no frame (TLS's own alerts)."""
    with contextlib.suppress(OSError, AssertionError):
        yield from link.until_the_end()
