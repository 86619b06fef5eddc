"""Comparing outcomes: known effects are found, intervals cover, and wrong pairs are refused."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy import stats
from tests import recordings

from holdfast.errors import OutputError
from holdfast.journal.journal import Journal
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.outcome import TrialResult
from holdfast.reports import outcome_comparison
from holdfast.reports.outcome_comparison import OutcomeEffect, compare_outcomes, effects_of

LIMIT = 100

CONFIGURATION = """\
problem: peg_in_hole_2d
model: {{hole_tolerance: {tolerance}}}
simulator: {{num_trials: {trials}, seed: {seed}, max_steps: {limit}}}
"""


def result_of(trial: int, steps: int, *, reward: float | None = None, **more: Any) -> TrialResult:
    made = recordings.result_of(trial, **more)
    return msgspec.structs.replace(made, steps=steps, reward=reward)


def run_of(
    path: Path,
    results: Sequence[TrialResult],
    *,
    tolerance: float = 0.1,
    seed: int = 5,
    limit: int = LIMIT,
    trials: int | None = None,
    environment: str = "",
) -> Path:
    path.mkdir()
    text = CONFIGURATION.format(
        tolerance=tolerance, trials=trials or len(results), seed=seed, limit=limit
    )
    text += environment
    with Journal.create(path / "journal.bin", {"configuration": text}) as journal:
        for result in results:
            journal.add(result)
    return path


def by_measure(effects: Sequence[OutcomeEffect]) -> dict[str, OutcomeEffect]:
    return {effect.measure: effect for effect in effects}


class TestEffects:
    def test_known_values(self) -> None:
        first = [
            result_of(0, 10, reward=-1.0, sensing_ms=(1.0, 3.0)),
            result_of(1, 40, success=False, reward=-2.0, sensing_ms=(2.0,)),
            result_of(2, 0, reward=0.0),
            result_of(3, 50, reward=-5.0, sensing_ms=(4.0,)),
        ]
        second = [
            result_of(0, 20, reward=-2.0, sensing_ms=(4.0,)),
            result_of(1, 50, reward=-2.0, sensing_ms=(4.0,)),
            result_of(2, 0, reward=0.0),
            result_of(3, 100, success=False, reward=-6.0, sensing_ms=(8.0,)),
        ]
        found = by_measure(effects_of(first, second, step_limit=LIMIT, paired=True))
        assert found["success_rate"].effect == 0.0
        # The failure counts as the limit, and the trial that begins in the goal does not count.
        assert found["steps"].trials == 3
        assert found["steps"].effect == pytest.approx((2 * 0.5 * 2) ** (1 / 3))
        assert found["steps"].baseline == pytest.approx((10 * 100 * 50) ** (1 / 3))
        assert found["reward"].effect == pytest.approx(-0.5)
        assert found["decision_ms"].effect == 2.0
        assert found["decision_ms"].interval is None, "each took twice as long"
        assert found["decision_ms"].verdict == "not judged"

    @pytest.mark.parametrize(("trials", "verdict"), [(9, "too few trials"), (10, "worse")])
    def test_few_trials_have_no_verdict(self, trials: int, verdict: str) -> None:
        runs = [
            [result_of(each, 10 + factor * each) for each in range(trials)] for factor in (1, 2)
        ]
        steps = by_measure(effects_of(*runs, step_limit=LIMIT, paired=True))["steps"]
        assert steps.interval is not None and steps.interval[0] > 1.0
        assert steps.verdict == verdict

    def test_failed_is_not_what_truncated_is(self) -> None:
        """Three successes and a truncated trial, against two crashes."""
        first = [result_of(trial, 10, success=trial > 0) for trial in range(4)]
        second = [result_of(trial, 10, success=trial > 1) for trial in range(4)]
        second[:2] = [msgspec.structs.replace(result, failed=True) for result in second[:2]]
        found = by_measure(effects_of(first, second, step_limit=LIMIT, paired=True))
        assert found["success_rate"].effect == -0.25
        failed = found["failure_rate"]
        assert (failed.baseline, failed.run, failed.effect) == (0.0, 0.5, 0.5)

    @pytest.mark.parametrize(("failing", "verdict"), [(0, "worse"), (1, "better")])
    def test_fewer_failures_are_better(self, failing: int, verdict: str) -> None:
        runs = [[result_of(trial, 10, success=False) for trial in range(20)] for _ in range(2)]
        runs[1 - failing][:15] = [
            msgspec.structs.replace(result, failed=True) for result in runs[1 - failing][:15]
        ]
        found = by_measure(effects_of(*runs, step_limit=LIMIT, paired=True))
        assert found["failure_rate"].verdict == verdict
        assert found["success_rate"].verdict == "no difference found"

    def test_what_is_not_recorded_is_not_compared(self) -> None:
        runs = [[result_of(trial, 5 + trial) for trial in range(4)] for _ in range(2)]
        found = by_measure(effects_of(*runs, step_limit=LIMIT, paired=True))
        assert set(found) == {"success_rate", "steps"}
        assert found["steps"].interval is None

    @pytest.mark.parametrize("paired", [True, False])
    def test_intervals_are_those_of_scipy(
        self, paired: bool, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(outcome_comparison, "_NUMBERS_IN_MEMORY", 20_000)  # so, in batches
        generator = np.random.default_rng(4)
        values = [generator.normal(size=length) for length in (30, 30 if paired else 25)]

        def difference(first: FloatArray, second: FloatArray, axis: int) -> Any:
            return np.mean(second, axis) - np.mean(first, axis)

        expected = stats.bootstrap(
            values,
            difference,
            paired=paired,
            vectorized=True,
            n_resamples=outcome_comparison.RESAMPLES,
            batch=20_000 // 30,
            method="percentile",
            random_state=np.random.default_rng(0),
        ).confidence_interval
        found = outcome_comparison.bootstrap_interval(values, difference, paired=paired)
        assert found == pytest.approx(tuple(expected), rel=1e-12)

    def test_pairs_find_what_independent_samples_do_not(self) -> None:
        generator = np.random.default_rng(3)
        steps = np.exp(generator.normal(5.0, 1.0, size=30))
        first = [result_of(trial, round(each)) for trial, each in enumerate(steps)]
        second = [
            result_of(trial, round(each * factor))
            for trial, (each, factor) in enumerate(
                zip(steps, np.exp(generator.normal(-0.2, 0.1, size=30)), strict=True)
            )
        ]
        verdicts = [
            by_measure(effects_of(first, second, step_limit=LIMIT, paired=paired))["steps"].verdict
            for paired in (True, False)
        ]
        assert verdicts == ["better", "no difference found"]


class TestRuns:
    def test_the_first_is_the_baseline_of_all(self, tmp_path: Path) -> None:
        runs = [
            run_of(
                tmp_path / str(factor),
                [result_of(trial, factor * (5 + trial % 3)) for trial in range(10)],
            )
            for factor in (2, 1, 4)
        ]
        found = compare_outcomes(runs)
        assert found.baseline == str(runs[0])
        assert [run.run for run in found.runs] == [str(run) for run in runs[1:]]
        effects = [by_measure(run.effects)["steps"].effect for run in found.runs]
        assert effects == pytest.approx([0.5, 2.0])
        assert f"{runs[1]} against {runs[0]}, 10 trials paired by number:" in found.describe()
        assert re.search(r"\n  steps +11\.68 +5\.842 +\W0\.5  ", found.describe())

    def test_trials_that_one_run_alone_has_are_left_out(self, tmp_path: Path) -> None:
        results = [result_of(trial, 5 + trial) for trial in range(6)]
        first = run_of(tmp_path / "first", results)
        second = run_of(tmp_path / "second", results[1:5], trials=6)
        (run,) = compare_outcomes([first, second]).runs
        assert run.trials == 4
        assert run.notes == (
            "trials that only one of the runs has finished, left out: 2",
            f"{second}: is not finished",
        )

    @pytest.mark.parametrize(
        ("other", "message"),
        [
            ({"seed": 6}, r"the seed is 6 here and 5 there.*\(--unpaired\)"),
            ({"tolerance": 0.2}, "model.hole_tolerance is 0.2 here and 0.1 there"),
            ({"limit": 50}, "the limit is 50 steps here and 100 there"),
        ],
    )
    def test_other_worlds_are_refused(
        self, other: dict[str, float], message: str, tmp_path: Path
    ) -> None:
        results = [result_of(trial, 5) for trial in range(3)]
        first = run_of(tmp_path / "first", results)
        second = run_of(tmp_path / "second", results, **other)  # type: ignore[arg-type]
        with pytest.raises(OutputError, match=message):
            compare_outcomes([first, second])
        if "seed" in other:
            assert not compare_outcomes([first, second], paired=False).paired
        else:
            with pytest.raises(OutputError, match=message):
                compare_outcomes([first, second], paired=False)

    def test_one_trial_is_too_few(self, tmp_path: Path) -> None:
        runs = [run_of(tmp_path / name, [result_of(0, 5)]) for name in ("first", "second")]
        with pytest.raises(OutputError, match="intervals need at least 2"):
            compare_outcomes(runs)


def test_runs_of_other_arguments_of_a_world_are_not_paired(tmp_path: Path) -> None:
    """A gymnasium world is its arguments; those of one's own robot may be a port."""

    def of(name: str, world: str, gravity: float) -> Path:
        section = f"environment: {{object: {world}, arguments: {{gravity: {gravity}}}}}\n"
        results = [result_of(trial, 20) for trial in range(12)]
        return run_of(tmp_path / name, results, environment=section)

    baseline = of("first", "gymnasium", -10.0)
    for paired in (True, False):
        with pytest.raises(
            OutputError, match=r"environment\.arguments\.gravity is -4\.0 here and -10\.0 there"
        ):
            compare_outcomes([baseline, of(f"{paired}", "gymnasium", -4.0)], paired=paired)
    mine = [of("mine", "arm:Arm", -10.0), of("other", "arm:Arm", -4.0)]
    (found,) = compare_outcomes(mine).runs
    assert any("environment.arguments.gravity is -4.0 here" in note for note in found.notes)
