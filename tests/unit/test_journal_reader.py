"""Reading a journal: finished trials, kept steps, other files and versions."""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
from pathlib import Path

import msgspec
import pytest
from tests.recordings import failed, result_of, without_decisions

from holdfast.config.loader import load
from holdfast.errors import OutputError
from holdfast.planning.outcome import Decisions
from holdfast.planning.planner import Planner
from holdfast.protocol.records import (
    replay,
)
from holdfast.recording.journal import Journal
from holdfast.recording.journal_file import of_trials
from holdfast.recording.journal_reader import TABLES, JournalReader
from holdfast.robot.trial import run_trial

BEFORE_OUTCOMES = Path(__file__).parent / "data" / "journal_before_outcomes.sqlite"
"""Of a robot killed at step 21 of trial 2, when results said only whether a trial succeeded."""


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
            expected = sorted(map(without_decisions, results), key=lambda result: result.trial)
            assert list(journal.results()) == expected
            for result in results:
                assert journal.decisions(result.trial) == result.decisions

    def test_a_result_that_nests_without_end_is_damage(self, tmp_path: Path) -> None:
        """A journal of somebody else may have the right checksums."""
        path = tmp_path / "journal.sqlite"
        with Journal.create(path, {}) as journal:
            journal.add(result_of(0))
        blob = msgspec.msgpack.encode(without_decisions(result_of(0)))
        assert blob[:1] == b"\xde"  # one field more, which no reader knows
        blob = b"\xde" + (int.from_bytes(blob[1:3]) + 1).to_bytes(2) + blob[3:]
        blob += b"\xa1x" + b"\x91" * 5000 + b"\x90"
        with contextlib.closing(sqlite3.connect(path)) as connection, connection:
            connection.execute(
                "UPDATE trials SET result = ?, result_checksum = ?", (blob, of_trials(0, 0, blob))
            )
        with Journal.read(path) as journal, pytest.raises(OutputError, match="recursion"):
            list(journal.results())

    def test_how_a_trial_ended_comes_back(self, tmp_path: Path) -> None:
        path = tmp_path / "journal.sqlite"
        with Journal.create(path, {}) as journal:
            journal.add(result_of(0))
            journal.add(failed(result_of(1)))
            journal.add(result_of(2, success=False))
        with Journal.open(path) as journal:
            results = list(journal.results())
            outcomes = [result.outcome for result in results]
            assert outcomes == ["succeeded", "failed", "truncated"]
            assert [result.failed for result in results] == [False, True, False]

    def test_one_from_before_trials_could_fail(self, tmp_path: Path) -> None:
        """It was made by that code: trials without success had run out of steps."""
        path = tmp_path / "journal.sqlite"
        shutil.copyfile(BEFORE_OUTCOMES, path)
        with Journal.open(path) as journal:
            results = list(journal.results(with_decisions=True))
            assert [result.outcome for result in results] == ["truncated", "succeeded"]
            assert [result.success for result in results] == [False, True]
            assert not any(result.failed for result in results)
            (tmp_path / "old.yaml").write_text(journal.meta()["configuration"])
            configuration = load(tmp_path / "old.yaml")
            for result in results:
                again = run_trial(
                    Planner(configuration.problem, configuration.planning),
                    configuration.simulator.seed,
                    result.trial,
                    max_steps=configuration.simulator.max_steps,
                )
                assert again.digest == result.digest
                assert again.outcome == result.outcome
            unfinished = journal.unfinished()
            assert unfinished is not None
            planner = Planner(configuration.problem, configuration.planning)
            history = replay(planner, 2, unfinished.trial, unfinished.records)
            assert (unfinished.trial, history.state.step) == (2, 21)

    def test_a_trial_is_kept_once(self, tmp_path: Path) -> None:
        with Journal.create(tmp_path / "journal.sqlite", {}) as journal:
            journal.add(result_of(0, reward=-1.0))
            with pytest.raises(OutputError, match="UNIQUE"):
                journal.add(result_of(0, reward=-2.0))
            assert [result.reward for result in journal.results()] == [-1.0]

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
        with pytest.raises(OutputError, match="'other' in it is no table of a journal"):
            Journal.open(path)
        assert path.read_bytes() == before

    @pytest.mark.parametrize("table", sorted(TABLES))
    @pytest.mark.parametrize(
        "statements",
        [
            "DROP TABLE {0}; CREATE VIEW {0} AS WITH RECURSIVE n(trial) AS "
            "(SELECT 0 UNION ALL SELECT trial + 1 FROM n) SELECT trial, trial AS key, "
            "trial AS value, trial AS checksum, trial AS sequence, trial AS result FROM n",
            "CREATE TRIGGER t AFTER INSERT ON {0} BEGIN DELETE FROM meta; END",
            "ALTER TABLE {0} ADD COLUMN more BLOB AS (zeroblob(900000000))",
            "CREATE INDEX i ON {0} ({1}) WHERE {1} LIKE '%a%b%c%d%e%'",
        ],
        ids=["view", "trigger", "computed column", "index"],
    )
    def test_what_is_no_plain_table_of_a_journal_is_asked_nothing(
        self, tmp_path: Path, table: str, statements: str
    ) -> None:
        """Somebody else's file may compute without end, or write, when it is read."""
        path = tmp_path / "journal.sqlite"
        Journal.create(path, {}).close()
        with contextlib.closing(sqlite3.connect(path)) as connection:
            if table == "kept_steps":
                connection.execute(TABLES[table])
            column = "result_checksum" if table == "trials" else "checksum"
            connection.executescript(statements.format(table, column))
        for opens in (Journal.open, JournalReader.read):
            with pytest.raises(OutputError, match="is no table of a journal"):
                opens(path)

    def test_decisions_that_never_end_or_lack_their_steps(self, tmp_path: Path) -> None:
        """Checksums have no key: whoever writes a journal can have them right."""
        result = result_of(0)
        assert result.decisions is not None
        endless = Decisions(-2, b"A" + bytes(8))
        for number, decisions in enumerate([endless, result.decisions]):
            path = tmp_path / f"{number}.sqlite"
            steps = 10**15 if decisions is result.decisions else 0
            bad = msgspec.structs.replace(
                result, decisions=decisions, steps=steps, digest=decisions.digest()
            )
            with Journal.create(path, {}) as journal:
                journal.add(bad)
            with JournalReader.read(path) as reader, pytest.raises(OutputError, match="damaged"):
                list(reader.results(with_decisions=True))

    def test_another_version_is_refused(self, tmp_path: Path) -> None:
        path = tmp_path / "journal.sqlite"
        with Journal.create(path, {}) as journal:
            journal.set_meta(schema_version="999")
        with pytest.raises(OutputError, match="schema version 999; this holdfast reads version 3"):
            Journal.open(path)
