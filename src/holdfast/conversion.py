"""Structs from plain data, in any thread."""

from __future__ import annotations

import threading
from typing import Any, TypeVar

import msgspec

_T = TypeVar("_T")

_INSPECTING = threading.RLock()


def convert(value: Any, kind: type[_T], *, strict: bool = True) -> _T:
    """Return ``msgspec.convert(value, kind, strict=strict)``.

    msgspec (0.22) inspects the fields of a struct at its first use, and the process crashes if a
    second thread uses the struct meanwhile. So one thread at a time lets it inspect.
    """
    with _INSPECTING:
        msgspec.msgpack.Decoder(kind)
    return msgspec.convert(value, kind, strict=strict)  # noqa: TID251
