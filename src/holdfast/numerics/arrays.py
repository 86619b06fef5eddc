"""Arrays and numbers: the types that holdfast uses, how they are read, how a message shows one.

NumPy makes numbers of almost anything: the text "4.0", True, a date, masked entries. The readers
here take real numbers and nothing else. They stand at every entry of the public interface, and
wherever something comes from a user's function.
"""

from __future__ import annotations

import operator
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from holdfast.errors import InvalidValueError
from holdfast.printable import brief

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

NOTHING_ELSE = "(no text, truth value, date or masked entry)"
"""What a message says after numbers, which the readers alone take for such."""

_EDGE = 4
"""Entries of a long array that a message shows, at either end."""


class KeepsReadOnly:
    """A class whose objects are pickled and copied with their read-only arrays still read-only."""

    def __getstate__(self) -> tuple[dict[str, Any], list[str]]:
        return vars(self), [name for name, value in vars(self).items() if _is_read_only(value)]

    def __setstate__(self, state: tuple[dict[str, Any], list[str]]) -> None:
        attributes, read_only = state
        vars(self).update(attributes)
        for name in read_only:
            value = attributes[name]
            for array in value if isinstance(value, list | tuple) else (value,):
                array.setflags(write=False)


def _is_read_only(value: object) -> bool:
    arrays = value if isinstance(value, list | tuple) and value else (value,)
    return all(isinstance(each, np.ndarray) and not each.flags.writeable for each in arrays)


def in_brief(values: object) -> str:
    """Return an array, or a nested list, on one line; a long one without its middle."""
    try:
        array = np.asarray(values)
    except (TypeError, ValueError):
        return brief(values)  # A ragged list.
    return np.array2string(array, max_line_width=sys.maxsize, threshold=2 * _EDGE, edgeitems=_EDGE)


def real_numbers(value: object) -> npt.NDArray[Any] | None:
    """Return an array of a number or of numbers; None for anything else.

    Truth values, texts, dates, objects and arrays with masked entries are something else.
    """
    if _hides_something(value):
        return None
    try:
        numbers = np.asarray(value)
    except (TypeError, ValueError):
        return None  # A ragged list.
    return numbers if numbers.dtype.kind in "fiu" else None


def _hides_something(value: object) -> bool:
    """Tell whether NumPy would silently make a number of something else, in a list say."""
    if isinstance(value, list | tuple):
        return any(map(_hides_something, value)) if value else False
    return is_masked(value) or isinstance(value, bool | np.bool_)


def is_masked(value: object) -> bool:
    """Tell whether a mask hides an entry of an array: NumPy's functions drop it in silence."""
    # No array is masked before NumPy's module of them is imported, which is slow.
    could_be = "numpy.ma" in sys.modules and isinstance(value, np.ma.MaskedArray)
    return could_be and bool(np.ma.is_masked(value))


def real_number(value: object) -> float | None:
    """Return one real number, finite or not; None for anything else."""
    if type(value) is float:
        return value
    number = None if isinstance(value, list | tuple) else real_numbers(value)
    return float(number) if number is not None and number.ndim == 0 else None


def integer(value: object) -> int | None:
    """Return a whole number, NumPy's too; None for anything else, 3.0 and True included."""
    if type(value) is int:
        return value
    if _hides_something(value):
        return None
    try:
        return operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        return None


def whole(what: str, value: object, least: int, most: int | None = None) -> int:
    """Return a whole number within bounds; otherwise InvalidValueError names ``what``."""
    number = integer(value)
    if number is None or number < least or (most is not None and number > most):
        limits = f"from {least}" if most is None else f"from {least} to {most}"
        came = value if number is None else number
        raise InvalidValueError(f"{what} {brief(came)}: allowed are whole numbers {limits}")
    return number


def floats(what: str, value: object) -> FloatArray:
    """Return real numbers as float64, in C order; otherwise InvalidValueError names ``what``."""
    if type(value) is np.ndarray and value.dtype == np.float64 and value.flags.c_contiguous:
        return value
    numbers = real_numbers(value)
    if numbers is None:
        raise InvalidValueError(f"{what} is {brief(value)}: must be real numbers {NOTHING_ELSE}")
    return np.ascontiguousarray(numbers, dtype=np.float64).reshape(numbers.shape)


def plain(value: Any) -> Any:
    """Return a value with Python's own numbers and lists in the place of NumPy's, however deep.

    What is neither a number nor a text of NumPy's stays as it is.
    """
    if isinstance(value, np.ndarray | np.generic) and not _hides_something(value):
        return value.tolist() if value.dtype.kind in "biufU" else value
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    return type(value)(map(plain, value)) if type(value) in (list, tuple) else value
