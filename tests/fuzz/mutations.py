"""Bytes that mean harm, drawn by seed: spoilt messages, and none at all."""

import random
from collections.abc import Callable, Sequence

_LENGTHS = (0, 1, 15, 16, 127, 128, 255, 256, 65_535, 65_536, 2**31 - 1, 2**31, 2**32 - 1)
"""What claims to follow: around every width in which MessagePack writes a length."""

_HEADERS = bytes.fromhex("c4c5c6c7c8c9cacbcccdcecfd0d1d2d3d4d5d6d7d8d9dadbdcdddedf")
"""Every first byte of MessagePack that is followed by a length or a number."""

_DEPTH = 3000


class Mutator:
    """Spoils messages; the same seed spoils the same messages in the same way."""

    def __init__(self, chance: random.Random, specimens: Sequence[bytes]) -> None:
        self._chance = chance
        self._specimens = specimens
        self._ways: tuple[Callable[[bytes], bytes], ...] = (
            self._flip,
            self._flip,
            self._overwrite,
            self._truncate,
            self._splice,
            self._repeat,
            self._lie,
            self._lie,
            self._retype,
            self._nest,
            self._append,
            self._nothing_like_it,
        )

    def specimen(self) -> bytes:
        """Return a valid message."""
        return self._chance.choice(self._specimens)

    def spoilt(self) -> bytes:
        """Return a message that was changed in one to four ways; by chance it may be valid."""
        message = self.specimen()
        for _ in range(self._chance.choice((1, 1, 1, 2, 4))):
            message = self._chance.choice(self._ways)(message)
        return message

    def _place(self, message: bytes) -> int:
        return self._chance.randrange(len(message)) if message else 0

    def _flip(self, message: bytes) -> bytes:
        if not message:
            return message
        spoilt = bytearray(message)
        for _ in range(self._chance.choice((1, 1, 2, 8))):
            spoilt[self._place(message)] ^= 1 << self._chance.randrange(8)
        return bytes(spoilt)

    def _overwrite(self, message: bytes) -> bytes:
        start = self._place(message)
        filler = self._chance.choice((0x00, 0x7F, 0x80, 0xC0, 0xC1, 0xFF))
        return message[:start] + bytes([filler]) * self._chance.randint(1, 8) + message[start + 8 :]

    def _truncate(self, message: bytes) -> bytes:
        return message[: self._place(message)]

    def _splice(self, message: bytes) -> bytes:
        other = self.specimen()
        return message[: self._place(message)] + other[self._place(other) :]

    def _repeat(self, message: bytes) -> bytes:
        start = self._place(message)
        end = start + self._chance.randint(1, 64)
        return message[:end] + message[start:end] * self._chance.randint(1, 20) + message[end:]

    def _lie(self, message: bytes) -> bytes:
        """Claim another length, where there may be one, or a number beyond all bounds."""
        places = [place for place, byte in enumerate(message) if byte in _HEADERS]
        start = self._chance.choice(places) + 1 if places else self._place(message)
        claimed = self._chance.choice(_LENGTHS)
        width = self._chance.choice((1, 2, 4, 8))
        lie = claimed.to_bytes(8, "big")[-width:]
        return message[:start] + lie + message[start + width :]

    def _retype(self, message: bytes) -> bytes:
        start = self._place(message)
        return message[:start] + bytes([self._chance.choice(_HEADERS)]) + message[start + 1 :]

    def _nest(self, message: bytes) -> bytes:
        start = self._place(message)
        opener = self._chance.choice((b"\x91", b"\x81", b"\xdc\x00\x01", b"\x92\x90"))
        return message[:start] + opener * self._chance.choice((2, 40, _DEPTH)) + message[start:]

    def _append(self, message: bytes) -> bytes:
        return message + self._chance.randbytes(self._chance.choice((1, 3, 100)))

    def _nothing_like_it(self, message: bytes) -> bytes:
        del message
        return self._chance.randbytes(self._chance.choice((0, 1, 4, 30, 200, 1500)))
