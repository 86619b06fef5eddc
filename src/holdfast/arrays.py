"""Arrays: the three types that holdfast uses, and how a message shows one."""

from __future__ import annotations

import sys

import numpy as np
import numpy.typing as npt

__all__ = ["BoolArray", "FloatArray", "IntArray", "in_brief"]

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
