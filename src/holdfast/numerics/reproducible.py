"""Functions of arrays with the same bits on every machine.

NumPy's ``exp``, ``sin`` and ``sum`` choose their code by processor, so results may differ in the
last bit. Decisions and digests depend only on the kernel's functions below, which use operations
that IEEE 754 defines exactly, in a fixed order.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from holdfast import _kernel
from holdfast.errors import ConfigurationError, InvalidValueError
from holdfast.numerics.arrays import FloatArray

_TURN = 2.0 * np.pi


try:
    _kernel.simd()
except RuntimeError as error:  # HOLDFAST_SIMD names an unavailable instruction set
    raise ConfigurationError(str(error)) from error


def _elementwise(function: Callable[[FloatArray], FloatArray], values: npt.ArrayLike) -> FloatArray:
    array = np.asarray(values, dtype=np.float64, order="C")
    return function(array.reshape(-1)).reshape(array.shape)


def exp(values: npt.ArrayLike) -> FloatArray:
    """Return e**values, elementwise; 0 below -707.7, infinite above 709.78."""
    return _elementwise(_kernel.exp, values)


def log(values: npt.ArrayLike) -> FloatArray:
    """Return the natural logarithm, elementwise; -inf at 0, NaN below."""
    return _elementwise(_kernel.log, values)


def sin(values: npt.ArrayLike) -> FloatArray:
    """Return the sine of angles in radians, elementwise; NaN above 2**30 in size."""
    return _elementwise(_kernel.sin, values)


def cos(values: npt.ArrayLike) -> FloatArray:
    """Return the cosine of angles in radians, elementwise; NaN above 2**30 in size."""
    return _elementwise(_kernel.cos, values)


def arcsin(value: float) -> float:
    """Return the angle in [-pi/2, pi/2] whose sine is ``value``; NaN outside [-1, 1]."""
    return _kernel.arcsin(float(value))


def arctan2(y: npt.ArrayLike, x: npt.ArrayLike) -> FloatArray:
    """Return the angles of vectors (x, y), in (-pi, pi]; 0 for a zero vector.

    The two arrays broadcast against each other.
    """
    ys, xs = np.broadcast_arrays(np.asarray(y, np.float64), np.asarray(x, np.float64))
    rows = (np.ascontiguousarray(each).reshape(-1) for each in (ys, xs))
    return _kernel.arctan2(*rows).reshape(ys.shape)


def wrapped(angles: npt.ArrayLike) -> FloatArray:
    """Return angles in radians less the nearest whole number of turns, in [-pi, pi].

    Of a difference of two angles it is the shorter way round. Above some thousand turns the
    rounding of a turn shows.
    """
    array = np.asarray(angles, dtype=np.float64)
    nearest: FloatArray = array - _TURN * np.rint(array / _TURN)
    return nearest


def sum(values: npt.ArrayLike) -> float:  # noqa: A001 - always used as numerics.sum
    """Return the sum of all values, added in one fixed order."""
    return _kernel.sum(np.ascontiguousarray(values, dtype=np.float64).reshape(-1))


def all_finite(values: FloatArray) -> bool:
    """Tell whether every value is finite; faster than NumPy for few values."""
    return _kernel.all_finite(values)


def weighted_mean(rows: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the mean, shape (d,), of rows (n, d) under weights (n,) that sum to 1."""
    values = np.ascontiguousarray(rows, dtype=np.float64)
    shares = np.ascontiguousarray(weights, dtype=np.float64)
    if values.ndim != 2 or shares.shape != values.shape[:1]:
        raise InvalidValueError(
            f"rows of shape {values.shape}, weights of shape {shares.shape}: need (n, d) and (n,)"
        )
    return _kernel.weighted_sums(shares, values)
