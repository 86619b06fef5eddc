"""Streams: however bytes are cut, the same frames come of them, and little is held of what is none.

What a stream says is read again here, all at once and by other code. The two must agree on every
frame before the first that is wrong, and memory stays bounded whatever a header announces.
"""

import random
import struct
import tracemalloc

from hypothesis import strategies as st
from tests.fuzz import corpus
from tests.fuzz.examples import always, examples
from tests.fuzz.mutations import Mutator
from tests.wire import (
    CALL,
    END,
    GOODBYE,
    HELLO,
    KINDS,
    LAST,
    MAGIC,
    PING,
    REPLY,
    frame_of,
    hello_of,
)

from holdfast.protocol.messages import encode
from holdfast.transport.frames import FrameDecoder

MAX_BYTES = 2000
BOUNDS = {CALL: MAX_BYTES, REPLY: MAX_BYTES, LAST: MAX_BYTES, END: 0, PING: 0, GOODBYE: 1024}
FIRST_BOUND = 4096


def read_at_once(said: bytes) -> tuple[list[tuple[int, int, int]], bool]:
    """Return kind, call and size of the frames that were said, and whether all were in order."""
    if said[: len(MAGIC)] != MAGIC[: len(said)]:
        return [], False
    found: list[tuple[int, int, int]] = []
    at = len(MAGIC)
    while len(said) - at >= 9:
        size, kind, call = struct.unpack_from("<IBI", said, at)
        bound = BOUNDS.get(kind) if found else FIRST_BOUND if kind == HELLO else None
        if bound is None:
            return found, False
        if size > bound and kind not in (CALL, REPLY, LAST):
            return found, False
        at += 9 + size
        # One that is too large is known by its header.
        if at > len(said) and size <= bound:
            break
        found.append((kind, call, size))
    return found, True


def decoded(said: bytes, cuts: list[int]) -> tuple[list[tuple[int, int, int]], bool]:
    decoder = FrameDecoder(MAX_BYTES)
    found = []
    for begin, end in zip([0, *cuts], [*cuts, len(said)], strict=True):
        for frame in decoder.feed(said[begin:end]):
            assert len(frame.payload) <= FIRST_BOUND
            found.append((frame.kind, frame.call, frame.skipped_bytes or len(frame.payload)))
        if decoder.error is not None:
            return found, False
        assert decoder.held_bytes <= FIRST_BOUND + 9
    return found, True


FRAMES = st.builds(
    frame_of,
    st.sampled_from([*KINDS.values(), CALL, CALL, 0, 9, 255]),
    st.integers(0, 2**32 - 1),
    st.binary(max_size=60) | st.sampled_from([b"", bytes(MAX_BYTES), bytes(MAX_BYTES + 1)]),
)
SAID = st.builds(
    lambda first, frames, last: first + b"".join(frames) + last,
    st.just(hello_of()) | st.binary(max_size=30),
    st.lists(FRAMES, max_size=6),
    st.binary(max_size=30),
)


@examples(quick=300, slow=20_000)
def test_cuts_change_nothing(examples: int) -> None:
    def check(said: bytes, places: list[int]) -> None:
        cuts = sorted(place % (len(said) + 1) for place in places)
        assert decoded(said, cuts) == read_at_once(said)

    always(examples, check, SAID, st.lists(st.integers(0, 10**6), max_size=8))


def test_what_is_spoilt_is_read_alike() -> None:
    chance = random.Random(3)
    whole = [
        hello_of() + b"".join(frame_of(CALL, number, encode(each)) for number in range(3))
        for each in corpus.requests()[:4]
    ]
    mutator = Mutator(chance, whole)
    for _ in range(2000):
        said = mutator.spoilt()
        cuts = sorted(chance.randrange(len(said) + 1) for _ in range(chance.randrange(6)))
        assert decoded(said, cuts) == read_at_once(said)


def test_a_length_alone_takes_no_memory() -> None:
    decoder = FrameDecoder(64 * 1024 * 1024)
    decoder.feed(hello_of())
    tracemalloc.start()
    try:
        (frame,) = decoder.feed(struct.pack("<IBI", 2**32 - 1, CALL, 1))
        assert frame.skipped_bytes == 2**32 - 1
        for _ in range(200):
            assert decoder.feed(bytes(100_000)) == []
        assert decoder.held_bytes == 0
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()
