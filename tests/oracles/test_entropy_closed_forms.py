"""The entropy estimates against entropies that are known in closed form.

The nearest-neighbour estimate is biased at any finite number N of points. That bias is not guessed
here but computed. The k-th nearest of N - 1 independent points lies at the radius r whose ball
holds a probability P that is distributed as Beta(k, N - k), whatever the density is; so E[log P] =
psi(k) - psi(N). With uniform weights the estimate is

    mean of  log(N - 1) - psi(k) + log(c_d r^d)

over the points, and its expectation is exactly

    H + log(N - 1) - psi(N) + E[log(p(x) c_d r^d / P)].

The last term is the bias of taking the density as constant within a ball; it falls like
(k / N)^(2/d) inside a smooth density and like (k / N)^(1/d) at an edge. For a Gaussian, P is a
noncentral chi-square probability, and for a box the part of a ball that lies in it, so both are
integrals that are computed here to better than the statistics needs.

Each comparison takes the mean of independent samples and is a t-test with their own deviation: a
right estimate fails it with probability 1e-6 over all seeds, and about 40 comparisons are made. A
mistake of `POWER` in an expectation is found, as every test asserts.
"""

import numpy as np
import pytest
from scipy import special, stats
from tests.oracles.reference_entropy import log_unit_ball
from tests.unit.test_estimators import entropy

from holdfast.numerics.arrays import FloatArray
from holdfast.planning.estimators import GaussianMixture, NearestNeighbor

FALSE_ALARM = 1e-6
POWER = 0.12
SAMPLES = 24
DIMENSIONS = [1, 2, 3, 6]
TINY = 1e-9
"""A resolution that never sets a radius here."""


def gaussian_entropy(variance: FloatArray) -> float:
    return float(0.5 * np.log(2.0 * np.pi * np.e * variance).sum())


def assert_mean(estimates: FloatArray, expected: float, allowance: float = 0.0) -> None:
    """Assert by a t-test that the estimates come from a distribution of the expected mean.

    ``allowance`` is for what is known of the expectation only as a bound.
    """
    sigma = estimates.std(ddof=1) / np.sqrt(len(estimates))
    reach = stats.t.ppf(1.0 - 0.5 * FALSE_ALARM, len(estimates) - 1) * sigma + allowance
    assert reach < POWER, "the test has no power"
    assert abs(estimates.mean() - expected) <= reach


def radial_nodes(dimension: int) -> tuple[FloatArray, FloatArray]:
    """Return distances from the origin and weights that integrate over a standard Gaussian."""
    nodes, weights = np.polynomial.legendre.leggauss(40)
    reach = stats.chi.ppf(1.0 - 1e-12, dimension)
    radius = 0.5 * reach * (nodes + 1.0)
    return radius, 0.5 * reach * weights * stats.chi.pdf(radius, dimension)


def beta_nodes(neighbors: int, count: int) -> tuple[FloatArray, FloatArray]:
    """Return values of P and weights that integrate over Beta(k, N - k)."""
    nodes, weights = np.polynomial.legendre.leggauss(20)
    return stats.beta.ppf(0.5 * (nodes + 1.0), neighbors, count - neighbors), 0.5 * weights


def gaussian_smoothing(
    dimension: int, neighbors: int, count: int, proposal_deviation: float = 1.0
) -> float:
    """Return E[log(p(x) c_d r^d / P_p)] for a standard Gaussian p.

    With another deviation the neighbours are those of a sample of N(0, deviation^2), and P_p is
    the probability under p of the ball that they span.
    """
    s = proposal_deviation
    radius, radius_weights = radial_nodes(dimension)
    share, share_weights = beta_nodes(neighbors, count)
    x = radius[:, None]
    ball = s * np.sqrt(stats.ncx2.ppf(share, dimension, np.square(x / s)))
    inside = share if s == 1.0 else stats.ncx2.cdf(np.square(ball), dimension, np.square(x))
    log_density = -0.5 * np.square(x) - 0.5 * dimension * np.log(2.0 * np.pi)
    term = log_density + log_unit_ball(dimension) + dimension * np.log(ball) - np.log(inside)
    return float(radius_weights @ term @ share_weights)


class TestNearestNeighbor:
    @pytest.mark.parametrize("neighbors", [1, 5, 12])
    @pytest.mark.parametrize("dimension", DIMENSIONS)
    def test_gaussian(self, dimension: int, neighbors: int) -> None:
        count = 1500
        rng = np.random.default_rng([1, dimension, neighbors])
        isotropic = np.full(dimension, 4.0)  # a scale changes no bias
        estimates = np.array(
            [
                entropy(
                    rng.normal(size=(count, dimension)) * np.sqrt(isotropic),
                    None,
                    NearestNeighbor(neighbors, TINY),
                )
                for _ in range(SAMPLES)
            ]
        )
        bias = np.log(count - 1) - special.psi(count)
        bias += gaussian_smoothing(dimension, neighbors, count)
        assert abs(bias) < 0.15
        assert_mean(estimates, gaussian_entropy(isotropic) + bias)

    @pytest.mark.parametrize("dimension", DIMENSIONS)
    def test_importance_weights(self, dimension: int) -> None:
        """Points of a wider Gaussian, weighted to stand for a standard one.

        The expectation is that of uniform weights with the balls of the wider sample, up to: the
        variation of the k weights within one ball, which biases the log of their mean by half of
        its relative variance over k at most (and the k-th lies on the surface, where the mean
        differs by the curvature over k); terms of the order of E[weight^2] / N from dividing by the
        sum of the weights; and what the negligible points took away. These are allowed, twice over.
        """
        count, neighbors, s = 3000, 5, 1.3 if dimension < 6 else 1.2
        rng = np.random.default_rng([4, dimension])
        tilt = 1.0 - 1.0 / s**2  # -grad log weight = tilt x
        estimates = np.empty(SAMPLES)
        for sample in range(SAMPLES):
            points = s * rng.normal(size=(count, dimension))
            weights = np.exp(-0.5 * tilt * np.square(points).sum(axis=1))
            estimates[sample] = entropy(points, weights, NearestNeighbor(neighbors, TINY))
        bias = np.log(count - 1) - special.psi(count)
        bias += gaussian_smoothing(dimension, neighbors, count, s)

        # E[r^2] over the points of p, from the mass k / N of a ball of the wider sample.
        radius, radius_weights = radial_nodes(dimension)
        squared_ball = s**2 * stats.ncx2.ppf(neighbors / count, dimension, np.square(radius / s))
        squared_gradient = np.square(tilt * radius)
        curvature = np.abs(squared_gradient - dimension * tilt)
        within = radius_weights @ (squared_gradient * squared_ball) / (dimension + 2) / 2
        surface = radius_weights @ (curvature * squared_ball) / (dimension * (dimension + 2))
        squared_weight = (s**2 / np.sqrt(2.0 * s**2 - 1.0)) ** dimension
        lost = negligible_tail(dimension, tilt)
        allowance = 2.0 * ((within + surface) / neighbors + squared_weight / count + lost)
        assert allowance < 0.06
        assert_mean(estimates, gaussian_entropy(np.ones(dimension)) + bias, allowance)

    @pytest.mark.parametrize("dimension", [1, 2])
    @pytest.mark.parametrize("resolution", [0.05, 0.4, 1.5])
    def test_a_resolution_that_counts(self, dimension: int, resolution: float) -> None:
        """The exact expectation where some radii are neighbours' and some the resolution.

        With P the probability of the ball of the resolution, the number q of others in it is
        Binomial(N - 1, P). If q >= k its term is log(N - 1) - psi(q) + log(c_d delta^d); else the
        k-th neighbour sets the radius, and its ball's probability is Beta(k, N - k) beyond P.
        """
        count, neighbors = 300, 5
        rng = np.random.default_rng([5, dimension, int(100 * resolution)])
        estimates = np.array(
            [
                entropy(
                    rng.normal(size=(count, dimension)),
                    None,
                    NearestNeighbor(neighbors, resolution),
                )
                for _ in range(3 * SAMPLES)
            ]
        )
        radius, radius_weights = radial_nodes(dimension)
        nodes, node_weights = np.polynomial.legendre.leggauss(30)
        expected = np.log(count - 1) + log_unit_ball(dimension)
        q = np.arange(neighbors, count)
        for x, weight in zip(radius, radius_weights, strict=True):
            inside = stats.ncx2.cdf(resolution**2, dimension, x**2)
            near = stats.binom.pmf(q, count - 1, inside)
            term = near @ (dimension * np.log(resolution) - special.psi(q))
            lowest = stats.beta.cdf(inside, neighbors, count - neighbors)
            if lowest < 1.0 - 1e-12:
                quantiles = lowest + (1.0 - lowest) * 0.5 * (nodes + 1.0)
                share = stats.beta.ppf(quantiles, neighbors, count - neighbors)
                ball = np.sqrt(stats.ncx2.ppf(share, dimension, x**2))
                far = dimension * np.log(ball) - special.psi(neighbors)
                term += (1.0 - lowest) * (0.5 * node_weights @ far)
            expected += weight * term
        assert_mean(estimates, float(expected), allowance=1e-3)

    def test_weights_are_like_repeated_points(self) -> None:
        """A point of weight 3 and three points of weight 1 at its place, as far as they can agree.

        Within the resolution both have the same ball. A copy counts its twins as others and the
        weighted point does not, so the shares are (W - w) / (T - w) and (W - 1) / (T - 1) with W
        the weight in the ball and T of all; and log q - psi(q), which is between 1 / (2 q) and
        1 / q, differs because q counts points. That bounds the difference of the estimates.
        """
        rng = np.random.default_rng(6)
        count, resolution = 400, 0.2
        points = rng.uniform(size=(count, 1))
        weights = rng.integers(1, 5, size=count).astype(np.float64)
        estimator = NearestNeighbor(5, resolution)
        weighted = entropy(points, weights, estimator)
        repeated = entropy(np.repeat(points, weights.astype(np.int64), axis=0), None, estimator)
        near = np.abs(points - points.T) <= resolution
        ball, total = near @ weights, weights.sum()
        shares = np.log((ball - weights) / (total - weights) * (total - 1.0) / (ball - 1.0))
        bound = np.average(np.abs(shares) + 1.0 / (near.sum(axis=1) - 1), weights=weights)
        assert bound < 0.025
        assert abs(weighted - repeated) <= bound
        # Weights that are not looked at would be found: they move the estimate by more.
        skewed = np.where(points[:, 0] < 0.5, 4.0, 1.0)
        assert abs(entropy(points, skewed, estimator) - weighted) > 2.0 * bound


def negligible_tail(dimension: int, tilt: float) -> float:
    """Return how much the entropy changes when the points of negligible weight are left out.

    The weight exp(-tilt |x|^2 / 2) is least far out: what is left is a Gaussian without its tail.
    """
    for threshold in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6):
        squared_reach = -2.0 * np.log(threshold) / tilt
        left_out = stats.chi2.sf(squared_reach, dimension)
        if left_out <= 0.005:
            break
    # E[|x|^2 / 2 ; inside] / P(inside) - E[|x|^2 / 2], and log P(inside).
    inside = dimension * stats.chi2.cdf(squared_reach, dimension + 2)
    return float(abs(0.5 * (inside / (1.0 - left_out) - dimension) + np.log1p(-left_out)))


class TestGaussianMixture:
    @pytest.mark.parametrize("upper", [True, False])
    @pytest.mark.parametrize("dimension", DIMENSIONS)
    def test_one_component_is_exact(self, dimension: int, upper: bool) -> None:
        variance = np.array([4.0, 0.25, 1.0, 9.0, 0.01, 2.0])[:dimension]
        exact = gaussian_entropy(variance)
        estimator = GaussianMixture(variance, upper)
        for count in (1, 2, 50, 200, 1500):
            points = np.full((count, dimension), 3.7)
            assert abs(entropy(points, None, estimator) - exact) < 1e-12

    @pytest.mark.parametrize("upper", [True, False])
    @pytest.mark.parametrize("dimension", DIMENSIONS)
    def test_components_far_apart_are_exact(self, dimension: int, upper: bool) -> None:
        """Then the entropy is that of one plus that of the weights."""
        rng = np.random.default_rng(dimension)
        for count in (3, 40, 300):
            points = rng.normal(size=(count, dimension))
            points[:, 0] = 1e3 * np.arange(count)
            weights = rng.uniform(0.5, 1.0, size=count)
            weights /= weights.sum()
            variance = rng.uniform(0.5, 2.0, size=dimension)
            exact = gaussian_entropy(variance) - weights @ np.log(weights)
            found = entropy(points, weights, GaussianMixture(variance, upper))
            assert abs(found - exact) < 1e-11
