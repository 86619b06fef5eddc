"""Nearest neighbours of many points, where the kernel takes the leaves of its tree in blocks.

It does so in trees of more than 16,384 points. A belief of as many particles or fewer has no such
tree, so its decisions keep the bits that they had before there were blocks. What small trees give
in blocks test_entropy_reference.py compares with the reference.
"""

from collections.abc import Iterator

import numpy as np
import pytest
from tests.oracles import test_entropy_reference as small
from tests.oracles.test_entropy_reference import BLOCKS_BEYOND as LIMIT
from tests.oracles.test_entropy_reference import TOLERANCE, draw_weights, find

from holdfast import _kernel
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.estimators import NearestNeighbor


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
def usual_limit() -> Iterator[None]:
    assert _kernel.use_blocks_beyond(LIMIT) == LIMIT
    yield
    _kernel.use_blocks_beyond(LIMIT)


@pytest.mark.parametrize("posteriors", [1, 9, 17, 27])
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
    """Twelve blocks of 256 points, the last of them not full."""
    count = 2900
    points = draw_belief(kind, count, dimension)
    rng = np.random.default_rng([8, posteriors])
    weights = draw_weights(rng, "similar", posteriors, count, count - 200)
    small.assert_found(points, weights, 5, resolution, small.by_trees(posteriors), -1)


@pytest.mark.parametrize("posteriors", [1, 9])
def test_more_points_than_short_counts_hold(posteriors: int, usual_limit: None) -> None:
    """Counts have 16 bits until they are added up. Some balls of a leaf hold 65,546 copies of a
    point, in leaves that are taken one by one since other balls of the same leaf hold none."""
    points = np.concatenate([np.linspace(0.0, 0.5, 16), np.full(2**16 + 10, 1.2)]).reshape(-1, 1)
    weights = np.random.default_rng(11).uniform(0.5, 1.0, size=(posteriors, len(points)))
    weights[:, :16] *= 1e4
    found = find(points, weights, NearestNeighbor(5, 1.0))
    _kernel.use_blocks_beyond(len(points))
    expected = find(points, weights, NearestNeighbor(5, 1.0))
    assert np.abs(found.entropies - expected.entropies).max() <= TOLERANCE


@pytest.mark.parametrize("posteriors", [1, 9])
def test_blocks_begin_beyond_the_limit(posteriors: int, usual_limit: None) -> None:
    """Up to it every bit is that of leaf by leaf; beyond it some of nearest neighbours differ."""
    points = draw_belief("spread", LIMIT + 1, 3)
    weights = draw_weights(np.random.default_rng(12), "similar", posteriors, LIMIT + 1, LIMIT + 1)
    for count in (LIMIT, LIMIT + 1):
        few, part = points[:count], weights[:, :count]
        usual = find(few, part, NearestNeighbor(5, 0.3))
        _kernel.use_blocks_beyond(count)
        by_leaves = find(few, part, NearestNeighbor(5, 0.3))
        _kernel.use_blocks_beyond(LIMIT)
        assert np.allclose(usual.entropies, by_leaves.entropies, rtol=0.0, atol=TOLERANCE)
        same = usual.entropies.tobytes() == by_leaves.entropies.tobytes()
        assert same == (count == LIMIT)


def test_threads_change_no_bit() -> None:
    count = 5000
    points = draw_belief("spread", 2 * count, 3)
    weights = np.abs(np.random.default_rng(10).normal(size=(9, count)))
    weights[7:, count // 3 :] = 0.0  # a tree of their own
    weights[8, count // 10 :] = 0.0
    before = _kernel.use_threads_from(0.0)
    try:
        with small.in_blocks():
            results = {
                _kernel.entropies(
                    points, weights, False, 0, 5, 0.3, 0.0, 0.0, threads, (1.0, 0.5), np.empty(0)
                )[0].tobytes()
                for threads in (1, 2, 3, 64)
            }
    finally:
        _kernel.use_threads_from(before)
    assert len(results) == 1
