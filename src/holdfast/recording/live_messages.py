"""What a robot's process tells the one that shows it.

The messages go through a pipe, each after its length. The robot's end never waits, so it writes
what the pipe takes and keeps the rest.
"""

from __future__ import annotations

from typing import TypeAlias

import msgspec

from holdfast.planning.outcome import TrialResult
from holdfast.protocol.events import Timing
from holdfast.protocol.records import Record

__all__ = [
    "HEADER_BYTES",
    "EndedMessage",
    "EventMessage",
    "FinishMessage",
    "FollowerReport",
    "LostMessage",
    "RecordsMessage",
    "TimingMessage",
    "ViewMessage",
]

HEADER_BYTES = 4
"""Of a message's length, little-endian."""


class RecordsMessage(msgspec.Struct, array_like=True, frozen=True, tag=1):
    """Records of a trial, once they are journalled; times are in nanoseconds since 1970."""

    time_ns: int
    trial: int
    records: tuple[Record, ...]


class TimingMessage(msgspec.Struct, array_like=True, frozen=True, tag=2):
    """Who decided; it comes before the record of that decision."""

    time_ns: int
    timing: Timing


class EndedMessage(msgspec.Struct, array_like=True, frozen=True, tag=3):
    """A trial has ended, with the action of its last record."""

    time_ns: int
    result: TrialResult


class EventMessage(msgspec.Struct, array_like=True, frozen=True, tag=4):
    """An event, as a line of ``events.jsonl``."""

    time_ns: int
    line: str


class LostMessage(msgspec.Struct, array_like=True, frozen=True, tag=5):
    """What waited was too much and is lost: the next records are of another trial."""


class FinishMessage(msgspec.Struct, array_like=True, frozen=True, tag=6):
    """The run is over."""


ViewMessage: TypeAlias = (
    RecordsMessage | TimingMessage | EndedMessage | EventMessage | LostMessage | FinishMessage
)


class FollowerReport(msgspec.Struct, array_like=True, frozen=True):
    """What the process that shows a run says: once when it is ready, once at its end.

    Attributes
    ----------
    error : str or None
        Why it shows nothing any more.
    steps, left_out : int
        Task actions that it was told of, and those that there was no time to show.
    """

    error: str | None = None
    steps: int = 0
    left_out: int = 0
