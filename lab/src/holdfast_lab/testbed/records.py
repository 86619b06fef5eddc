"""What the processes of a run write for everybody: events as JSON lines, and the decision table.

The testbed looks into no process. All that it knows of a run it reads here.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import IO, Any, NamedTuple

import msgspec

from holdfast.conversion import convert
from holdfast.protocol.question import OWN_PLANNER


@dataclass(frozen=True)
class LogEvent:
    """An event that a process has logged."""

    at: float  # in seconds since the epoch
    name: str
    fields: Mapping[str, Any]

    def __getitem__(self, field: str) -> Any:
        """Return a field."""
        return self.fields[field]

    def matches(self, name: str, **fields: object) -> bool:
        """Tell whether it has a name and these fields."""
        return self.name == name and fields.items() <= self.fields.items()


def log_event_of(line: str) -> LogEvent | None:
    """Return the event in a line of a JSON log; None if there is none."""
    if not line.startswith("{"):
        return None
    try:
        event = msgspec.json.decode(line, type=dict[str, Any])
        return LogEvent(time_of(event["time"]), str(event["event"]), event)
    except (msgspec.DecodeError, KeyError, TypeError, ValueError):
        return None


class Decision(NamedTuple):
    """A row of a robot's ``timings.csv``."""

    at: float  # when it was carried out, in seconds since the epoch
    trial: int
    step: int
    kind: str  # ``sensing`` or ``task``
    service: str
    status: str
    waited_ms: float  # how long the robot stood still for it
    round_trip_ms: float = 0.0  # from the request until the answer
    computed_ms: float = 0.0  # the service's own part of that


def of_services(decisions: Iterable[Decision]) -> list[Decision]:
    """Return the decisions without the task actions that the robot took itself."""
    return [each for each in decisions if (each.kind, each.service) != ("task", OWN_PLANNER)]


class DecisionTable:
    """A robot's ``timings.csv``, read while it grows; it need not exist yet."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: IO[bytes] | None = None
        self._columns: list[str] = []
        self.rows: list[Decision] = []

    def read(self) -> None:
        """Read new rows; an incomplete last line is left for later."""
        if self._file is None:
            try:
                self._file = self._path.open("rb")
            except FileNotFoundError:
                return
        start = self._file.tell()
        content = self._file.read()
        complete = content.rfind(b"\n") + 1
        self._file.seek(start + complete)
        for fields in csv.reader(content[:complete].decode().splitlines()):
            if not self._columns:
                self._columns = fields
                continue
            row = dict(zip(self._columns, fields, strict=True))
            values = [time_of(row["time"]), *(row[name] for name in Decision._fields[1:])]
            self.rows.append(convert(values, Decision, strict=False))

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()


def time_of(text: str) -> float:
    """Return the seconds since the epoch of a time as events and tables have it."""
    return datetime.fromisoformat(text).timestamp()
