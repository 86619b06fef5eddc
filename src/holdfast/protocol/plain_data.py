"""A look at packed plain data before it is decoded: only what a YAML file can say, and not much.

MessagePack has more than JSON: times, extensions, bytes, numbers that are not finite, keys of any
kind. A decoder makes all of them before anybody can refuse them, and some are costly: an array as a
key becomes a tuple, a peer can choose thousands of tuples with the same hash (-1 and -2 have the
same), and to fill a mapping with those takes quadratic time.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable
from typing import Final

from holdfast.errors import MessageError

MAX_CONFIGURATION_VALUES: Final = 10_000
"""Bound on a session configuration's values: the smallest take one byte each when encoded, and
sixty in memory."""

MAX_CONFIGURATION_DEPTH: Final = 32
"""Bound on levels of lists and mappings in each of its free sections, as in a YAML file."""

_FLOATS: Final = {0xCA: ">f", 0xCB: ">d"}

_SIZES: Final = {
    **dict.fromkeys((*range(0x80), *range(0xE0, 0x100), 0xC0, 0xC2, 0xC3), 0),
    **{first: first & 0x1F for first in range(0xA0, 0xC0)},
    0xCA: 4,
    0xCB: 8,
    0xCC: 1,
    0xCD: 2,
    0xCE: 4,
    0xCF: 8,
    0xD0: 1,
    0xD1: 2,
    0xD2: 4,
    0xD3: 8,
}
"""Bytes after the first of what has no length: constants, numbers, short texts."""

_TEXTS: Final = {0xD9: 1, 0xDA: 2, 0xDB: 4}
_ARRAYS: Final = {**dict.fromkeys(range(0x90, 0xA0), 0), 0xDC: 2, 0xDD: 4}
_MAPPINGS: Final = {**dict.fromkeys(range(0x80, 0x90), 0), 0xDE: 2, 0xDF: 4}
_LENGTHS: Final = {**_TEXTS, **_ARRAYS, **_MAPPINGS}
"""Bytes of the length after the first byte; none where that byte has the length itself."""

_KEYS: Final = frozenset((*range(0xA0, 0xC0), *_TEXTS))


def check_plain_data(sections: Iterable[bytes], where: str) -> None:
    """Check well-formed MessagePack, a value a section, in time that the bounds limit.

    ``where`` names the sections in errors.

    Raises MessageError: ``malformed``: a value or key that a file does not have, or more than
    :data:`MAX_CONFIGURATION_DEPTH` levels. ``too_large``: more than
    :data:`MAX_CONFIGURATION_VALUES` in all sections.
    """
    count = 0
    for data in sections:
        count = _counted(data, count, where)


def _counted(data: bytes, count: int, where: str) -> int:
    """Return the count, plus the values and keys in a section."""
    position = 0
    around: list[tuple[int, bool]] = []
    to_come, in_mapping = 1, False
    while True:
        while not to_come:
            if not around:
                return count
            to_come, in_mapping = around.pop()
        first = data[position]
        position += 1
        if in_mapping and to_come % 2 == 0 and first not in _KEYS:
            raise MessageError("malformed", f"{where}: a key that is no text (0x{first:02x})")
        to_come -= 1
        size = _SIZES.get(first)
        if size is not None:
            if first in _FLOATS:
                (number,) = struct.unpack_from(_FLOATS[first], data, position)
                if not math.isfinite(number):
                    raise MessageError("malformed", f"{where}: the number {number}")
            position += size
            continue
        width = _LENGTHS.get(first)
        if width is None:
            raise MessageError("malformed", f"{where}: a value that JSON lacks (0x{first:02x})")
        length = int.from_bytes(data[position : position + width], "big") if width else first & 0xF
        position += width
        if first in _TEXTS:
            position += length
            continue
        around.append((to_come, in_mapping))
        in_mapping = first in _MAPPINGS
        to_come = 2 * length if in_mapping else length
        # What a header only promises counts, too: nobody walks on for it.
        count += to_come
        if count > MAX_CONFIGURATION_VALUES:
            raise MessageError("too_large", f"{where}: more than {MAX_CONFIGURATION_VALUES} values")
        if len(around) > MAX_CONFIGURATION_DEPTH:
            raise MessageError("malformed", f"{where}: more than {MAX_CONFIGURATION_DEPTH} levels")
