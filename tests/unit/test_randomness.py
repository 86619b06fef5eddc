"""Streams: the same numbers for the same name, others for every other name, of the right
distribution.

Seeds are fixed. The statistical bounds below would each fail with the stated probability if the
seed were drawn anew.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy import stats

from holdfast import _kernel
from holdfast.errors import InvalidValueError
from holdfast.randomness import Purpose, Stream, stream

SAMPLE = 200_000
NAMED = stream(12, 3, 4, Purpose.PREDICTION)

GOLDEN_UNIFORM = ["0x1.f5ffc4fe43eadp-1", "0x1.191f6d04e75b5p-1", "0x1.b5b448943e518p-4"]
GOLDEN_NORMAL = ["-0x1.562eb41142b4ap+1", "-0x1.b3e1ab7e0d64fp-1", "0x1.d872a84e8b3a0p-10"]


class TestNames:
    def test_the_words_are_part_of_the_format(self) -> None:
        """A change here changes every decision ever made, and makes old journals useless."""
        named = stream(2**40 + 5, 6, 7, Purpose.RESAMPLING)
        assert named.words == (5, 2**8, 3, 7, 6)
        assert {purpose.name: purpose.value for purpose in Purpose} == {
            "INITIAL_BELIEF": 1,
            "PREDICTION": 2,
            "RESAMPLING": 3,
            "HYPOTHESES": 4,
            "SELECTION": 5,
            "MOVE_RESAMPLING": 6,
            "REINITIALISATION": 7,
            "RANK_TEST": 8,
            "WORLD_INITIAL_STATE": 16,
            "WORLD_MOTION": 17,
            "WORLD_OBSERVATION": 18,
            "WORLD_MEASURED_MOTION": 19,
            "WORLD_MOVE_OBSERVATION": 20,
        }

    def test_a_substream_is_keyed_by_a_block_that_no_draw_uses(self) -> None:
        named = Stream((5, 6, 3, 7, 8))
        block = _kernel.philox((5, 6, 3 | 2**31, 7, 8), 42)
        assert named.substream(42).words == (block[0], block[1], 0, 0, 0)
        assert all(purpose < 2**31 for purpose in Purpose)

    def test_every_name_gives_other_numbers(self) -> None:
        """No two of 3,750 blocks of streams and substreams agree (by chance: below 1e-12)."""
        seeds, trials, steps = (0, 1, 2**32, 2**63 - 1), (0, 1, 2**32 - 1), (0, 1, 2**32 - 1)
        first = [
            stream(seed, trial, step, purpose)
            for seed, trial, step in itertools.product(seeds, trials, steps)
            for purpose in Purpose
        ]
        every = first + [
            parent.substream(index) for parent in first for index in (0, 1, 2, 2**32 - 1)
        ]
        every += [parent.substream(1).substream(1) for parent in first]
        draws = {named.uniform(4).tobytes() for named in every}
        assert len(draws) == len(every)
        # Nor does any stream run into the blocks of another one further on.
        values = np.concatenate([named.uniform(50) for named in every])
        assert len(np.unique(values)) == len(values)

    def test_equal_names_are_equal(self) -> None:
        assert stream(1, 2, 3, Purpose.SELECTION) == stream(1, 2, 3, Purpose.SELECTION)
        assert len({NAMED, stream(12, 3, 4, Purpose.PREDICTION), NAMED.substream(0)}) == 2
        assert NAMED.words != NAMED
        assert repr(NAMED) == f"Stream({NAMED.words})"

    @pytest.mark.parametrize("seed", [-1, 2**63, 2**64])
    def test_seed_out_of_range(self, seed: int) -> None:
        with pytest.raises(InvalidValueError, match=rf"seed {seed}: .* 0 to {2**63 - 1}"):
            stream(seed, 0, 0, Purpose.PREDICTION)

    @pytest.mark.parametrize(("trial", "step"), [(-1, 0), (2**32, 0), (0, -1), (0, 2**32)])
    def test_trial_or_step_out_of_range(self, trial: int, step: int) -> None:
        with pytest.raises(InvalidValueError, match=rf"trial {trial}, step {step}: .*{2**32 - 1}"):
            stream(0, trial, step, Purpose.PREDICTION)

    @pytest.mark.parametrize("index", [-1, 2**32])
    def test_substream_out_of_range(self, index: int) -> None:
        with pytest.raises(InvalidValueError, match=rf"substream index {index}: .*{2**32 - 1}"):
            NAMED.substream(index)


class TestDraws:
    @pytest.mark.parametrize("kind", ["normal", "uniform"])
    def test_a_draw_depends_on_its_place_alone(self, kind: str) -> None:
        draw = getattr(NAMED, kind)
        many = draw(1000)
        for count in (0, 1, 2, 3, 8, 15, 16, 17, 999):
            assert draw(count).tobytes() == many[:count].tobytes()
        assert draw((10, 20, 5)).tobytes() == many.tobytes()
        assert draw((10, 20, 5)).shape == (10, 20, 5)
        assert draw().shape == ()
        assert draw(()).item() == many[0]
        assert draw((0, 3)).shape == (0, 3)

    def test_asking_changes_nothing(self) -> None:
        before = NAMED.words
        first = NAMED.normal(10)
        NAMED.uniform(3)
        NAMED.substream(1).normal(5)
        first_again = NAMED.normal(10)
        assert NAMED.words == before
        assert first_again.tobytes() == first.tobytes()
        # The array belongs to the caller.
        first[:] = 0.0
        assert NAMED.normal(10).tobytes() == first_again.tobytes()

    def test_golden_numbers(self) -> None:
        """The first numbers of one stream, as every machine must give them."""
        named = stream(1, 2, 3, Purpose.INITIAL_BELIEF)
        assert [value.hex() for value in named.uniform(3).tolist()] == GOLDEN_UNIFORM
        assert [value.hex() for value in named.normal(3).tolist()] == GOLDEN_NORMAL


class TestDistribution:
    def test_uniform(self) -> None:
        """Kolmogorov and Smirnov's test at 1e-6, and chi-square of the high and the low bits."""
        values = NAMED.uniform(SAMPLE)
        assert (values >= 0.0).all()
        assert (values < 1.0).all()
        assert stats.kstest(values, "uniform").pvalue > 1e-6
        mantissas = (values * 2.0**53).astype(np.int64)
        for bits in (mantissas >> 45, mantissas & 0xFF):
            assert stats.chisquare(np.bincount(bits, minlength=256)).pvalue > 1e-6

    def test_normal(self) -> None:
        """Kolmogorov and Smirnov's test, and four moments, each at 1e-6 (4.9 sigma)."""
        values = NAMED.normal(SAMPLE)
        assert stats.kstest(values, "norm").pvalue > 1e-6
        # Standard errors of the sample moments of a standard normal: var(x^n) / N.
        for power, mean, variance in ((1, 0.0, 1.0), (2, 1.0, 2.0), (3, 0.0, 15.0), (4, 3.0, 96.0)):
            error = float((values**power).mean()) - mean
            assert abs(error) < 4.9 * np.sqrt(variance / SAMPLE)
        # The tails are there: 2 * SAMPLE * (1 - Phi(4)) = 12.7 values are expected beyond 4.
        assert 1 <= int((np.abs(values) > 4.0).sum()) <= 40

    def test_neighbours_are_independent(self) -> None:
        """Correlations at lags 1 to 8, of values and of squares, each at 1e-6 (4.9 sigma)."""
        values = NAMED.normal(SAMPLE)
        for sample in (values, (values**2 - 1.0) / np.sqrt(2.0)):
            for lag in range(1, 9):
                correlation = float((sample[lag:] * sample[:-lag]).mean())
                assert abs(correlation) < 4.9 / np.sqrt(SAMPLE - lag)

    @pytest.mark.parametrize("what", ["trials", "steps", "purposes", "substreams"])
    def test_streams_of_like_names_are_independent(self, what: str) -> None:
        """First numbers of many streams are again a standard normal sample; each test at 1e-6."""
        if what == "trials":
            streams = [stream(1, n, 0, Purpose.PREDICTION) for n in range(5000)]
        elif what == "steps":
            streams = [stream(1, 0, n, Purpose.PREDICTION) for n in range(5000)]
        elif what == "purposes":
            streams = [stream(seed, 0, 0, p) for seed in range(625) for p in Purpose]
        else:
            streams = [NAMED.substream(n) for n in range(5000)]
        values = np.array([named.normal(4) for named in streams])
        for column in values.T:
            assert stats.kstest(column, "norm").pvalue > 1e-6
        # Rows in order: neighbours by name are not neighbours by number.
        correlation = float((values[1:, 0] * values[:-1, 0]).mean())
        assert abs(correlation) < 4.9 / np.sqrt(len(values))
        across = np.corrcoef(values.T)[np.triu_indices(4, 1)]
        assert np.abs(across).max() < 4.9 / np.sqrt(len(values))
