"""The kernel's entropies against the same estimates written for reading.

The kernel has several ways to an entropy and chooses by counts alone (cpp/src/entropy.cpp). Each
is driven here on purpose, and the kernel's own count of the ways shows that it was taken, across
dimensions, numbers of neighbours, ties, weights of zero and weights of very different sizes. Trees
of more than 16,384 points are taken in blocks of leaves, whose arithmetic differs; the kernel is
asked to do so with these small ones as well. Both sides are sums of a few thousand terms of about
ten nats, each known to a few units in 1e16, so 1e-9 is generous for rounding and small for any
mistake.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
import pytest
from tests.oracles.reference_entropy import (
    gaussian_mixture_entropy,
    nearest_neighbor_entropy,
    significant,
)

from holdfast import _kernel
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.estimators import GaussianMixture, NearestNeighbor, entropy, kernel_estimator

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
    elif kind == "similar":  # none of them negligible
        weights = 0.2 + rng.exponential(size=(posteriors, count))
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


class Ways(NamedTuple):
    """How many posteriors went each way; those with a single point go none."""

    pair_by_pair: int = 0
    own_tree: int = 0
    grouped: int = 0


class Found(NamedTuple):
    """What the kernel tells."""

    entropies: FloatArray
    visits: int
    ways: Ways


def find(
    points: FloatArray,
    weights: FloatArray,
    estimator: NearestNeighbor | GaussianMixture,
    sampled: bool = False,
) -> Found:
    """Return what :func:`holdfast.planning.estimators.entropy` returns, with the ways to it."""
    kernel = kernel_estimator(estimator, points.shape[1])
    result, _, visits, ways = _kernel.entropies(
        points if kernel.scale is None else points * kernel.scale,
        weights,
        False,
        *kernel.parameters,
        1,
        (1.0,),
        kernel.prior,
        sampled,
    )
    return Found(result, visits, Ways(*ways))


FEW_UP_TO = 16_384
"""Points up to which all terms are added, leaf by leaf."""


@contextmanager
def in_blocks() -> Iterator[None]:
    """Let trees of any size be taken in blocks."""
    assert _kernel.take_as_few_up_to(0) == FEW_UP_TO == _kernel.few_up_to
    try:
        yield
    finally:
        _kernel.take_as_few_up_to(FEW_UP_TO)


def by_trees(posteriors: int) -> Ways:
    """Return the way of posteriors of many points: one has a tree of its own, others share one."""
    return Ways(own_tree=1) if posteriors == 1 else Ways(grouped=posteriors)


def assert_found(
    points: FloatArray,
    weights: FloatArray,
    neighbors: int,
    resolution: float,
    ways: Ways,
    *rows: int,
) -> Found:
    """Assert that the kernel took these ways, and what it has found for some posteriors, leaf by
    leaf and in blocks; return what it has found leaf by leaf.
    """
    estimator = NearestNeighbor(neighbors, resolution)
    found = find(points, weights, estimator)
    with in_blocks():
        blocks = find(points, weights, estimator)
    assert found.ways == blocks.ways == ways
    for row in rows:
        expected = nearest_neighbor_entropy(points, weights[row], neighbors, resolution)
        assert abs(found.entropies[row] - expected) <= TOLERANCE, f"row {row}"
        assert abs(blocks.entropies[row] - expected) <= TOLERANCE, f"row {row}, in blocks"
    return found


class Case(NamedTuple):
    """Posteriors over the same points, all with as many survivors."""

    points: int
    survivors: int
    posteriors: int
    way: str

    def expected_ways(self) -> Ways:
        return Ways()._replace(**{self.way: self.posteriors})


# Posteriors of 25 points and more are grouped if there are enough of them: groups have up to 32,
# eight to a vector. Where the points are fewer than the share of a group, each gets its own tree.
WAYS = {
    "pair by pair, two": Case(10, 2, 2, "pair_by_pair"),
    "pair by pair, no more than k": Case(30, 5, 3, "pair_by_pair"),
    "pair by pair, a single full vector": Case(8, 8, 1, "pair_by_pair"),
    "pair by pair, the most": Case(24, 24, 5, "pair_by_pair"),
    "pair by pair, the most of many": Case(500, 24, 40, "pair_by_pair"),
    "own tree, the fewest": Case(25, 25, 1, "own_tree"),
    "own tree, the fewest of many": Case(1000, 25, 3, "own_tree"),
    "own tree, alone": Case(300, 300, 1, "own_tree"),
    "own tree, too few to share": Case(800, 64, 40, "own_tree"),
    "own tree, more points than candidates": Case(1400, 1300, 1, "own_tree"),
    "own tree, two of most points": Case(1100, 1080, 2, "own_tree"),
    "grouped, the fewest points": Case(26, 26, 32, "grouped"),
    "grouped, one vector, three": Case(500, 500, 3, "grouped"),
    "grouped, one vector, full": Case(300, 290, 8, "grouped"),
    "grouped, two vectors, nine": Case(300, 270, 9, "grouped"),
    "grouped, two vectors, full": Case(400, 240, 16, "grouped"),
    "grouped, three vectors, seventeen": Case(600, 320, 17, "grouped"),
    "grouped, three vectors, full": Case(300, 165, 24, "grouped"),
    "grouped, four vectors, twenty-five": Case(500, 200, 25, "grouped"),
    "grouped, four vectors, full": Case(320, 300, 32, "grouped"),
    "grouped, a third of the points": Case(1000, 330, 20, "grouped"),
    "grouped, more points than candidates": Case(1400, 470, 12, "grouped"),
    "grouped, a group of one": Case(300, 200, 33, "grouped"),
    "grouped, two groups": Case(300, 250, 45, "grouped"),
}

# For each dimension a kind of points and a resolution: sparse and dense next to it, and in between.
POINTS = {
    1: ("spread", 0.01),
    2: ("grid", 0.5),
    3: ("spread", 1e-9),
    4: ("clusters", 0.3),
    5: ("spread", 20.0),
    6: ("half at rest", 1e-9),
}


@pytest.mark.parametrize("neighbors", [1, 5, 8, 9, 12, 30])
@pytest.mark.parametrize("way", WAYS)
def test_every_way(way: str, neighbors: int) -> None:
    case = WAYS[way]
    rng = np.random.default_rng([*case[:3], neighbors])
    # Half of the dimensions with one number of neighbours, half with the next.
    for dimension in (1, 4, 5) if neighbors in (1, 8, 12) else (2, 3, 6):
        kind, resolution = POINTS[dimension]
        points = draw_points(rng, kind, case.points, dimension)
        weights = draw_weights(rng, "similar", case.posteriors, case.points, case.survivors)
        k = min(neighbors, case.points - 1)
        # One posterior of the first vector or of the last one.
        row = int(rng.choice([0, case.posteriors - 1]))
        assert_found(points, weights, k, resolution, case.expected_ways(), row)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize(
    "way",
    ["own tree, alone", "own tree, more points than candidates", "grouped, two vectors, full"],
)
def test_balls_and_lists(way: str, dimension: int) -> None:
    """Told apart by what is looked at.

    With all points nearer than the resolution, the ball of each leaf is the whole tree, which is
    looked at once. With none nearer, each point has a list, of the points of its leaf at least.
    """
    case = WAYS[way]
    rng = np.random.default_rng([5, dimension])
    points = draw_points(rng, "spread", case.points, dimension)
    weights = draw_weights(rng, "similar", case.posteriors, case.points, case.survivors)
    for resolution, least, most in (
        (1e3, 1, case.points // 8),
        (1e-9, 16 * case.survivors, np.inf),
    ):
        found = assert_found(points, weights, 5, resolution, case.expected_ways(), 0)
        assert least <= found.visits <= most


@pytest.mark.parametrize("posteriors", [1, 33])
def test_a_point_among_its_copies(posteriors: int) -> None:
    """A point's list holds itself among its copies, and points without weight among the others.

    All but the copies are far away from each other, so that the lists of their leaf are done early.
    Few arrangements of a leaf are critical, so there are many small cases.
    """
    for seed in range(300):
        rng = np.random.default_rng([4, seed])
        count = int(rng.integers(48, 130)) if posteriors == 1 else int(rng.integers(130, 200))
        points = rng.normal(size=(count, int(rng.integers(1, 4)))) * 1e3
        points[rng.permutation(count)[: int(rng.integers(2, 40))]] = 0.0
        survivors = count if posteriors == 1 else 2 * count // 3
        weights = draw_weights(rng, "similar", posteriors, count, survivors)
        neighbors = int(rng.choice([1, 2, 3, 9]))
        assert_found(points, weights, neighbors, 1e-3, by_trees(posteriors), -1)


@pytest.mark.parametrize("neighbors", [8, 9, 12, 30])
@pytest.mark.parametrize("dimension", [1, 2, 3, 6])
def test_lists_that_end_before_the_last_neighbour(neighbors: int, dimension: int) -> None:
    """Posteriors with a third of the points: of the nearest 64 only some 20 have weight."""
    rng = np.random.default_rng([6, dimension])
    points = draw_points(rng, "spread", 900, dimension)
    for posteriors, survivors in ((8, 330), (14, 300), (20, 290), (32, 280)):
        weights = draw_weights(rng, "similar", posteriors, 900, survivors)
        ways = Ways(grouped=posteriors)
        found = assert_found(points, weights, neighbors, 1e-9, ways, 0, posteriors - 1)
        if neighbors == 30:
            # The lists are as long as for 9 neighbours, so what is looked at beyond are searches:
            # at least a leaf of 16 points for a fifth of the terms.
            lists = find(points, weights, NearestNeighbor(9, 1e-9)).visits
            assert found.visits > lists + 3 * posteriors * survivors


@pytest.mark.parametrize(("posteriors", "survivors"), [(1, 2200), (12, 2000)])
@pytest.mark.parametrize("neighbors", [1, 5, 9])
def test_more_candidates_than_numbers(neighbors: int, posteriors: int, survivors: int) -> None:
    """In six dimensions each leaf is near to most others, and its lists have seen more points than
    there are numbers for them. Numbers are given anew then, so that nothing is searched: no pair of
    points is looked at twice."""
    rng = np.random.default_rng([9, neighbors])
    points = draw_points(rng, "spread", 2200, 6)
    weights = draw_weights(rng, "similar", posteriors, 2200, survivors)
    found = assert_found(points, weights, neighbors, 1e-9, by_trees(posteriors), -1)
    assert 1024 * 2200 < found.visits <= 2208**2


def test_all_ways_in_one_call() -> None:
    """Posteriors of every size, each in its own place of the result."""
    rng = np.random.default_rng(8)
    count = 400
    sizes = [1, 2, 24, 25, 30] + [390, 300, 200, 150] * 4 + [1, 40, 10]
    rng.shuffle(sizes)
    points = draw_points(rng, "grid", count, 3)
    weights = np.concatenate([draw_weights(rng, "similar", 1, count, size) for size in sizes])
    variance = np.full(3, 0.01)
    for estimator in (NearestNeighbor(5, 0.2), GaussianMixture(variance)):
        found = find(points, weights, estimator)
        assert found.ways == Ways(pair_by_pair=3, own_tree=3, grouped=16)
        for row in range(len(sizes)):
            expected = (
                nearest_neighbor_entropy(points, weights[row], 5, 0.2)
                if isinstance(estimator, NearestNeighbor)
                else gaussian_mixture_entropy(points, weights[row], variance, upper=True)
            )
            assert abs(found.entropies[row] - expected) <= TOLERANCE, f"{sizes[row]} points"


@pytest.mark.parametrize("neighbors", [1, 5, 8, 9, 12, 30])
@pytest.mark.parametrize(
    "kind", ["spread", "grid", "line", "half at rest", "clusters", "one place"]
)
def test_ties_and_numbers_of_neighbours(kind: str, neighbors: int) -> None:
    rng = np.random.default_rng([neighbors, len(kind)])
    for case in (
        Case(24, 20, 2, "pair_by_pair"),
        Case(33, 33, 1, "own_tree"),
        Case(1300, 150, 1, "own_tree"),
        Case(100, 85, 24, "grouped"),
        Case(300, 290, 8, "grouped"),
    ):
        k = min(neighbors, case.points - 1)
        for dimension, resolution in ((1, 0.01), (2, 0.1), (3, 1.0), (4, 1e-9), (5, 0.5)):
            points = draw_points(rng, kind, case.points, dimension)
            weights = draw_weights(rng, "similar", case.posteriors, case.points, case.survivors)
            assert_found(points, weights, k, resolution, case.expected_ways(), -1)


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
    count = 2000
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


@pytest.mark.parametrize("way", WAYS)
def test_gaussian_mixture(way: str) -> None:
    """Narrow components, which do not reach each other, wide ones, and both.

    Each way has each kind of points once, and half of the dimensions with one of the bounds; which
    come together changes from way to way.
    """
    case = WAYS[way]
    number = list(WAYS).index(way)
    upper = number % 2 == 0
    rng = np.random.default_rng([*case[:3], 2])
    kinds = (("spread", 0.3), ("grid", 5.0), ("clusters", 0.01))
    for place, dimension in enumerate((1, 2, 6) if upper else (3, 4, 5)):
        kind, deviation = kinds[(place + number) % 3]
        points = draw_points(rng, kind, case.points, dimension)
        weights = draw_weights(rng, "similar", case.posteriors, case.points, case.survivors)
        variance = deviation**2 * rng.uniform(0.5, 2.0, size=dimension)
        found = find(points, weights, GaussianMixture(variance, upper))
        assert found.ways == case.expected_ways()
        expected = gaussian_mixture_entropy(points, weights[-1], variance, upper)
        assert abs(found.entropies[-1] - expected) <= TOLERANCE
