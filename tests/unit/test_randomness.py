"""Streams: the same numbers for the same name, others for every other name, of the right
distribution.

Seeds are fixed. The statistical bounds below would each fail with the stated probability if the
seed were drawn anew.
"""

import copy
import itertools
import pickle
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import numpy as np
import pytest
from scipy import stats

from holdfast import _kernel
from holdfast.errors import InvalidValueError, ProblemError
from holdfast.numerics.geometry import DiscWorld
from holdfast.numerics.randomness import (
    NOISE_FREE,
    NoiseFreeStream,
    Purpose,
    Stream,
    seed_and_trial,
    stream,
)

MASKED = np.ma.array([1, 2], mask=[True, False])
named = partial(stream, 12, 3, 4, Purpose.PREDICTION)  # anew at each call

GOLDEN_UNIFORM = ["0x1.f5ffc4fe43eadp-1", "0x1.191f6d04e75b5p-1", "0x1.b5b448943e518p-4"]
GOLDEN_NORMAL = ["-0x1.562eb41142b4ap+1", "-0x1.b3e1ab7e0d64fp-1", "0x1.d872a84e8b3a0p-10"]
GOLDEN_LATER = ["0x1.873934e776fc0p-7", "0x1.b7f0b9607e8a0p-4"]
GOLDEN_LATER += ["0x1.26b96ba7abac6p-2", "0x1.3002581272d4cp-3"]


class TestNames:
    def test_the_words_are_part_of_the_format(self) -> None:
        """A change here changes every decision ever made, and makes old journals useless."""
        named = stream(2**40 + 5, 6, 7, Purpose.RESAMPLING)
        assert named.words == (5, 2**8, 3, 7, 6)
        assert [purpose.value for purpose in Purpose] == [*range(1, 9), *range(16, 21)]
        assert " ".join(purpose.name for purpose in Purpose) == (
            "INITIAL_BELIEF PREDICTION RESAMPLING HYPOTHESES SELECTION MOVE_RESAMPLING "
            "REINITIALISATION RANK_TEST WORLD_INITIAL_STATE WORLD_MOTION WORLD_OBSERVATION "
            "WORLD_MEASURED_MOTION WORLD_MOVE_OBSERVATION"
        )

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
        assert len({named(), stream(12, 3, 4, Purpose.PREDICTION), named().substream(0)}) == 2
        assert named().words != named()
        assert repr(named()) == f"Stream({named().words})"

    @pytest.mark.parametrize("seed", [-1, 2**63, 2**64])
    def test_seed_out_of_range(self, seed: int) -> None:
        with pytest.raises(InvalidValueError, match=rf"seed {seed}: .* 0 to {2**63 - 1}"):
            stream(seed, 0, 0, Purpose.PREDICTION)
        for given in ((seed, 0), (0, -1), (0, 2**32)):
            with pytest.raises(InvalidValueError, match="allowed are whole numbers from 0 to"):
                seed_and_trial(*given)
        greatest = 2**63 - 1, 2**32 - 1
        assert (seed_and_trial(0, 0), seed_and_trial(*greatest)) == ((0, 0), greatest)

    @pytest.mark.parametrize(("trial", "step"), [(-1, 0), (2**32, 0), (0, -1), (0, 2**32)])
    def test_trial_or_step_out_of_range(self, trial: int, step: int) -> None:
        with pytest.raises(InvalidValueError, match=rf"trial {trial}, step {step}: .*{2**32 - 1}"):
            stream(0, trial, step, Purpose.PREDICTION)

    @pytest.mark.parametrize("index", [-1, 2**32])
    def test_substream_out_of_range(self, index: int) -> None:
        with pytest.raises(InvalidValueError, match=rf"substream index {index}: .*{2**32 - 1}"):
            named().substream(index)


class TestDraws:
    @pytest.mark.parametrize("kind", ["normal", "uniform"])
    def test_a_first_draw_depends_on_its_place_alone(self, kind: str) -> None:
        def draw(*shape: object) -> Any:
            return getattr(named(), kind)(*shape)

        many = draw(1000)
        for count in (0, 1, 2, 3, 8, 15, 16, 17, 999):
            assert draw(count).tobytes() == many[:count].tobytes()
        assert draw((10, 20, 5)).tobytes() == many.tobytes()
        assert draw((10, 20, 5)).shape == (10, 20, 5)
        assert draw().shape == ()
        assert draw(()).item() == draw() == many[0]
        assert draw((0, 3)).shape == (0, 3)

    def test_golden_numbers(self) -> None:
        """The first numbers of one stream, as every machine must give them."""
        of_all = partial(stream, 1, 2, 3, Purpose.INITIAL_BELIEF)
        assert [value.hex() for value in of_all().uniform(3).tolist()] == GOLDEN_UNIFORM
        assert [value.hex() for value in of_all().normal(3).tolist()] == GOLDEN_NORMAL
        going_on = of_all()
        first, *later = (going_on.uniform(2) for _ in range(3))
        assert [value.hex() for value in first.tolist()] == GOLDEN_UNIFORM[:2]
        assert [value.hex() for value in np.ravel(later).tolist()] == GOLDEN_LATER


class TestGoingOn:
    """A stream goes on, as a NumPy generator does."""

    DRAWS: ClassVar[dict[str, Callable[[Stream], Any]]] = {
        "normal": lambda own: own.normal(6),
        "standard_normal": lambda own: own.standard_normal(size=(2, 3)),
        "random": lambda own: own.random(6),
        "uniform": lambda own: own.uniform(-1.0, 1.0, 6),
        "integers": lambda own: own.integers(2**50, size=6),
        "choice": lambda own: own.choice(2**20, 6),
        "order": lambda own: own.choice(1000, 6, replace=False),
    }

    @pytest.mark.parametrize("kind", DRAWS)
    def test_no_draw_repeats_another(self, kind: str) -> None:
        own, other = named(), named()
        draws = [np.ravel(self.DRAWS[kind](own)) for _ in range(20)]
        assert len({draw.tobytes() for draw in draws}) == 20
        assert [draw.tobytes() for draw in draws] == [
            np.ravel(self.DRAWS[kind](other)).tobytes() for _ in range(20)
        ]

    def test_anew_begins_again(self) -> None:
        own = named()
        first, _ = own.normal(4), own.normal(4)
        assert own.anew().normal(4).tobytes() == first.tobytes()

    def test_a_copy_goes_on_where_the_original_is(self) -> None:
        own = named()
        own.normal(4)
        for again in (copy.deepcopy(own), pickle.loads(pickle.dumps(own))):
            assert again == own
            assert again.normal(4).tobytes() == copy.copy(own).normal(4).tobytes()

    def test_a_world_goes_on_too(self) -> None:
        world, own = DiscWorld(0.1, ()), named()
        still, deviation = np.zeros((5, 2)), np.ones(2)
        moved = [world.move(still, np.zeros(2), deviation, 1e-3, own) for _ in range(3)]
        drawn = [world.draw_free(np.zeros(2), deviation, 5, own)[0] for _ in range(3)]
        each = world.move_each(
            np.zeros((2, 5, 2)), np.zeros((2, 2)), deviation, 1e-3, [own, own], 1
        )
        every = [*moved, *drawn, *each, own.normal((5, 2)), own.normal((5, 2))]
        assert len(np.unique(every)) == np.size(every)
        to = world.move(still, np.ones(2), 0.0 * deviation, 1e-3, NOISE_FREE)
        np.testing.assert_array_equal(to, np.ones((5, 2)))
        # A draw before does not change the first motion.
        other = named()
        other.normal(3)
        assert (
            world.move(still, np.zeros(2), deviation, 1e-3, other).tobytes() == moved[0].tobytes()
        )

    def test_one_that_has_ended_gives_nothing(self) -> None:
        own = named()
        own._draws = 2**32 - 1
        own.normal()
        with pytest.raises(InvalidValueError, match="and all have been made"):
            own.normal()
        own.end()
        for draw in (own.normal, own.random, own.for_motion, lambda: own.substream(0)):
            with pytest.raises(ProblemError, match=r"for the one call .* kept from an earlier"):
                draw()

    def test_what_came_from_one_that_has_ended_gives_nothing(self) -> None:
        own = named()
        lent = own.lent()
        derived = [lent.substream(3), lent.substream(3).substream(1), lent.anew()]
        derived += [copy.copy(lent), copy.deepcopy(lent.substream(4))]
        first = [each.normal() for each in derived]
        lent.end()
        for each in (*derived, lent.anew()):
            with pytest.raises(ProblemError, match=r"for the one call .* kept from an earlier"):
                each.normal()
        # Whose it is goes on, and lends the same again.
        assert own.normal() == own.lent().anew().normal() == first[2]


class TestParameters:
    """NumPy's parameters, and nothing that means one thing there and another one here."""

    def test_normal(self) -> None:
        standard = named().normal((4, 3))
        for found in (
            named().normal(size=(4, 3)),
            named().normal(shape=(4, 3)),
            named().normal(0.0, 1.0, (4, 3)),
            named().normal(0.0, size=(4, 3)),
            named().normal(scale=1, size=[4, 3]),
            named().normal(np.zeros((4, 3)), 1.0),
            named().standard_normal((4, 3)),
        ):
            assert found.tobytes() == standard.tobytes()
        deviations = np.array([0.1, 1.0, 10.0])
        found = named().normal(5.0, deviations, (4, 3))
        assert found.tobytes() == (5.0 + deviations * standard).tobytes()
        assert named().normal(loc=np.arange(3.0)).shape == (3,)
        assert named().normal(7.0, 0.0) == 7.0
        # One number is a number, as NumPy's.
        assert isinstance(named().normal(1.0, 2.0), float)
        assert isinstance(named().random(), float)

    def test_uniform(self) -> None:
        standard = named().random((4, 3))
        assert named().uniform((4, 3)).tobytes() == standard.tobytes()
        assert named().uniform(size=(4, 3)).tobytes() == standard.tobytes()
        found = named().uniform(-1.0, [1.0, 2.0, 3.0], (4, 3))
        assert found.tobytes() == (-1.0 + np.array([2.0, 3.0, 4.0]) * standard).tobytes()
        assert named().uniform(high=np.array([2.0, 4.0])).shape == (2,)
        assert named().uniform(2.0, 2.0) == 2.0
        found = named().uniform(low=[-1.0, 0.0])
        expected = np.array([-1.0, 0.0]) + np.array([2.0, 1.0]) * named().random(2)
        assert found.tobytes() == expected.tobytes()

    @pytest.mark.parametrize("kind", ["normal", "uniform"])
    @pytest.mark.parametrize(
        ("positional", "keywords"),
        [
            ((4.0,), {}),
            ((np.zeros(3),), {}),
            (([4, 3],), {}),
            ((True,), {}),
            ((None,), {}),
            ((4,), {"second": 0.5}),
            (((4, 3),), {"second": 0.5}),
            ((4,), {"first": 0.5}),
        ],
    )
    def test_what_may_be_a_shape_or_a_parameter_is_refused(
        self, kind: str, positional: tuple[Any, ...], keywords: dict[str, float]
    ) -> None:
        names = {"normal": ("loc", "scale"), "uniform": ("low", "high")}[kind]
        given = {names[which == "second"]: value for which, value in keywords.items()}
        with pytest.raises(
            InvalidValueError, match=rf"{kind}\(.*: is this the shape, or {names[0]}\?"
        ):
            getattr(named(), kind)(*positional, **given)

    @pytest.mark.parametrize(
        ("call", "message"),
        [
            (lambda own: own.normal(0.0, 1.0, 3, 4), "loc, scale and size, each of them once"),
            (lambda own: own.normal(0.0, 1.0, scale=2.0), "loc, scale and size, each of them once"),
            (lambda own: own.normal(0.0, -1.0), r"scale is -1\., must be >= 0"),
            (lambda own: own.normal(0.0, np.nan), "scale is nan, must be >= 0"),
            (lambda own: own.normal("a", size=2), "loc is 'a': must be real numbers"),
            (lambda own: own.normal(loc="1"), "loc is '1': must be real numbers"),
            (lambda own: own.normal(loc=True), "loc is True: must be real numbers"),
            (lambda own: own.normal(loc=[0.0, True]), r"loc is \[0\.0, True\]: must be real"),
            (lambda own: own.normal(loc=MASKED), "loc is masked_array.*: must be real numbers"),
            (lambda own: own.uniform(high=np.datetime64("2026-01-01")), "high is .*must be real"),
            (lambda own: own.normal(size=True), "size True: must be an integer"),
            (lambda own: own.normal(size=(2, np.True_)), "size .*: must be an integer"),
            (lambda own: own.random("34"), "size '34': must be an integer"),
            (lambda own: own.integers(MASKED), "high .*: must be integers"),
            (lambda own: own.integers([3, True]), "high .*: must be integers"),
            (lambda own: own.integers(np.timedelta64(3, "s")), "high .*: must be integers"),
            (lambda own: own.choice(MASKED), "must have no masked entry"),
            (lambda own: own.choice(2, p=["0.5", "0.5"]), "p is .*: must be real numbers"),
            (lambda own: own.choice([], 0, p=[]), "must be 0 probabilities"),
            (lambda own: own.substream(True), "substream index True: allowed are whole numbers"),
            (
                lambda own: own.normal(np.zeros(3), 1.0, 4),
                r"size \(4,\) does not fit loc and scale",
            ),
            (lambda own: own.normal(size=-1), "shape -1: no extent may be negative"),
            (lambda own: own.normal(size=2.0), r"size 2\.0: must be an integer"),
            (lambda own: own.normal(size=(2**20, 2**20)), r"at most 2\*\*33 numbers"),
            (lambda own: own.uniform(1.0, 0.0), r"high less low is -1\., must be >= 0"),
            (lambda own: own.uniform(0.0, np.inf), "high less low is inf, must be >= 0 and finite"),
            (lambda own: own.integers(0), "from 0 to 0: a range must have 1"),
            (lambda own: own.integers(3, 3), "from 3 to 3: a range must have 1"),
            (lambda own: own.integers(-1, 2**53), "range must have 1 to"),
            (lambda own: own.integers(2.5), r"high 2\.5: must be integers"),
            (lambda own: own.integers(2**63 - 1, 2**63), "must be integers from"),
            (lambda own: own.choice(0), "from 0 to 0: a range must have 1"),
            (lambda own: own.choice(3, 4, replace=False), "4 of 3 without replacement"),
            (lambda own: own.choice(2, p=[0.5, 0.6]), r"p \[0\.5 0\.6\]: must be 2 probabilities"),
            (lambda own: own.choice(2, p=[1.5, -0.5]), "must be 2 probabilities"),
            (lambda own: own.choice(3, p=[0.5, 0.5]), "must be 3 probabilities"),
            (lambda own: own.choice(2, 1, False, [0.5, 0.5]), "p does not go with replace=False"),
        ],
    )
    def test_what_is_out_of_bounds_is_named(
        self, call: Callable[[Stream], object], message: str
    ) -> None:
        with pytest.raises(InvalidValueError, match=message):
            call(named())


class TestIntegersAndChoices:
    def test_integers_are_within_their_range(self) -> None:
        drawn = named().integers(-3, 4, 1000)
        assert drawn.dtype == np.int64
        assert set(drawn.tolist()) == set(range(-3, 4))
        assert set(named().integers(3, size=1000, endpoint=True).tolist()) == set(range(4))
        assert named().integers([1, 10], [2, 11]).tolist() == [1, 10]
        assert named().integers(5, 6).item() == 5
        assert named().integers(np.array([], dtype=np.int64), 5).shape == (0,)

    def test_nothing_may_be_drawn_from_nothing(self) -> None:
        for empty in (
            named().integers(0, size=0),
            named().integers(3, 3, (2, 0)),
            named().choice([], size=0),
            named().choice(0, 0, replace=False),
        ):
            assert empty.size == 0

    @pytest.mark.parametrize("count", [6, 10, 2**52 + 1, 3 * 2**51])
    def test_no_integer_is_favoured(self, count: int) -> None:
        """Chi-square of three parts at 1e-6. Of 2**53 numbers, up to half are rejected here.

        Without rejection the first third of 3 * 2**51 would come twice as often as the others.
        """
        drawn = named().integers(count, size=60_000)
        assert drawn.min() >= 0
        assert drawn.max() < count
        part = -(-count // 3)
        shares = np.array([part, part, count - 2 * part]) / count
        counts = np.bincount(drawn // part, minlength=3)
        assert stats.chisquare(counts, len(drawn) * shares).pvalue > 1e-6

    def test_choices(self) -> None:
        """Chi-square at 1e-6."""
        letters = np.array(["a", "b", "c"])
        drawn = named().choice(letters, 30_000, p=[0.2, 0.0, 0.8])
        counts = [int((drawn == letter).sum()) for letter in letters]
        assert counts[1] == 0
        assert stats.chisquare(counts[::2], [6000.0, 24000.0]).pvalue > 1e-6
        assert named().choice(["left", "right"]) in {"left", "right"}
        rows = named().choice(np.arange(12).reshape(4, 3), (2, 5))
        assert rows.shape == (2, 5, 3)

    def test_an_order_is_as_likely_as_any_other(self) -> None:
        """Chi-square of the 24 orders of 4 at 1e-6."""
        own = named()
        orders = [tuple(own.choice(4, 4, replace=False).tolist()) for _ in range(6000)]
        assert set(orders) == set(itertools.permutations(range(4)))
        counts = [orders.count(order) for order in set(orders)]
        assert stats.chisquare(counts).pvalue > 1e-6


class TestWithoutNoise:
    def test_everything_is_at_the_middle(self) -> None:
        own = NoiseFreeStream()
        assert own.normal((2, 3)).tolist() == np.zeros((2, 3)).tolist()
        assert own.normal(2.0, 0.5, 2).tolist() == [2.0, 2.0]
        assert own.standard_normal() == 0.0
        assert own.random(2).tolist() == own.uniform(2).tolist() == [0.5, 0.5]
        assert own.uniform(-1.0, 3.0) == 1.0
        assert own.integers(0, 10) == 4
        assert own.integers(5, size=2).tolist() == [2, 2]
        assert own.choice(["a", "b", "c"]) == "b"
        assert own.choice(3, p=[0.1, 0.2, 0.7]) == 2
        assert sorted(own.choice(5, 5, replace=False).tolist()) == list(range(5))

    def test_it_does_not_end(self) -> None:
        NOISE_FREE.end()
        assert NOISE_FREE.normal() == 0.0
        assert NOISE_FREE.anew() is NOISE_FREE.lent() is NOISE_FREE

    @pytest.mark.parametrize("kind", ["normal", "random", "standard_normal", "uniform"])
    def test_who_waits_for_another_number_is_told(self, kind: str) -> None:
        own = NoiseFreeStream(limit=3)
        for _ in range(3):
            getattr(own, kind)()
        with pytest.raises(ProblemError, match="draws again and again"):
            getattr(own, kind)()
