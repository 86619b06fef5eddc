"""Functions with the same bits everywhere: how near they are to the true values.

The true values are those of the C library's long double functions, which on most machines have
eleven more bits or sixty more; where they have none, the accuracy cannot be judged and is not.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
import numpy.typing as npt
import pytest

from holdfast import numerics
from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.randomness import Purpose, stream

fresh = partial(stream, 5, 0, 0, Purpose.PREDICTION)  # anew at each call
COUNT = 200_000

has_long_double = pytest.mark.skipif(
    np.finfo(np.longdouble).nmant < 60, reason="long double is no longer than double here"
)


def units_in_the_last_place(
    function: Callable[[npt.ArrayLike], FloatArray], true: Callable[..., FloatArray], x: FloatArray
) -> float:
    """Return the largest error in units in the last place of the true value."""
    expected = true(x.astype(np.longdouble))
    error = np.abs(function(x).astype(np.longdouble) - expected)
    return float((error / np.spacing(np.abs(expected).astype(np.float64))).max())


def uniform(low: float, high: float, index: int = 0) -> FloatArray:
    return low + (high - low) * fresh().substream(index).uniform(COUNT)


@has_long_double
class TestAccuracy:
    """Below two units in the last place on the stated ranges."""

    @pytest.mark.parametrize(
        ("low", "high"), [(-1.0, 1.0), (-30.0, 30.0), (-707.7, 709.78), (-1e-8, 1e-8)]
    )
    def test_exp(self, low: float, high: float) -> None:
        assert units_in_the_last_place(numerics.exp, np.exp, uniform(low, high)) < 2.0

    @pytest.mark.parametrize(("low", "high"), [(0.5, 2.0), (0.0, 1e3), (1.0 - 1e-6, 1.0 + 1e-6)])
    def test_log(self, low: float, high: float) -> None:
        assert units_in_the_last_place(numerics.log, np.log, uniform(low, high)) < 2.0

    @pytest.mark.parametrize("size", [1.0, 1e-3, 1e3])
    def test_arctan2(self, size: float) -> None:
        """All around the circle, in vectors of very different lengths, also beside the axes."""
        y, x = uniform(-1.0, 1.0), uniform(-size, size, 1)
        expected = np.arctan2(y.astype(np.longdouble), x.astype(np.longdouble))
        error = np.abs(numerics.arctan2(y, x).astype(np.longdouble) - expected)
        assert float((error / np.spacing(np.abs(expected).astype(np.float64))).max()) < 2.0

    def test_log_of_every_order_of_magnitude(self) -> None:
        """From the smallest subnormal number to the largest of all."""
        exponents = (fresh().substream(2).uniform(COUNT) * 2098).astype(np.int64) - 1074
        x = np.ldexp(1.0 + fresh().substream(3).uniform(COUNT), exponents)
        x = np.concatenate([x[np.isfinite(x)], [5e-324, 2.0**-1022, np.finfo(np.float64).max]])
        assert units_in_the_last_place(numerics.log, np.log, x) < 2.0

    @pytest.mark.parametrize(("bound", "units"), [(0.8, 2.0), (7.0, 2.0), (1e3, 2.0), (1e6, 2.5)])
    def test_sin_and_cos(self, bound: float, units: float) -> None:
        """Far from zero the reduction of the argument rounds twice: half a unit more."""
        x = uniform(-bound, bound)
        assert units_in_the_last_place(numerics.sin, np.sin, x) < units
        assert units_in_the_last_place(numerics.cos, np.cos, x) < units

    def test_sin_and_cos_near_their_zeros(self) -> None:
        """Here the reduction of the argument cancels all digits that it can."""
        multiples = np.concatenate([np.arange(-2000, 2001), np.arange(600_000, 636_000)])
        for shift in (0.0, 1e-9, -1e-6, 1e-3):
            x = multiples * (0.5 * np.pi) + shift
            x = x[x != 0.0]
            assert units_in_the_last_place(numerics.sin, np.sin, x) < 2.0
            assert units_in_the_last_place(numerics.cos, np.cos, x) < 2.0

    def test_tiny_angles(self) -> None:
        x = np.ldexp(1.0 + fresh().uniform(1000), -np.arange(1000))
        assert units_in_the_last_place(numerics.sin, np.sin, x) < 2.0
        assert units_in_the_last_place(numerics.cos, np.cos, x) < 2.0

    def test_arcsin(self) -> None:
        x = np.concatenate(
            [
                np.linspace(-1.0, 1.0, 20_001),
                1.0 - np.ldexp(1.0, -np.arange(1, 53)),
                np.ldexp(1.0, -np.arange(1, 1000)),
            ]
        )
        x = x[x != 0.0]

        def arcsin(values: npt.ArrayLike) -> FloatArray:
            return np.array([numerics.arcsin(value) for value in np.asarray(values).tolist()])

        assert units_in_the_last_place(arcsin, np.arcsin, x) < 2.0


class TestSpecialValues:
    def test_exp(self) -> None:
        x = [-np.inf, -1e300, -745.0, -707.71, 0.0, -0.0, 1.0, 709.79, 1e300, np.inf]
        expected = [0.0, 0.0, 0.0, 0.0, 1.0, 1.0, np.e, np.inf, np.inf, np.inf]
        np.testing.assert_array_max_ulp(numerics.exp(x), np.array(expected), 1)
        assert np.isnan(numerics.exp(np.nan))
        assert 0.0 < numerics.exp(-707.69) < 5.2e-308
        assert 1e308 < numerics.exp(709.78) < np.inf

    def test_log(self) -> None:
        x = [0.0, -0.0, 1.0, np.inf]
        assert numerics.log(x).tolist() == [-np.inf, -np.inf, 0.0, np.inf]
        assert np.isnan(numerics.log([-1.0, -5e-324, -np.inf, np.nan])).all()

    def test_sin_and_cos(self) -> None:
        assert numerics.sin([0.0]).tolist() == [0.0]
        assert numerics.cos([0.0, -0.0]).tolist() == [1.0, 1.0]
        beyond = [np.nextafter(2.0**30, np.inf), -1e10, np.inf, -np.inf, np.nan]
        assert np.isnan(numerics.sin(beyond)).all()
        assert np.isnan(numerics.cos(beyond)).all()
        within = np.array([2.0**30, -(2.0**30), 123456789.0])
        both = numerics.sin(within) ** 2 + numerics.cos(within) ** 2
        np.testing.assert_allclose(both, 1.0, rtol=0.0, atol=1e-14)

    def test_arcsin(self) -> None:
        assert numerics.arcsin(0.0) == 0.0
        assert numerics.arcsin(1.0) == 0.5 * np.pi
        assert numerics.arcsin(-1.0) == -0.5 * np.pi
        for outside in (1.0 + 2.0**-52, -1.1, np.inf, np.nan):
            assert np.isnan(numerics.arcsin(outside))

    def test_symmetry(self) -> None:
        x = uniform(-10.0, 10.0)
        assert numerics.sin(-x).tobytes() == (-numerics.sin(x)).tobytes()
        assert numerics.cos(-x).tobytes() == numerics.cos(x).tobytes()


class TestForm:
    """What an element comes to depends on nothing around it."""

    @pytest.mark.parametrize("name", ["exp", "log", "sin", "cos"])
    def test_shapes(self, name: str) -> None:
        function = getattr(numerics, name)
        x = np.abs(fresh().normal((3, 5, 7)))
        result = function(x)
        assert result.shape == x.shape
        assert result.dtype == np.float64
        assert function(x[1, 2, 3]).shape == ()
        assert function(x[1, 2, 3]).item() == result[1, 2, 3]
        assert function(x.T).tobytes() == np.ascontiguousarray(result.T).tobytes()
        assert function(x[:, ::2, ::-1]).tolist() == result[:, ::2, ::-1].tolist()
        assert function(x.tolist()).tolist() == result.tolist()
        assert function(np.empty((0, 4))).shape == (0, 4)
        assert function([1, 2]).tolist() == function([1.0, 2.0]).tolist()

    @pytest.mark.parametrize("name", ["exp", "log", "sin", "cos"])
    def test_elements_do_not_depend_on_their_place(self, name: str) -> None:
        function = getattr(numerics, name)
        x = fresh().normal(40) * 5.0
        whole = function(x)
        for first in range(9):
            for last in range(first, 40, 3):
                assert function(x[first:last]).tobytes() == whole[first:last].tobytes()

    def test_sum(self) -> None:
        x = fresh().normal((10, 7))
        assert numerics.sum(x) == numerics.sum(x.reshape(-1))
        assert numerics.sum([1, 2, 3]) == 6.0
        assert numerics.sum([]) == 0.0
        assert isinstance(numerics.sum(x), float)
        assert np.isnan(numerics.sum([1.0, np.nan]))

    def test_weighted_mean(self) -> None:
        rows = fresh().normal((50, 3))
        weights = fresh().substream(1).uniform(50)
        weights /= weights.sum()
        mean = numerics.weighted_mean(rows, weights)
        np.testing.assert_allclose(mean, np.average(rows, axis=0, weights=weights), atol=1e-15)
        strided = np.repeat(rows, 2, axis=0)[::2]
        assert numerics.weighted_mean(strided, weights).tobytes() == mean.tobytes()

    def test_arguments_are_not_changed(self) -> None:
        x = fresh().normal(20)
        x.setflags(write=False)
        for function in (numerics.exp, numerics.log, numerics.sin, numerics.cos):
            assert not np.shares_memory(function(x), x)
        numerics.sum(x)
        numerics.weighted_mean(x.reshape(-1, 1), x)


class TestAngles:
    def test_the_axes_and_the_origin(self) -> None:
        found = numerics.arctan2([0.0, 1.0, 0.0, -1.0, 0.0, -0.0], [1.0, 0.0, -1.0, 0.0, 0.0, -1.0])
        assert found.tolist() == [0.0, np.pi / 2, np.pi, -np.pi / 2, 0.0, np.pi]
        assert np.isnan(numerics.arctan2([np.nan, 1.0], [1.0, np.nan])).all()

    def test_shapes_broadcast(self) -> None:
        y = fresh().normal((4, 1, 3))
        found = numerics.arctan2(y, 1.0)
        assert found.shape == y.shape
        assert numerics.arctan2(y, np.ones((5, 1))).shape == (4, 5, 3)
        np.testing.assert_allclose(found, np.arctan(y), rtol=1e-15)

    def test_wrapped_is_the_shorter_way_round(self) -> None:
        angles = uniform(-50.0, 50.0)
        found = numerics.wrapped(angles)
        assert np.abs(found).max() <= np.pi
        np.testing.assert_allclose(np.exp(1j * found), np.exp(1j * angles), atol=1e-13)
        assert numerics.wrapped([3.0, -3.0, 0.5]).tolist() == [3.0, -3.0, 0.5]
