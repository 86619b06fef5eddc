"""A reader of MessagePack in plain Python: where msgspec's own code shows no coverage, this does.

It decides nothing. Each kind of value has a branch of its own, so that a fuzzer which sees the
branches taken learns what messages are made of, and keeps those of a new form.
"""

from __future__ import annotations

_MAX_VALUES = 200
_NUMBERS = {0xCA: 4, 0xCB: 8, 0xCC: 1, 0xCD: 2, 0xCE: 4, 0xCF: 8}
_NUMBERS |= {0xD0: 1, 0xD1: 2, 0xD2: 4, 0xD3: 8}
_FIXED_EXTENSIONS = {0xD4: 2, 0xD5: 3, 0xD6: 5, 0xD7: 9, 0xD8: 17}
_BINARIES = {0xC4: 1, 0xC5: 2, 0xC6: 4}
_TEXTS = {0xD9: 1, 0xDA: 2, 0xDB: 4}
_EXTENSIONS = {0xC7: 1, 0xC8: 2, 0xC9: 4}
_ARRAYS = {0xDC: 2, 0xDD: 4}
_MAPPINGS = {0xDE: 2, 0xDF: 4}


def outline(data: bytes) -> int:
    """Go through the values that a message begins with; return how many these are."""
    position = seen = 0
    while position < len(data) and seen < _MAX_VALUES:
        first = data[position]
        seen += 1
        start = position + 1
        if first < 0x80:
            position = _small(first, seen, start)
        elif first < 0x90 or first < 0xA0:
            position = start
        elif first < 0xC0:
            position = start + (first & 0x1F)
        elif first >= 0xE0:
            position = start
        elif first in _NUMBERS:
            position = _number(data, start, _NUMBERS[first])
        elif first in _BINARIES:
            position = _skipped(data, start, _BINARIES[first])
        elif first in _TEXTS:
            position = _skipped(data, start, _TEXTS[first])
        elif first in _EXTENSIONS:
            position = _skipped(data, start, _EXTENSIONS[first]) + 1
        elif first in _FIXED_EXTENSIONS:
            position = start + _FIXED_EXTENSIONS[first]
        elif first in _ARRAYS:
            position = start + _ARRAYS[first]
        elif first in _MAPPINGS:
            position = start + _MAPPINGS[first]
        elif first == 0xC0 or first == 0xC2 or first == 0xC3:
            position = start
        else:
            return seen
    return seen


def _small(value: int, seen: int, start: int) -> int:
    """Tell the tags of replies and records apart: they come first."""
    if seen == 2:
        if value == 1:
            return start
        if value == 2:
            return start
        if value == 3:
            return start
        if value == 4:
            return start
        if value == 5:
            return start
        if value == 6:
            return start
    return start


def _number(data: bytes, start: int, width: int) -> int:
    if width == 1:
        return start + 1
    if width == 2:
        return start + 2
    if width == 4:
        return start + 4
    if data[start : start + 2] in (b"\x7f\xf0", b"\xff\xf0", b"\x7f\xf8"):
        return start + 8  # not finite, if it is a float
    return start + 8


def _skipped(data: bytes, start: int, width: int) -> int:
    length = int.from_bytes(data[start : start + width], "big")
    if start + width + length > len(data):
        return len(data)  # a lie
    if length == 0:
        return start + width
    if length == 16:
        return start + width + 16
    return start + width + length
