"""Frames: however a stream is cut, the same ones come out; and what is none is found at once."""

import msgspec
import pytest

from holdfast.errors import FrameError
from holdfast.transport.frames import (
    CALL,
    END,
    GOODBYE,
    HELLO,
    MAGIC,
    MAX_HELLO_BYTES,
    PING,
    WIRE_VERSION,
    Frame,
    FrameDecoder,
    Hello,
    decode_hello,
    encode_frame,
    encode_goodbye,
    encode_hello,
    read_goodbye,
)

MAX_BYTES = 300
GREETING = encode_hello("robot", "r", "i1", 400.0)


@pytest.mark.parametrize("size", range(1, len(MAGIC) + 1))
def test_a_wrong_greeting_is_seen_at_its_first_wrong_byte(size: int) -> None:
    decoder = FrameDecoder(MAX_BYTES)
    decoder.feed(MAGIC[: size - 1])
    assert decoder.error is None
    decoder.feed(b"?")
    assert "does not speak holdfast" in str(decoder.error)


@pytest.mark.parametrize("behind", [b"", encode_frame(END, 8), encode_frame(END, 9)[:1]])
def test_a_large_message_comes_as_it_was_sent(behind: bytes) -> None:
    payload = bytes(range(256)) * 8192
    stream = encode_frame(PING) + encode_frame(CALL, 7, payload) + behind
    decoder = FrameDecoder(1 << 22)
    came = decoder.feed(GREETING)
    for start in range(0, len(stream), 100_000):
        came += decoder.feed(stream[start : start + 100_000])
    came += decoder.feed(encode_frame(END, 9)[len(behind) % 9 :])
    assert [(frame.kind, frame.call) for frame in came[1:3]] == [(PING, 0), (CALL, 7)]
    assert came[2].payload == payload
    assert came[-1].kind == END
    assert decoder.held_bytes == 0


@pytest.mark.parametrize(
    ("stream", "error"),
    [
        (MAGIC + encode_frame(CALL, 1, b"x"), "begins with a frame of kind 2 instead of a hello"),
        (MAGIC + encode_frame(HELLO, 0, bytes(MAX_HELLO_BYTES + 1)), "of kind 1 with 4097 bytes"),
        (GREETING + GREETING[len(MAGIC) :], "sends a frame of the unknown kind 1"),
        (GREETING + encode_frame(PING, 0, b"x"), "sends a frame of kind 6 with 1 bytes"),
        (GREETING + encode_frame(GOODBYE, 0, bytes(2000)), "of kind 7 with 2000 bytes"),
        (b"HTTP/1.1 400 Bad Request", "speaks HTTP"),
        (b"PRI * HTTP/2.0", "speaks HTTP"),
        (b"\x15\x03\x03\x00\x02\x02\x46", "speaks TLS, and this endpoint does not"),
        (b"\x16\x03\x01\x02\x00\x01", "speaks TLS, and this endpoint does not"),
    ],
)
def test_what_is_no_frame_of_ours_is_refused_before_it_is_kept(stream: bytes, error: str) -> None:
    decoder = FrameDecoder(MAX_BYTES)
    decoder.feed(stream)
    assert error in str(decoder.error)
    assert decoder.held_bytes <= 16


def test_a_hello_is_read_as_it_was_written() -> None:
    (frame,) = FrameDecoder(MAX_BYTES).feed(encode_hello("service", "cloud", "b1", 250.0))
    hello = decode_hello(frame.payload)
    assert (hello.role, hello.name, hello.incarnation) == ("service", "cloud", "b1")
    assert (hello.version, hello.lease_ms) == (WIRE_VERSION, 250.0)


def test_a_service_tells_its_clock_and_need_not() -> None:
    (frame,) = FrameDecoder(MAX_BYTES).feed(encode_hello("service", "cloud", "b1", 250.0, 1.8e9))
    assert decode_hello(frame.payload).clock_s == 1.8e9
    assert decode_hello(changed()).clock_s == 0.0
    assert b"clock_s" not in GREETING


def changed(**values: object) -> bytes:
    (frame,) = FrameDecoder(MAX_BYTES).feed(GREETING)
    return msgspec.msgpack.encode({**msgspec.msgpack.decode(frame.payload), **values})


@pytest.mark.parametrize(
    ("payload", "error"),
    [
        (changed(version=9, release="2.0"), "is holdfast 2.0 with version 9 of the wire; here"),
        (msgspec.msgpack.encode({"version": 9}), "is holdfast unknown with version 9"),
        (changed(version=9, release="\x1b[2J"), r"is holdfast \x1b[2J with"),
        (b"\xff", "sends a malformed hello"),
        (changed(role="king"), "sends a malformed hello"),
        (changed(name="a b"), "sends a malformed hello: name 'a b'"),
        (changed(role="service", name=""), "sends a malformed hello: name ''"),
        (changed(incarnation=""), "sends a malformed hello: incarnation ''"),
        (changed(lease_ms=0.5), "a lease of 0.5 ms"),
        (changed(lease_ms=float("nan")), "a lease of nan ms"),
    ],
)
def test_a_hello_that_is_none_of_ours_is_refused_in_words(payload: bytes, error: str) -> None:
    with pytest.raises(FrameError) as raised:
        decode_hello(payload)
    assert error in str(raised.value)
    assert str(raised.value).isprintable()


def test_a_later_version_may_say_more() -> None:
    assert isinstance(decode_hello(changed(something=1)), Hello)


def test_a_goodbye_is_cut_and_fit_to_be_shown() -> None:
    (frame,) = FrameDecoder(MAX_BYTES).feed(MAGIC + encode_goodbye("\x1b" + "x" * 5000))
    text = read_goodbye(frame.payload)
    assert text.startswith(r"\x1bxxx")
    assert len(text) < 1100


def test_a_lease_of_a_millisecond_or_an_hour() -> None:
    for lease_ms in (1.0, 3.6e6):
        assert decode_hello(changed(lease_ms=lease_ms)).lease_ms == lease_ms
    with pytest.raises(FrameError, match=r"a lease of 3\.60001e\+06 ms"):
        decode_hello(changed(lease_ms=3.60001e6))


def test_a_whole_frame_is_held_to_the_same_bounds_as_a_piece() -> None:
    """It takes a short way of its own."""
    for size, skipped in ((MAX_BYTES, 0), (MAX_BYTES + 1, MAX_BYTES + 1)):
        decoder = FrameDecoder(MAX_BYTES)
        decoder.feed(GREETING)
        ((kind, call, payload, rest),) = decoder.feed(encode_frame(CALL, 7, bytes(size)))
        assert (kind, call, len(payload), rest) == (CALL, 7, 0 if skipped else size, skipped)
        # What looks like a frame within one that is skipped is none.
    decoder.feed(encode_frame(CALL, 8, bytes(MAX_BYTES + 9))[:-9])
    inside = encode_frame(PING)
    assert decoder.feed(inside) == []
    assert decoder.feed(inside) == [Frame(PING, 0, b"")]


def test_a_kind_of_its_own_has_a_bound_of_its_own() -> None:
    decoder = FrameDecoder(MAX_BYTES, more={77: 2})
    decoder.feed(GREETING)
    assert decoder.feed(encode_frame(77, 1, b"xy")) == [Frame(77, 1, b"xy")]
    assert decoder.feed(encode_frame(77, 1, b"xyz")) == []
    assert str(decoder.error) == "sends a frame of kind 77 with 3 bytes"
