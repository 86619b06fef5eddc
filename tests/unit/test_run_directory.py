"""The directory of a run: claimed, resumed, and what is in it."""

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from tests.recordings import configuration_of, result_of

from holdfast.config.loader import Configuration, load
from holdfast.errors import OutputError
from holdfast.journal.run_directory import (
    OUTPUT_NAMES,
    RunDirectory,
    claim_default_directory,
    latest_default_directory,
)
from holdfast.planning.inputs import PausedRecord
from holdfast.planning.settings import EnvironmentSettings
from holdfast.robot.recomputing import resume_run


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
        with resume_run(tmp_path / "out", configuration) as directory:
            assert directory.journal.finished() == {0}
            assert directory.write_tables(wall_time_s=2.0).wall_time_s == 3.5

    @pytest.mark.parametrize("name", OUTPUT_NAMES)
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
            resume_run(tmp_path / "missing", configuration_of(tmp_path))
        (tmp_path / "empty").mkdir()
        with pytest.raises(OutputError, match=r"holds no journal\.bin, so no run to resume"):
            resume_run(tmp_path / "empty", configuration_of(tmp_path))

    def test_resuming_with_another_configuration_names_the_key(self, tmp_path: Path) -> None:
        RunDirectory.create(tmp_path / "out", configuration_of(tmp_path)).close()
        with pytest.raises(OutputError, match=r"simulator\.seed is 5 there and 6 here"):
            resume_run(tmp_path / "out", configuration_of(tmp_path, seed=6))
        with pytest.raises(OutputError, match=r"model\.hole_tolerance is 0\.1 there and 0\.2 here"):
            resume_run(tmp_path / "out", configuration_of(tmp_path, tolerance=0.2))

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
        resume_run(out, configuration).close()
        changed = self.of_own_problem(tmp_path, source + "# changed\n")
        with pytest.raises(OutputError, match=r"source has changed since \(module own_problem\)"):
            resume_run(out, changed)
        resume_run(out, self.of_own_problem(tmp_path, source)).close()

    def test_resuming_may_ask_for_more_trials_but_not_for_fewer_than_finished(
        self, tmp_path: Path
    ) -> None:
        path = tmp_path / "peg.yaml"
        path.write_text("problem: peg_in_hole_2d\n")
        out = tmp_path / "out"
        with RunDirectory.create(out, load(path, num_trials=4)) as directory:
            directory.add(result_of(0))
            directory.add(result_of(2))
        with resume_run(out, load(path, num_trials=9)) as directory:
            assert directory.write_tables(1.0).trials == 9
        assert load(out / "config.yaml").simulator.num_trials == 9
        resume_run(out, load(path, num_trials=3)).close()
        with pytest.raises(OutputError, match=r"trial 2 .* at least 3, not 2"):
            resume_run(out, load(path, num_trials=2))
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
            assert {path.name for path in out.iterdir()} == {"config.yaml", "journal.bin"}
            with pytest.raises(OutputError, match="holds config"):
                RunDirectory.create(out, other)  # in use by the run above
            directory.add(result_of(0))
        assert load(out / "config.yaml") == other
        resume_run(out, other).close()
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
            resume_run(path, load(tmp_path / "peg.yaml", num_trials=1))
        with resume_run(path, configuration) as directory:
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
        with resume_run(out, load(path)) as directory:
            assert directory.journal.survives == "power_cut"
        assert load(out / "config.yaml").offload.services == ("tcp/127.0.0.1:1",)
        with resume_run(out, configuration) as directory:
            assert directory.journal.survives == "process_crash"

    def test_another_world_does_not_go_on_with_a_run(self, tmp_path: Path) -> None:
        out = tmp_path / "out"
        configuration = configuration_of(tmp_path)
        RunDirectory.create(out, configuration).close()
        robot = replace(configuration, environment=EnvironmentSettings(object="arm:Arm"))
        with pytest.raises(OutputError, match=r"environment.* is not given there .*arm:Arm"):
            resume_run(out, robot)

    @pytest.mark.parametrize("name", ["gymnasium", "arm:Arm"])
    def test_other_arguments_of_the_environment_are_another_world(
        self, tmp_path: Path, name: str
    ) -> None:
        """Gravity and noise are arguments; what only says how the world is reached may change."""

        def of(**settings: Any) -> Configuration:
            environment = EnvironmentSettings(object=name, **settings)
            return replace(configuration_of(tmp_path), environment=environment)

        out = tmp_path / "out"
        RunDirectory.create(out, of(arguments={"id": "Moon-v0", "gravity": -10.0})).close()
        text = (out / "config.yaml").read_text()
        with pytest.raises(
            OutputError, match=r"environment\.arguments\.gravity is -10\.0 there and -4\.0 here"
        ):
            resume_run(out, of(arguments={"id": "Moon-v0", "gravity": -4.0}))
        assert (out / "config.yaml").read_text() == text
        same = of(arguments={"id": "Moon-v0", "gravity": -10.0}, timeout_ms=20.0, directory="/srv")
        resume_run(out, same).close()

    @pytest.mark.parametrize("name", [*OUTPUT_NAMES, "recovery.log", "journal.sqlite"])
    def test_nothing_is_written_through_a_link(self, tmp_path: Path, name: str) -> None:
        configuration = configuration_of(tmp_path)
        mine = tmp_path / "mine"
        out = tmp_path / "out"
        RunDirectory.create(out, configuration).close()
        if (out / name).exists():
            (out / name).rename(mine)
        else:
            mine.write_text("half a line")
        before = mine.read_bytes()
        (out / name).symlink_to(mine)
        (out / "new").mkdir()
        (out / "new" / name).symlink_to(tmp_path / "missing")
        with pytest.raises(OutputError, match=rf"{name}: is no file but a link"):
            resume_run(out, configuration)
        with pytest.raises(OutputError, match=rf"{name}: is no file but a link"):
            RunDirectory.create(out / "new", configuration)
        assert mine.read_bytes() == before
        assert not (tmp_path / "missing").exists()

    def test_a_damaged_journal_is_neither_resumed_nor_taken_over(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)
        out = tmp_path / "out"
        RunDirectory.create(out, configuration).close()
        damaged = (out / "journal.bin").read_bytes()[:-100]
        (out / "journal.bin").write_bytes(damaged)
        with pytest.raises(OutputError, match=r"the journal is damaged .*another directory"):
            resume_run(out, configuration)
        with pytest.raises(OutputError, match=r"holds config"):
            RunDirectory.create(out, configuration)
        assert (out / "journal.bin").read_bytes() == damaged

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
