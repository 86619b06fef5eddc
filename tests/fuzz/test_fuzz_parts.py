"""Requests in parts: whoever sends what parts in whatever order, memory stays bounded.

The service's end is given queries as Zenoh's thread would bring them. An honest upload among them
arrives whole, and nothing arrives that was not sent as one.
"""

from __future__ import annotations

import random
import sys
import tracemalloc
from typing import Any

import pytest
from hypothesis import strategies as st
from tests.fuzz.examples import always, examples

from holdfast.runtime.transport import zenoh_transport
from holdfast.runtime.transport.contract import IncomingCall
from holdfast.runtime.transport.zenoh_transport import ZenohServiceTransport

MAX_BYTES = 200_000
PART = zenoh_transport._PART
SMALLEST = zenoh_transport._SMALLEST_PART_BYTES


class Bytes(bytes):
    """What Zenoh calls bytes."""

    def to_bytes(self, *_: Any, **__: Any) -> bytes:
        return bytes(self)


class Query:
    """A call as Zenoh brings it."""

    def __init__(self, payload: bytes, attachment: bytes | None) -> None:
        self.payload = Bytes(payload)
        self.attachment = None if attachment is None else Bytes(attachment)


class End:
    """A service's end that is not connected to anything."""

    def __init__(self) -> None:
        self.transport = ZenohServiceTransport(
            "cloud", boot="1", listen=["tcp/127.0.0.1:7447"], max_message_bytes=MAX_BYTES
        )
        self.arrived: list[bytes] = []
        self.transport._deliver = self._deliver
        # Nobody is there to be answered.
        self.transport._answer = lambda *_: None  # type: ignore[method-assign]

    def _deliver(self, call: IncomingCall) -> None:
        self.arrived.append(call.payload)

    def receive(self, payload: bytes, attachment: bytes | None) -> None:
        self.transport._received(Query(payload, attachment))  # type: ignore[arg-type]

    def held_bytes(self) -> int:
        """Return what the parts that wait take, to the last byte of bookkeeping."""
        incoming = self.transport._assembly._incoming
        return sys.getsizeof(incoming) + sum(
            sys.getsizeof(name)
            + sys.getsizeof(upload)
            + sys.getsizeof(upload.parts)
            + sum(
                sys.getsizeof(number) + sys.getsizeof(part) for number, part in upload.parts.items()
            )
            for name, upload in incoming.items()
        )


BOUND = 2 * MAX_BYTES + zenoh_transport._UPLOADS * 1000 + MAX_BYTES // 2
"""The bytes that are allowed, what 256 uploads take by themselves, and a quarter for the rest."""


def upload_of(chance: random.Random, name: bytes) -> tuple[bytes, list[tuple[bytes, bytes]]]:
    """Return a request and its parts, with what describes them."""
    count = chance.randint(2, 6)
    size = chance.randint(SMALLEST, 9000)
    request = chance.randbytes(size * (count - 1) + chance.randint(0, size))
    parts = [
        (request[index * size : (index + 1) * size], PART.pack(name, len(request), index, count))
        for index in range(count)
    ]
    return request, parts


def hostile_part(chance: random.Random, names: list[bytes]) -> tuple[bytes, bytes]:
    """Return a part of no good request, or what does not even describe one."""
    if chance.random() < 0.1:
        return chance.randbytes(20), chance.randbytes(chance.choice((0, 5, PART.size, 40)))
    numbers = (0, 1, 2, 3, 199, 200, 201, 2**16, 2**32 - 1)
    size_bytes = chance.choice((0, 1, SMALLEST, MAX_BYTES, MAX_BYTES + 1, 2**63))
    description = PART.pack(
        chance.choice(names) if chance.random() < 0.5 else chance.randbytes(16),
        size_bytes,
        chance.choice(numbers),
        chance.choice(numbers),
    )
    size = chance.choice((0, 0, 1, SMALLEST - 1, SMALLEST, 36_000))
    return bytes(size), description


@examples(quick=25, slow=1_500)
def test_an_honest_upload_arrives_and_memory_is_bounded(examples: int) -> None:
    def check(seed: int) -> None:
        chance = random.Random(seed)
        end = End()
        names = [chance.randbytes(16) for _ in range(20)]
        sent = []
        for _ in range(3):
            request, parts = upload_of(chance, chance.randbytes(16))
            sent.append(request)
            for part, description in parts:
                # Fewer in between than uploads are remembered.
                for _ in range(chance.randrange(80)):
                    end.receive(*hostile_part(chance, names))
                end.receive(part, description)
            assert end.held_bytes() < BOUND
        honest = [request for request in end.arrived if request in sent]
        assert honest == sent

    always(examples, check, st.integers(0, 2**48))


@pytest.mark.parametrize("size", [0, SMALLEST - 1])
@pytest.mark.parametrize("own_count", [False, True], ids=["of the upload", "of the part"])
def test_many_small_parts_take_no_more_memory_than_they_say(size: int, own_count: bool) -> None:
    """Of each part a number and a place in a table were kept, however little it brought."""
    end = End()
    most = 1 + MAX_BYTES // SMALLEST
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        for upload in range(50):
            name = upload.to_bytes(16, "big")
            end.receive(bytes(SMALLEST), PART.pack(name, MAX_BYTES, 0, most))
            for index in range(1, most - 1):
                count = index + 1 if own_count else most
                end.receive(bytes(size), PART.pack(name, MAX_BYTES, index, count))
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert end.held_bytes() < BOUND
    assert after - before < 2 * BOUND
    assert not end.arrived


@examples(quick=60, slow=5_000)
def test_nothing_arrives_that_was_not_sent_as_one(examples: int) -> None:
    def check(seed: int) -> None:
        chance = random.Random(seed)
        end = End()
        name = chance.randbytes(16)
        request, parts = upload_of(chance, name)
        shuffled = [*parts, *chance.choices(parts, k=3)]
        chance.shuffle(shuffled)
        for part, description in shuffled:
            if chance.random() < 0.1:
                part = part[: chance.randint(0, len(part))]
            end.receive(part, description)
        assert all(len(arrived) == len(request) for arrived in end.arrived)
        assert all(arrived == request for arrived in end.arrived)

    always(examples, check, st.integers(0, 2**48))
