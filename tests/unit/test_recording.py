"""Journal, tables, the run's directory, the recorder and the figure."""

from __future__ import annotations

import contextlib
import csv
import json
import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
import scipy.stats
from matplotlib.figure import Figure
from matplotlib.image import imread

from holdfast.cli.terminal import _summary_rows
from holdfast.configuration import Configuration, load
from holdfast.files import OutputError, write_atomically
from holdfast.outcome import Decisions, TrialResult
from holdfast.planning import Planner, digest
from holdfast.recording.figure import _draw_entropies, _draw_workspace, trial_figure
from holdfast.recording.journal import Journal
from holdfast.recording.recorder import MAX_PARTICLES_KEPT, RecordedEnvironment, Recorder
from holdfast.recording.run_directory import (
    RunDirectory,
    claim_default_directory,
    latest_default_directory,
    output_names,
)
from holdfast.recording.tables import (
    CSV_COLUMNS,
    SummaryBuilder,
    csv_lines,
    wilson_interval,
)
from holdfast.recording.timings import AnswerCounts
from holdfast.runtime.trial import NullObserver, SensingStep, TaskStep, run_trial
from holdfast.session.records import (
    ActingRecord,
    ObservedRecord,
    PausedRecord,
    PerformedRecord,
    Record,
    RecordError,
)
from holdfast.session.robot import replay
from holdfast.settings import EnvironmentSettings

EXAMPLES = Path(__file__).parents[2] / "examples"

BEFORE_OUTCOMES = Path(__file__).parent / "data" / "journal_before_outcomes.sqlite"
"""Of a robot killed at step 21 of trial 2, when results said only whether a trial succeeded."""


def result_of(
    trial: int, *, success: bool = True, reward: float = -1.0, sensing_ms: tuple[float, ...] = ()
) -> TrialResult:
    decisions = Decisions(1, trial.to_bytes(8, "little"))
    return TrialResult(
        trial=trial,
        seed=5,
        success=success,
        steps=10 + trial,
        reward=reward,
        sensing_decisions=len(sensing_ms),
        mean_sensing_ms=0.1 + 0.2,
        recoveries=0,
        unexplained_observations=1,
        digest=decisions.digest(),
        sensing_ms=sensing_ms,
        decisions=decisions,
    )


def configuration_of(
    tmp_path: Path,
    *,
    seed: int = 5,
    tolerance: float = 0.1,
    num_particles: int = 30,
    max_steps: int = 30,
) -> Configuration:
    path = tmp_path / "peg.yaml"
    path.write_text(
        "problem: peg_in_hole_2d\n"
        f"model: {{hole_tolerance: {tolerance}}}\n"
        f"particle_filter: {{num_particles: {num_particles}}}\n"
        "active_sensing: {num_observation_samples: 2, num_cores: 1}\n"
        f"simulator: {{num_trials: 3, max_steps: {max_steps}, seed: {seed}}}\n"
    )
    return load(path)


def failed(result: TrialResult) -> TrialResult:
    return msgspec.structs.replace(result, success=False, failed=True)


def without_decisions(result: TrialResult) -> TrialResult:
    return msgspec.structs.replace(result, decisions=None)


class TestAtomicFiles:
    def test_text_bytes_and_lines(self, tmp_path: Path) -> None:
        path = tmp_path / "file"
        for content, expected in (
            ("θ", "θ"),
            (b"bytes", "bytes"),
            (iter(["a\n", "b\n"]), "a\nb\n"),
        ):
            write_atomically(path, content)
            assert path.read_text(encoding="utf-8") == expected
        assert [entry.name for entry in tmp_path.iterdir()] == ["file"]

    def test_a_failure_leaves_the_old_file_and_nothing_else(self, tmp_path: Path) -> None:
        path = tmp_path / "file"
        write_atomically(path, "old")

        def lines() -> list[str]:
            raise ZeroDivisionError

        with pytest.raises(ZeroDivisionError):
            write_atomically(path, (line for _ in range(1) for line in lines()))
        assert path.read_text() == "old"
        assert [entry.name for entry in tmp_path.iterdir()] == ["file"]

    def test_a_missing_directory_is_named(self, tmp_path: Path) -> None:
        with pytest.raises(OutputError, match="missing/file: cannot be written: No such file"):
            write_atomically(tmp_path / "missing" / "file", "text")


class TestJournal:
    def test_what_was_added_comes_back_in_order(self, tmp_path: Path) -> None:
        path = tmp_path / "journal.sqlite"
        results = [result_of(2, success=False), result_of(0), result_of(1, sensing_ms=(0.5, 1.5))]
        with Journal.create(path, {"key": "value"}) as journal:
            for result in results:
                journal.add(result)
        with Journal.open(path) as journal:
            assert journal.meta()["key"] == "value"
            assert journal.finished() == {0, 1, 2}
            assert journal.tally() == (3, 2, 0)
            expected = sorted(map(without_decisions, results), key=lambda result: result.trial)
            assert list(journal.results()) == expected
            for result in results:
                assert journal.decisions(result.trial) == result.decisions

    def test_how_a_trial_ended_comes_back(self, tmp_path: Path) -> None:
        path = tmp_path / "journal.sqlite"
        with Journal.create(path, {}) as journal:
            journal.add(result_of(0))
            journal.add(failed(result_of(1)))
            journal.add(result_of(2, success=False))
        with Journal.open(path) as journal:
            outcomes = [result.outcome for result in journal.results()]
            assert outcomes == ["succeeded", "failed", "truncated"]
            assert journal.tally() == (3, 1, 1)

    def test_one_from_before_trials_could_fail(self, tmp_path: Path) -> None:
        """It was made by that code: trials without success had run out of steps."""
        path = tmp_path / "journal.sqlite"
        shutil.copyfile(BEFORE_OUTCOMES, path)
        with Journal.open(path) as journal:
            results = list(journal.results(with_decisions=True))
            assert [result.outcome for result in results] == ["truncated", "succeeded"]
            assert [result.success for result in results] == [False, True]
            assert journal.tally() == (2, 1, 0)
            (tmp_path / "old.yaml").write_text(journal.meta()["configuration"])
            configuration = load(tmp_path / "old.yaml")
            for result in results:
                again = run_trial(
                    configuration.problem,
                    configuration.planning,
                    configuration.simulator,
                    result.trial,
                )
                assert again.digest == result.digest
                assert again.outcome == result.outcome
            unfinished = journal.unfinished()
            assert unfinished is not None
            planner = Planner(configuration.problem, configuration.planning)
            history = replay(planner, 2, unfinished.trial, unfinished.records)
            assert (unfinished.trial, history.state.step) == (2, 21)

    def test_closing_leaves_one_file(self, tmp_path: Path) -> None:
        with Journal.create(tmp_path / "journal.sqlite", {}) as journal:
            journal.add(result_of(0))
        assert [entry.name for entry in tmp_path.iterdir()] == ["journal.sqlite"]

    def test_a_trial_is_kept_once(self, tmp_path: Path) -> None:
        with Journal.create(tmp_path / "journal.sqlite", {}) as journal:
            journal.add(result_of(0, reward=-1.0))
            with pytest.raises(OutputError, match="UNIQUE"):
                journal.add(result_of(0, reward=-2.0))
            assert [result.reward for result in journal.results()] == [-1.0]

    def test_it_belongs_to_one_process_at_a_time(self, tmp_path: Path) -> None:
        path = tmp_path / "journal.sqlite"
        with (
            Journal.create(path, {}),
            pytest.raises(OutputError, match="another process is using this run"),
        ):
            Journal.open(path)
        Journal.open(path).close()

    def test_a_trial_that_is_not_there_is_named(self, tmp_path: Path) -> None:
        with (
            Journal.create(tmp_path / "journal.sqlite", {}) as journal,
            pytest.raises(OutputError, match="trial 7 is not in the journal"),
        ):
            journal.decisions(7)

    def test_other_files_are_refused(self, tmp_path: Path) -> None:
        path = tmp_path / "journal.sqlite"
        with pytest.raises(OutputError, match="there is no journal"):
            Journal.open(path)
        path.write_bytes(b"no database at all, but long enough to be looked at" * 20)
        with pytest.raises(OutputError, match="not a usable journal"):
            Journal.open(path)
        path.unlink()
        path.touch()
        with pytest.raises(OutputError, match="is empty"):
            Journal.open(path)
        path.unlink()
        with contextlib.closing(sqlite3.connect(path)) as connection:
            connection.execute("CREATE TABLE other (value INTEGER)")
        before = path.read_bytes()
        with pytest.raises(OutputError, match="no such table: meta"):
            Journal.open(path)
        assert path.read_bytes() == before

    def test_another_version_is_refused(self, tmp_path: Path) -> None:
        path = tmp_path / "journal.sqlite"
        with Journal.create(path, {}) as journal:
            journal.set_meta("schema_version", "999")
        with pytest.raises(OutputError, match="schema version 999; this holdfast reads version 3"):
            Journal.open(path)


class TestTables:
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
        assert tuple(rows[0]) == CSV_COLUMNS
        assert CSV_COLUMNS == (
            "trial",
            "seed",
            "success",
            "steps",
            "reward",
            "sensing_decisions",
            "mean_sensing_ms",
            "recoveries",
            "unexplained_observations",
            "digest",
            "outcome",
        )
        for row, result in zip(rows, results, strict=True):
            assert float(row["reward"]) == result.reward
            assert float(row["mean_sensing_ms"]) == result.mean_sensing_ms
            assert int(row["success"]) == result.success
            assert row["digest"] == result.digest
        assert [row["outcome"] for row in rows] == ["succeeded", "truncated", "failed"]
        assert [row["success"] for row in rows] == ["1", "0", "0"]

    def test_summary(self) -> None:
        builder = SummaryBuilder()
        builder.add(result_of(0, reward=-1.0, sensing_ms=(1.0, 2.0)))
        builder.add(result_of(1, reward=-3.0, sensing_ms=(3.0,)))
        builder.add(result_of(2, reward=-8.0, success=False))
        summary = builder.build(problem="p", seed=5, version="1", trials=4, wall_time_s=2.0)
        assert (summary.trials, summary.finished, summary.successes) == (4, 3, 2)
        assert summary.success_rate == pytest.approx(2 / 3)
        assert summary.mean_reward == pytest.approx(-4.0)
        assert summary.mean_reward_of_successes == pytest.approx(-2.0)
        assert summary.mean_steps == pytest.approx(11.0)
        assert summary.sensing_ms_median == pytest.approx(2.0)
        assert summary.sensing_ms_p99 == pytest.approx(2.98)
        assert summary.unexplained_observations == 3
        assert json.loads(summary.to_json())["digest"] == summary.digest
        assert summary.failures == 0
        assert "failed" not in dict(_summary_rows(summary))

    def test_failures_are_no_successes_and_told_if_there_are_any(self) -> None:
        builder = SummaryBuilder()
        builder.add(result_of(0, reward=-1.0))
        builder.add(failed(result_of(1, reward=-8.0)))
        builder.add(failed(result_of(2)))
        builder.add(result_of(3, success=False))
        summary = builder.build(problem="p", seed=5, version="1", trials=4, wall_time_s=2.0)
        assert (summary.successes, summary.failures, summary.finished) == (1, 2, 4)
        assert summary.success_rate == pytest.approx(0.25)
        assert summary.mean_reward_of_successes == pytest.approx(-1.0)
        assert dict(_summary_rows(summary))["failed"] == "2 of 4 trials"

    def test_the_mean_of_rewards_that_are_not_there_is_none(self) -> None:
        """A trial without a reward has not earned 0."""
        without = msgspec.structs.replace(result_of(1, success=False), reward=None)
        builder = SummaryBuilder()
        builder.add(result_of(0, reward=-1.0))
        builder.add(without)
        summary = builder.build(problem="p", seed=5, version="1", trials=2, wall_time_s=2.0)
        assert summary.mean_reward is None
        assert summary.mean_reward_of_successes == -1.0
        assert "mean reward" not in dict(_summary_rows(summary))
        (row,) = csv.DictReader(csv_lines([without]))
        assert row["reward"] == ""

    def test_who_decided_is_told_where_it_is_known(self) -> None:
        builder = SummaryBuilder()
        result = result_of(0, sensing_ms=(1.0, 2.0))
        builder.add(msgspec.structs.replace(result, sensing_decisions=17))
        summary = builder.build(
            problem="p",
            seed=5,
            version="1",
            trials=1,
            wall_time_s=2.0,
            answers=AnswerCounts({"cloud": 13, "local": 4}, {"cloud": 17}, 12.5),
        )
        assert summary.sensing_decisions == 17
        written = json.loads(summary.to_json())
        assert written["sensing_decisions_by_service"] == {"cloud": 13, "local": 4}
        assert written["task_answers_by_service"] == {"cloud": 17}
        assert written["longest_wait_ms"] == 12.5

    def test_the_digest_depends_on_every_trial_and_their_order(self) -> None:
        def digest(*order: int) -> str:
            builder = SummaryBuilder()
            for trial in order:
                builder.add(result_of(trial))
            return builder.build(problem="p", seed=5, version="1", trials=3, wall_time_s=0.0).digest

        assert len({digest(0, 1, 2), digest(0, 2, 1), digest(0, 1), digest()}) == 4

    def test_without_trials_there_are_no_means(self) -> None:
        summary = SummaryBuilder().build(
            problem="p", seed=5, version="1", trials=3, wall_time_s=0.0
        )
        assert summary.finished == 0
        assert summary.success_rate is None
        assert summary.mean_reward is None
        assert summary.sensing_ms_median is None


class TestRunDirectory:
    def test_tables_are_made_from_the_journal(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)
        with RunDirectory.create(tmp_path / "out", configuration) as directory:
            for trial in (2, 0, 1):
                directory.add(result_of(trial))
            summary = directory.write_tables(wall_time_s=1.5)
        rows = list(csv.DictReader((tmp_path / "out" / "trials.csv").read_text().splitlines()))
        assert [row["trial"] for row in rows] == ["0", "1", "2"]
        assert summary.finished == 3
        assert load(tmp_path / "out" / "config.yaml") == configuration

    def test_wall_time_adds_up_over_resumed_parts(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)
        with RunDirectory.create(tmp_path / "out", configuration) as directory:
            directory.add(result_of(0))
            directory.write_tables(wall_time_s=1.5)
        with RunDirectory.resume(tmp_path / "out", configuration) as directory:
            assert directory.journal.finished() == {0}
            assert directory.write_tables(wall_time_s=2.0).wall_time_s == 3.5

    @pytest.mark.parametrize("name", output_names())
    def test_no_file_of_a_run_is_overwritten(self, tmp_path: Path, name: str) -> None:
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / name).write_text("mine")
        with pytest.raises(OutputError, match=rf"holds {name} already.*--resume"):
            RunDirectory.create(tmp_path / "out", configuration_of(tmp_path))
        assert (tmp_path / "out" / name).read_text() == "mine"

    def test_a_place_that_cannot_be_a_directory_is_refused(self, tmp_path: Path) -> None:
        (tmp_path / "file").touch()
        with pytest.raises(OutputError, match="is a file, not a directory"):
            RunDirectory.create(tmp_path / "file", configuration_of(tmp_path))
        with pytest.raises(OutputError, match="cannot be made: Not a directory"):
            RunDirectory.create(tmp_path / "file" / "below", configuration_of(tmp_path))

    def test_resuming_needs_a_run(self, tmp_path: Path) -> None:
        with pytest.raises(OutputError, match="no such directory, so no run to resume"):
            RunDirectory.resume(tmp_path / "missing", configuration_of(tmp_path))
        (tmp_path / "empty").mkdir()
        with pytest.raises(OutputError, match=r"holds no journal\.sqlite, so no run to resume"):
            RunDirectory.resume(tmp_path / "empty", configuration_of(tmp_path))

    def test_resuming_with_another_configuration_names_the_key(self, tmp_path: Path) -> None:
        RunDirectory.create(tmp_path / "out", configuration_of(tmp_path)).close()
        with pytest.raises(OutputError, match=r"simulator\.seed is 5 there and 6 here"):
            RunDirectory.resume(tmp_path / "out", configuration_of(tmp_path, seed=6))
        with pytest.raises(OutputError, match=r"model\.hole_tolerance is 0\.1 there and 0\.2 here"):
            RunDirectory.resume(tmp_path / "out", configuration_of(tmp_path, tolerance=0.2))

    @staticmethod
    def of_own_problem(tmp_path: Path, source: str) -> Configuration:
        (tmp_path / "own_problem.py").write_text(source)
        path = tmp_path / "own.yaml"
        path.write_text("problem: own_problem:Own\nsimulator: {num_trials: 3, max_steps: 30}\n")
        return load(path)

    def test_resuming_with_another_source_of_the_problem_is_refused(self, tmp_path: Path) -> None:
        source = (
            "from holdfast.problems.peg_in_hole_2d import PegInHole2D\n"
            "class Own(PegInHole2D): pass\n"
        )
        out = tmp_path / "out"
        configuration = self.of_own_problem(tmp_path, source)
        RunDirectory.create(out, configuration).close()
        RunDirectory.resume(out, configuration).close()
        changed = self.of_own_problem(tmp_path, source + "# changed\n")
        with pytest.raises(OutputError, match=r"source has changed since \(module own_problem\)"):
            RunDirectory.resume(out, changed)
        RunDirectory.resume(out, self.of_own_problem(tmp_path, source)).close()

    def test_resuming_with_another_holdfast_is_refused(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)
        with RunDirectory.create(tmp_path / "out", configuration) as directory:
            directory.journal.set_meta("holdfast_version", "0.0.1")
        with pytest.raises(OutputError, match=r"by holdfast 0\.0\.1, this is .*--out"):
            RunDirectory.resume(tmp_path / "out", configuration)

    def test_resuming_may_ask_for_more_trials_but_not_for_fewer_than_finished(
        self, tmp_path: Path
    ) -> None:
        path = tmp_path / "peg.yaml"
        path.write_text("problem: peg_in_hole_2d\n")
        out = tmp_path / "out"
        with RunDirectory.create(out, load(path, num_trials=4)) as directory:
            directory.add(result_of(0))
            directory.add(result_of(2))
        with RunDirectory.resume(out, load(path, num_trials=9)) as directory:
            assert directory.write_tables(1.0).trials == 9
        assert load(out / "config.yaml").simulator.num_trials == 9
        RunDirectory.resume(out, load(path, num_trials=3)).close()
        with pytest.raises(OutputError, match=r"trial 2 .* at least 3, not 2"):
            RunDirectory.resume(out, load(path, num_trials=2))
        assert load(out / "config.yaml").simulator.num_trials == 3

    def test_a_run_without_a_finished_trial_keeps_no_directory(self, tmp_path: Path) -> None:
        out = tmp_path / "out"
        with RunDirectory.create(out, configuration_of(tmp_path)) as directory:
            directory.write_tables(1.0)
        for name in ("events.jsonl", "timings.csv"):
            (out / name).write_text("of the run that has done nothing\n")
        other = configuration_of(tmp_path, seed=6)
        with RunDirectory.create(out, other) as directory:
            assert directory.earlier_wall_time_s == 0.0
            assert {path.name for path in out.iterdir()} == {
                "config.yaml",
                "journal.sqlite",
                "journal.sqlite-wal",
            }
            with pytest.raises(OutputError, match="holds config"):
                RunDirectory.create(out, other)  # in use by the run above
            directory.add(result_of(0))
        assert load(out / "config.yaml") == other
        RunDirectory.resume(out, other).close()
        with pytest.raises(OutputError, match=r"--resume.*--out"):
            RunDirectory.create(out, other)

    def test_a_run_with_a_begun_trial_keeps_its_directory(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)
        path = claim_default_directory(configuration, tmp_path / "runs")
        with RunDirectory.create(path, configuration) as directory:
            directory.journal.append(1, [PausedRecord()])
        with pytest.raises(OutputError, match=r"holds config.*--resume"):
            RunDirectory.create(path, configuration)
        assert claim_default_directory(configuration, tmp_path / "runs").name == "peg-seed5-2"
        with pytest.raises(OutputError, match=r"trial 1 of that run is begun.* at least 2, not 1"):
            RunDirectory.resume(path, load(tmp_path / "peg.yaml", num_trials=1))
        with RunDirectory.resume(path, configuration) as directory:
            unfinished = directory.journal.unfinished()
            assert unfinished is not None
            assert (unfinished.trial, unfinished.records) == (1, [PausedRecord()])
            directory.add(result_of(0))
            assert directory.journal.unfinished_trial() == 1
            directory.add(result_of(1))
            assert directory.journal.unfinished_trial() is None

    def test_who_decides_may_change_between_the_parts_of_a_run(self, tmp_path: Path) -> None:
        out = tmp_path / "out"
        path = tmp_path / "peg.yaml"
        configuration = configuration_of(tmp_path)
        RunDirectory.create(out, configuration).close()
        path.write_text(
            path.read_text() + "offload: {services: [tcp/127.0.0.1:1], lease_ms: 300}\n"
            "recovery: {journal_survives: power_cut}\n"
            "environment: {timeout_ms: 20}\n"
        )
        with RunDirectory.resume(out, load(path)) as directory:
            assert directory.journal.survives == "power_cut"
        assert load(out / "config.yaml").offload.services == ("tcp/127.0.0.1:1",)
        with RunDirectory.resume(out, configuration) as directory:
            assert directory.journal.survives == "process_crash"

    def test_another_world_does_not_go_on_with_a_run(self, tmp_path: Path) -> None:
        out = tmp_path / "out"
        configuration = configuration_of(tmp_path)
        RunDirectory.create(out, configuration).close()
        robot = replace(configuration, environment=EnvironmentSettings(object="arm:Arm"))
        with pytest.raises(OutputError, match=r"environment.* is not given there .*arm:Arm"):
            RunDirectory.resume(out, robot)

    def test_a_damaged_journal_is_neither_resumed_nor_taken_over(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)
        out = tmp_path / "out"
        RunDirectory.create(out, configuration).close()
        damaged = (out / "journal.sqlite").read_bytes()[:-4096]
        (out / "journal.sqlite").write_bytes(damaged)
        with pytest.raises(OutputError, match=r"the journal is damaged .*--out"):
            RunDirectory.resume(out, configuration)
        with pytest.raises(OutputError, match=r"holds config"):
            RunDirectory.create(out, configuration)
        assert (out / "journal.sqlite").read_bytes() == damaged

    def test_a_default_directory_without_a_finished_trial_is_taken_again(
        self, tmp_path: Path
    ) -> None:
        configuration = configuration_of(tmp_path)
        for _ in range(2):
            path = claim_default_directory(configuration, tmp_path / "runs")
            assert path.name == "peg-seed5"
            RunDirectory.create(path, configuration).close()
        with RunDirectory.create(path, configuration) as directory:
            directory.add(result_of(0))
        assert claim_default_directory(configuration, tmp_path / "runs").name == "peg-seed5-2"

    def test_default_directories_are_numbered(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)
        runs = tmp_path / "runs"
        with pytest.raises(OutputError, match="no run to resume"):
            latest_default_directory(configuration, runs)
        made = [claim_default_directory(configuration, runs) for _ in range(3)]
        assert [path.name for path in made] == ["peg-seed5", "peg-seed5-2", "peg-seed5-3"]
        assert latest_default_directory(configuration, runs) == made[-1]


class TestRecorder:
    @staticmethod
    def record(configuration: Configuration, trial: int = 1) -> Recorder:
        recorder = Recorder(trial)
        run_trial(
            configuration.problem,
            configuration.planning,
            configuration.simulator,
            trial,
            observer=recorder,
        )
        return recorder

    def test_it_keeps_every_step(self, tmp_path: Path) -> None:
        record = self.record(configuration_of(tmp_path)).record
        assert record.result is not None
        steps = record.result.steps
        assert len(record.actions) == len(record.rewards) == steps
        # One more than steps: the states before the first and after each.
        assert len(record.true_states) == len(record.estimates) == steps + 1
        assert len(record.standard_deviations) == steps + 1
        assert sum(record.rewards) == pytest.approx(record.result.reward)
        assert [sensing.step for sensing in record.sensing] == list(range(0, steps, 9))

    def test_the_choice_has_the_least_entropy(self, tmp_path: Path) -> None:
        for sensing in self.record(configuration_of(tmp_path)).record.sensing:
            assert sensing.entropies is not None
            assert sensing.sensing_action == int(np.argmin(sensing.entropies))

    def test_it_keeps_copies(self, tmp_path: Path) -> None:
        record = self.record(configuration_of(tmp_path)).record
        states = np.array(record.true_states)
        assert len(np.unique(states, axis=0)) == len(states)

    def test_it_looks_away_from_other_trials(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)
        recorder = Recorder(trial=0)
        run_trial(
            configuration.problem,
            configuration.planning,
            configuration.simulator,
            1,
            observer=recorder,
        )
        assert recorder.record.result is None
        assert not recorder.record.actions

    def test_particles_are_thinned_out(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path, num_particles=2 * MAX_PARTICLES_KEPT + 1)
        before = self.record(configuration).record.sensing[0].before
        assert MAX_PARTICLES_KEPT // 2 < len(before) <= MAX_PARTICLES_KEPT


class _Journalling(NullObserver):
    """Writes down what a robot writes down."""

    def __init__(self) -> None:
        self.records: list[Record] = []

    def sensed(self, step: SensingStep) -> None:
        data = np.asarray(step.observation, dtype="<f8").tobytes()
        record = ObservedRecord(step.before.step, step.sensing_action, data, digest(step.after), 0)
        self.records.append(record)

    def acted(self, step: TaskStep) -> None:
        data = np.asarray(step.executed, dtype="<f8").tobytes()
        self.records.append(ActingRecord(step.state.step, data))
        self.records.append(PerformedRecord(step.state.step, step.reward))


class TestRecordedEnvironment:
    """What was observed, given to the same planner, leads to the same beliefs."""

    @staticmethod
    def again(
        configuration: Configuration, records: list[Record], result: TrialResult
    ) -> tuple[Recorder, TrialResult]:
        recorder = Recorder(result.trial)
        found = run_trial(
            configuration.problem,
            configuration.planning,
            configuration.simulator,
            result.trial,
            RecordedEnvironment(records, result),
            recorder,
        )
        return recorder, found

    @staticmethod
    def first(configuration: Configuration) -> tuple[list[Record], TrialResult]:
        journalling = _Journalling()
        result = run_trial(
            configuration.problem,
            configuration.planning,
            configuration.simulator,
            1,
            observer=journalling,
        )
        return journalling.records, result

    @pytest.mark.parametrize("max_steps", [20, 500])
    def test_the_beliefs_are_those_of_the_trial(self, tmp_path: Path, max_steps: int) -> None:
        configuration = configuration_of(tmp_path, max_steps=max_steps)
        records, result = self.first(configuration)
        assert result.success == (max_steps == 500)
        # The last performance is not written down on its own: the result says all of it.
        recorder, again = self.again(configuration, records[:-1], result)
        assert again.digest == result.digest
        assert (again.success, again.steps) == (result.success, result.steps)
        expected = TestRecorder.record(configuration).record
        record = recorder.record
        assert np.array_equal(record.estimates, expected.estimates)
        assert np.array_equal(record.standard_deviations, expected.standard_deviations)
        for seen, known in zip(record.sensing, expected.sensing, strict=True):
            assert np.array_equal(seen.after, known.after)
        assert record.true_states == []
        assert record.rewards[:-1] == expected.rewards[:-1]
        trial_figure(configuration, record, tmp_path / "trial.png")
        assert (tmp_path / "trial.png").read_bytes().startswith(b"\x89PNG\r\n")

    def test_a_failure_is_one_again(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)
        records, result = self.first(configuration)
        failed = msgspec.structs.replace(result, success=False, failed=True, steps=4)
        _, again = self.again(configuration, records, failed)
        assert (again.failed, again.steps) == (True, 4)

    def test_what_was_decided_otherwise_is_refused(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)
        records, result = self.first(configuration)
        observed = records[0]
        assert isinstance(observed, ObservedRecord)
        other = msgspec.structs.replace(observed, sensing_action=observed.sensing_action ^ 1)
        for spoilt in ([other, *records[1:]], records[:20], records[1:]):
            with pytest.raises(RecordError, match="trial 1 is decided otherwise at step"):
                self.again(configuration, spoilt, result)


class TestFigure:
    @pytest.mark.parametrize("example", ["light_dark_room", "capsule_robot", "peg_in_hole_3d"])
    def test_nothing_is_cut_off(self, tmp_path: Path, example: str) -> None:
        configuration = load(EXAMPLES / f"{example}.yaml")
        recorder = TestRecorder.record(configuration, trial=0)
        trial_figure(configuration, recorder.record, tmp_path / "trial.png")
        picture = imread(tmp_path / "trial.png")[..., :3]
        for edge in (picture[0], picture[-1], picture[:, 0], picture[:, -1]):
            assert (edge == 1.0).all()
        assert (picture < 1.0).any()

    @pytest.mark.parametrize(
        ("method", "label"),
        [
            ("action_entropy", "expected entropy of\nthe actions (nats)"),
            ("state_entropy", "expected entropy of\nthe state (nats)"),
            ("path_entropy", "expected entropies of\nthe actions, sum (nats)"),
            ("action_covariance", "expected covariance\nof the actions (trace)"),
            ("expected_return", "expected loss\n(minus the return)"),
        ],
    )
    def test_the_scores_say_of_what_they_are_and_which_were_not_chosen(
        self, method: str, label: str
    ) -> None:
        overrides = {"selector.method": method, "simulator.max_steps": 12}
        configuration = load(EXAMPLES / "peg_in_hole_2d.yaml", overrides=overrides)
        record = TestRecorder.record(configuration, trial=0).record
        panel = Figure().subplots()
        _draw_entropies(panel, configuration, record)
        assert panel.get_ylabel() == label
        legend = panel.get_legend()
        assert legend is not None
        assert [text.get_text() for text in legend.get_texts()] == [
            "chosen",
            "not chosen (hollow)",
        ]

    @pytest.mark.parametrize("method", ["action_entropy", "random"])
    @pytest.mark.parametrize("problem", ["peg_in_hole_2d", "capsule_robot", "peg_in_hole_3d"])
    def test_every_kind_of_problem_is_drawn(
        self, tmp_path: Path, problem: str, method: str
    ) -> None:
        path = tmp_path / "run.yaml"
        path.write_text(
            f"problem: {problem}\n"
            f"selector: {{method: {method}}}\n"
            "simulator: {num_trials: 1, max_steps: 12}\n"
        )
        configuration = load(path)
        recorder = TestRecorder.record(configuration, trial=0)
        trial_figure(configuration, recorder.record, tmp_path / "trial.png")
        assert (tmp_path / "trial.png").read_bytes().startswith(b"\x89PNG\r\n")

    def test_a_problem_without_a_scene_is_drawn(self, tmp_path: Path) -> None:
        (tmp_path / "sceneless.py").write_text(
            "from holdfast.problems.peg_in_hole_2d import PegInHole2D\n"
            "class Sceneless(PegInHole2D):\n"
            "    state_labels = ()\n"
            "    def scene(self):\n"
            "        return None\n"
        )
        path = tmp_path / "run.yaml"
        path.write_text("problem: sceneless:Sceneless\nsimulator: {num_trials: 1, max_steps: 12}\n")
        configuration = load(path)
        recorder = TestRecorder.record(configuration, trial=0)
        trial_figure(configuration, recorder.record, tmp_path / "trial.png")
        assert (tmp_path / "trial.png").read_bytes().startswith(b"\x89PNG\r\n")

    @pytest.mark.parametrize(
        "points",
        [
            pytest.param([(4.5, 3.5), (-0.9, -0.9)], id="far from where anything happened"),
            pytest.param([(30.0, 1.0), (2.0, -12.0)], id="outside the scene's limits"),
        ],
    )
    def test_points_of_interest_are_seen(
        self, tmp_path: Path, points: list[tuple[float, float]]
    ) -> None:
        configuration = load(EXAMPLES / "light_dark_room.yaml")
        record = TestRecorder.record(configuration, trial=0).record
        scene = configuration.problem.scene()
        assert scene is not None
        # Short of the lamp and of the door: nothing but the points makes the drawn part large.
        for rows in (record.true_states, record.estimates, record.standard_deviations):
            del rows[3:]
        del record.sensing[1:]
        scene.points, scene.goal = np.array(points), None
        panel = Figure().subplots()
        _draw_workspace(panel, configuration.problem, scene, record)
        (x_min, x_max), (y_min, y_max) = panel.get_xlim(), panel.get_ylim()
        for x, y in points:
            # The whole of the mark, not its edge.
            assert x_min < x < x_max
            assert y_min < y < y_max
