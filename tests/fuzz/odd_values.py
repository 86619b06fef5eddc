"""MessagePack of every type, drawn by seed: what an encoder of plain data never writes, too.

Each first byte has its values: numbers at the edges of their widths, texts that are no UTF-8,
times that no calendar has, extensions, keys of every type, lengths that lie, and deep nesting.
"""

import itertools
import random
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence

_EDGES = (0, 1, 15, 16, 31, 127, 128, 255, 256, 65_535, 65_536, 2**31 - 1, 2**31, 2**32 - 1)
_FLOATS = (0.0, -0.0, 1e-320, 1e308, -1e308, float("inf"), float("-inf"), float("nan"))
_TEXTS = (
    *(b"", b"a", b"model", "ü😀".encode(), b"x" * 300, b"\x00\x1b[2J\r\n"),
    # No UTF-8: a half, a surrogate, an overlong form, a code point beyond the last.
    *(b"\xc3", b"\xed\xa0\x80", b"\xc0\x80", b"\xf4\x90\x80\x80"),
)
_SECONDS = (
    0,
    1,
    253_402_300_799,
    253_402_300_800,
    2**34 - 1,
    2**63 - 1,
    -1,
    -(2**63),
    -62_135_596_801,
)
_NANOSECONDS = (0, 1, 999_999_499, 999_999_500, 999_999_999, 1_000_000_000, 2**32 - 1)
_DEPTHS = (1, 2, 31, 32, 33, 100, 900, 970, 1100)


class OddValues:
    """Draws encoded values; the same chance draws the same."""

    def __init__(self, chance: random.Random) -> None:
        self._chance = chance
        self._scalars: tuple[Callable[[], bytes], ...] = (
            self._constant,
            self._integer,
            self._float,
            self._text,
            self._bytes,
            self._time,
            self._extension,
            self._lie,
        )

    def value(self, depth: int = 3) -> bytes:
        """Return a value; containers are at most so deep, but for a tower now and then."""
        draw = self._chance.random()
        if draw < 0.05:
            return self.tower(self._chance.choice(_DEPTHS))
        if depth and draw < 0.35:
            return self._array(depth - 1) if draw < 0.2 else self._mapping(depth - 1)
        return self._chance.choice(self._scalars)()

    def tower(self, height: int) -> bytes:
        """Return containers within each other, of one kind or of both."""
        openers = self._chance.choice(((b"\x91",), (b"\x81\xa1a",), (b"\x91", b"\x81\xa1a")))
        return b"".join(openers[k % len(openers)] for k in range(height)) + self._chance.choice(
            (b"\x90", b"\x80", b"\xc0", self._time())
        )

    def plain(self, depth: int = 3) -> bytes:
        """Return a value that JSON has."""
        draw = self._chance.random()
        count = self._chance.randrange(4)
        if depth and draw < 0.2:
            return bytes([0x90 | count]) + b"".join(self.plain(depth - 1) for _ in range(count))
        if depth and draw < 0.4:
            items = (b"\xa1" + bytes([97 + k]) + self.plain(depth - 1) for k in range(count))
            return bytes([0x80 | count]) + b"".join(items)
        return self._chance.choice((b"\xc0", b"\xc2", b"\xc3", b"\x07", b"\xe0", b"\xa1a"))

    def _constant(self) -> bytes:
        return self._chance.choice((b"\xc0", b"\xc2", b"\xc3", b"\xc1"))

    def _integer(self) -> bytes:
        chance = self._chance
        head, form = chance.choice(
            ((b"\xcc", ">B"), (b"\xcd", ">H"), (b"\xce", ">I"), (b"\xcf", ">Q"))
        )
        width = struct.calcsize(form)
        last = (1 << 8 * width) - 1
        raw = (chance.choice((*_EDGES, last, last // 2 + 1)) & last).to_bytes(width, "big")
        signed = bytes([head[0] + 4])
        return chance.choice((head, signed)) + raw if chance.random() < 0.8 else raw[:1]

    def _float(self) -> bytes:
        if self._chance.random() < 0.3:
            return b"\xca" + self._chance.choice((b"\x7f\x80\0\0", b"\x7f\xc0\0\0", b"\0\0\0\1"))
        return b"\xcb" + struct.pack(">d", self._chance.choice(_FLOATS))

    def _text(self) -> bytes:
        text = self._chance.choice(_TEXTS)
        if len(text) < 32 and self._chance.random() < 0.7:
            return bytes([0xA0 | len(text)]) + text
        return b"\xda" + len(text).to_bytes(2, "big") + text

    def _bytes(self) -> bytes:
        data = self._chance.randbytes(self._chance.choice((0, 1, 16, 200)))
        return b"\xc5" + len(data).to_bytes(2, "big") + data

    def _time(self) -> bytes:
        """Return a timestamp in one of its three forms, mostly of no calendar."""
        seconds, nanoseconds = self._chance.choice(_SECONDS), self._chance.choice(_NANOSECONDS)
        match self._chance.randrange(3):
            case 0:
                return b"\xd6\xff" + (seconds % 2**32).to_bytes(4, "big")
            case 1:
                word = (nanoseconds % 2**30) << 34 | seconds % 2**34
                return b"\xd7\xff" + word.to_bytes(8, "big")
            case _:
                return b"\xc7\x0c\xff" + struct.pack(">Iq", nanoseconds, seconds)

    def _extension(self) -> bytes:
        kind = bytes([self._chance.choice((0, 1, 127, 128, 255))])
        if self._chance.random() < 0.5:
            head, size = self._chance.choice(
                ((0xD4, 1), (0xD5, 2), (0xD6, 4), (0xD7, 8), (0xD8, 16))
            )
            return bytes([head]) + kind + self._chance.randbytes(size)
        size = self._chance.choice((0, 1, 3, 12, 100))
        return bytes([0xC7, size]) + kind + self._chance.randbytes(size)

    def _lie(self) -> bytes:
        """Return a header that says how much follows, and little of it."""
        head, width = self._chance.choice(
            (
                *((0xC4, 1), (0xC5, 2), (0xC6, 4), (0xD9, 1), (0xDA, 2), (0xDB, 4)),
                *((0xDC, 2), (0xDD, 4), (0xDE, 2), (0xDF, 4), (0xC7, 1), (0xC8, 2), (0xC9, 4)),
            )
        )
        size = self._chance.choice(_EDGES) & ((1 << 8 * width) - 1)
        return bytes([head]) + size.to_bytes(width, "big") + self._chance.randbytes(3)

    def _array(self, depth: int) -> bytes:
        count = self._chance.choice((0, 1, 2, 15))
        return bytes([0x90 | count]) + b"".join(self.value(depth) for _ in range(count))

    def _mapping(self, depth: int) -> bytes:
        count = self._chance.choice((0, 1, 2, 5))
        items = []
        for k in range(count):
            odd = self._chance.random() < 0.3
            items += [self.value(depth) if odd else b"\xa1" + bytes([97 + k]), self.value(depth)]
        return bytes([0x80 | count]) + b"".join(items)


def replaced(fields: Sequence[bytes], place: int, value: bytes) -> bytes:
    """Return an array of encoded fields with another value at one place."""
    assert len(fields) < 16
    changed = [*fields[:place], value, *fields[place + 1 :]]
    return bytes([0x90 | len(fields)]) + b"".join(changed)


def _mapping_of(keys: Iterable[bytes]) -> bytes:
    items = [key + b"\xc0" for key in keys]
    return b"\xdf" + struct.pack(">I", len(items)) + b"".join(items)


def _same_hash(count: int, length: int) -> Iterator[bytes]:
    """Yield arrays of the same hash: in CPython, -1 and -2 have the same."""
    for numbers in itertools.islice(itertools.product(b"\xff\xfe", repeat=length), count):
        yield bytes([0x90 | length, *numbers])


STORMS = {
    "array keys of one hash": _mapping_of(_same_hash(16_000, 14)),
    "few array keys of one hash": _mapping_of(_same_hash(4_000, 12)),
    "nested array keys of one hash": _mapping_of(
        b"\x92" + one + other
        for one, other in itertools.product(_same_hash(100, 7), _same_hash(100, 7))
    ),
    "array keys of one hash, deep": b"\x91" * 29 + _mapping_of(_same_hash(16_000, 14)),
    "array keys of one hash in a key": b"\x81\x91" + _mapping_of(_same_hash(16_000, 14)) + b"\xc0",
    "text keys": _mapping_of(b"\xa5%05d" % number for number in range(30_000)),
    "integer keys": _mapping_of(b"\xce" + struct.pack(">I", k << 8) for k in range(30_000)),
    "empty arrays": b"\xdd" + struct.pack(">I", 250_000) + b"\x90" * 250_000,
    "towers": b"\xdd" + struct.pack(">I", 6_000) + (b"\x91" * 29 + b"\x90") * 6_000,
}
"""Values that are costly to make, each less than 250 kB."""
