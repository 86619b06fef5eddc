"""A run that another version began goes on only if that version's decisions come out again."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.recordings import Journalling, configuration_of, decided, flipped

from holdfast.config.loader import Configuration
from holdfast.errors import OutputError
from holdfast.journal.fingerprint import EarlierCode
from holdfast.journal.run_directory import RunDirectory
from holdfast.planning.inputs import ActingRecord, Record, Sensed
from holdfast.planning.outcome import TrialResult
from holdfast.planning.settings import EnvironmentSettings
from holdfast.robot import recomputing
from holdfast.robot.recomputing import resume_run

OLD = {"holdfast_version": "0.0.1", "holdfast_core": "0.0.1+abc"}


def records_of(configuration: Configuration, trial: int, count: int) -> list[Record]:
    journalling = Journalling()
    decided(configuration, trial, observer=journalling)
    return journalling.records[:count]


def begin(out: Path, configuration: Configuration, finished: Any, begun: Any = ()) -> None:
    """Leave a run that another version has begun."""
    with RunDirectory.create(out, configuration) as directory:
        for result in finished:
            directory.add(result)
        directory.journal.append(2, list(begun))
        directory.journal.set_meta(**OLD)


def test_a_run_of_another_version_goes_on_and_says_who_decided_what(tmp_path: Path) -> None:
    configuration = configuration_of(tmp_path)
    finished = [decided(configuration, trial) for trial in (0, 1)]
    # Three decisions: a sensing action and two task actions, of which the last is pending.
    begin(tmp_path / "run", configuration, finished, records_of(configuration, 2, 4))
    told: list[tuple[int, int]] = []
    with resume_run(tmp_path / "run", configuration, lambda *each: told.append(each)) as directory:
        expected = EarlierCode(
            holdfast="0.0.1+abc", finished=((0, 1),), unfinished=(2, 3), computed_again=(0, 1, 2)
        )
        assert directory.before_upgrade == expected
        assert expected.in_words() == (
            "holdfast 0.0.1+abc decided trials 0 to 1 and the first 3 decisions of trial 2; "
            "this version decides the same (computed again: trials 0 to 2)"
        )
        directory.add(decided(configuration, 2))
        directory.write_tables(1.0)
        # The next version adds what this one has decided alone.
        directory.journal.set_meta(**OLD)
    total = sum(len(list(each.decisions or ())) for each in finished) + 3
    assert told == [(done, total) for done in range(1, total + 1)]
    with resume_run(tmp_path / "run", configuration) as directory:
        assert directory.before_upgrade == EarlierCode(
            holdfast="0.0.1+abc", finished=((2, 2),), computed_again=(0, 1, 2)
        )
    with resume_run(tmp_path / "run", configuration) as directory:
        assert directory.before_upgrade is None
        directory.write_tables(1.0)
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert [each["finished"] for each in summary["earlier_code"]] == [[[0, 1]], [[2, 2]]]


def test_of_many_finished_trials_few_are_computed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    configuration = configuration_of(tmp_path)
    simulator = msgspec.structs.replace(configuration.simulator, num_trials=12)
    configuration = replace(configuration, simulator=simulator)
    finished = [decided(configuration, trial) for trial in (0, 1, 2, 5, 6, 9)]
    for seconds, computed in ((30.0, (0, 2, 9)), (-1.0, (0,))):
        monkeypatch.setattr(recomputing, "_FINISHED_S", seconds)
        out = tmp_path / f"run{computed}"
        begin(out, configuration, finished)
        with resume_run(out, configuration) as directory:
            assert directory.before_upgrade == EarlierCode(
                holdfast="0.0.1+abc", finished=((0, 2), (5, 6), (9, 9)), computed_again=computed
            )


def test_nothing_decided_is_nothing_to_compute(tmp_path: Path) -> None:
    configuration = configuration_of(tmp_path)
    begin(tmp_path / "run", configuration, [])
    with resume_run(tmp_path / "run", configuration) as directory:
        assert directory.before_upgrade is not None
        assert directory.before_upgrade.in_words() == "holdfast 0.0.1+abc decided nothing yet"


def test_another_decision_is_refused_and_named(tmp_path: Path) -> None:
    configuration = configuration_of(tmp_path)
    begun = records_of(configuration, 2, 7)
    first = decided(configuration, 0)
    sensed, acting = begun[0], begun[5]
    assert isinstance(sensed, Sensed)
    assert isinstance(acting, ActingRecord)
    action = (np.frombuffer(acting.action) + 1e-16).tobytes()
    cases: dict[str, tuple[TrialResult, list[Record]]] = {
        r"trial 0, step 0 \(the sensing action": (flipped(first), begun),
        r"trial 2, step 2 \(the task action\)": (
            first,
            [*begun[:5], ActingRecord(acting.step, action)],
        ),
        r"trial 2, step 0 \(the state that": (
            first,
            [msgspec.structs.replace(sensed, digest=bytes(32)), *begun[1:]],
        ),
    }
    for number, (words, (finished, records)) in enumerate(cases.items()):
        out = tmp_path / str(number)
        begin(out, configuration, [finished], records)
        for _ in range(2):  # nothing has changed by the first refusal
            with pytest.raises(OutputError, match=rf"by holdfast 0\.0\.1.*{words}.*--out"):
                resume_run(out, configuration)


def test_a_run_without_observations_is_refused(tmp_path: Path) -> None:
    """As of a robot's own world, which cannot be simulated; an older version kept none."""
    configuration = replace(
        configuration_of(tmp_path), environment=EnvironmentSettings(object="arm:Arm")
    )
    begin(tmp_path / "run", configuration, [decided(configuration, 0)])
    with pytest.raises(OutputError, match=r"cannot be computed again: .*not kept its observations"):
        resume_run(tmp_path / "run", configuration)
