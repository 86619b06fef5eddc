"""The place and the words of a value that does not fit its type.

msgspec says in English what is wrong, and stops at the first mistake. :func:`find_mismatch` walks
down from the whole to the smallest value that msgspec refuses, so the place comes out as data. What
is allowed there is read from the type (:func:`described`).
"""

from __future__ import annotations

import json
import re
import types
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Union, get_args, get_origin

import msgspec
import msgspec.inspect
from msgspec.inspect import FloatType, IntType, ListType, StrType, VarTupleType

from holdfast.conversion import convert
from holdfast.errors import InvalidValueError
from holdfast.printable import brief, cut, did_you_mean

KeyPath = tuple[str | int, ...]
"""Keys and list indices that lead from the top of a document to a value."""


class Mismatch(NamedTuple):
    """A value that does not fit its type: what is ``expected`` instead, in words.

    If it is ``unknown``, its path ends with a key that is not one of ``allowed``; if it is
    ``missing``, with a key that is needed and not there.
    """

    path: KeyPath
    allowed: tuple[str, ...] = ()
    unknown: bool = False
    missing: bool = False
    value: Any = None
    expected: str = ""

    def in_words(self) -> str:
        """Return what the value is and what is expected."""
        if self.missing:
            return "is missing; it has no default"
        if self.unknown:
            hint = close_match(str(self.path[-1]), self.allowed)
            return f"is not a known key{hint}; allowed: {', '.join(self.allowed)}"
        value = self.value
        length = f" (a list of {len(value)})" if isinstance(value, list) else ""
        hint = close_match(value, self.allowed) if isinstance(value, str) else ""
        if isinstance(value, str) and self.expected.startswith("a list"):
            hint = f", as in [{value}]"
        return f"is {shown(value)}{length}; expected {self.expected}{hint}"


def find_mismatch(value: Any, annotation: Any, path: KeyPath = ()) -> Mismatch | None:
    """Return the first value, the innermost one, that msgspec does not convert to its type."""
    try:
        convert(value, annotation)
    except msgspec.ValidationError as error:
        reason = str(error)
    else:
        return None
    for key, inner, inner_annotation in _parts(value, annotation):
        if (found := find_mismatch(inner, inner_annotation, (*path, key))) is not None:
            return found
    for struct in _alternatives(annotation):
        if not (isinstance(value, Mapping) and _is_struct(struct)):
            continue
        names = field_names(struct)
        if struct.__struct_config__.forbid_unknown_fields:
            for key in value:
                if key not in names:
                    return Mismatch((*path, key), tuple(names), unknown=True)
        for field in msgspec.structs.fields(struct):
            if field.required and field.encode_name not in value:
                return Mismatch((*path, field.encode_name), missing=True)
        # What the struct itself checks.
        return Mismatch(path, value=value, expected=reason)
    allowed = msgspec.inspect.type_info(annotation)
    return Mismatch(path, _choices(allowed), value=value, expected=described(allowed) or reason)


def _parts(value: Any, annotation: Any) -> Iterator[tuple[str | int, Any, Any]]:
    """Yield key or index, value and type of what a mapping or list holds."""
    for each in _alternatives(annotation):
        kind, arguments = get_origin(each), get_args(each)
        if isinstance(value, Mapping):
            if _is_struct(each):
                fields = {field.encode_name: field.type for field in msgspec.structs.fields(each)}
                yield from ((key, value[key], fields[key]) for key in value if key in fields)
            elif isinstance(kind, type) and issubclass(kind, Mapping):
                yield from ((key, inner, arguments[1]) for key, inner in value.items())
        elif isinstance(value, list):
            if kind is tuple and arguments[1:] != (...,):
                if len(arguments) == len(value):
                    yield from zip(range(len(value)), value, arguments, strict=True)
            elif kind in (tuple, list):
                yield from ((index, inner, arguments[0]) for index, inner in enumerate(value))


def _alternatives(annotation: Any) -> list[Any]:
    """Return the members of a union, or the type itself."""
    kind = get_origin(annotation)
    if kind is Annotated:
        return _alternatives(get_args(annotation)[0])
    if kind in (Union, types.UnionType):
        return [inner for each in get_args(annotation) for inner in _alternatives(each)]
    return [annotation]


def _is_struct(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, msgspec.Struct)


def field_names(schema: type[msgspec.Struct]) -> list[str]:
    """Return the keys of a section."""
    return [field.encode_name for field in msgspec.structs.fields(schema)]


def _members(allowed: msgspec.inspect.Type) -> list[msgspec.inspect.Type]:
    while isinstance(allowed, msgspec.inspect.Metadata):
        allowed = allowed.type
    if isinstance(allowed, msgspec.inspect.UnionType):
        return [inner for member in allowed.types for inner in _members(member)]
    return [allowed]


def _choices(allowed: msgspec.inspect.Type) -> tuple[str, ...]:
    return tuple(
        str(value)
        for each in _members(allowed)
        if isinstance(each, msgspec.inspect.LiteralType)
        for value in each.values
    )


def described(allowed: msgspec.inspect.Type) -> str:
    """Return in words what a value of a type may be; empty where there are no words."""
    words = []
    for each in _members(allowed):
        match each:
            case IntType():
                words.append(f"a whole number{_bounds(each)}")
            case FloatType():
                words.append(f"a number{_bounds(each)}")
            case StrType():
                words.append(f"text{_lengths(each, ' characters')}")
            case msgspec.inspect.BoolType():
                words.append("true or false")
            case msgspec.inspect.NoneType():
                words.append("null")
            case msgspec.inspect.LiteralType():
                choices = ", ".join(map(str, each.values))
                words.append(f"one of {choices}" if len(each.values) > 1 else choices)
            case msgspec.inspect.TupleType():
                words.append(f"a list of {len(each.item_types)}")
            case ListType() | VarTupleType():
                words.append(f"a list{_lengths(each)}")
            case msgspec.inspect.DictType():
                words.append("a mapping of keys")
            case msgspec.inspect.StructType():
                keys = ", ".join(field.encode_name for field in each.fields)
                words.append(f"a mapping with the keys {keys}")
            case _:
                return ""
    return " or ".join(words)


def _bounds(number: IntType | FloatType) -> str:
    bounds = ((">=", number.ge), (">", number.gt), ("<=", number.le), ("<", number.lt))
    given = [
        f"{sign} {f'{bound:g}' if isinstance(bound, float) else bound}"
        for sign, bound in bounds
        if bound is not None
    ]
    return f" {' and '.join(given)}" if given else ""


def _lengths(items: ListType | VarTupleType | StrType, unit: str = "") -> str:
    bounds = (("at least", items.min_length), ("at most", items.max_length))
    given = [f"{sign} {bound}" for sign, bound in bounds if bound is not None]
    return f" of {' and '.join(given)}{unit}" if given else ""


def dotted(path: KeyPath) -> str:
    """Return a path as people write it: ``model.holes[2].center``.

    Keys from a file may be anything, so long ones are cut and unprintable ones quoted.
    """
    text = ""
    for part in path:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            key = part if part.isprintable() else repr(part)
            text += f".{key:.80}" if text else f"{key:.80}"
    return text


def close_match(text: str, allowed: Iterable[str]) -> str:
    """Return a question after the allowed texts of which this is a part, or after the nearest."""
    texts = list(allowed)
    part = rf"(?:^|_){re.escape(text.lower())}(?:_|$)"
    close = [each for each in texts if re.search(part, each)]
    return did_you_mean(text.lower(), texts, sure=close if len(close) == 2 else ())


def as_path(what: str, value: Any, kind: str = "a path") -> Path:
    """Return a path; otherwise InvalidValueError names ``what`` and the ``kind``."""
    try:
        path = Path(value)
    except TypeError:
        path = Path()
    if str(value) in ("", "\0") or not isinstance(value, str | Path) or "\0" in str(path):
        raise InvalidValueError(f"{what} is {brief(value)}; it must be {kind}")
    return path


def as_function(what: str, value: Any) -> Callable[..., Any]:
    """Return a function; otherwise InvalidValueError names ``what``."""
    if not callable(value):
        raise InvalidValueError(f"{what} is {brief(value)}; it must be a function")
    return value  # type: ignore[no-any-return]


def shown(value: Any) -> str:
    """Return a value as a file may have it, on one line and at most 60 characters."""
    text = json.dumps(value, ensure_ascii=False, default=str)
    return cut(text, 60)
