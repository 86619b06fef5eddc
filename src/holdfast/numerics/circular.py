"""Angles: coordinates that come back to where they began.

Headings of 179 and -179 degrees are two degrees apart, and their mean is 180, not 0. A problem
names such coordinates (``circular``, ``circular_actions``, ``circular_observations``), and here is
what is done with them. A mean is the direction of the sum of unit vectors. A difference is the
shorter way round. For an entropy the circle is cut open where there are no points: in the middle of
the widest gap between neighbours. Then it is a line, and every estimator of points on a line will
do. Where points are all around the circle, no place to cut is free; but an entropy of neighbours
adds up what each point sees nearby, so the cut costs the few points beside it a part of theirs.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from holdfast import _kernel
from holdfast.numerics import reproducible as numerics
from holdfast.numerics.arrays import FloatArray

_TURN = 2.0 * np.pi


def mean_angles(angles: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the mean direction of each column of angles, shape (d,), in (-pi, pi].

    ``angles`` has the shape (n, d), ``weights`` (n,). Where the unit vectors cancel each other, the
    direction is that of what rounding leaves of their sum.

    Source: Mardia and Jupp, "Directional Statistics", 2000, section 2.2.
    """
    sines = _kernel.weighted_sums(weights, numerics.sin(angles))
    cosines = _kernel.weighted_sums(weights, numerics.cos(angles))
    return numerics.arctan2(sines, cosines)


def differences(states: FloatArray, origin: FloatArray, circular: Sequence[int]) -> FloatArray:
    """Return ``states - origin``, of the circular coordinates the shorter way round."""
    difference: FloatArray = states - origin
    for coordinate in circular:
        difference[..., coordinate] = numerics.wrapped(difference[..., coordinate])
    return difference


def unwrapped(points: FloatArray, circular: Sequence[int]) -> FloatArray:
    """Return points whose circular coordinates are cut open at the widest gap of their set.

    ``points`` has the shape (..., n, d); each set of n has cuts of its own. Distances across a cut
    are lost, all others are those on the circle, as far as they are shorter than half of it.
    """
    opened: FloatArray = points.copy()
    for coordinate in circular:
        angles = numerics.wrapped(points[..., coordinate])
        ordered = np.sort(angles, axis=-1)
        following = np.concatenate([ordered[..., 1:], ordered[..., :1] + _TURN], axis=-1)
        gaps = following - ordered
        widest = gaps.argmax(axis=-1)[..., np.newaxis]
        cut = np.take_along_axis(ordered, widest, -1) + 0.5 * np.take_along_axis(gaps, widest, -1)
        opened[..., coordinate] = numerics.wrapped(angles - (cut - np.pi))
    return opened


def embedded(points: FloatArray, circular: Sequence[int]) -> FloatArray:
    """Return points whose angles are unit vectors: cosines in their places, sines behind all.

    The variance of a unit vector is about that of a small angle, and at most 1. No circle is cut,
    so it is right for what depends on the distances of far points, as a covariance does.
    """
    angles = points[..., list(circular)]
    vectors = np.concatenate([points, numerics.sin(angles)], axis=-1)
    vectors[..., list(circular)] = numerics.cos(angles)
    return vectors
