"""The encryption of datagrams: a record protocol beside a TLS link (``docs/datagrams.md``).

TLS has authenticated both ends. Over it the service sends the robot an *association*: a number, and
two keys drawn for it, one for each direction, so a datagram cannot be reflected. The header, with
the association and a counter, is the nonce of AES-256-GCM, so it is authenticated too. No nonce is
used twice: a counter is never set back, and the keys exist only in the memory of the two processes.

Datagrams may arrive late, in any order, or twice. A window over the last counters, as in IPsec
(RFC 4303 and RFC 6479), accepts each once and drops what is older. It also counts the losses.
"""

from __future__ import annotations

import os
import struct
from typing import TYPE_CHECKING, NamedTuple

from holdfast.errors import KeysExhaustedError, TransportError, how_to_install

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.ciphers.aead import AESGCM

_HEADER = struct.Struct(">II")
_NONCE_PREFIX = bytes(4)
_TAG_BYTES = 16
_KEY_BYTES = 32

OVERHEAD = _HEADER.size + _TAG_BYTES
"""Bytes that a datagram is longer than its message."""

WINDOW = 1024
"""Counters below the newest that are still accepted."""

_ALL_SEEN = (1 << WINDOW) - 1

LOSS_SAMPLE = 128
"""Counters over which losses are counted."""

KNOWN_AFTER = 32
"""With fewer counters the loss is unknown."""

_REORDERED = 3
"""The newest counters may only be late, so they do not count as lost."""

MAX_DATAGRAMS = 1 << 27
"""Bound on the datagrams of one key: of 1,200 bytes each, an attacker's advantage against AES-GCM
stays below 2**-52 (RFC 9001, appendix B, has the arithmetic)."""


class AssociationKeys(NamedTuple):
    """An association: a number below 2**32, unique at a service's socket, and two keys."""

    association: int
    to_service: bytes
    to_robot: bytes

    @classmethod
    def draw(cls, association: int) -> AssociationKeys:
        """Draw keys for a new association from the system's generator."""
        return cls(association, os.urandom(_KEY_BYTES), os.urandom(_KEY_BYTES))

    def __repr__(self) -> str:
        return f"AssociationKeys(association={self.association}, to_service=..., to_robot=...)"


def require_cryptography() -> type[AESGCM]:
    """Return the cipher; raise TransportError if ``cryptography`` is not installed."""
    try:
        from cryptography.hazmat.primitives.ciphers.aead import AESGCM
    except ImportError as error:
        raise TransportError(
            "udp/... needs the package cryptography, which is not installed: "
            f"{how_to_install('cryptography')}; or use tls/..."
        ) from error
    return AESGCM


class ReplayWindow:
    """Accepts each counter once; ``newest`` is the highest so far, -1 at first."""

    def __init__(self) -> None:
        self.newest = -1
        self._seen = 0  # bit k: whether newest - k has arrived

    def is_fresh(self, counter: int) -> bool:
        """Return whether a counter is acceptable: not seen, and within the window."""
        behind = self.newest - counter
        if behind < 0:
            return True
        return behind < WINDOW and not self._seen >> behind & 1

    def note(self, counter: int) -> None:
        """Record the counter of an authentic datagram."""
        if counter > self.newest:
            self._seen = self._seen << min(counter - self.newest, WINDOW) & _ALL_SEEN
            self.newest = counter
        self._seen |= 1 << self.newest - counter

    @property
    def num_lost(self) -> int:
        """How many of the last :data:`LOSS_SAMPLE` counters were lost, except the newest few.

        At least 1 until :data:`KNOWN_AFTER` counters are known.
        """
        settled = min(LOSS_SAMPLE, max(0, self.newest + 1 - _REORDERED))
        came = (self._seen >> _REORDERED & (1 << LOSS_SAMPLE) - 1).bit_count()
        return max(int(settled < KNOWN_AFTER), settled - came)


class DatagramCipher:
    """One end of an association; raises as :func:`require_cryptography` does."""

    __slots__ = ("_counter", "_decryptor", "_encryptor", "_invalid_tag", "association", "window")

    def __init__(self, keys: AssociationKeys, *, service: bool) -> None:
        cipher = require_cryptography()
        from cryptography.exceptions import InvalidTag

        self._invalid_tag = InvalidTag
        ours, theirs = (
            (keys.to_robot, keys.to_service) if service else (keys.to_service, keys.to_robot)
        )
        self._encryptor = cipher(ours)
        self._decryptor = cipher(theirs)
        self._counter = 0
        self.association = keys.association
        self.window = ReplayWindow()

    def encrypt(self, message: bytes) -> bytes:
        """Return a datagram, with the next counter.

        Raises KeysExhaustedError after :data:`MAX_DATAGRAMS`.
        """
        counter = self._counter
        if counter >= MAX_DATAGRAMS:
            raise KeysExhaustedError(
                f"association {self.association} has encrypted {MAX_DATAGRAMS} datagrams, "
                f"as many as one key may"
            )
        self._counter = counter + 1
        header = _HEADER.pack(self.association, counter)
        return header + self._encryptor.encrypt(_NONCE_PREFIX + header, message, None)

    def decrypt(self, datagram: bytes) -> bytes | None:
        """Return the message of a datagram.

        None if it is forged, damaged, cut short, of another association, or has come before.
        """
        if len(datagram) < OVERHEAD:
            return None
        association, counter = _HEADER.unpack_from(datagram)
        if association != self.association or counter >= MAX_DATAGRAMS:
            return None
        if not self.window.is_fresh(counter):
            return None
        header, encrypted = datagram[: _HEADER.size], datagram[_HEADER.size :]
        try:
            message = self._decryptor.decrypt(_NONCE_PREFIX + header, encrypted, None)
        except self._invalid_tag:
            return None
        # After authentication: a forged counter must not move the window.
        self.window.note(counter)
        return message
