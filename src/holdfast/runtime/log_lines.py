"""Events as lines of a log: JSON for programs, text for people.

JSON keeps every field. The text form orders the same fields by rules that hold for any event: what
changed and for whom, then why, then the rest; units follow their numbers. Values of any kind and
size, text with control characters and numbers that are not finite still make one bounded line.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Literal, TypeAlias

import msgspec

from holdfast.printable import one_line

LogFormat: TypeAlias = Literal["text", "json"]

MAX_LINE_BYTES = 4096
"""Bound on a line; fields that do not fit are dropped, and the line says so."""

MAX_VALUE_CHARACTERS = 800
"""Bound on a text within a line, and on an encoded list or mapping."""

_ROBOT = "robot"
_COMPONENT_WIDTH = 8
_EVENT_WIDTH = 18

_UNITS = {"_ms": "ms", "_us": "µs", "_s": "s", "_hz": "Hz", "_bytes": "bytes"}
"""Endings of field names, and how the text form writes them."""


def json_line(now_ns: int, component: str, name: str, fields: Mapping[str, object]) -> str:
    """Return an event as a line of JSON; ``now_ns`` are nanoseconds since 1970."""
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
        # A field cannot replace those that every line has.
        unique = f"{key}_" if key in head or key == "truncated" else _bounded(key, 100)
        piece = f",{_json(unique)}:{_json(_plain(key, value))}"
        room -= len(piece.encode())
        if room < 0:
            return line + truncated
        line += piece
    return line + "}\n"


def text_line(now_ns: int, component: str, name: str, fields: Mapping[str, object]) -> str:
    """Return an event as a line of text; the time is local, in ISO 8601 with its zone."""
    seconds, rest_ns = divmod(now_ns, 1_000_000_000)
    local = time.localtime(seconds)
    moment, zone = time.strftime("%Y-%m-%dT%H:%M:%S", local), time.strftime("%z", local)
    stamp = f"{moment}.{rest_ns // 1_000_000:03d}{zone[:3]}:{zone[3:]}"
    who = (_ROBOT if component == _ROBOT else "service").ljust(_COMPONENT_WIDTH)
    what = _readable(name.replace("_", " "), 100).ljust(_EVENT_WIDTH)
    line = f"{stamp} {who} {what} {fields_as_text(fields)}".rstrip()
    data = line.encode()
    if len(data) >= MAX_LINE_BYTES:
        line = data[: MAX_LINE_BYTES - 4].decode("utf-8", "ignore") + "…"
    return line + "\n"


def fields_as_text(fields: Mapping[str, object]) -> str:
    """Write an event's fields: change and name (reason), the others, the duration."""
    rest = {key: value for key, value in fields.items() if value is not None}
    if "outcome" in rest:
        rest.pop("success", None)  # the outcome says it
        reason = rest.pop("reason", None)
        if reason is not None:
            rest["outcome"] = f"{rest['outcome']} ({reason})"
    head = []
    if "from" in rest and "to" in rest:
        head.append(f"{_value(rest.pop('from'))} -> {_value(rest.pop('to'))}")
    head += [_value(rest.pop(key)) for key in ("service", "robot") if key in rest]
    parts = [", ".join(head)] if head else []
    if "reason" in rest:
        reason = _value(rest.pop("reason"))
        parts = [f"{parts[0]} ({reason})"] if parts else [reason]
    duration = rest.pop("duration_ms", None)
    parts.extend(_phrase(key, value) for key, value in rest.items())
    if duration is not None:
        parts.append(f"{_value(duration, milliseconds=True)} ms")
    return ", ".join(parts)


def _json(value: object) -> str:
    """Encode plain data; numbers that are not finite become null, what is unprintable escapes."""
    text = msgspec.json.encode(value).decode()
    if text.isprintable():
        return text
    return "".join(each if each.isprintable() else _escaped(each) for each in text)


def _escaped(letter: str) -> str:
    units = letter.encode("utf-16-be").hex()
    return "".join(f"\\u{units[at : at + 4]}" for at in range(0, len(units), 4))


def _plain(key: str, value: object) -> object:
    """Return a field's value as bounded plain data."""
    match value:
        case None | bool():
            return value
        case int():
            # The encoder and many readers have 64 bits.
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
        return _plain(key, item())  # a NumPy scalar
    return _bounded(str(value))


def _fits(value: object) -> bool:
    return len(_json(value)) <= MAX_VALUE_CHARACTERS


def _bounded(text: str, limit: int = MAX_VALUE_CHARACTERS) -> str:
    """Cut a text, and escape what UTF-8 cannot encode."""
    if len(text) > limit:
        text = f"{text[: limit - 1]}…"
    return text.encode("utf-8", "backslashreplace").decode()


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
        return f"{value[:4].hex()}…"  # enough to identify a session
    plain = _plain("", value)
    if isinstance(plain, float):
        if milliseconds and abs(plain) < 1e9:
            return f"{plain:.{2 if abs(plain) < 10 else 1 if abs(plain) < 100 else 0}f}"
        return f"{plain:.6g}"
    if isinstance(plain, (list, dict)):
        return _readable(_json(plain))
    return _readable(str(plain))


def _readable(text: str, limit: int = MAX_VALUE_CHARACTERS) -> str:
    """Return a text on one line; many spaces would break it where a terminal does."""
    return one_line(_bounded(text, limit))


LINES: dict[LogFormat, Callable[[int, str, str, Mapping[str, object]], str]] = {
    "text": text_line,
    "json": json_line,
}
"""The formats of a log, with what makes a line of each."""
