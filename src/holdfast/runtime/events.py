"""Events: what happened in a process, as a name and a few fields.

The code that reports an event does not know where it goes: :class:`~holdfast.runtime.logs.EventLog`
writes it as a line, :class:`BoundedEventLog` passes it to several sinks and limits the rate of
repeated ones.

docs/status.md has tables of a robot's events, and docs/operations.md one of a service's. These
fields have a place of their own in the text form: ``from`` and ``to`` (of a change), ``service``,
``robot``, ``reason``, ``duration_ms``.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Hashable, Iterable, Mapping
from typing import Literal, Protocol, TypeAlias

from holdfast.errors import DEFECT

_REPEAT_INTERVAL_S = 1.0
_BURST = 20
"""Events of one kind that pass at once: more than correct peers cause."""

_WARNINGS = frozenset(
    [
        *("launch_failed", "recovery_exited", "service_vanished", "service_suspected", "refused"),
        *("unreachable", "insecure", "malformed_reply", "holding", "missed_ticks"),
        *("disagreement", "verification_failed", "distrusted", "performed_unseen"),
        *("unexplained", "no_reading", "lost", "sensor_suspect", "reinitialised"),
    ]
)
_ERRORS = frozenset(
    ("wrong_answer", "not_deterministic", "state_diverged", "stopped", "stuck", "error", DEFECT)
)

_WORSE_STATUS = "local_recovery"
"""The status in which no cloud service decides (:mod:`holdfast.protocol.status`)."""

Event: TypeAlias = tuple[str, Mapping[str, object]]
"""A name and its fields; after dropped ones like it with their number."""


def severity(name: str, fields: Mapping[str, object]) -> Literal["INFO", "WARN", "ERROR"]:
    """Return how bad it is that an event has happened."""
    worse = name == "status" and fields.get("to") == _WORSE_STATUS
    return "ERROR" if name in _ERRORS else "WARN" if worse or name in _WARNINGS else "INFO"


class EventSink(Protocol):
    """Takes events."""

    def event(self, name: str, /, **fields: object) -> None:
        """Take an event; never raises."""
        ...

    def close(self) -> None:
        """Ignore all further events; may be repeated."""
        ...


class _TokenBucket:
    """The rate limit of one kind of event."""

    __slots__ = ("last", "omitted", "tokens", "updated_at")

    def __init__(self, now: float) -> None:
        self.tokens = float(_BURST)
        self.updated_at = now
        self.omitted = 0
        self.last: tuple[str, Mapping[str, object]] | None = None

    def refill(self, now: float) -> None:
        earned = (now - self.updated_at) / _REPEAT_INTERVAL_S
        self.tokens = min(float(_BURST), self.tokens + earned)
        self.updated_at = now

    @property
    def due_at(self) -> float:
        return self.updated_at + (1.0 - self.tokens) * _REPEAT_INTERVAL_S


class EventRates:
    """Token buckets, one per kind of event: a burst of 20 passes, then one event a second.

    Another machine can cause the same event a thousand times a second. Events over the rate are
    dropped and counted; the last one of each kind is kept and reported when its token is there.
    """

    def __init__(self) -> None:
        self._buckets: dict[Hashable, _TokenBucket] = {}

    def admit(
        self, kind: Hashable, name: str, fields: Mapping[str, object], now: float
    ) -> list[Event]:
        """Return the event, if it may be reported now (``now`` in seconds), or nothing.

        Events of one ``kind`` share a bucket.
        """
        bucket = self._buckets.get(kind)
        if bucket is None:
            bucket = self._buckets[kind] = _TokenBucket(now)
        bucket.refill(now)
        if bucket.tokens < 1.0:
            bucket.omitted += 1
            bucket.last = name, fields
            return []
        bucket.tokens -= 1.0
        omitted, bucket.omitted, bucket.last = bucket.omitted, 0, None
        return [_counted(name, fields, omitted)]

    def next_due(self) -> float | None:
        """Return when :meth:`due` will return something; None if nothing was dropped."""
        times = [bucket.due_at for bucket in self._buckets.values() if bucket.last is not None]
        return min(times, default=None)

    def due(self, now: float) -> list[Event]:
        """Return the last dropped event of each kind whose time has come; of all if infinite."""
        found = []
        for bucket in self._buckets.values():
            if bucket.last is not None and bucket.due_at <= now:
                found.append(_counted(*bucket.last, bucket.omitted - 1))
                bucket.tokens, bucket.updated_at = 0.0, now
                bucket.omitted, bucket.last = 0, None
        return found


def _counted(name: str, fields: Mapping[str, object], omitted: int) -> Event:
    return name, {**fields, "similar_lines_omitted": omitted} if omitted else fields


class BoundedEventLog:
    """Passes events to several sinks; limits the rate of those about a service.

    So no service can fill a robot's log. Changes of status always pass. Without sinks it drops all.
    """

    def __init__(self, *sinks: EventSink, clock: Callable[[], float] = time.monotonic) -> None:
        self._sinks = sinks
        self._clock = clock
        # Reentrant: a signal handler of the same thread may report an event.
        self._lock = threading.RLock()
        self._rates = EventRates()

    def event(self, name: str, /, **fields: object) -> None:
        """Pass an event on, or count it."""
        with self._lock:
            now = self._clock()
            self._report(self._rates.due(now))
            if "service" in fields and name != "status":
                self._report(self._rates.admit((name, fields["service"]), name, fields, now))
            else:
                self._report([(name, fields)])

    def close(self) -> None:
        """Report the last dropped events, and close the sinks."""
        with self._lock:
            self._report(self._rates.due(math.inf))
            for sink in self._sinks:
                sink.close()

    def _report(self, events: Iterable[Event]) -> None:
        for name, fields in events:
            for sink in self._sinks:
                sink.event(name, **fields)
