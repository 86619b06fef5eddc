"""Sealed datagrams: the record protocol of small messages beside a TLS link.

A TLS link has shown to both ends who the other one is. Over it the service hands the robot an
*association*: a number, and two keys drawn for it alone, one for each direction. From then on
either end can put a message into a datagram that only the other one can read, and that nobody else
can make. A datagram is ::

    association   4 bytes, big-endian: whose keys these are
    counter       4 bytes, big-endian: 0, 1, 2, ... of this direction
    sealed        AES-256-GCM of the message, with a tag of 16 bytes

The first eight bytes are the nonce, so they are authenticated with the rest, and no nonce is used
twice: a counter is never set back, and keys live in the memory of two processes and nowhere else.
A process that starts again has a new TLS link and so new keys. The two directions have keys of
their own, so that nothing can be reflected.

Datagrams may come late, in any order, or twice. A window over the last counters, as in IPsec
(RFC 4303 and RFC 6479), lets each pass once and drops what is older than the window. The same
window shows which ones never came: how much the way loses is measured where it arrives.

Nothing here knows sockets or time.
"""

from __future__ import annotations

import os
import struct
from typing import TYPE_CHECKING, NamedTuple

from holdfast.errors import TransportError

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.ciphers.aead import AESGCM

__all__ = [
    "KNOWN_AFTER",
    "LOSS_SAMPLE",
    "MAX_DATAGRAMS",
    "OVERHEAD",
    "WINDOW",
    "Keys",
    "KeysExhaustedError",
    "ReplayWindow",
    "Sealing",
    "association_of",
    "require_cryptography",
]

_HEADER = struct.Struct(">II")
_NONCE_PREFIX = bytes(4)
_TAG_BYTES = 16
_KEY_BYTES = 32

OVERHEAD = _HEADER.size + _TAG_BYTES
"""Bytes that a datagram is longer than its message."""

WINDOW = 1024
"""Counters below the newest that may still come; what is older is dropped."""

LOSS_SAMPLE = 128
"""Counters over which losses are counted."""

KNOWN_AFTER = 32
"""Before so many counters have come or been lost, nobody knows whether the way loses any."""

_REORDERED = 3
"""The newest counters may only be late, so they are not counted as lost yet."""

MAX_DATAGRAMS = 1 << 27
"""Bound on the datagrams of one key: of 1,200 bytes each, an attacker's advantage against AES-GCM
stays below 2**-52 (RFC 9001, appendix B, has the arithmetic)."""


class KeysExhaustedError(TransportError):
    """A key has sealed as many datagrams as it may; a new link brings new keys."""


class Keys(NamedTuple):
    """An association as the service hands it over.

    Attributes
    ----------
    association : int
        From 0 to 2**32 - 1; unique among those of the service's socket.
    to_service, to_robot : bytes
        Keys of 32 bytes.
    """

    association: int
    to_service: bytes
    to_robot: bytes

    @classmethod
    def draw(cls, association: int) -> Keys:
        """Draw keys for a new association from the system's generator."""
        return cls(association, os.urandom(_KEY_BYTES), os.urandom(_KEY_BYTES))

    def __repr__(self) -> str:
        return f"Keys(association={self.association}, to_service=..., to_robot=...)"


def require_cryptography() -> type[AESGCM]:
    """Return the cipher.

    Raises
    ------
    TransportError
        If the package ``cryptography`` is not installed.
    """
    try:
        from cryptography.hazmat.primitives.ciphers.aead import AESGCM
    except ImportError as error:
        raise TransportError(
            "udp/... needs the package cryptography, which is not installed: "
            "pip install cryptography; or use tls/..."
        ) from error
    return AESGCM


def association_of(datagram: bytes) -> int | None:
    """Return whose keys a datagram claims to be sealed with; None if it is too short to be one."""
    if len(datagram) < OVERHEAD:
        return None
    return int.from_bytes(datagram[:4], "big")


class ReplayWindow:
    """Which counters have come: each passes once.

    Attributes
    ----------
    newest : int
        The highest that has come; -1 at first.
    """

    __slots__ = ("_seen", "newest")

    def __init__(self) -> None:
        self.newest = -1
        self._seen = 0  # bit k: whether newest - k has come

    def is_fresh(self, counter: int) -> bool:
        """Whether a counter may still come."""
        behind = self.newest - counter
        if behind < 0:
            return True
        return behind < WINDOW and not self._seen >> behind & 1

    def note(self, counter: int) -> None:
        """Take note that a counter has come, whose datagram was genuine."""
        behind = self.newest - counter
        if behind >= 0:
            self._seen |= 1 << behind
            return
        # A jump as long as the window leaves nothing of what was seen.
        self._seen = self._seen << -behind & (1 << WINDOW) - 1 if -behind < WINDOW else 0
        self._seen |= 1
        self.newest = counter

    @property
    def lost(self) -> int:
        """How many of the last :data:`LOSS_SAMPLE` counters have not come, the newest left out.

        At least 1 as long as there were fewer than :data:`KNOWN_AFTER`.
        """
        settled = min(LOSS_SAMPLE, max(0, self.newest + 1 - _REORDERED))
        came = (self._seen >> _REORDERED & (1 << LOSS_SAMPLE) - 1).bit_count()
        return max(int(settled < KNOWN_AFTER), settled - came)


class Sealing:
    """One end of an association.

    Parameters
    ----------
    keys : Keys
    service : bool
        Whether this is the service's end.

    Raises
    ------
    TransportError
        If the package ``cryptography`` is not installed.

    Attributes
    ----------
    association : int
    window : ReplayWindow
        Of what has come.
    """

    __slots__ = ("_counter", "_forged", "_opener", "_sealer", "association", "window")

    def __init__(self, keys: Keys, *, service: bool) -> None:
        cipher = require_cryptography()
        from cryptography.exceptions import InvalidTag

        self._forged = InvalidTag
        ours, theirs = (
            (keys.to_robot, keys.to_service) if service else (keys.to_service, keys.to_robot)
        )
        self._sealer = cipher(ours)
        self._opener = cipher(theirs)
        self._counter = 0
        self.association = keys.association
        self.window = ReplayWindow()

    def seal(self, message: bytes) -> bytes:
        """Return a datagram; each call uses the next counter, for the same message as well.

        Raises
        ------
        KeysExhaustedError
            After :data:`MAX_DATAGRAMS`.
        """
        counter = self._counter
        if counter >= MAX_DATAGRAMS:
            raise KeysExhaustedError(
                f"association {self.association} has sealed {MAX_DATAGRAMS} datagrams, "
                f"as many as one key may"
            )
        self._counter = counter + 1
        header = _HEADER.pack(self.association, counter)
        return header + self._sealer.encrypt(_NONCE_PREFIX + header, message, None)

    def open(self, datagram: bytes) -> bytes | None:
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
        header = datagram[: _HEADER.size]
        try:
            message = self._opener.decrypt(_NONCE_PREFIX + header, datagram[_HEADER.size :], None)
        except self._forged:
            return None
        # Only now: a forged counter must not move the window.
        self.window.note(counter)
        return message
