"""Sensing actions that another one makes superfluous.

An observation that can be made of another one, by a scale, a shift and more noise, is worth no more
than that one, whatever has to be decided (Blackwell, "Equivalent comparisons of experiments",
Annals of Mathematical Statistics 24, 1953; for means that depend linearly on the unknown, Hansen
and Torgersen, "Comparison of linear normal experiments", Annals of Statistics 2, 1974). Entropies
estimated from few particles do not know it: below the distance of neighbours they see nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from holdfast.numerics.arrays import BoolArray, FloatArray

_ROUNDING = 1e-9
"""Relative differences below which means, or variances, are the same."""


def dominated(
    sizes: Sequence[int], means: FloatArray, variances: FloatArray, prices: FloatArray
) -> BoolArray:
    """Return which of J sensing actions another one dominates that is no dearer, shape (J,).

    Each coordinate of the worse observation is one of the better one, in all particles scaled and
    shifted alike, with noise added; they are fewer, or noisier. ``sizes``, ``means`` and
    ``variances`` are what :func:`holdfast.problems.checked.predictions` returns.
    """
    # Three particles rule out nearly all pairs.
    first = means[:, 0]
    one, two = means[:, means.shape[1] // 2] - first, means[:, -1] - first
    products = one[:, np.newaxis] * two
    size = np.abs(products)
    matches = np.abs(products - products.T) <= 1e-6 * (size + size.T)
    if np.count_nonzero(matches) == len(means):  # each only itself
        return np.zeros(len(sizes), dtype=bool)
    rows = [range(end - size, end) for end, size in zip(np.cumsum(sizes), sizes, strict=True)]

    def makes(better: int, worse: int) -> bool:
        left, noisier = list(rows[better]), False
        for row in rows[worse]:
            for own in left:
                pair = [own, row]
                added = _added_variance(means[pair], variances[pair]) if matches[own, row] else -1.0
                if added >= 0.0:
                    left.remove(own)
                    noisier |= added > 0.0
                    break
            else:
                return False
        return noisier or bool(left)

    every = range(len(sizes))
    no_dearer = [[j for j in every if j != i and prices[j] <= prices[i]] for i in every]
    return np.array([any(makes(j, i) for j in no_dearer[i]) for i in every])


def _added_variance(means: FloatArray, variances: FloatArray) -> float:
    """Return the variance of the noise that makes the second of the first; -1 if none does."""
    better, worse = means - means[:, :1]
    farthest = int(np.abs(better).argmax())
    # What is the same in all particles tells nothing, and is left to the estimate.
    if better[farthest] == 0.0 or not worse.any():
        return -1.0
    slope = worse[farthest] / better[farthest]
    added = variances[1] - slope * slope * variances[0]
    tolerance = _ROUNDING * variances[1].min()
    alike = (np.abs(worse - slope * better) <= _ROUNDING * np.abs(worse).max()).all()
    if not alike or added.min() < -tolerance or np.ptp(added) > tolerance:
        return -1.0
    return float(added.min()) if added.min() > tolerance else 0.0
