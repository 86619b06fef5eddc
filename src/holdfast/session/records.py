"""What a robot writes down of an unfinished trial, so that a new process can go on with it.

Before an observation is used and before a task action is performed, it is in the journal. So after
a crash the journal says everything that was decided; the one thing that it may not know is whether
the last task action was still performed, and that only the environment can tell.
"""

from __future__ import annotations

from typing import TypeAlias

import msgspec

from holdfast.errors import HoldfastError

__all__ = [
    "ActingRecord",
    "ObservedRecord",
    "PausedRecord",
    "PerformedRecord",
    "Record",
    "RecordError",
    "RecoveredRecord",
    "decode_record",
    "encode_record",
]


class RecordError(HoldfastError):
    """A record of the journal does not decode, or does not follow from those before it."""


class ObservedRecord(msgspec.Struct, array_like=True, frozen=True, tag=1):
    """An observation, before it is used.

    Attributes
    ----------
    step, sensing_action : int
    observation : bytes
        Little-endian float64.
    digest : bytes
        32 bytes of the state that it led to: tells whether going on leads to the same state.
    sensing_ms : float
        How long the sensing action was computed; nothing is decided by it.
    """

    step: int
    sensing_action: int
    observation: bytes
    digest: bytes
    sensing_ms: float


class ActingRecord(msgspec.Struct, array_like=True, frozen=True, tag=2):
    """A task action that is about to be performed.

    Attributes
    ----------
    step : int
    action : bytes
        The executed action, little-endian float64.
    """

    step: int
    action: bytes


class PerformedRecord(msgspec.Struct, array_like=True, frozen=True, tag=3):
    """A task action that has been performed. Written together with what follows it.

    Attributes
    ----------
    step : int
    reward : float or None
    """

    step: int
    reward: float | None


class PausedRecord(msgspec.Struct, array_like=True, frozen=True, tag=4):
    """The robot's process ended in order: nothing happened that is not written here."""


class RecoveredRecord(msgspec.Struct, array_like=True, frozen=True, tag=5):
    """Another service had to take over. For the tables: nothing follows from it.

    Attributes
    ----------
    times : int
        Since the last such record.
    """

    times: int


Record: TypeAlias = ObservedRecord | ActingRecord | PerformedRecord | PausedRecord | RecoveredRecord

_ENCODER = msgspec.msgpack.Encoder()
_DECODER: msgspec.msgpack.Decoder[Record] = msgspec.msgpack.Decoder(Record)


def encode_record(record: Record) -> bytes:
    """Encode a record."""
    return _ENCODER.encode(record)


def decode_record(data: bytes) -> Record:
    """Decode a record.

    Raises
    ------
    RecordError
        If the bytes are none.
    """
    try:
        return _DECODER.decode(data)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise RecordError(f"{len(data)} bytes are no record of a journal: {error}") from error
