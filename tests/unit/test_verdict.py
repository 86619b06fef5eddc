"""What fresh trials say of a race's winner."""

from collections.abc import Sequence

import numpy as np
import pytest

from holdfast.tuning.candidates import AS_CONFIGURED, RANDOM
from holdfast.tuning.kept_trials import TrialRow
from holdfast.tuning.verdict import cost_of, judge, mean_difference

LIMIT = 100
WORLDS = np.random.default_rng(5).integers(20, 60, 200)


def rows(
    name: str,
    more: float,
    *,
    failures: Sequence[int] = (),
    reward: float | None = None,
    decision_ms: float = 1.0,
) -> list[TrialRow]:
    """Return trials that take so many steps more than others of the same worlds, about."""
    noise = np.random.default_rng(list(name.encode())).normal(0.0, 4.0, len(WORLDS))
    return [
        TrialRow(name, n, n not in failures, False, "", steps, reward, decision_ms, 0.1)
        for n, steps in enumerate(np.rint(WORLDS + more + noise).astype(int).tolist())
    ]


def trials_of(configured: float, random: float, **others: float) -> dict[str, list[TrialRow]]:
    """Return the trials of candidates by how many steps more they take."""
    more = {AS_CONFIGURED: configured, RANDOM: random, **others}
    return {name: rows(name, steps) for name, steps in more.items()}


def test_a_winner_that_is_better() -> None:
    trials = trials_of(10.0, 20.0)
    trials["state_entropy"] = rows("state_entropy", 0.0, decision_ms=20.0)
    found = judge(trials, ["state_entropy"], "steps", LIMIT)
    assert (found.choice, found.matters) == ("state_entropy", True)
    first = found.comparisons[0]
    assert (first.against, first.measure, first.finding) == (AS_CONFIGURED, "steps", 1)
    assert first.interval[0] < first.difference < first.interval[1] < 0.0
    assert first.difference == pytest.approx(first.value - first.other)
    assert found.sentence.startswith("Sense by state_entropy: ")
    assert "steps against your configuration; " in found.sentence
    assert "within noise" not in found.sentence


def test_a_winner_of_the_race_that_others_beat() -> None:
    found = judge(trials_of(0.0, 20.0, lucky=3.0), ["lucky"], "steps", LIMIT)
    assert found.choice == AS_CONFIGURED
    assert found.sentence.startswith("Keep your configuration: ")
    found = judge(trials_of(30.0, 0.0, path=20.0), ["path"], "steps", LIMIT)
    assert found.sentence.startswith("Sense at random: ")


def test_no_trial_succeeds() -> None:
    trials = {
        name: [each._replace(success=False) for each in found]
        for name, found in trials_of(0.0, 0.0, other=0.0).items()
    }
    assert "No trial succeeded" in judge(trials, ["other"], "steps", LIMIT).sentence


def test_nothing_matters() -> None:
    trials = trials_of(0.0, 0.0, other=0.0)
    found = judge(trials, ["other"], "steps", LIMIT)
    assert (found.choice, found.matters) == (AS_CONFIGURED, False)
    assert found.sentence.startswith("What you sense does not matter here, as far as 200 trials")
    assert found.sentence.endswith("Keep your configuration.")
    # The same with few trials: what they would not have shown is said.
    few = {name: trials[name][:10] for name in trials}
    few["other"][3] = few["other"][3]._replace(success=False)
    sentence = judge(few, ["other"], "steps", LIMIT).sentence
    assert "would not have shown" in sentence and sentence.startswith("No difference showed in ")
    same = {AS_CONFIGURED: trials[AS_CONFIGURED], RANDOM: trials[AS_CONFIGURED]}
    assert judge(same, AS_CONFIGURED, "steps", LIMIT).comparisons[0].interval == (0.0, 0.0)


def test_other_measures_may_say_otherwise() -> None:
    failing = range(0, 200, 10)
    trials = {
        AS_CONFIGURED: rows(AS_CONFIGURED, 30.0, reward=-1.0),
        "hasty": rows("hasty", 0.0, failures=failing, reward=-3.0),
        RANDOM: rows(RANDOM, 30.0, reward=-1.0),
    }
    found = judge(trials, ["hasty"], "steps", LIMIT)
    assert found.choice == "hasty"
    assert found.sentence.count("But success says otherwise: -10 [") == 2
    assert found.sentence.count("But reward says otherwise: -2 [-2, -2] of reward") == 2
    found = judge(trials, ["hasty"], "reward", LIMIT)
    assert found.choice == AS_CONFIGURED
    assert "But steps says otherwise: " in found.sentence


def test_slower_decisions_need_a_reason() -> None:
    trials = trials_of(0.5, 30.0)
    trials["slow"] = rows("slow", 0.0, decision_ms=20.0)
    trials["quick"] = rows("quick", 0.0, decision_ms=1.5)
    quick = {name: trials[name] for name in (AS_CONFIGURED, "quick", RANDOM)}
    slow = {name: trials[name] for name in (AS_CONFIGURED, "slow", RANDOM)}
    assert judge(quick, ["quick"], "steps", LIMIT).choice == "quick"
    assert judge(slow, ["slow"], "steps", LIMIT).choice == AS_CONFIGURED


def test_of_two_finalists_the_quick_one_if_it_is_as_good() -> None:
    trials = trials_of(30.0, 30.0)
    trials["slow"] = rows("slow", 0.0, decision_ms=20.0)
    trials["quick"] = rows("quick", 0.0, decision_ms=2.0)
    found = judge(trials, ["slow", "quick"], "steps", LIMIT)
    assert found.choice == "quick"
    slower = " slow is no better beyond noise and takes 20 ms to decide, not 2."
    assert (slower in found.sentence) == (
        np.mean([a.steps - b.steps for a, b in zip(trials["slow"], trials["quick"], strict=True)])
        < 0
    )
    trials["quick"] = rows("quick", 2.0, decision_ms=2.0)
    assert judge(trials, ["slow", "quick"], "steps", LIMIT).choice == "slow"
    few = judge(
        {name: each[:19] for name, each in trials.items()}, ["slow"], "steps", LIMIT, (), 20
    )
    assert (few.choice, few.comparisons) == (AS_CONFIGURED, ())
    assert few.sentence.startswith("The budget was too short to judge: 19 fresh trials of at least")


def test_a_slow_one_does_not_hide_that_random_sensing_is_better() -> None:
    trials = trials_of(8.0, 0.0)
    swings = [60 * (-1) ** n for n in range(len(WORLDS))]
    trials["slow"] = [
        row._replace(candidate="slow", steps=row.steps - 2 + swing, decision_ms=20.0)
        for row, swing in zip(trials[RANDOM], swings, strict=True)
    ]
    found = judge(trials, ["slow"], "steps", LIMIT)
    assert found.choice == RANDOM
    assert found.sentence.startswith("Sense at random: ")


def test_who_is_barred_or_failed_afterwards_is_not_chosen() -> None:
    assert judge(trials_of(0.0, 0.0), ["gone"], "steps", LIMIT, {AS_CONFIGURED}).choice == RANDOM
    trials = {AS_CONFIGURED: rows(AS_CONFIGURED, 0.0), "other": rows("other", 0.0)}
    found = judge(trials, ["other"], "steps", LIMIT, {AS_CONFIGURED})
    assert found.choice == "other"
    assert found.sentence.endswith("Sense by other.")


def test_costs_and_intervals() -> None:
    row = rows("a", 0.0, failures=[0], reward=-2.0)[0]
    assert [cost_of(row, each, LIMIT) for each in ("steps", "success", "reward")] == [100, 0, 2]
    assert np.isnan(cost_of(row._replace(reward=None), "reward", LIMIT))
    middle, (low, high) = mean_difference(np.random.default_rng(1).normal(size=400))
    # Four standard errors of the mean, and of an interval's length.
    assert abs(middle) < 0.2
    assert 0.17 < high - low < 0.23
