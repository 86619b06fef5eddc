"""Arrays: the three types that holdfast uses, and how a message shows one."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["BoolArray", "FloatArray", "IntArray", "floats_or_none", "in_brief", "real_numbers"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

_EDGE = 4
"""Entries of a long array that a message shows, at either end."""


def in_brief(values: object) -> str:
    """Return an array, or a nested list, on one line; a long one without its middle."""
    try:
        array = np.asarray(values)
    except (TypeError, ValueError):
        return " ".join(repr(values).split())[:80]  # A ragged list.
    return np.array2string(array, max_line_width=sys.maxsize, threshold=2 * _EDGE, edgeitems=_EDGE)


def real_numbers(value: object) -> npt.NDArray[Any] | None:
    """Return an array of a number or of numbers; None for anything else, truth values included."""
    try:
        numbers = np.asarray(value)
    except (TypeError, ValueError):
        return None  # A ragged list.
    return numbers if numbers.dtype.kind in "fiu" else None


def floats_or_none(shown: npt.ArrayLike | None) -> FloatArray | None:
    """Return a copy of what was shown, as float64; None for nothing."""
    return None if shown is None else np.array(shown, dtype=np.float64)
