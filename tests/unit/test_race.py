"""The race, on candidates whose true costs are known."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import pytest

from holdfast.numerics.arrays import FloatArray
from holdfast.tuning.race import MeasuredTrial, Standing, beats, race

LIMIT = 250.0
MOST = 160


def world(
    seed: int, kinds: Mapping[str, tuple[float, float, float]]
) -> Callable[[Sequence[tuple[str, int]]], list[MeasuredTrial]]:
    """Return what runs trials of candidates: (factor, share of failures, seconds) of each."""
    generator = np.random.default_rng(seed)
    shared = generator.gamma(9.0, 7.0, MOST)
    costs: dict[str, FloatArray] = {}
    for name, (factor, failures, _) in kinds.items():
        own = np.clip(factor * shared + generator.normal(0.0, 5.0, MOST), 1.0, LIMIT)
        costs[name] = np.where(generator.random(MOST) < failures, LIMIT, own)

    def run(jobs: Sequence[tuple[str, int]]) -> list[MeasuredTrial]:
        assert len(set(jobs)) == len(jobs)
        return [MeasuredTrial(name, n, costs[name][n], kinds[name][2]) for name, n in jobs][::-1]

    return run


def by_name(standings: Sequence[Standing]) -> dict[str, Standing]:
    return {each.candidate: each for each in standings}


def test_the_best_is_dropped_in_few_races() -> None:
    """``quick`` is quicker in 95 of 100 trials, and fails in the others: no small sample shows it.

    The bound is 5 % of the races: more than 12 of 100 come about once in a thousand times.
    """
    kinds = {"quick": (0.93, 0.05, 0.1), "best": (1.0, 0.0, 0.1), "same": (1.0, 0.002, 0.1)}
    kinds["poor"] = (1.0, 0.5, 0.1)
    dropped, poor = 0, 0
    for seed in range(100):
        standings = by_name(race(list(kinds), world(seed, kinds), limit=LIMIT, most=MOST))
        dropped += standings["best"].state == "beaten"
        poor += standings["poor"].state == "beaten"
    assert dropped <= 12
    assert poor == 100


def test_no_number_of_looks_makes_a_tie_a_victory() -> None:
    """Asked after each trial, of heavy tails: more than 40 of 400 at 5 % is once in 10,000."""
    found = 0
    for seed in range(400):
        generator = np.random.default_rng(seed)
        costs = np.where(generator.random((2, MOST)) < 0.1, LIMIT, 50.0)
        found += beats(costs[0] - costs[1], LIMIT, 0.05)
    assert found <= 40
    assert beats(np.full(40, 60.0), LIMIT, 0.05)
    assert not beats(np.full(2, LIMIT), LIMIT, 0.05)
    assert not beats(np.empty(0), LIMIT, 0.05)


def test_of_equals_all_stay() -> None:
    kinds = dict.fromkeys("abc", (1.0, 0.1, 0.1))
    standings = race(list(kinds), world(1, kinds), limit=LIMIT, most=40)
    assert [(each.trials, each.state) for each in standings] == [(40, "in the race")] * 3


def test_a_slow_one_does_not_eat_the_budget() -> None:
    kinds = {"configured": (1.0, 0.2, 0.1), "good": (1.0, 0.0, 0.1), "slow": (1.0, 0.0, 2.0)}
    standings = by_name(race(list(kinds), world(2, kinds), limit=LIMIT, most=MOST, budget_s=90.0))
    assert sum(each.trials * each.seconds for each in standings.values()) <= 90.0
    assert 10 <= standings["slow"].trials < standings["good"].trials
    assert standings["slow"].seconds == pytest.approx(2.0)
    # Where ten trials exceed what there is, one says how long it takes.
    standings = by_name(race(list(kinds), world(2, kinds), limit=LIMIT, most=MOST, budget_s=20.0))
    assert standings["slow"].trials == 2
    assert standings["slow"].reason == "10 trials take 20 s, more than its share of the time"
    assert standings["good"].trials > 10


def test_the_worse_half_is_set_aside_where_time_is_short() -> None:
    kinds = {f"{n}": (1.0 + 0.1 * n, 0.0, 1.0) for n in range(8)}
    standings = race(list(kinds), world(3, kinds), limit=LIMIT, most=MOST, budget_s=300.0)
    assert standings[0].candidate == "0"
    assert {each.candidate for each in standings if each.state == "set aside"} >= {"5", "6", "7"}
    assert sum(each.trials for each in standings) <= 300


def test_few_trials_are_not_lucky_worlds() -> None:
    """What had only the first, easy trials is compared on these alone."""
    costs = {"a": np.arange(MOST, dtype=float), "b": np.arange(MOST) + 1.0}

    def run(jobs: Sequence[tuple[str, int]]) -> list[MeasuredTrial]:
        seconds = {"a": 0.1, "b": 5.0}
        return [MeasuredTrial(name, n, costs[name][n], seconds[name]) for name, n in jobs]

    first, second = race(["a", "b"], run, limit=1000.0, most=MOST, budget_s=150.0)
    assert (first.candidate, second.candidate) == ("a", "b")
    assert 10 <= second.trials < 30 < first.trials
    assert second.mean == pytest.approx(first.mean + 1.0)
    assert second.deviation == 0.0


def test_who_must_not_win() -> None:
    kinds = {"configured": (1.2, 0.0, 0.1), "best": (1.0, 0.0, 0.1), "fails": (0.5, 0.0, 0.1)}
    run = world(4, kinds)

    def leaves_out(jobs: Sequence[tuple[str, int]]) -> list[MeasuredTrial]:
        return [each for each in run(jobs) if each.candidate != "fails"]

    reasons = {"best": "too slow", "fails": None}
    # Without a limit: the range of what was seen.
    standings = race(list(kinds), leaves_out, most=20, refuse=reasons.get)
    assert [each.candidate for each in standings] == ["configured", "best", "fails"]
    assert [each.reason for each in standings[1:]] == ["too slow", "there was no time for a trial"]
    assert [each.trials for each in standings] == [10, 2, 0]  # one is left: nothing to decide
