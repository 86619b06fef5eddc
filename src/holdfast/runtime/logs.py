"""What happened, one line each: for a person to read, or for a program.

A run that survives a dead service has a story: when the loss was seen, what was launched, how long
each part took. Every chapter of it is an *event*: a name and a few fields. The one who reports it
does not know where it goes. JSON lines keep every field for whoever evaluates a run; the text form
arranges the same fields so that the eye finds them, by rules that hold for events not thought of
yet: what changed and who it is about come first, then why, then the rest, and units follow their
numbers.

A log must never hurt what it watches. A terminal that was closed, a full disk, a value that is not
a number, a text of a megabyte or with control characters in it cost at most the line.

Names of events in use. By the robot: status, launch, launched, launch_failed, recovery_exited,
retry, hedge, restore, restored, state_diverged, service_appeared, service_vanished,
service_suspected, unreachable, no_datagrams, insecure, credentials,
late_replies, waiting, holding, resumed, busy, refused, malformed_reply, disagreement,
wrong_answer, not_deterministic, verification_failed, distrusted,
limits_unknown, verifying, prefetch_unused, unexplained, filter_diverged,
resumed_trial, performed_unseen, trial, missed_ticks, stopped, note, interrupted, offers.
By a service: ready, session_opened, session_taken_over, restored, state_diverged, refused, busy,
evicted, robot_connected, robot_disconnected, link_refused, credentials, credentials_reloaded,
stopping, process_ended, process_started.
By ``holdfast ros1-guard``: ready, guarding, master_started, master_lost, master_failed,
master_hangs, nodes_gone, journal_failed, journal_written, rosout_ended, note, stopping.
By ``holdfast chaos``: chaos_trial, left_out, note, interrupted. By a command that ends with an
error: error. Fields with a place of their own in the text form: ``from`` and ``to`` (of a change),
``service``, ``robot``, ``reason``, ``duration_ms``. Of events that may come very often twenty of a
kind are written at once and then one a second, which says how many were left out, as
``similar_lines_omitted``.
"""

from __future__ import annotations

import math
import os
import re
import stat
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Literal, NamedTuple, Protocol, Self, TextIO, TypeAlias

import msgspec

from holdfast.files import OutputError
from holdfast.printable import printable

__all__ = [
    "MAX_LINE_BYTES",
    "BoundedEventLog",
    "CountedEvent",
    "EventLog",
    "EventRates",
    "EventSink",
    "LogFormat",
    "NullEventLog",
    "TeeEventLog",
    "event_in_words",
    "tell_event",
]

LogFormat: TypeAlias = Literal["text", "json"]

MAX_LINE_BYTES = 4096
"""Bound on a line; fields that do not fit are left out, and the line says so."""

MAX_VALUE_CHARACTERS = 800
"""Bound on a text within a line, and on a list or mapping once it is written out."""

_MAX_WAITING_LINES = 10_000
"""Lines that wait for a terminal that is not being read; further ones are lost, and counted."""

_FLUSH_S = 0.5

_REPEATED_S = 1.0
"""Repeated events of one kind are told this often."""

_BURST = 20
"""So many of one kind, about one service, are told at once: more than honest peers cause."""

_ROBOT = "robot"
_COMPONENT_WIDTH = 8
_EVENT_WIDTH = 18

_OBEYED = re.compile("[\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069]")
"""Control characters, and those that turn the direction of what follows."""

# Units that a field's name ends in, and how they are written.
_UNITS = {"_ms": "ms", "_us": "µs", "_s": "s", "_hz": "Hz", "_bytes": "bytes"}


class EventSink(Protocol):
    """Whatever takes events."""

    def event(self, name: str, /, **fields: object) -> None:
        """Take an event; never raises."""
        ...

    def close(self) -> None:
        """Take no more; may be repeated."""
        ...


class NullEventLog:
    """Forgets every event: for those who do not want any."""

    def event(self, name: str, /, **fields: object) -> None:
        """Forget an event."""

    def close(self) -> None:
        """Do nothing."""


class TeeEventLog:
    """Hands every event to several others.

    Parameters
    ----------
    *sinks : EventSink
        In the order in which they get it.
    """

    def __init__(self, *sinks: EventSink) -> None:
        self._sinks = sinks

    def event(self, name: str, /, **fields: object) -> None:
        """Hand an event on."""
        for sink in self._sinks:
            sink.event(name, **fields)

    def close(self) -> None:
        """Close all of them."""
        for sink in self._sinks:
            sink.close()


class CountedEvent(NamedTuple):
    """An event, and how many of its kind were left out before it."""

    name: str
    fields: Mapping[str, object]
    omitted: int

    def told(self) -> dict[str, object]:
        """Return its fields, and the number if there is one."""
        more = {"similar_lines_omitted": self.omitted} if self.omitted else {}
        return {**self.fields, **more}


class _Rate:
    """Of one kind of event."""

    __slots__ = ("allowance", "last", "omitted", "updated_at")

    def __init__(self, now: float) -> None:
        self.allowance = float(_BURST)
        self.updated_at = now
        self.omitted = 0
        self.last: tuple[str, Mapping[str, object]] | None = None


class EventRates:
    """Lets a few events of one kind through at once, then one a second, and counts the others.

    What another machine can bring about, it can bring about a thousand times a second.
    """

    def __init__(self) -> None:
        self._rates: dict[Hashable, _Rate] = {}

    def admit(
        self, kind: Hashable, name: str, fields: Mapping[str, object], now: float
    ) -> int | None:
        """Tell whether an event is to be told now.

        Parameters
        ----------
        kind : hashable
            Those of one kind are counted together.
        name : str
        fields : mapping
        now : float
            In seconds.

        Returns
        -------
        int or None
            How many were left out before this one; None if it is left out itself.
        """
        rate = self._rates.get(kind)
        if rate is None:
            rate = self._rates[kind] = _Rate(now)
        earned = (now - rate.updated_at) / _REPEATED_S
        rate.allowance = min(float(_BURST), rate.allowance + earned)
        rate.updated_at = now
        if rate.allowance < 1.0:
            rate.omitted += 1
            rate.last = name, fields
            return None
        rate.allowance -= 1.0
        omitted, rate.omitted, rate.last = rate.omitted, 0, None
        return omitted

    def next_due(self) -> float | None:
        """Return when :meth:`due` will have something; None if nothing is left out."""
        times = [self._due_at(rate) for rate in self._rates.values() if rate.last is not None]
        return min(times, default=None)

    def due(self, now: float) -> list[CountedEvent]:
        """Return, of each kind of which some were left out, the last one, once its time has come.

        Parameters
        ----------
        now : float
            Infinite for all of them.
        """
        told = []
        for rate in self._rates.values():
            if rate.last is not None and self._due_at(rate) <= now:
                told.append(CountedEvent(*rate.last, rate.omitted - 1))
                rate.allowance, rate.updated_at = 0.0, now
                rate.omitted, rate.last = 0, None
        return told

    @staticmethod
    def _due_at(rate: _Rate) -> float:
        return rate.updated_at + (1.0 - rate.allowance) * _REPEATED_S


class BoundedEventLog:
    """Hands on what concerns a service only so often: no service can fill a robot's log.

    Changes of status are all handed on.

    Parameters
    ----------
    sink : EventSink
    clock : callable
        Returns seconds.
    """

    def __init__(self, sink: EventSink, clock: Callable[[], float] = time.monotonic) -> None:
        self._sink = sink
        self._clock = clock
        # Taken again by the same thread if a signal's handler reports an event.
        self._lock = threading.RLock()
        self._rates = EventRates()

    def event(self, name: str, /, **fields: object) -> None:
        """Hand an event on, or count it."""
        with self._lock:
            now = self._clock()
            self._tell(self._rates.due(now))
            omitted: int | None = 0
            if "service" in fields and name != "status":
                omitted = self._rates.admit((name, fields["service"]), name, fields, now)
            if omitted is not None:
                self._tell([CountedEvent(name, fields, omitted)])

    def close(self) -> None:
        """Tell what was left out last, and close."""
        with self._lock:
            self._tell(self._rates.due(math.inf))
            self._sink.close()

    def _tell(self, events: Iterable[CountedEvent]) -> None:
        for event in events:
            self._sink.event(event.name, **event.told())


class EventLog:
    """Writes events as lines; any thread may report one.

    Parameters
    ----------
    target : text stream or path
        A stream stays open when the log is closed. A file is appended to, each line in one piece,
        so that several processes can write to the same one.
    format : {"text", "json"}
    component : str
        Who reports: ``robot``, or a service's name. In the text form each service is ``service``,
        because the names are longer than the column.
    clock : callable
        Returns nanoseconds since the epoch.

    Attributes
    ----------
    lost : int
        Lines that could not be written.

    Raises
    ------
    OutputError
        If the file cannot be opened.
    """

    def __init__(
        self,
        target: TextIO | Path | str,
        *,
        format: LogFormat = "text",  # noqa: A002 (nothing else says it as well)
        component: str,
        clock: Callable[[], int] = time.time_ns,
    ) -> None:
        self._compose = _compose_json if format == "json" else _compose_text
        self._component = component
        self._clock = clock
        self._stream: TextIO | None = None
        self._descriptor: int | None = None
        # Taken again by the same thread if a signal's handler reports an event in mid-write.
        self._lock = threading.RLock()
        self.lost = 0
        self._writer: _PatientWriter | None = None
        if isinstance(target, (str, Path)):
            self._descriptor = _open_for_lines(Path(target))
        else:
            self._stream = target
            if _may_block(target):
                self._writer = _PatientWriter(target)

    def event(self, name: str, /, **fields: object) -> None:
        """Write an event.

        Parameters
        ----------
        name : str
            What happened.
        **fields : object
            Numbers, texts, None, lists and mappings of them; bytes are written as hexadecimal.
            Names end in their unit; those in ``_ms`` are rounded to three digits.
        """
        now_ns = self._clock()
        try:
            line = self._compose(now_ns, self._component, name, fields)
        except Exception as error:  # noqa: BLE001
            # Whatever a field's own methods do must not end a robot's run.
            unwritable = {"unwritable_fields": type(error).__name__}
            line = self._compose(now_ns, self._component, name, unwritable)
        with self._lock:
            try:
                if self._descriptor is not None:
                    os.write(self._descriptor, line.encode())
                elif self._writer is not None:
                    self.lost += not self._writer.put(line)
                elif self._stream is not None:
                    _write_line(self._stream, line)
            # ValueError: it is closed. RuntimeError: a signal's handler came in mid-write.
            except (OSError, ValueError, RuntimeError):
                self.lost += 1

    def close(self) -> None:
        """Write no more; may be repeated. Waits a moment for a terminal that is slow."""
        with self._lock:
            writer, self._writer = self._writer, None
            self._stream = None
            if self._descriptor is not None:
                os.close(self._descriptor)
                self._descriptor = None
        if writer is not None:
            self.lost += writer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def tell_event(component: str, name: str, /, **fields: object) -> None:
    """Write one event to the standard error, as JSON, where no log is open for more of them.

    Parameters
    ----------
    component, name : str
        Whose event it is, and what it is called.
    **fields
        As those of :meth:`EventSink.event`.
    """
    with EventLog(sys.stderr, format="json", component=component) as log:
        log.event(name, **fields)


class _PatientWriter:
    """Writes lines from a thread of its own: whoever reports an event does not wait for a reader.

    A terminal can be stopped with Ctrl-S, and a pipe may be read by nobody.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._lines: deque[str] = deque()
        # Taken again by the same thread if a signal's handler reports an event.
        self._changed = threading.Condition(threading.RLock())
        self._closed = False
        self._lost = 0
        self._thread: threading.Thread | None = None

    def put(self, line: str) -> bool:
        """Take a line; False if too many are waiting."""
        with self._changed:
            if self._closed or len(self._lines) >= _MAX_WAITING_LINES:
                return False
            self._lines.append(line)
            if self._thread is None:
                self._thread = threading.Thread(target=self._work, name="holdfast-log", daemon=True)
                self._thread.start()
            self._changed.notify()
        return True

    def close(self) -> int:
        """Write what can be written in a moment, and return how many lines could not be."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        if self._thread is not None:
            self._thread.join(_FLUSH_S)
        return self._lost + len(self._lines)

    def _work(self) -> None:
        while True:
            with self._changed:
                while not self._lines and not self._closed:
                    self._changed.wait()
                if not self._lines:
                    return
                line = self._lines[0]
            try:
                _write_line(self._stream, line)
            except (OSError, ValueError, RuntimeError):
                self._lost += 1
            with self._changed:
                self._lines.popleft()


def _may_block(stream: TextIO) -> bool:
    """Tell whether a reader is needed for a write to end."""
    try:
        mode = os.fstat(stream.fileno()).st_mode
    except (OSError, ValueError, AttributeError):
        return False
    return stat.S_ISFIFO(mode) or stat.S_ISCHR(mode) or stat.S_ISSOCK(mode)


def _write_line(stream: TextIO, line: str) -> None:
    try:
        stream.write(line)
    except UnicodeEncodeError:
        stream.write(line.encode("ascii", "backslashreplace").decode())
    stream.flush()


def _open_for_lines(path: Path) -> int:
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o666)
        size = os.fstat(descriptor).st_size
        # A power cut may have left half a line; what comes now is not to be appended to that.
        if size and os.pread(descriptor, 1, size - 1) != b"\n":
            os.write(descriptor, b"\n")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error
    return descriptor


# JSON


def _compose_json(now_ns: int, component: str, name: str, fields: Mapping[str, object]) -> str:
    seconds, rest_ns = divmod(now_ns, 1_000_000_000)
    moment = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(seconds))
    head = {
        "time": f"{moment}.{rest_ns // 1000:06d}Z",
        "component": _bounded(component, 100),
        "event": _bounded(name, 100),
    }
    line = _json(head)[:-1]
    truncated = ',"truncated":true}\n'
    room = MAX_LINE_BYTES - len(line.encode()) - len(truncated)
    for key, value in fields.items():
        # What every line has keeps its meaning.
        own = f"{key}_" if key in head or key == "truncated" else _bounded(key, 100)
        piece = f",{_json(own)}:{_json(_plain(key, value))}"
        room -= len(piece.encode())
        if room < 0:
            return line + truncated
        line += piece
    return line + "}\n"


def _json(value: object) -> str:
    """Encode plain data; what is not finite becomes null, and a terminal obeys none of it."""
    text = msgspec.json.encode(value).decode()
    if text.isprintable():
        return text
    # The encoder escapes what is below the blank; of the rest a terminal obeys these, too.
    return _OBEYED.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def _plain(key: str, value: object) -> object:
    """Return a field's value as bounded plain data."""
    match value:
        case None | bool():
            return value
        case int():
            # Beyond 64 bits many readers, and the encoder, give up.
            return int(value) if -(2**63) <= value < 2**63 else _bounded(str(value))
        case float():
            return round(float(value), 3) if key.endswith("_ms") else float(value)
        case str():
            return _bounded(value)
        case bytes():
            return _bounded(value.hex())
        case BaseException():
            return _bounded(f"{type(value).__name__}: {value}")
        case list() | tuple():
            short = [_plain(key, item) for item in value[:100]]
            return short if _fits(short) and len(value) <= 100 else _bounded(_json(short))
        case dict():
            pairs = list(value.items())[:100]
            named = {_bounded(str(inner), 100): _plain(str(inner), item) for inner, item in pairs}
            return named if _fits(named) and len(value) <= 100 else _bounded(_json(named))
    item = getattr(value, "item", None)
    if callable(item) and getattr(value, "size", None) == 1:
        return _plain(key, item())  # a number of NumPy's
    return _bounded(str(value))


def _fits(value: object) -> bool:
    return len(_json(value)) <= MAX_VALUE_CHARACTERS


def _bounded(text: str, limit: int = MAX_VALUE_CHARACTERS) -> str:
    """Cut a text, and write what no encoding has as an escape."""
    if len(text) > limit:
        text = f"{text[: limit - 1]}…"
    return text.encode("utf-8", "backslashreplace").decode()


# Text


def _compose_text(now_ns: int, component: str, name: str, fields: Mapping[str, object]) -> str:
    seconds, rest_ns = divmod(now_ns, 1_000_000_000)
    moment = time.strftime("%H:%M:%S", time.localtime(seconds))
    who = (_ROBOT if component == _ROBOT else "service").ljust(_COMPONENT_WIDTH)
    what = _readable(name.replace("_", " "), 100).ljust(_EVENT_WIDTH)
    line = f"{moment}.{rest_ns // 1_000_000:03d} {who} {what} {event_in_words(fields)}".rstrip()
    data = line.encode()
    if len(data) >= MAX_LINE_BYTES:
        line = data[: MAX_LINE_BYTES - 4].decode("utf-8", "ignore") + "…"
    return line + "\n"


def event_in_words(fields: Mapping[str, object]) -> str:
    """Arrange an event's fields: what changed and who (why), the rest, how long it took."""
    rest = {key: value for key, value in fields.items() if value is not None}
    if "outcome" in rest:
        rest.pop("success", None)  # which it says, too
    head = []
    if "from" in rest and "to" in rest:
        head.append(f"{_value(rest.pop('from'))} -> {_value(rest.pop('to'))}")
    head += [_value(rest.pop(key)) for key in ("service", "robot") if key in rest]
    parts = [", ".join(head)] if head else []
    if "reason" in rest:
        why = _value(rest.pop("reason"))
        parts = [f"{parts[0]} ({why})"] if parts else [why]
    duration = rest.pop("duration_ms", None)
    parts.extend(_phrase(key, value) for key, value in rest.items())
    if duration is not None:
        parts.append(f"{_value(duration, milliseconds=True)} ms")
    return ", ".join(parts)


def _phrase(key: str, value: object) -> str:
    """Return ``retry_in_ms=12.3`` as ``retry in 12.3 ms``, ``warm=False`` as ``not warm``."""
    label, unit = key, ""
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        for ending, symbol in _UNITS.items():
            if key.endswith(ending):
                label, unit = key.removesuffix(ending), f" {symbol}"
                break
    label = _readable(label.replace("_", " "), 100)
    if isinstance(value, bool):
        return label if value else f"not {label}"
    return f"{label} {_value(value, milliseconds=unit == ' ms')}{unit}"


def _value(value: object, *, milliseconds: bool = False) -> str:
    if isinstance(value, bytes) and len(value) > 4:
        return f"{value[:4].hex()}…"  # enough to tell sessions apart
    plain = _plain("", value)
    if isinstance(plain, float):
        if milliseconds and abs(plain) < 1e9:
            return f"{plain:.{2 if abs(plain) < 10 else 1 if abs(plain) < 100 else 0}f}"
        return f"{plain:.6g}"
    if isinstance(plain, (list, dict)):
        return _readable(_json(plain))
    return _readable(str(plain))


def _readable(text: str, limit: int = MAX_VALUE_CHARACTERS) -> str:
    """Return a text without what would move a terminal's cursor or begin a line of its own."""
    text = _bounded(text, limit)
    return printable(text.replace("\n", " ").replace("\t", " "), keep="")
