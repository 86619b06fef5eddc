"""The kernel's entropies against the same estimates written for reading.

The kernel has several ways to an entropy and chooses by counts alone (cpp/src/entropy.cpp). Each
is driven here on purpose, across dimensions, numbers of neighbours, ties, weights of zero and
weights of very different sizes. Both sides are sums of a few thousand terms of about ten nats, each
known to a few units in 1e16, so 1e-9 is generous for rounding and small for any mistake.
"""

from __future__ import annotations

import numpy as np
import pytest
from tests.oracles.reference_entropy import (
    gaussian_mixture_entropy,
    nearest_neighbor_entropy,
    significant,
)

from holdfast.entropy import GaussianMixture, NearestNeighbor, entropy
from holdfast.problems.problem import FloatArray

TOLERANCE = 1e-9


def draw_points(rng: np.random.Generator, kind: str, count: int, dimension: int) -> FloatArray:
    """Return points as policies make them: spread out, tied, on a line, at one place."""
    points = rng.normal(size=(count, dimension))
    if kind == "grid":  # ties of points and of distances
        points = np.round(points, 1)
    elif kind == "line":
        points[:, 1:] = 0.0
    elif kind == "half at rest":
        points[rng.random(count) < 0.5] = 0.0
    elif kind == "clusters":  # far from each other next to their size
        points = 1e-3 * points + rng.integers(0, 3, size=(count, 1)) * 10.0
    elif kind == "one place":
        points[:] = points[0]
    return points


def draw_weights(
    rng: np.random.Generator, kind: str, posteriors: int, count: int, survivors: int
) -> FloatArray:
    """Return rows of weights of which ``survivors`` are not zero."""
    if kind == "equal":
        weights = np.ones((posteriors, count))
    elif kind == "spread":
        weights = rng.exponential(size=(posteriors, count))
    else:  # over many orders of magnitude, some negligible
        weights = 10.0 ** rng.uniform(-9.0, 0.0, size=(posteriors, count))
    for row in weights:
        row[rng.permutation(count)[survivors:]] = 0.0
    return weights


def assert_matches(
    points: FloatArray,
    weights: FloatArray,
    neighbors: int,
    resolution: float,
    rows: list[int] | None = None,
) -> None:
    found = entropy(points, weights, NearestNeighbor(neighbors, resolution))
    assert isinstance(found, np.ndarray)
    assert found.shape == (len(weights),)
    for row in range(len(weights)) if rows is None else rows:
        expected = nearest_neighbor_entropy(points, weights[row], neighbors, resolution)
        assert abs(found[row] - expected) <= TOLERANCE, f"row {row}"


# name: points, survivors of each posterior, posteriors. The name says which way it drives.
WAYS = {
    "pair by pair, two": (10, 2, 2),
    "pair by pair, no more than k": (30, 5, 3),
    "pair by pair, 16 of 16": (16, 16, 1),
    "pair by pair, 33 of 100": (100, 33, 1),
    "pair by pair, 64 of 2000": (2000, 64, 2),
    "grouped, 17 of 100 under many": (100, 17, 120),
    "grouped, 64 of 64 under many": (64, 64, 32),
    "grouped, one vector": (100, 90, 7),
    "grouped, two vectors": (65, 65, 9),
    "grouped, three vectors": (200, 120, 24),
    "grouped, four vectors": (100, 80, 25),
    "grouped, two groups": (100, 70, 33),
    "grouped, few of the near points count": (1000, 70, 3),
    "grouped, many leaves": (1400, 1300, 2),
    "grouped, a quarter of many": (1200, 300, 2),
    "own tree": (2000, 200, 2),
    "own tree, just above pair by pair": (1100, 65, 3),
}


@pytest.mark.parametrize("dimension", [1, 2, 3, 6])
@pytest.mark.parametrize("way", WAYS)
def test_every_way(way: str, dimension: int) -> None:
    """Each with sparse and with dense points next to the resolution, and in between."""
    count, survivors, posteriors = WAYS[way]
    rng = np.random.default_rng([count, survivors, posteriors, dimension])
    for kind, resolution in (("spread", 1e-3), ("clusters", 0.3), ("grid", 0.5), ("spread", 3.0)):
        points = draw_points(rng, kind, count, dimension)
        weights = draw_weights(rng, "spread", posteriors, count, survivors)
        some = rng.choice(posteriors, size=min(posteriors, 2), replace=False)
        assert_matches(points, weights, 5, resolution, sorted(some.tolist()))


@pytest.mark.parametrize("neighbors", [1, 5, 12, 30])
@pytest.mark.parametrize(
    "kind", ["spread", "grid", "line", "half at rest", "clusters", "one place"]
)
def test_ties_and_numbers_of_neighbours(kind: str, neighbors: int) -> None:
    rng = np.random.default_rng([neighbors, len(kind)])
    for count, survivors, posteriors in ((33, 33, 1), (100, 85, 9), (300, 290, 3), (1300, 250, 1)):
        for dimension, resolution in ((1, 0.01), (2, 0.1), (3, 1.0), (4, 1e-6), (5, 0.5)):
            points = draw_points(rng, kind, count, dimension)
            weights = draw_weights(rng, "spread", posteriors, count, survivors)
            assert_matches(points, weights, neighbors, resolution, [posteriors - 1])


@pytest.mark.parametrize("weighting", ["equal", "spread", "extreme"])
@pytest.mark.parametrize("count", [6, 20, 65, 100, 500])
def test_weights(count: int, weighting: str) -> None:
    rng = np.random.default_rng([count, len(weighting)])
    points = draw_points(rng, "spread", count, 3)
    for survivors in {1, 2, count // 2, count}:
        weights = draw_weights(rng, weighting, 5, count, survivors)
        for neighbors in (1, min(12, count - 1)):
            assert_matches(points, weights, neighbors, 0.05)


@pytest.mark.parametrize("count", [20, 100, 600])
def test_one_point_has_nearly_all_the_weight(count: int) -> None:
    """The others share so little that their share of the rest must not be lost in rounding."""
    rng = np.random.default_rng(count)
    points = draw_points(rng, "spread", count, 2)
    for small in (1.0, 0.02, 5e-3, 3e-4, 2e-5, 3e-6):
        weights = np.full((3, count), small)
        weights[:, 0] = 1.0
        for resolution in (1e-3, 10.0):
            assert_matches(points, weights, 5, resolution)


@pytest.mark.parametrize(
    ("count", "small", "negligible"),
    [(1000, 5e-4, True), (1000, 6e-4, False), (1000, 1e-7, True), (20_000, 8e-7, True)],
)
def test_negligible_points_are_left_out(count: int, small: float, negligible: bool) -> None:
    """What is left out is at most 0.5 % of the weight, or below a millionth of the greatest.

    A tenth of the points has weight 1, so the others have 9 ``small`` of their sum together.
    """
    rng = np.random.default_rng(3)
    points = rng.normal(size=(count, 2))
    heavy = np.arange(count) % 10 == 0
    weights = np.where(heavy, 1.0, small)
    assert (significant(weights) == heavy).all() == negligible
    for estimator in (NearestNeighbor(5, 0.01), GaussianMixture(np.array([0.01, 0.02]))):
        alone = entropy(points[heavy], np.ones((1, count // 10)), estimator)
        together = entropy(points, weights.reshape(1, -1), estimator)
        assert np.allclose(alone, together, rtol=0.0, atol=TOLERANCE) == negligible
    if count <= 1000:
        assert_matches(points, weights.reshape(1, -1), 5, 0.01)


def test_more_posteriors_than_one_batch() -> None:
    """Weights are taken in batches of 64 MB: rows of the first, at the border and of the last."""
    count = 4000
    batch = 8 * 2**20 // count
    posteriors = batch + 40
    rng = np.random.default_rng(7)
    points = draw_points(rng, "spread", count, 2)
    weights = np.zeros((posteriors, count))
    for row in weights:
        row[rng.integers(0, count, size=60)] = rng.exponential(size=60)
    full = [0, batch - 1, batch, posteriors - 1]
    weights[full] = rng.exponential(size=(len(full), count))
    few = [1, batch - 2, batch + 1]
    assert_matches(points, weights, 5, 0.02, few + full)


@pytest.mark.parametrize("seed", range(12))
def test_anything(seed: int) -> None:
    """Twelve mixtures of all of the above, drawn at random."""
    rng = np.random.default_rng([99, seed])
    for _ in range(5):
        count = int(rng.choice([6, 17, 40, 64, 65, 100, 257, 1030, 1500]))
        dimension = int(rng.integers(1, 7))
        kind = str(rng.choice(["spread", "grid", "line", "half at rest", "clusters"]))
        points = draw_points(rng, kind, count, dimension) * 10.0 ** rng.integers(-3, 4)
        posteriors = int(rng.choice([1, 3, 9, 30, 33]))
        weights = np.concatenate(
            [
                draw_weights(
                    rng,
                    str(rng.choice(["equal", "spread", "extreme"])),
                    1,
                    count,
                    int(rng.integers(1, count + 1)),
                )
                for _ in range(posteriors)
            ]
        )
        neighbors = int(rng.choice([1, 3, 5, 12, 30]))
        resolution = float(10.0 ** rng.uniform(-4.0, 1.0))
        rows = rng.choice(posteriors, size=min(posteriors, 3), replace=False).tolist()
        assert_matches(points, weights, min(neighbors, count - 1), resolution, rows)


MIXTURES = {
    "pair by pair": (40, 40, 1),
    "grouped": (100, 90, 9),
    "grouped, four vectors": (300, 300, 32),
    "grouped, many leaves": (1100, 1100, 1),
    "own tree": (1100, 200, 1),
}


@pytest.mark.parametrize("upper", [True, False])
@pytest.mark.parametrize("dimension", [1, 2, 3, 6])
@pytest.mark.parametrize("way", MIXTURES)
def test_gaussian_mixture(way: str, dimension: int, upper: bool) -> None:
    """Narrow components, which do not reach each other, wide ones, and both."""
    count, survivors, posteriors = MIXTURES[way]
    rng = np.random.default_rng([count, survivors, dimension])
    for kind in ("spread", "grid", "clusters"):
        for deviation in (0.01, 0.3, 5.0):
            points = draw_points(rng, kind, count, dimension)
            weights = draw_weights(rng, "spread", posteriors, count, survivors)
            variance = deviation**2 * rng.uniform(0.5, 2.0, size=dimension)
            found = entropy(points, weights, GaussianMixture(variance, upper))
            assert isinstance(found, np.ndarray)
            expected = gaussian_mixture_entropy(points, weights[-1], variance, upper)
            assert abs(found[-1] - expected) <= TOLERANCE
