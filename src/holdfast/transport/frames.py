"""Frames: how messages are delimited on a stream.

A stream begins with a magic word. Then each message is a frame: its length, its kind, its call and
its payload. Any program may connect to a port, so each length is checked against a bound before
memory is allocated. A message above the bound is skipped, and its sender is informed. Any other
violation ends the link with a reason for the log. Nothing here knows a socket.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Mapping
from typing import Final, NamedTuple, TypeVar, cast

import msgspec

from holdfast import __version__
from holdfast.errors import FrameError, TransportError
from holdfast.printable import one_line
from holdfast.transport.endpoints import Role, check_name

WIRE_VERSION: Final = 1
"""Version of the frames and the hello; the protocol's messages have another version."""

MAGIC: Final = b"holdfast"
"""The first bytes of either end."""

HELLO: Final = 1  # identifies the sender; the first frame, unless that is a goodbye
CALL: Final = 2  # a request
REPLY: Final = 3  # one of the replies to a call
END: Final = 4  # no more replies to a call
LAST: Final = 5  # a reply and the end
PING: Final = 6  # this end lives
GOODBYE: Final = 7  # why this end closes the link; empty: it will close soon
KEYS: Final = 8  # of the cipher of datagrams
MESSAGE: Final = 9  # of an exchange, instead of a datagram

MAX_HELLO_BYTES: Final = 4096
_MAX_GOODBYE_BYTES: Final = 1024

_LARGE_BYTES: Final = 1 << 20

_HEADER: Final = struct.Struct("<IBI")  # bytes that follow it, kind, call

HEADER_BYTES: Final = _HEADER.size
"""Size of the header of each frame."""


class Frame(NamedTuple):
    """A received frame."""

    kind: int
    call: int
    payload: bytes  # a large one is a bytearray that nothing else refers to
    skipped_bytes: int = 0  # size of a message that is larger than allowed and was skipped


class Hello(msgspec.Struct, frozen=True, omit_defaults=True):
    """The first frame: identifies one end of a link."""

    version: int  # WIRE_VERSION of its code
    release: str  # of holdfast there
    role: Role
    name: str  # a robot's may be empty
    incarnation: str  # of its process; a restarted process has another
    lease_ms: float  # after this much silence it may be considered lost
    clock_s: float = 0.0  # the time at a service, in seconds since 1970; 0 is unknown


class _Version(msgspec.Struct):
    """The fields that the hello of every version has."""

    version: int
    release: str = "unknown"


_HELLO: Final = msgspec.msgpack.Decoder(Hello)
_VERSION: Final = msgspec.msgpack.Decoder(_Version)

_Form = TypeVar("_Form")


def encode_frame(kind: int, call: int = 0, payload: bytes = b"") -> bytes:
    """Return a frame's bytes."""
    return _HEADER.pack(len(payload), kind, call) + payload


def encode_hello(
    role: Role, name: str, incarnation: str, lease_ms: float, clock_s: float = 0.0
) -> bytes:
    """Return the first bytes of this end: the magic word and its hello."""
    hello = Hello(WIRE_VERSION, __version__, role, name, incarnation, lease_ms, clock_s)
    return MAGIC + encode_frame(HELLO, 0, msgspec.msgpack.encode(hello))


def encode_goodbye(reason: str) -> bytes:
    """Return the last frame of this end."""
    return encode_frame(GOODBYE, 0, reason.encode(errors="replace")[:_MAX_GOODBYE_BYTES])


def read_goodbye(payload: bytes) -> str:
    """Return the reason in a goodbye, on one line; empty if there is none."""
    return one_line(payload.decode(errors="replace"))


def decode_hello(payload: bytes) -> Hello:
    """Decode the peer's hello; raise FrameError if it is of another version, or malformed."""
    version = _decoded(payload, _VERSION)
    if version.version != WIRE_VERSION:
        raise FrameError(
            f"is holdfast {one_line(version.release[:40])} with version {version.version} of "
            f"the wire; here is holdfast {__version__} with version {WIRE_VERSION}: install "
            "the same release at both ends"
        )
    hello = _decoded(payload, _HELLO)
    try:
        check_name("incarnation", hello.incarnation)
        if hello.role == "service" or hello.name:
            check_name("name", hello.name)
    except TransportError as error:
        raise FrameError(f"sends a malformed hello: {error}") from None
    if not 1.0 <= hello.lease_ms <= 3.6e6:
        raise FrameError(f"sends a hello with a lease of {hello.lease_ms:g} ms (1 to 3.6e6)")
    if not math.isfinite(hello.clock_s):
        raise FrameError(f"sends a hello with a clock of {hello.clock_s:g} s")
    return hello


def _decoded(payload: bytes, decoder: msgspec.msgpack.Decoder[_Form]) -> _Form:
    try:
        return decoder.decode(payload)
    except Exception as error:  # noqa: BLE001 - decoding may raise anything
        raise FrameError(f"sends a malformed hello: {one_line(str(error))}") from None


class FrameDecoder:
    """Decodes the frames of one stream, in pieces of any size.

    A request or reply above the bound is skipped. ``more`` has bounds of further kinds. ``error``
    is the violation after the last frame, if any; nothing may be fed after it.
    """

    def __init__(self, max_message_bytes: int, more: Mapping[int, int] | None = None) -> None:
        self.error: FrameError | None = None
        self._buffer = bytearray()
        self._to_skip = 0
        self._has_magic = False
        self._has_hello = False
        self._bounds = {
            CALL: max_message_bytes,
            REPLY: max_message_bytes,
            LAST: max_message_bytes,
            END: 0,
            PING: 0,
            GOODBYE: _MAX_GOODBYE_BYTES,
            **(more or {}),
        }

    @property
    def held_bytes(self) -> int:
        """Size of the incomplete frame."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[Frame]:
        """Take bytes and return the frames that they complete."""
        frames: list[Frame] = []
        if self._has_hello and not self._buffer and not self._to_skip:
            # The usual case: exactly one frame.
            start = _HEADER.size
            if len(data) >= start:
                size, kind, call = _HEADER.unpack_from(data)
                if start + size == len(data) and size <= self._bounds.get(kind, -1):
                    return [Frame(kind, call, data[start:])]
        try:
            self._feed(data, frames)
        except FrameError as error:
            self.error = error
            self._buffer.clear()
        return frames

    def _feed(self, data: bytes, frames: list[Frame]) -> None:
        buffer = self._buffer
        buffer += data
        at = 0
        if not self._has_magic:
            if not MAGIC.startswith(buffer[: len(MAGIC)]):
                raise FrameError(_describe_foreign(bytes(buffer[:16])))
            if len(buffer) < len(MAGIC):
                return
            self._has_magic = True
            at = len(MAGIC)
        while True:
            skipped = min(self._to_skip, len(buffer) - at)
            self._to_skip -= skipped
            at += skipped
            start = at + _HEADER.size
            if start > len(buffer):
                break
            size, kind, call = _HEADER.unpack_from(buffer, at)
            if size > self._bound(kind):
                if kind not in (CALL, REPLY, LAST, MESSAGE):
                    raise FrameError(f"sends a frame of kind {kind} with {size} bytes")
                frames.append(Frame(kind, call, b"", size))
                self._to_skip = size
                at = start
                continue
            if start + size > len(buffer):
                break
            self._has_hello = True
            if size >= _LARGE_BYTES:
                # Not copied: that would block the loop for a tenth of a second.
                behind = bytes(buffer[start + size :])
                del buffer[start + size :], buffer[:start]
                frames.append(Frame(kind, call, cast(bytes, buffer)))
                self._buffer = bytearray()
                self._feed(behind, frames)
                return
            with memoryview(buffer) as view:
                frames.append(Frame(kind, call, bytes(view[start : start + size])))
            at = start + size
        del buffer[:at]

    def _bound(self, kind: int) -> int:
        if not self._has_hello:
            if kind not in (HELLO, GOODBYE):
                raise FrameError(f"begins with a frame of kind {kind} instead of a hello")
            return MAX_HELLO_BYTES
        bound = self._bounds.get(kind)
        if bound is None:
            if kind in (KEYS, MESSAGE):
                raise FrameError(
                    "is at udp/..., and the other end at tls/...: write the same at both ends"
                )
            raise FrameError(f"sends a frame of the unknown kind {kind}")
        return bound


def _describe_foreign(first: bytes) -> str:
    """Describe a peer that does not begin with the magic word."""
    if first[:2] in (b"\x16\x03", b"\x15\x03"):
        return "speaks TLS, and this endpoint does not (tls/... goes with tls/...)"
    if re.match(rb"(GET|HEAD|POST|PUT|OPTIONS|CONNECT|PRI|HTTP)\b", first):
        return "speaks HTTP"
    return f"does not speak holdfast: it begins with {first!r}"
