"""The wire in a test's own hands: plain sockets, the standard library's TLS, and frames by hand.

It shares no code with the product's own ends, so nothing of theirs keeps it from saying what it
likes, when it likes. A stream begins, in both directions, with eight bytes and a frame that says
who speaks. A frame is a header of nine bytes, little-endian: how many bytes follow (4), of which
kind it is (1), to which call it belongs (4).
"""

import contextlib
import socket
import ssl
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, Self

import msgspec

from holdfast.protocol.messages import Reply, Request, decode_reply, encode

MAGIC = b"holdfast"
HELLO, CALL, REPLY, END, LAST, PING, GOODBYE, KEYS, MESSAGE = range(1, 10)
KINDS = {
    "hello": HELLO,
    "call": CALL,
    "reply": REPLY,
    "end": END,
    "last": LAST,
    "ping": PING,
    "goodbye": GOODBYE,
}

PATIENCE_S = 60.0
"""Only what hangs takes as long."""

LEASE_MS = 600_000.0
"""Announced: a machine that stands still for a moment is not given up."""

_HEADER = struct.Struct("<IBI")


class Frame(NamedTuple):
    """A frame that has come."""

    kind: int
    call: int
    payload: bytes


def frame_of(kind: int, call: int = 0, payload: bytes = b"") -> bytes:
    """Return a frame's bytes."""
    return _HEADER.pack(len(payload), kind, call) + payload


def hello_of(
    role: str = "robot", name: str = "", incarnation: str = "raw", **changes: Any
) -> bytes:
    """Return what an end says first; ``changes`` are other fields, or other values."""
    fields = {
        "version": 1,
        "release": "0.1.0",
        "role": role,
        "name": name,
        "incarnation": incarnation,
        "lease_ms": LEASE_MS,
        **changes,
    }
    return MAGIC + frame_of(HELLO, 0, msgspec.msgpack.encode(fields))


def robot_context(keys: Path) -> ssl.SSLContext:
    """Return the client's end of mutual TLS, with the keys in a directory."""
    context = ssl.create_default_context(cafile=str(keys / "authority.pem"))
    context.load_cert_chain(keys / "certificate.pem", keys / "key.pem")
    return context


class RawLink:
    """A stream to an endpoint; nothing is said on it but what is asked for."""

    def __init__(
        self, endpoint: str | socket.socket, keys: Path | None = None, *, shakes_hands: bool = True
    ) -> None:
        self._buffer = bytearray()
        self._has_magic = False
        self.socket: socket.socket
        if isinstance(endpoint, socket.socket):  # to a process that was launched with it
            self.socket = endpoint
            self.socket.settimeout(PATIENCE_S)
            return
        protocol, _, place = endpoint.partition("/")
        if protocol == "unix":
            self.socket = socket.socket(socket.AF_UNIX)
            self.socket.settimeout(PATIENCE_S)
            self.socket.connect(place)
            return
        host, _, port = place.rpartition(":")
        self.socket = socket.create_connection((host, int(port)), PATIENCE_S)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if protocol in ("tls", "udp") and shakes_hands:
            assert keys is not None, "tls takes credentials"
            try:
                self.socket = robot_context(keys).wrap_socket(self.socket, server_hostname=host)
            except BaseException:
                self.socket.close()
                raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Hang up. May be repeated."""
        self.socket.close()

    def say(self, data: bytes) -> None:
        """Send bytes."""
        self.socket.sendall(data)

    def send(self, kind: int, call: int = 0, payload: bytes = b"") -> None:
        """Send a frame."""
        self.say(frame_of(kind, call, payload))

    def receive(self, wait_s: float = PATIENCE_S) -> Frame | None:
        """Return the next frame; None once the other end has hung up."""
        until = time.monotonic() + wait_s
        while (frame := self._take()) is None:
            left = until - time.monotonic()
            if left <= 0.0:
                raise TimeoutError(f"nothing came within {wait_s:g} s")
            self.socket.settimeout(left)
            try:
                data = self.socket.recv(65_536)
            except TimeoutError:
                continue
            except OSError:
                return None
            finally:
                with contextlib.suppress(OSError):
                    self.socket.settimeout(PATIENCE_S)
            if not data:
                return None
            self._buffer += data
        return frame

    def until_the_end(self, wait_s: float = PATIENCE_S) -> Iterator[Frame]:
        """Yield all frames until the other end hangs up."""
        while (frame := self.receive(wait_s)) is not None:
            yield frame

    def _take(self) -> Frame | None:
        if not self._has_magic:
            if len(self._buffer) < len(MAGIC):
                return None
            assert self._buffer.startswith(MAGIC), bytes(self._buffer[:40])
            del self._buffer[: len(MAGIC)]
            self._has_magic = True
        if len(self._buffer) < _HEADER.size:
            return None
        size, kind, call = _HEADER.unpack_from(self._buffer)
        end = _HEADER.size + size
        if len(self._buffer) < end:
            return None
        payload = bytes(self._buffer[_HEADER.size : end])
        del self._buffer[:end]
        return Frame(kind, call, payload)


class RawClient(RawLink):
    """A robot's end that has greeted the service, and asks it one thing at a time."""

    def __init__(
        self, endpoint: str | socket.socket, keys: Path | None = None, *, hello: bytes | None = None
    ) -> None:
        super().__init__(endpoint, keys)
        try:
            self.say(hello_of() if hello is None else hello)
            frame = self.receive()
            assert frame is not None, "the service has hung up instead of greeting"
            assert frame.kind == HELLO, frame
            self.service: dict[str, Any] = msgspec.msgpack.decode(frame.payload)
        except BaseException:
            self.close()
            raise
        self._calls = 0

    def send_call(self, payload: bytes) -> int:
        """Send a request; return its call."""
        self._calls += 1
        self.send(CALL, self._calls, payload)
        return self._calls

    def replies_to(self, call: int) -> list[Reply]:
        """Return all replies to a call, once it has ended; those to others are passed over."""
        replies = []
        for frame in self.until_the_end():
            if frame.kind == PING:
                self.send(PING)
            elif frame.call == call and frame.kind in (REPLY, LAST, END):
                if frame.kind != END:
                    replies.append(decode_reply(frame.payload))
                if frame.kind != REPLY:
                    return replies
        raise ConnectionError("the service has hung up")

    def ask(self, request: Request | bytes) -> list[Reply]:
        """Return all replies to a request."""
        payload = request if isinstance(request, bytes) else encode(request)
        return self.replies_to(self.send_call(payload))
