"""The estimate with the prior's neighbourhoods: against a plain one, and what it is there for.

The kernel takes the prior and its posteriors eight at a time, points in blocks of 32, and from 129
points on those that are equal together; the counts lie around these.
"""

import math

import numpy as np
import pytest
from tests.oracles.reference_entropy import prior_neighbors_entropy
from tests.oracles.test_entropy_reference import draw_points, draw_weights

from holdfast.errors import InvalidValueError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.estimators import NearestNeighbor, PriorNeighbors, entropy

TOLERANCE = 1e-9


def posteriors_of(rng: np.random.Generator, prior: FloatArray, number: int) -> FloatArray:
    """Return rows of weights, some of them of a few points."""
    rows = prior * np.exp(-rng.uniform(0.1, 20.0, size=(number, 1)) * rng.random(prior.shape))
    rows[0] = 0.0
    rows[0, int(np.flatnonzero(prior)[0])] = 1.0
    return np.asarray(rows / rows.sum(axis=1, keepdims=True))


@pytest.mark.parametrize("points", ["spread", "grid", "line", "half at rest", "one place"])
@pytest.mark.parametrize("weights", ["equal", "spread", "orders of magnitude"])
@pytest.mark.parametrize(
    ("count", "dimension", "number", "neighbors", "resolution"),
    [
        (2, 1, 1, 1, 1e-3),
        (15, 2, 7, 5, 0.1),
        (16, 3, 8, 15, 1e-6),
        (17, 6, 9, 5, 0.5),
        (100, 3, 30, 5, 0.1),
        (130, 2, 17, 40, 10.0),
        (180, 2, 17, 5, 0.1),
        (65, 1, 40, 9, 1e-2),
    ],
)
def test_reference(
    points: str,
    weights: str,
    count: int,
    dimension: int,
    number: int,
    neighbors: int,
    resolution: float,
) -> None:
    rng = np.random.default_rng([count, number])
    places = draw_points(rng, points, count, dimension)
    kept = max(2, 3 * count // 4)
    prior = draw_weights(rng, weights, 1, count, kept)[0]
    prior /= prior.sum()
    rows = posteriors_of(rng, prior, number)
    found = entropy(places, rows, PriorNeighbors(prior, neighbors, resolution))
    expected = [prior_neighbors_entropy(places, row, prior, neighbors, resolution) for row in rows]
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=TOLERANCE)


@pytest.mark.parametrize("kind", ["spread", "grid", "half at rest"])
def test_the_prior_itself_has_the_nearest_neighbour_entropy(kind: str) -> None:
    points = draw_points(np.random.default_rng(1), kind, 200, 3)
    prior = np.full(200, 1.0 / 200)
    found = entropy(points, prior, PriorNeighbors(prior, 5, 0.1))
    assert found == pytest.approx(entropy(points, prior, NearestNeighbor(5, 0.1)), abs=TOLERANCE)


def test_a_single_particle_is_known_to_within_the_resolution() -> None:
    for prior in ([1.0], [0.0, 1.0, 0.0]):
        points = np.arange(2.0 * len(prior)).reshape(-1, 2)
        found = entropy(points, prior, PriorNeighbors(np.array(prior), 1, 0.1))
        assert found == pytest.approx(math.log(math.pi * 0.1**2), abs=TOLERANCE)


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        (np.full(4097, 1.0 / 4097), r"prior of shape \(4097,\): .* 1 to 4096"),
        (np.full(9, 1.0 / 9), r"prior of shape \(9,\): need \(10,\)"),
        (np.full(10, 0.2), "their sum 1"),
        (np.array([-0.1, 1.1, *[0.0] * 8]), "must not be negative"),
        (np.full(10, np.nan), "must not be negative"),
    ],
)
def test_refused_priors(prior: FloatArray, message: str) -> None:
    points = np.random.default_rng(3).normal(size=(10, 2))
    with pytest.raises(InvalidValueError, match=message):
        entropy(points, None, PriorNeighbors(prior))
