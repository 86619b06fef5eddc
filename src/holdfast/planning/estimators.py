"""How uncertain are weighted points? Differential entropy, estimated.

Three estimates. *Nearest neighbour*: where the k-th neighbour is far, the density is low. Distances
below a resolution count as the resolution, so equal points (a policy that does not move half of the
particles) give a finite answer. *Prior neighbours*: the same for the points before they were
weighted, less the information that the weights carry. *Gaussian mixture*: every point stands for a
Gaussian of the motion noise, since a robot executes an action with that noise; pairwise distances
then bound the entropy of the mixture.

Entropies are in nats. Those of continuous quantities may be negative.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from holdfast import _kernel
from holdfast.errors import InvalidValueError
from holdfast.numerics import reproducible as numerics
from holdfast.numerics.arrays import FloatArray, floats, in_brief, real_number, whole
from holdfast.numerics.circular import unwrapped
from holdfast.numerics.floating_mode import in_own_mode
from holdfast.planning.settings import MAX_PRIOR_NEIGHBORS_POINTS

MAX_DIMENSION = 64

LARGEST = 1e150
"""Bound on coordinates, and on the resolution and its inverse: their squares must be numbers."""


class NearestNeighbor(NamedTuple):
    """The weighted nearest-neighbour estimate with a resolution.

    With r_n the distance from point n to its k-th nearest other point, or the resolution if that
    is larger; q_n the number of others within r_n (k where the k-th distance set it); m_n their
    weight over ``1 - w_n``; and c_d the volume of the unit ball::

        entropy = sum_n w_n (-log m_n + log c_d + d log r_n + log q_n - psi(q_n))

    Points of negligible weight are left out, because a neighbour of weight 1e-200 says nothing
    about the density: those below the largest of 1e-2, 1e-3, ..., 1e-6 times the greatest weight
    that loses at most 0.5 % of the sum, or below 1e-6 times it if none does. With k or fewer
    others left, k is their number;
    and a single point has the entropy of the ball of the resolution. On uniform weights and a
    small resolution it is the estimate of Kozachenko and Leonenko (1987) in the form of Kraskov,
    Stögbauer and Grassberger (2004), with ``log(N - 1)`` in the place of
    ``psi(N)``.

    Attributes
    ----------
    neighbors : int
        The k, at least 1.
    resolution : float or array of shape (d,), optional
        Positive, in the unit of the points. With an array distances are measured in resolutions,
        coordinate by coordinate, so they do not depend on units. None: :func:`entropy` takes a
        thousandth of the points' own scale, the median of their distances from their median (or,
        where half of them are there, the root of the mean square of those distances).
    """

    neighbors: int = 5
    resolution: float | FloatArray | None = None


class PriorNeighbors(NamedTuple):
    """The nearest-neighbour entropy of a prior, less the information gained since.

    Neighbourhoods are those of the prior, the same for all posteriors: B_n is the other points of
    positive prior weight within the distance to the k-th nearest of them, or within the resolution
    if that is larger. With w the prior's weights, W those of a posterior and s = 1/20::

        m_n(W) = (sum_{j in B_n} W_j + s W_n) / (1 - (1 - s) W_n)
        entropy = (nearest-neighbour entropy of the prior) - sum_n W_n log(m_n(W) / m_n(w))

    The sum estimates the Kullback-Leibler divergence of the posterior from the prior, whose
    expectation over observations is the information gained (Lindley 1956). Where a sharp
    observation leaves a handful of points, :class:`NearestNeighbor` is mostly bias, and the bias
    depends on the observation, through the number of points left. Here the volumes are the prior's
    and favour no observation. A point counts a little (s) in its own neighbourhood, so the estimate
    is finite where no neighbour is left.

    Attributes
    ----------
    prior : array of shape (n,)
        Weights of the points before the observation: non-negative, of sum 1.
    neighbors : int
        The k, at least 1.
    resolution : float or array of shape (d,), optional
        As that of :class:`NearestNeighbor`.

    Notes
    -----
    With few points it overrates uninformative observations, the more the fewer points they leave:
    the divergence of a random handful from the prior is not zero.

    Without weights, divergences from distances to nearest neighbours are those of Wang, Kulkarni
    and Verdu (2009), "Divergence estimation for multidimensional densities via k-nearest-neighbor
    distances", IEEE Transactions on Information Theory 55(5). Time grows with the square of the
    number of points, of which there may be 4,096.
    """

    prior: FloatArray
    neighbors: int = 5
    resolution: float | FloatArray | None = None


class GaussianMixture(NamedTuple):
    """A bound on the entropy of the points blurred by Gaussian noise.

    With S the noise's covariance (diagonal)::

        d/2 log(2 pi e) + 1/2 log |S| - sum_i w_i log sum_j w_j exp(-c D(u_i, u_j)),
        D(u, v) = (u - v)' S^-1 (u - v)

    Attributes
    ----------
    variance : array of shape (d,)
        Positive: the diagonal of S.
    upper : bool
        True: c = 1/2, from above. False: c = 1/8, from below.

    Notes
    -----
    Kolchinsky and Tracey (2017), "Estimating mixture entropy with pairwise distances", Entropy
    19(7), eqs. 10 and 11 with the Kullback-Leibler and the Bhattacharyya distance.
    """

    variance: FloatArray
    upper: bool = True


class EstimatorKind(IntEnum):
    """The kernel's number of each estimate; both bounds of a mixture are one kind."""

    NEAREST_NEIGHBOR = 0
    GAUSSIAN_MIXTURE = 1
    TOTAL_VARIANCE = 2
    PRIOR_NEIGHBORS = 3


_NO_PRIOR: FloatArray = np.empty(0)


class KernelEstimator(NamedTuple):
    """An estimator in the kernel's terms.

    The points are to be multiplied by ``scale``, coordinate by coordinate. What the kernel then
    returns lacks ``log_volume``, the logarithm of the volume of a cell of the resolution. It is the
    same for all sensing actions and depends on units: add it after the choice, so that its rounding
    has no part in that.
    """

    kind: EstimatorKind
    neighbors: int
    resolution: float
    exponent: float
    offset: float
    scale: FloatArray | None
    log_volume: float = 0.0
    prior: FloatArray = _NO_PRIOR

    @property
    def parameters(self) -> tuple[EstimatorKind, int, float, float, float]:
        """The arguments that the kernel's functions take one after the other."""
        return self.kind, self.neighbors, self.resolution, self.exponent, self.offset

    @property
    def drops_negligible(self) -> bool:
        """Whether points of negligible weight are left out."""
        return self.kind != EstimatorKind.TOTAL_VARIANCE


TOTAL_VARIANCE = KernelEstimator(EstimatorKind.TOTAL_VARIANCE, 1, 1.0, 0.0, 0.0, None)
"""Not an entropy: the trace of the covariance of weighted points, to compare with."""


def scaled(points: FloatArray, estimator: KernelEstimator) -> FloatArray:
    """Return the points as the kernel takes them.

    InvalidValueError says if one is too far from zero in the units of the estimator.
    """
    if estimator.scale is None:
        return points
    array: FloatArray = points * estimator.scale
    if (bad := first_unbounded(array)) is not None:
        mixture = estimator.kind == EstimatorKind.GAUSSIAN_MIXTURE
        unit = "standard deviations" if mixture else "resolutions"
        raise InvalidValueError(
            f"point {bad} is {array[bad]} {unit} from zero: at most {LARGEST:g}"
        )
    return array


def first_unbounded(points: FloatArray) -> int | None:
    """Return the index of the first point with a coordinate that is NaN or too large, or None."""
    if _kernel.all_within(points, -LARGEST, LARGEST):
        return None
    return int(np.argmin((np.abs(points) <= LARGEST).all(axis=1)))


def scale_of(resolution: npt.ArrayLike, dimension: int) -> tuple[FloatArray, float]:
    """Return what makes a resolution 1 in every coordinate, and the log of its cell's volume."""
    sizes = floats("resolution", resolution)
    if sizes.shape != (dimension,):
        raise InvalidValueError(
            f"resolution of shape {sizes.shape}: need one number, or ({dimension},)"
        )
    # A comparison with NaN is false.
    if not ((sizes >= 1.0 / LARGEST) & (sizes <= LARGEST)).all():
        raise InvalidValueError(
            f"resolution {in_brief(sizes)}: allowed are {1.0 / LARGEST:g} to {LARGEST:g} "
            "in every coordinate"
        )
    return 1.0 / sizes, numerics.sum(numerics.log(sizes))


def kernel_estimator(
    estimator: NearestNeighbor | PriorNeighbors | GaussianMixture,
    dimension: int,
    *,
    split_volume: bool = False,
) -> KernelEstimator:
    """Check an estimator of points with ``dimension`` coordinates, and translate it.

    ``split_volume`` keeps the part of a mixture's entropy that depends on units apart, in
    ``log_volume``. That of a nearest-neighbour estimate with an array is always there.
    """
    _check_dimension(dimension)
    if isinstance(estimator, NearestNeighbor | PriorNeighbors):
        neighbors = whole("neighbors", estimator.neighbors, 1)
        if isinstance(estimator, NearestNeighbor):
            kind, prior = EstimatorKind.NEAREST_NEIGHBOR, _NO_PRIOR
        else:
            kind, prior = EstimatorKind.PRIOR_NEIGHBORS, _checked_prior(estimator.prior)
        if estimator.resolution is None:
            raise InvalidValueError("resolution is None: only entropy, which has points, takes it")
        resolution = real_number(estimator.resolution)
        if resolution is None:  # one for each coordinate
            scale, log_volume = scale_of(estimator.resolution, dimension)
            return KernelEstimator(kind, neighbors, 1.0, 0.0, 0.0, scale, log_volume, prior)
        if not 1.0 / LARGEST <= resolution <= LARGEST:
            raise InvalidValueError(
                f"resolution {resolution}: allowed are {1.0 / LARGEST:g} to {LARGEST:g}"
            )
        return KernelEstimator(kind, neighbors, resolution, 0.0, 0.0, None, 0.0, prior)
    variance = floats("variance", estimator.variance).reshape(-1)
    if variance.shape != (dimension,):
        raise InvalidValueError(f"variance of shape {variance.shape}: need ({dimension},)")
    if not (variance > 0.0).all() or not np.isfinite(variance).all():
        raise InvalidValueError(
            f"variance {in_brief(variance)}: every entry must be > 0 and finite"
        )
    two_pi_e = 17.079468445347132
    offset = 0.5 * dimension * float(numerics.log(two_pi_e))
    log_volume = 0.5 * numerics.sum(numerics.log(variance))
    if not split_volume:
        offset, log_volume = offset + log_volume, 0.0
    scale = 1.0 / np.sqrt(variance)
    exponent = 0.5 if estimator.upper else 0.125
    return KernelEstimator(
        EstimatorKind.GAUSSIAN_MIXTURE, 1, 1.0, exponent, offset, scale, log_volume
    )


def _own_resolution(points: FloatArray, shares: FloatArray) -> float:
    """Return a thousandth of the scale of weighted points."""
    middle = np.array([_median(column, shares) for column in points.T])
    distances = np.abs(points - middle) * (shares > 0.0)[:, np.newaxis]
    greatest = float(distances.max())
    if greatest == 0.0:
        raise InvalidValueError(
            f"points that are all {in_brief(middle)} have no scale from which a resolution could "
            "follow: give an estimator with one, NearestNeighbor(resolution=...)"
        )
    # In parts of the greatest coordinate, whose squares are not too large, and not all 0.
    parts = distances / greatest
    squares = np.square(parts).sum(axis=1)
    square = _median(squares, shares) or float((shares * squares).sum() / shares.sum())
    return 1e-3 * greatest * float(np.sqrt(square))


def _median(values: FloatArray, shares: FloatArray) -> float:
    """Return the least value below or at which half of the weight lies."""
    order = np.argsort(values, kind="stable")
    below = np.cumsum(shares[order])
    return float(values[order[np.searchsorted(below, 0.5 * below[-1])]])


def _check_dimension(dimension: int) -> None:
    if not 1 <= dimension <= MAX_DIMENSION:
        raise InvalidValueError(
            f"points of {dimension} coordinates: allowed are 1 to {MAX_DIMENSION}"
        )


def _checked_prior(prior: npt.ArrayLike) -> FloatArray:
    weights = floats("prior", prior)
    if weights.ndim != 1 or not 1 <= weights.shape[0] <= MAX_PRIOR_NEIGHBORS_POINTS:
        raise InvalidValueError(
            f"prior of shape {weights.shape}: need (n,) with n from 1 to "
            f"{MAX_PRIOR_NEIGHBORS_POINTS}"
        )
    # Comparisons with NaN are false.
    if not (weights >= 0.0).all() or not abs(numerics.sum(weights) - 1.0) < 1e-6:
        raise InvalidValueError(
            f"prior {in_brief(weights)}: weights must not be negative, their sum 1"
        )
    return weights


@in_own_mode
def entropy(
    points: npt.ArrayLike,
    weights: npt.ArrayLike | None = None,
    estimator: NearestNeighbor | PriorNeighbors | GaussianMixture | None = None,
    *,
    circular: Sequence[int] = (),
    threads: int = 0,
) -> float | FloatArray:
    """Estimate the differential entropy of weighted points.

    Parameters
    ----------
    points : array of shape (n, d)
        Finite.
    weights : array of shape (n,) or (b, n), optional
        Non-negative, not all zero; need not sum to 1. With ``b`` rows, ``b`` entropies of the same
        points under different weights, much faster than one by one. Default: equal weights.
    estimator : NearestNeighbor, PriorNeighbors or GaussianMixture, optional
        Default: ``NearestNeighbor()``, whose resolution follows from the points: in another unit
        (points times s) the entropy is ``d log(s)`` more. Points that are all equal need one.
    circular : sequence of int
        Which coordinates are angles in radians, of which pi is -pi. Distances across the widest gap
        between neighbouring angles are not seen.
    threads : int
        At most so many; 0 means all cores. The result does not depend on it.

    Returns
    -------
    float or array of shape (b,)
        In nats.

    Raises
    ------
    InvalidValueError
        If an argument is out of bounds; the message names it.
    """
    estimator = NearestNeighbor() if estimator is None else estimator
    if not isinstance(estimator, NearestNeighbor | PriorNeighbors | GaussianMixture):
        raise InvalidValueError(
            f"estimator is {estimator!r}; it must be a NearestNeighbor, PriorNeighbors or "
            "GaussianMixture"
        )
    array = floats("points", points)
    if array.ndim != 2 or array.shape[0] == 0:
        raise InvalidValueError(f"points of shape {array.shape}: need (n, d) with n >= 1")
    count = array.shape[0]
    if (bad := first_unbounded(array)) is not None:
        raise InvalidValueError(
            f"point {bad} is {array[bad]}: every coordinate must be finite and at most {LARGEST:g}"
        )
    _check_dimension(array.shape[1])
    if not isinstance(estimator, GaussianMixture):
        neighbors = whole("neighbors", estimator.neighbors, 1)
        if neighbors >= count > 1:
            raise InvalidValueError(
                f"neighbors {neighbors}: must be below the number of points, {count}"
            )
    if isinstance(estimator, PriorNeighbors):
        estimator = estimator._replace(prior=_checked_prior(estimator.prior))
        if estimator.prior.shape != (count,):
            raise InvalidValueError(f"prior of shape {estimator.prior.shape}: need ({count},)")
    rows = np.ones((1, count)) if weights is None else floats("weights", weights)
    single = rows.ndim == 1 or weights is None
    rows = rows.reshape(1, -1) if rows.ndim == 1 else rows
    if rows.ndim != 2 or rows.shape[1] != count:
        raise InvalidValueError(f"weights of shape {rows.shape}: need ({count},) or (b, {count})")
    if not np.isfinite(rows).all() or (rows < 0.0).any():
        row, bad = np.argwhere(~(np.isfinite(rows) & (rows >= 0.0)))[0]
        raise InvalidValueError(
            f"weight of point {bad} is {rows[row, bad]}: must be >= 0 and finite"
        )
    if not (rows > 0.0).any(axis=1).all():
        bad = int(np.argmin((rows > 0.0).any(axis=1)))
        raise InvalidValueError(f"weights[{bad}] are all zero: one must be positive")
    angles = [whole("circular", each, 0, array.shape[1] - 1) for each in circular]
    threads = whole("threads", threads, 0)
    array = unwrapped(array, angles) if angles else array
    if not isinstance(estimator, GaussianMixture) and estimator.resolution is None:
        shares = (rows / rows.sum(axis=1, keepdims=True)).sum(axis=0)
        if isinstance(estimator, PriorNeighbors):
            shares = estimator.prior
        estimator = estimator._replace(resolution=_own_resolution(array, shares))
    kernel = kernel_estimator(estimator, array.shape[1])
    array = scaled(array, kernel)
    result, _, _, _ = _kernel.entropies(
        array, rows, False, *kernel.parameters, threads, (1.0,), kernel.prior, False
    )
    if kernel.log_volume != 0.0:
        result = result + kernel.log_volume
    return float(result[0]) if single else result
