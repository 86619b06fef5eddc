"""Nearest neighbours of many points: leaves of the tree in blocks, and terms of a sample.

The kernel begins with that beyond 16,384 points. A belief of as many particles or fewer keeps the
bits that its decisions had before. ``take_as_few_up_to`` lets few points be taken as many,
and test_entropy_reference.py compares small trees in blocks with the reference.
"""

import itertools
from collections.abc import Iterator

import numpy as np
import pytest
from tests.oracles import test_entropy_reference as small
from tests.oracles.test_entropy_reference import FEW_UP_TO as LIMIT
from tests.oracles.test_entropy_reference import TOLERANCE, draw_weights, find

from holdfast import _kernel
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.estimators import GaussianMixture, NearestNeighbor, entropy


def draw_belief(kind: str, count: int, dimension: int) -> FloatArray:
    """Return points of about unit width."""
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
def in_blocks() -> Iterator[None]:
    with small.in_blocks():
        yield


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
def test_more_points_than_short_counts_hold(posteriors: int, in_blocks: None) -> None:
    """Counts have 16 bits until they are added up. Some balls of a leaf hold 65,546 copies of a
    point, in leaves that are taken one by one since other balls of the same leaf hold none."""
    points = np.concatenate([np.linspace(0.0, 0.5, 16), np.full(2**16 + 10, 1.2)]).reshape(-1, 1)
    weights = np.random.default_rng(11).uniform(0.5, 1.0, size=(posteriors, len(points)))
    weights[:, :16] *= 1e4
    found = find(points, weights, NearestNeighbor(5, 1.0))
    _kernel.take_as_few_up_to(len(points))
    expected = find(points, weights, NearestNeighbor(5, 1.0))
    assert np.abs(found.entropies - expected.entropies).max() <= TOLERANCE


def posteriors_of(points: FloatArray, kind: str, seed: int) -> FloatArray:
    """Return 12 Gaussian likelihoods of a first coordinate, observed at points drawn at random."""
    rng = np.random.default_rng([13, seed])
    deviation = {"alike": 3.0, "different": 0.5, "few points each": 0.04}[kind]
    seen = points[rng.integers(0, len(points), size=(12, 1)), 0]
    return np.asarray(np.exp(-0.5 * ((points[:, 0] - seen) / deviation) ** 2))


@pytest.mark.parametrize("kind", ["alike", "different", "few points each"])
@pytest.mark.parametrize(
    ("dimension", "estimator"),
    [*itertools.product([1, 2, 3, 6], ["lists", "lists and balls", "balls"]), (2, "mixture")],
)
def test_a_sample_is_right_within_its_error(
    dimension: int, estimator: str, kind: str, in_blocks: None
) -> None:
    """At least 128 points stand for a posterior. Their terms, of density, have a standard deviation
    of the root of d/2 for a Gaussian, and a little more as neighbours are few."""
    resolution = {"lists": 1e-4, "lists and balls": 0.1 * dimension, "balls": 0.6 * dimension}
    errors = []
    # Of fewer points those near each other would be too few for a sample.
    count = 1 + (LIMIT if kind == "few points each" else 6000)
    _kernel.take_as_few_up_to(count - 1)
    for seed in range(3):
        points = np.random.default_rng([14, dimension, seed]).normal(size=(count, dimension))
        weights = posteriors_of(points, kind, seed)
        way: NearestNeighbor | GaussianMixture = NearestNeighbor(5, resolution.get(estimator, 1.0))
        if estimator == "mixture":
            way = GaussianMixture(np.full(dimension, 0.05))
        exact, sampled = (find(points, weights, way, sampled=each) for each in (False, True))
        errors.append(sampled.entropies - exact.entropies)
    error = np.sqrt((0.5 * dimension + 0.25) / 128.0)
    assert 0.0 < np.sqrt(np.square(errors).mean()) < error > 0.25 * np.abs(errors).max()
    assert abs(np.mean(errors)) < 2.0 * error / np.sqrt(3.0)


def test_up_to_the_limit_and_for_users_all_terms_are_added() -> None:
    points = draw_belief("spread", LIMIT + 1, 2)
    weights = posteriors_of(points, "alike", 0)
    way = NearestNeighbor(5, 0.3)
    few = [find(points[1:], weights[:, 1:], way, sampled=each).entropies for each in (False, True)]
    assert np.array_equal(few[0], few[1])
    assert np.array_equal(entropy(points, weights, way), find(points, weights, way).entropies)


@pytest.mark.parametrize("posteriors", [1, 9])
def test_blocks_begin_beyond_the_limit(posteriors: int) -> None:
    """Up to it every bit is that of leaf by leaf; beyond it some of nearest neighbours differ."""
    points = draw_belief("spread", LIMIT + 1, 3)
    weights = draw_weights(np.random.default_rng(12), "similar", posteriors, LIMIT + 1, LIMIT + 1)
    for count in (LIMIT, LIMIT + 1):
        belief = (points[:count], weights[:, :count], NearestNeighbor(5, 0.3))
        usual = find(*belief).entropies
        _kernel.take_as_few_up_to(count)
        by_leaves = find(*belief).entropies
        _kernel.take_as_few_up_to(LIMIT)
        assert np.allclose(usual, by_leaves, rtol=0.0, atol=TOLERANCE)
        assert (usual.tobytes() == by_leaves.tobytes()) == (count == LIMIT)


def test_a_sample_bounds_the_work() -> None:
    """With twice the points, each of them dense, a sample is not asked of twice as many."""
    visits = []
    for count in (20_000, 40_000):
        points = np.random.default_rng(15).normal(size=(count, 2))
        weights = posteriors_of(points, "alike", 0)
        way = NearestNeighbor(5, 0.3)
        exact, sampled = (find(points, weights, way, each).visits for each in (False, True))
        visits.append((exact, sampled))
        assert sampled < 0.3 * exact
    assert visits[1][1] / visits[0][1] < 0.8 * visits[1][0] / visits[0][0]


@pytest.mark.parametrize("sampled", [False, True])
def test_threads_change_no_bit(sampled: bool, in_blocks: None) -> None:
    count = 11_000
    points = draw_belief("spread", 2 * count, 3)
    weights = np.abs(np.random.default_rng(10).normal(size=(9, count)))
    weights[7:, count // 3 :] = 0.0  # a tree of their own
    weights[8, count // 10 :] = 0.0
    arguments = (points, weights, False, 0, 5, 0.3, 0.0, 0.0)
    before = _kernel.use_threads_from(0.0)
    try:
        results = {
            _kernel.entropies(*arguments, threads, (1.0, 0.5), np.empty(0), sampled)[0].tobytes()
            for threads in (1, 2, 3, 64)
        }
    finally:
        _kernel.use_threads_from(before)
    assert len(results) == 1
