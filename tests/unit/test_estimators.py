"""Entropies of weighted points: what does not depend on what, degenerate points, bad input."""

from typing import Any

import numpy as np
import pytest

from holdfast.errors import InvalidValueError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning import estimators as estimation
from holdfast.planning.estimators import GaussianMixture, NearestNeighbor, PriorNeighbors

# Sums of up to some thousand terms, the same but for rounding.
TOLERANCE = 1e-9

ESTIMATORS: dict[str, NearestNeighbor | GaussianMixture] = {
    "neighbours": NearestNeighbor(5, 1e-3),
    "resolution": NearestNeighbor(3, 0.8),
    "upper": GaussianMixture(np.array([0.04, 0.04, 0.04]), upper=True),
    "lower": GaussianMixture(np.array([0.04, 0.04, 0.04]), upper=False),
}

# Numbers of points that are treated in different ways by the kernel.
COUNTS = [6, 50, 100, 1500]


def entropy(
    points: FloatArray,
    weights: FloatArray | None = None,
    estimator: NearestNeighbor | PriorNeighbors | GaussianMixture | None = None,
) -> float:
    estimate = estimation.entropy(points, weights, estimator)
    assert isinstance(estimate, float)
    return estimate


def draw(count: int, seed: int = 1, dimension: int = 3) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng([seed, count])
    return rng.normal(size=(count, dimension)), rng.uniform(0.1, 1.0, size=count)


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("name", ESTIMATORS)
class TestWhatMakesNoDifference:
    def test_layout_of_the_arguments(self, name: str, count: int) -> None:
        points, weights = draw(count)
        expected = entropy(points, weights, ESTIMATORS[name])
        assert entropy(np.asfortranarray(points), weights, ESTIMATORS[name]) == expected
        strided = np.repeat(np.repeat(points, 2, axis=0), 2, axis=1)[::2, ::2]
        assert entropy(strided, np.repeat(weights, 2)[::2], ESTIMATORS[name]) == expected
        for array in (points, weights):
            array.setflags(write=False)
        assert entropy(points, weights, ESTIMATORS[name]) == expected


class TestResolutionOfEachCoordinate:
    SIZES = np.array([0.3, 5.0, 0.01])

    @pytest.mark.parametrize("count", COUNTS)
    def test_points_are_measured_in_it(self, count: int) -> None:
        points, weights = draw(count)
        expected = entropy(points, weights, NearestNeighbor(5, 1.0)) + np.log(self.SIZES).sum()
        found = entropy(points * self.SIZES, weights, NearestNeighbor(5, self.SIZES))
        assert abs(found - expected) < TOLERANCE

    def test_a_single_point_is_known_to_within_an_ellipsoid(self) -> None:
        expected = np.log(4.0 / 3.0 * np.pi * self.SIZES.prod())
        assert abs(entropy(np.ones((1, 3)), None, NearestNeighbor(1, self.SIZES)) - expected) < 1e-9


class TestDegeneratePoints:
    """Policies map half of the particles to the same action: entropies stay finite."""

    @pytest.mark.parametrize("count", [2, 10, 64, 100, 1500])
    def test_all_equal(self, count: int) -> None:
        """A ball of the resolution: all that is known is that the points lie within it.

        To the ball's own entropy comes log q - psi(q) of its q = N - 1 others, between 1 / (2 q)
        and 1 / q.
        """
        for dimension, ball in ((1, 2.0), (2, np.pi), (3, 4.0 * np.pi / 3.0)):
            points = np.full((count, dimension), 1.7)
            excess = entropy(points, None, NearestNeighbor(min(5, count - 1), 0.01)) - (
                np.log(ball) + dimension * np.log(0.01)
            )
            assert 0.5 / (count - 1) < excess < 1.0 / (count - 1)

    @pytest.mark.parametrize("weight", [1.0, 1e-300])
    def test_one_point(self, weight: float) -> None:
        expected = np.log(np.pi) + 2.0 * np.log(0.3)
        for points, weights in (
            (np.ones((1, 2)), np.array([weight])),
            (np.arange(10.0).reshape(5, 2), np.array([0.0, 0.0, weight, 0.0, 0.0])),
        ):
            assert abs(entropy(points, weights, NearestNeighbor(3, 0.3)) - expected) < 1e-12


class TestDefaults:
    def test_weights_and_estimator(self) -> None:
        points, _ = draw(100)
        expected = entropy(points, np.ones(100), NearestNeighbor(5, 1e-3))
        assert entropy(points) == pytest.approx(expected, abs=1e-12)
        assert estimation.entropy(points.tolist()) == entropy(points)

    @pytest.mark.parametrize("scale", [1e-140, 1e-9, 1e-6, 1.0, 1e6, 1e140])
    def test_the_unit_does_not_matter(self, scale: float) -> None:
        points, weights = draw(100)
        for estimator in (None, NearestNeighbor(3), PriorNeighbors(np.full(100, 0.01))):
            usual, found = (
                entropy(points, weights, estimator),
                entropy(scale * points, weights, estimator),
            )
            assert found == pytest.approx(usual + 3.0 * np.log(scale), abs=1e-9)
        # Of a Gaussian it is right at every scale: 3 nats off would be a scale that is taken for 1.
        normal = np.random.default_rng(4).normal(size=(2000, 1))
        exact = 0.5 * np.log(2.0 * np.pi * np.e) + np.log(scale)
        assert entropy(scale * normal) == pytest.approx(exact, abs=0.1)

    def test_where_most_points_are_equal_the_others_have_a_scale(self) -> None:
        tied = np.vstack([np.zeros((60, 2)), np.random.default_rng(4).normal(size=(40, 2))])
        assert np.isfinite(entropy(tied))
        assert entropy(1e-6 * tied) == pytest.approx(entropy(tied) + 2.0 * np.log(1e-6))

    @pytest.mark.parametrize("points", [np.full((9, 2), 0.3), np.zeros((1, 1))])
    def test_equal_points_have_no_scale(self, points: np.ndarray) -> None:
        with pytest.raises(InvalidValueError, match=r"have no scale .*NearestNeighbor\(res"):
            estimation.entropy(points)
        assert np.isfinite(entropy(points, None, NearestNeighbor(1, 0.1)))

    def test_form_of_the_result(self) -> None:
        points, weights = draw(30)
        assert isinstance(estimation.entropy(points, weights), float)
        rows = estimation.entropy(points, np.tile(weights, (3, 1)))
        assert isinstance(rows, np.ndarray)
        assert rows.shape == (3,)
        assert rows.dtype == np.float64
        assert np.asarray(estimation.entropy(points, weights.reshape(1, -1))).shape == (1,)


def weights_with(bad: float) -> FloatArray:
    weights = draw(20)[1]
    weights[3] = bad
    return weights


NO_NUMBERS = (np.nan, np.inf, -np.inf)
MISFITS: list[tuple[str, Any, Any, Any]] = [
    *((r"points of shape \(.*\): need \(n, d\)", np.zeros(shape), None, None)
      for shape in ((0, 3), (5,), (2, 3, 1), ())),
    *((f"points of {size} coordinates: allowed are 1 to 64", np.zeros((9, size)), None, None)
      for size in (0, 65)),
    *((f"weight of point 3 is {bad}: must be >= 0", None, rows, None)
      for bad in (*NO_NUMBERS, -0.5)
      for rows in (weights_with(bad), np.stack([np.ones(20), weights_with(bad)]))),
    (r"weights\[1\] are all zero: one must be pos", None, np.eye(2, 20) * [[1.0], [0.0]], None),
    *((r"weights of shape .* need \(20,\) or \(b, 20", None, np.ones(shape), None)
      for shape in ((19,), (21,), (2, 19), (2, 2, 20), (0,))),
    *((f"neighbors {count}: allowed are whole n", None, None, NearestNeighbor(count, 0.1))
      for count in (0, -1)),
    *((f"neighbors {count}: must be below .* 20", None, None, NearestNeighbor(count, 0.1))
      for count in (20, 21, 10**6)),
    *((f"resolution {size}: allowed are", None, None, NearestNeighbor(5, size))
      for size in (0.0, -1.0, np.nan, np.inf)),
    *((r"resolution \[.*\]: allowed are .* in every", None, None,
       NearestNeighbor(5, np.array([0.1, size, 0.1])))
      for size in (0.0, -1.0, np.nan, np.inf, 1e-151)),
    (r"resolution of shape \(2,\): need .* \(3,\)", None, None, NearestNeighbor(5, np.ones(2))),
    (r"point 0 is .* resolutions from zero: at most", draw(20)[0] + 1e9, None,
     NearestNeighbor(5, np.full(3, 1e-145))),
    *((r"variance \[.*\]: every entry must be > 0", None, None,
       GaussianMixture(np.array([0.1, bad, 0.1])))
      for bad in (0.0, -0.1, np.nan, np.inf)),
    *((rf"variance of shape \({size},\): need \(3,\)", None, None, GaussianMixture(np.ones(size)))
      for size in (1, 2, 4)),
]  # fmt: skip


@pytest.mark.parametrize(("message", "points", "weights", "estimator"), MISFITS)
def test_what_does_not_fit_is_named(
    message: str, points: Any, weights: Any, estimator: Any
) -> None:
    with pytest.raises(InvalidValueError, match=message):
        estimation.entropy(draw(20)[0] if points is None else points, weights, estimator)


@pytest.mark.parametrize("bad", NO_NUMBERS)
def test_points_that_are_not_finite(bad: float) -> None:
    points, _ = draw(20)
    points[7] = [1.0, bad, 2.0]
    for estimator in ESTIMATORS.values():
        with pytest.raises(InvalidValueError, match=rf"point 7 is \[ *1\. +{bad} +2\. *\]"):
            entropy(points, None, estimator)
