"""The heaviest mode of a belief: found where there are several, and nothing changed where not."""

import numpy as np
import pytest

from holdfast.numerics import wrapped
from holdfast.numerics.arrays import BoolArray, FloatArray
from holdfast.numerics.randomness import Purpose, stream
from holdfast.planning.belief import Belief, estimate
from holdfast.planning.modes import heaviest_mode


def heap(seed: int, count: int, size: int) -> FloatArray:
    return stream(seed, 0, size, Purpose.HYPOTHESES).normal((count, size))


def two_heaps(seed: int, count: int, size: int, apart: float) -> tuple[FloatArray, BoolArray]:
    """Return states, of which six in ten lie ``apart`` in the first coordinate, and which do."""
    states = heap(seed, count, size)
    there = stream(seed, 1, size, Purpose.HYPOTHESES).uniform(count) < 0.6
    states[:, 0] += apart * there
    return states, there


@pytest.mark.parametrize("size", [1, 3, 6])
@pytest.mark.parametrize("count", [100, 300, 3000])
class TestFinding:
    def test_a_single_heap_stays_whole(self, count: int, size: int) -> None:
        """None of 20, as none of 100 others that were tried at each size."""
        weights = np.full(count, 1.0 / count)
        for seed in range(20):
            assert heaviest_mode(heap(seed, count, size), weights) is weights

    def test_the_heavier_of_two_is_found(self, count: int, size: int) -> None:
        """Of 60 at six standard deviations 59 or 60 were found, at each size; these are eight."""
        weights = np.full(count, 1.0 / count)
        for seed in range(10):
            states, there = two_heaps(seed, count, size, 8.0)
            own = heaviest_mode(states, weights)
            heavier = there if there.mean() > 0.5 else ~there
            assert own.sum() == pytest.approx(1.0)
            assert own[heavier].sum() > 0.99


class TestWhatItIsOf:
    def test_one_of_four_is_taken(self) -> None:
        """Where a first look sees two heaps of two, each is looked at again."""
        states = heap(4, 400, 1)
        states[:, 0] += np.repeat([0.0, 9.0, 40.0, 49.0], [90, 100, 100, 110])
        own = heaviest_mode(states, np.full(400, 1.0 / 400))
        assert np.flatnonzero(own).tolist() == list(range(290, 400))

    def test_units_do_not_matter(self) -> None:
        states, _ = two_heaps(5, 300, 3, 8.0)
        weights = np.full(300, 1.0 / 300)
        scaled = states * [2.0**-10, 2.0**10, 8.0]
        assert heaviest_mode(scaled, weights).tobytes() == heaviest_mode(states, weights).tobytes()

    def test_headings_beside_pi_are_one_mode(self) -> None:
        states = np.stack([heap(6, 300, 1)[:, 0], wrapped(np.pi + 0.2 * heap(7, 300, 1)[:, 0])], 1)
        weights = np.full(300, 1.0 / 300)
        assert heaviest_mode(states, weights, (1,)) is weights
        assert heaviest_mode(states, weights) is not weights


class TestEstimate:
    def test_of_one_mode_it_is_the_mean(self) -> None:
        belief = Belief.uniform(heap(9, 300, 3))
        assert estimate(belief, "heaviest_mode").tobytes() == estimate(belief).tobytes()

    def test_angles_are_averaged_as_angles(self) -> None:
        states = np.stack([heap(1, 200, 1)[:, 0], wrapped(np.pi + 0.1 * heap(2, 200, 1)[:, 0])], 1)
        states[:80, 1] = wrapped(states[:80, 1] + 2.5)
        found = estimate(Belief.uniform(states), "heaviest_mode", (1,))
        assert abs(float(wrapped(found[1] - np.pi))) < 0.05
