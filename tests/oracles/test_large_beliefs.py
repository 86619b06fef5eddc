"""Nearest neighbours of many points: blocks of leaves, and points that stand for several.

Up to 4,096 points the kernel takes the leaves of its tree one by one (test_entropy_reference.py),
beyond them in blocks. With more than 16,384 points the work on dense points can have a bound, where
neighbours share a term; only ``use_ball_work`` sets it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from tests.oracles.reference_entropy import nearest_neighbor_entropy
from tests.oracles.test_entropy_reference import TOLERANCE, Ways, draw_weights, find

from holdfast import _kernel
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.estimators import NearestNeighbor

COUNT = 4500


def draw_belief(kind: str, count: int, dimension: int) -> FloatArray:
    """Return points of about unit width, as beliefs are."""
    rng = np.random.default_rng([7, dimension])
    points = rng.normal(size=(count, dimension))
    if kind == "resampled":  # each some twenty times
        points = points[rng.integers(0, count // 20, size=count)]
    elif kind == "heavy tails":
        points /= np.sqrt(rng.exponential(size=(count, 1)))
    elif kind == "two clusters":
        points[: count // 2, 0] += 30.0
    elif kind == "line":
        points[:, 1:] = 0.0
    elif kind == "angles":  # a heading about the place where it wraps
        points[:, 0] = (points[:, 0] + np.pi) % (2.0 * np.pi) - np.pi
    return points


@pytest.fixture
def usual_work() -> Iterator[None]:
    usual = _kernel.use_ball_work(np.inf)
    yield
    _kernel.use_ball_work(usual)


@pytest.mark.parametrize("posteriors", [1, 9, 27])
@pytest.mark.parametrize(
    ("kind", "dimension", "resolution"),
    [
        ("spread", 3, 0.3),  # lists for some, balls for others
        ("resampled", 3, 2.0),
        ("heavy tails", 2, 1.0),
        ("two clusters", 6, 2.0),
        ("line", 3, 0.5),
        ("angles", 1, 0.1),
    ],
)
def test_blocks_against_the_reference(
    kind: str, dimension: int, resolution: float, posteriors: int
) -> None:
    points = draw_belief(kind, COUNT, dimension)
    rng = np.random.default_rng([8, posteriors])
    weights = draw_weights(rng, "similar", posteriors, COUNT, COUNT - 200)
    found = find(points, weights, NearestNeighbor(5, resolution))
    assert found.ways == (Ways(own_tree=1) if posteriors == 1 else Ways(grouped=posteriors))
    expected = nearest_neighbor_entropy(points, weights[-1], 5, resolution)
    assert abs(found.entropies[-1] - expected) <= TOLERANCE


@pytest.mark.parametrize("kind", ["spread", "heavy tails", "two clusters"])
def test_points_that_stand_for_several(kind: str, usual_work: None) -> None:
    """Less work, and entropies within a fiftieth of a nat. Up to 16,384 points all are exact."""
    points = draw_belief(kind, 20_000, 3)
    centres = np.random.default_rng(9).normal(size=(12, 1, 3))
    weights = np.exp(-0.5 * ((points - centres) ** 2 / [0.3, 0.5, 4.0]).sum(axis=2))
    for count in (20_000, 16_384):
        few, part = points[:count], weights[:, :count]
        _kernel.use_ball_work(np.inf)
        exact = find(few, part, NearestNeighbor(5, 1.0))
        _kernel.use_ball_work(2e7)
        found = find(few, part, NearestNeighbor(5, 1.0))
        error = np.abs(found.entropies - exact.entropies).max()
        assert found.ways == exact.ways
        if count == 20_000:
            assert 0.0 < error < 0.02
            assert found.visits < exact.visits
        else:
            assert error == 0.0


@pytest.mark.parametrize("work", [np.inf, 1e6])
def test_threads_change_no_bit(work: float, usual_work: None) -> None:
    count = 20_000
    points = draw_belief("spread", 2 * count, 3)
    weights = np.abs(np.random.default_rng(10).normal(size=(9, count)))
    weights[7:, count // 3 :] = 0.0  # a tree of their own
    weights[8, 5000:] = 0.0
    before = _kernel.use_threads_from(0.0)
    _kernel.use_ball_work(work)
    try:
        results = {
            _kernel.entropies(
                points, weights, False, 0, 5, 0.3, 0.0, 0.0, threads, (1.0, 0.5), np.empty(0)
            )[0].tobytes()
            for threads in (1, 2, 3, 64)
        }
    finally:
        _kernel.use_threads_from(before)
    assert len(results) == 1
