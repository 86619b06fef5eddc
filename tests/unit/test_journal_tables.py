"""``trials.csv`` and ``summary.json``."""

import csv
import io
import json
from typing import Any

import msgspec
import pytest
import scipy.stats
from tests.recordings import failed, result_of

from holdfast.cli.terminal import _summary_rows
from holdfast.journal.tables import RunSummary, SummaryBuilder, csv_lines, wilson_interval
from holdfast.journal.timings import AnswerCounts
from holdfast.planning.outcome import TRIAL_COLUMNS, TrialResult


def summary_of(*results: TrialResult, **changes: Any) -> RunSummary:
    builder = SummaryBuilder()
    for result in results:
        builder.add(result)
    given = {"problem": "p", "seed": 5, "version": "1", "wall_time_s": 2.0}
    return builder.build(**{**given, "trials": len(results), **changes})


class TestTables:
    def test_a_reason_is_no_formula_and_stays_in_its_row(self) -> None:
        """An environment, or the journal of somebody else, may say anything."""
        for reason, written in (("=HYPERLINK(1)", "'=HYPERLINK(1)"), ("a\n=1\r", "a\n=1\r")):
            result = msgspec.structs.replace(result_of(0), reason=reason)
            (row,) = csv.DictReader(io.StringIO("".join(csv_lines([result])), newline=""))
            assert row["reason"] == written
            assert float(row["reward"]) == result.reward

    @pytest.mark.parametrize("trials", [1, 2, 10, 1000])
    def test_wilson_interval_is_that_of_scipy(self, trials: int) -> None:
        for successes in {0, 1, trials // 3, trials - 1, trials}:
            expected = scipy.stats.binomtest(successes, trials).proportion_ci(method="wilson")
            low, high = wilson_interval(successes, trials)
            assert low == pytest.approx(expected.low, abs=1e-12)
            assert high == pytest.approx(expected.high, abs=1e-12)

    def test_csv_numbers_read_back_exactly(self) -> None:
        results = [
            result_of(0, reward=-0.1 - 0.2),
            result_of(1, success=False, reward=1e-300),
            failed(result_of(2)),
        ]
        rows = list(csv.DictReader("".join(csv_lines(results)).splitlines()))
        assert tuple(rows[0]) == TRIAL_COLUMNS
        assert " ".join(TRIAL_COLUMNS) == (
            "trial seed success steps reward sensing_decisions mean_sensing_ms recoveries "
            "unexplained_observations digest lost suspect_sensors missing_observations "
            "fewest_distinct_particles outcome reason"
        )
        for row, result in zip(rows, results, strict=True):
            assert float(row["reward"]) == result.reward
            assert float(row["mean_sensing_ms"]) == result.mean_sensing_ms
            assert int(row["success"]) == result.success
            assert row["digest"] == result.digest
        assert [row["outcome"] for row in rows] == ["succeeded", "truncated", "failed"]
        assert [row["success"] for row in rows] == ["1", "0", "0"]

    def test_summary(self) -> None:
        summary = summary_of(
            result_of(0, reward=-1.0, sensing_ms=(1.0, 2.0)),
            result_of(1, reward=-3.0, sensing_ms=(3.00006,)),
            result_of(2, reward=-8.0, success=False),
            trials=4,
            wall_time_s=2.0004,
        )
        assert (summary.trials, summary.finished, summary.successes) == (4, 3, 2)
        assert summary.success_rate == pytest.approx(2 / 3)
        assert summary.mean_reward == pytest.approx(-4.0)
        assert summary.mean_reward_of_successes == pytest.approx(-2.0)
        assert summary.mean_steps == pytest.approx(11.0)
        assert summary.sensing_ms_median == pytest.approx(2.0)
        assert (summary.sensing_ms_p99, summary.wall_time_s) == (2.9801, 2.0)
        assert summary.earlier_code is msgspec.UNSET
        assert summary.to_json().startswith('{\n  "')
        assert summary.unexplained_observations == 3
        assert json.loads(summary.to_json())["digest"] == summary.digest
        assert summary.failures == 0
        assert "failed" not in dict(_summary_rows(summary))
        assert "lost" not in dict(_summary_rows(summary))

    def test_lost_robots_and_suspect_sensors_are_told_if_there_are_any(self) -> None:
        results = []
        for trial, (lost, suspects) in enumerate([(2, 0), (0, 1), (1, 0)]):
            result = result_of(trial)
            results.append(msgspec.structs.replace(result, lost=lost, suspect_sensors=suspects))
        summary = summary_of(*results)
        assert (summary.lost, summary.suspect_sensors) == (3, 1)
        assert dict(_summary_rows(summary))["lost"].startswith("3 times, 1 suspect sensor (")

    @pytest.mark.parametrize(("unexplained", "is_advised"), [(5, False), (6, True)])
    def test_unexplained_observations_lead_to_advice_above_the_share_of_a_sound_belief(
        self, unexplained: int, is_advised: bool
    ) -> None:
        result = msgspec.structs.replace(
            result_of(0), sensing_decisions=100, unexplained_observations=unexplained
        )
        summary = summary_of(result)
        said = " ".join(value for _, value in _summary_rows(summary))
        assert f"{unexplained} of 100 observations over 8 sigma" in said
        assert ("take more particles" in said) == is_advised

    def test_missing_observations_are_told_if_there_are_any(self) -> None:
        results = []
        for trial, missing in enumerate([2, 0, 1]):
            result = msgspec.structs.replace(result_of(trial), sensing_decisions=5)
            results.append(msgspec.structs.replace(result, missing_observations=missing))
        summary = summary_of(*results)
        assert summary.missing_observations == 3
        assert dict(_summary_rows(summary))["no reading"] == "3 of 15 looks had no observation"

    def test_the_fewest_particles_are_those_of_the_worst_trial(self) -> None:
        results = []
        for trial, fewest in enumerate((None, 300, 4, 20)):
            result = result_of(trial)
            results.append(msgspec.structs.replace(result, fewest_distinct_particles=fewest))
        summary = summary_of(*results)
        assert json.loads(summary.to_json())["fewest_distinct_particles"] == 4

    def test_failures_are_no_successes_and_told_if_there_are_any(self) -> None:
        summary = summary_of(
            result_of(0, reward=-1.0),
            failed(result_of(1, reward=-8.0)),
            failed(result_of(2)),
            result_of(3, success=False),
        )
        assert (summary.successes, summary.failures, summary.finished) == (1, 2, 4)
        assert summary.success_rate == pytest.approx(0.25)
        assert summary.mean_reward_of_successes == pytest.approx(-1.0)
        assert dict(_summary_rows(summary))["failed"] == "2 of 4 trials (1 truncated)"

    def test_the_mean_of_rewards_that_are_not_there_is_none(self) -> None:
        """A trial without a reward has not earned 0."""
        without = msgspec.structs.replace(result_of(1, success=False), reward=None)
        summary = summary_of(result_of(0, reward=-1.0), without)
        assert summary.mean_reward is None
        assert summary.mean_reward_of_successes == -1.0
        assert "mean reward" not in dict(_summary_rows(summary))
        (row,) = csv.DictReader(csv_lines([without]))
        assert row["reward"] == ""

    def test_who_decided_is_told_where_it_is_known(self) -> None:
        result = msgspec.structs.replace(result_of(0), sensing_decisions=17)
        counts = AnswerCounts({"cloud": 13, "local": 4}, {"cloud": 17}, 12.5)
        summary = summary_of(result, answers=counts)
        assert summary.sensing_decisions == 17
        written = json.loads(summary.to_json())
        assert written["sensing_decisions_by_service"] == {"cloud": 13, "local": 4}
        assert written["task_answers_by_service"] == {"cloud": 17}
        assert written["longest_wait_ms"] == 12.5

    def test_the_digest_depends_on_every_trial_and_their_order(self) -> None:
        def digest(*order: int) -> str:
            return summary_of(*map(result_of, order)).digest

        assert len({digest(0, 1, 2), digest(0, 2, 1), digest(0, 1), digest()}) == 4

    def test_without_trials_there_are_no_means(self) -> None:
        summary = summary_of(trials=3)
        assert summary.finished == 0
        assert summary.success_rate is None
        assert summary.mean_reward is None
        assert summary.sensing_ms_median is None
