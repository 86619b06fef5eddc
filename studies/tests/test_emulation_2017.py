"""The entropies of 2017, against their formula written out, and what won without a number."""

import math

import numpy as np
import pytest
from scipy import special

from studies.emulation_2017 import _neighborhoods, entropy_of_neighborhoods, least_of


def literal_entropy(points: np.ndarray, weights: np.ndarray, k: int) -> float:
    """Return the estimate for one set of weighted points, term by term."""
    size = points.shape[1]
    ball = math.pi ** (size / 2) / special.gamma(size / 2 + 1)
    entropy = math.log(k) - float(special.digamma(k))
    for point in points:
        distances = np.linalg.norm(points - point, axis=1)
        nearest = np.argsort(distances, kind="stable")[:k]
        mass = float(weights[nearest].sum())
        if mass <= 1e-16:
            continue
        radius = float(distances[nearest[-1]])
        if radius == 0.0:
            return -math.inf
        entropy -= mass / k * math.log(mass / (ball * radius**size))
    return entropy


@pytest.mark.parametrize("size", [1, 2, 3])
def test_the_formula(size: int) -> None:
    generator = np.random.default_rng(size)
    points = generator.normal(size=(4, 30, size))
    weights = generator.random((4, 5, 30)) ** 20
    weights /= weights.sum(axis=-1, keepdims=True)
    weights[:, 0, 1:], weights[:, 0, 0] = 0.0, 1.0
    found = entropy_of_neighborhoods(weights, *_neighborhoods(points, 5))
    expected = [
        [literal_entropy(each, row, 5) for row in rows]
        for each, rows in zip(points, weights, strict=True)
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-10)


def test_equal_points_make_it_minus_infinity() -> None:
    points = np.random.default_rng(0).normal(size=(1, 20, 3))
    points[0, :5] = points[0, 0]
    found = entropy_of_neighborhoods(np.full((1, 1, 20), 0.05), *_neighborhoods(points, 5))
    assert found == -np.inf


def test_what_wins() -> None:
    nothing, least = np.nan, -np.inf
    entropies = np.array(
        [
            [2.0, 1.0, 3.0],
            [2.0, least, least],
            [nothing, 5.0, 6.0],
            [least, least, least],
            [nothing, nothing, nothing],
            [least, nothing, least],
        ]
    )
    drawn = np.array([0.9, 0.9, 0.9, 0.0, 0.5, 0.99])
    np.testing.assert_array_equal(least_of(entropies, drawn), [1, 1, 1, 0, 1, 2])
