"""Reading a journal: finished trials, kept steps, other files and versions."""

from pathlib import Path
from typing import Any

import msgspec
import pytest
from tests.recordings import failed, result_of, without_decisions
from tests.unit.test_trial import one

from holdfast.config.loader import load
from holdfast.errors import OutputError
from holdfast.journal.journal import Journal
from holdfast.journal.journal_file import Finished, Notes, Steps, packed
from holdfast.journal.journal_reader import JournalReader
from holdfast.planning.outcome import Decisions
from holdfast.planning.planner import Planner
from holdfast.planning.tracking import replay

BEFORE_OUTCOMES = Path(__file__).parent / "data" / "journal_before_outcomes.sqlite"
"""A robot was killed at step 21 of trial 2, when results said only whether a trial succeeded."""


def finished(trial: int) -> Finished:
    result = result_of(trial)
    outcome = packed(without_decisions(result))
    return Finished(trial, outcome, packed(result.decisions), keeps_steps=False)


class TestJournal:
    def test_what_was_added_comes_back_in_order(self, tmp_path: Path) -> None:
        path = tmp_path / "journal.bin"
        results = [result_of(2, success=False), result_of(0), result_of(1, sensing_ms=(0.5, 1.5))]
        with Journal.create(path, {"key": "value"}) as journal:
            for result in results:
                journal.add(result)
        with JournalReader.read_run(tmp_path, "see") as journal:
            assert journal.meta()["key"] == "value"
            assert journal.finished() == {0, 1, 2}
            expected = sorted(map(without_decisions, results), key=lambda result: result.trial)
            assert list(journal.results()) == expected
            for result in results:
                assert journal.decisions(result.trial) == result.decisions

    def test_a_result_that_nests_without_end_is_damage(self, tmp_path: Path) -> None:
        """A journal of somebody else may have the right checksums."""
        path = tmp_path / "journal.bin"
        blob = msgspec.msgpack.encode(without_decisions(result_of(0)))
        assert blob[:1] == b"\xde"  # one field more, which no reader knows
        blob = b"\xde" + (int.from_bytes(blob[1:3]) + 1).to_bytes(2) + blob[3:]
        blob += b"\xa1x" + b"\x91" * 5000 + b"\x90"
        entry = Finished(0, msgspec.Raw(blob), packed(result_of(0).decisions), keeps_steps=False)
        with pytest.raises(OutputError, match="recursion"):
            Journal.create_from(path, [entry])

    def test_how_a_trial_ended_comes_back(self, tmp_path: Path) -> None:
        path = tmp_path / "journal.bin"
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
        with Journal.read(BEFORE_OUTCOMES) as journal:
            results = list(journal.results(with_decisions=True))
            assert [result.outcome for result in results] == ["truncated", "succeeded"]
            assert [result.success for result in results] == [False, True]
            assert not any(result.failed for result in results)
            (tmp_path / "old.yaml").write_text(journal.meta()["configuration"])
            configuration = load(tmp_path / "old.yaml")
            for result in results:
                again = one(configuration, result.trial)
                assert again.digest == result.digest
                assert again.outcome == result.outcome
            unfinished = journal.unfinished()
            assert unfinished is not None
            planner = Planner(configuration.problem, configuration.planning)
            history = replay(planner, 2, unfinished.trial, unfinished.records)
            assert (unfinished.trial, history.state.step) == (2, 21)

    def test_a_trial_is_kept_once(self, tmp_path: Path) -> None:
        with Journal.create(tmp_path / "journal.bin", {}) as journal:
            journal.add(result_of(0, reward=-1.0))
            with pytest.raises(OutputError, match="trial 0 is in the journal already"):
                journal.add(result_of(0, reward=-2.0))
            assert [result.reward for result in journal.results()] == [-1.0]

    def test_a_trial_that_is_not_there_is_named(self, tmp_path: Path) -> None:
        with (
            Journal.create(tmp_path / "journal.bin", {}) as journal,
            pytest.raises(OutputError, match="trial 7 is not in the journal"),
        ):
            journal.decisions(7)

    @pytest.mark.parametrize(
        ("entries", "named"),
        [
            (
                [Steps(0, packed([])), Steps(1, packed([]))],
                "after record -1 of the unfinished trial 0",
            ),
            ([finished(0), finished(0)], "after the result of trial 0"),
            ([finished(0), Steps(0, packed([]))], "after the result of trial 0"),
        ],
    )
    def test_trials_that_cannot_follow_each_other_are_damage(
        self, tmp_path: Path, entries: list[Any], named: str
    ) -> None:
        with pytest.raises(OutputError, match=rf"damaged \({named}, .* comes where it cannot"):
            Journal.create_from(tmp_path / "journal.bin", [Notes({}), *entries])

    def test_decisions_that_never_end_or_lack_their_steps(self, tmp_path: Path) -> None:
        """Checksums have no key: whoever writes a journal can have them right."""
        result = result_of(0)
        assert result.decisions is not None
        endless = Decisions(-2, b"A" + bytes(8))
        for number, decisions in enumerate([endless, result.decisions]):
            path = tmp_path / f"{number}.bin"
            steps = 10**15 if decisions is result.decisions else 0
            bad = msgspec.structs.replace(
                result, decisions=decisions, steps=steps, digest=decisions.digest()
            )
            with Journal.create(path, {}) as journal:
                journal.add(bad)
            with JournalReader.read(path) as reader, pytest.raises(OutputError, match="damaged"):
                list(reader.results(with_decisions=True))
