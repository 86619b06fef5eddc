"""Comparing two runs: what is the same, and the first thing that is not."""

import json
import math
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from tests import recordings
from tests.command_line import Workplace

from holdfast.errors import HoldfastError, OutputError
from holdfast.journal.journal import Journal
from holdfast.planning.inputs import ActingRecord, Sensed
from holdfast.planning.outcome import DecisionLog, TrialResult
from holdfast.reports.compare import Comparison, compare_runs

CONFIGURATION = """\
problem: peg_in_hole_2d
model: {hole_tolerance: 0.1}
simulator: {num_trials: 3, seed: 5}
offload: {lease_ms: 400.0}
"""

NAN = struct.unpack("<d", struct.pack("<Q", 0x7FF8000000000000))[0]
OTHER_NAN = struct.unpack("<d", struct.pack("<Q", 0x7FF8000000000001))[0]

Step = tuple[int | None, bytes, Sequence[float]]
"""Sensing action (None: no sensing), state digest after it, task action."""

STEPS: list[Step] = [
    (2, b"\x01" * 32, (0.1, 0.0)),
    (None, b"", (0.2, 1.0)),
    (1, b"\x02" * 32, (0.3, 0.1 + 0.2)),
]


def result_of(
    trial: int,
    steps: Sequence[Step] = STEPS,
    *,
    reward: float = -1.0,
    last: bytes = b"\x09" * 32,
    action_size: int = 2,
) -> TrialResult:
    log = DecisionLog(action_size)
    for step, (sensing_action, state_digest, action) in enumerate(steps):
        if sensing_action is not None:
            log.sensed(step, sensing_action, state_digest)
        log.acted(step, np.array(action))
    log.ended(len(steps), last)
    decisions = log.decisions()
    return msgspec.structs.replace(
        recordings.result_of(trial, reward=reward),
        steps=len(steps),
        mean_sensing_ms=float(trial),
        recoveries=trial,
        sensing_decisions=sum(step[0] is not None for step in steps),
        digest=decisions.digest(),
        decisions=decisions,
    )


def run_of(
    directory: Path,
    results: Sequence[TrialResult],
    *,
    configuration: str = CONFIGURATION,
    version: str = "1.0",
    unfinished: int | None = None,
    action: bytes = b"\0" * 16,
) -> Path:
    directory.mkdir()
    meta = {"configuration": configuration, "holdfast_version": version, "problem_sources": "{}"}
    with Journal.create(directory / "journal.bin", meta) as journal:
        for result in results:
            journal.add(result)
        if unfinished is not None:
            journal.append(
                unfinished, [Sensed(0, 1, b"\0" * 8, b"\0" * 32, 0.5), ActingRecord(0, action)]
            )
    return directory


def changed(step: int, what: Step) -> list[Step]:
    return [*STEPS[:step], what, *STEPS[step + 1 :]]


def compared(
    tmp_path: Path, first: Sequence[TrialResult], second: Sequence[TrialResult], **of_second: Any
) -> Comparison:
    one = run_of(tmp_path / "first", first)
    return compare_runs(one, run_of(tmp_path / "second", second, **of_second))


def difference_of(found: Comparison) -> tuple[object, ...]:
    """Return what differs, of which trial and step, and how it is in both."""
    assert found.difference is not None and not found.identical
    return msgspec.structs.astuple(found.difference)


class TestDecisions:
    def test_times_and_recoveries_do_not_matter(self, tmp_path: Path) -> None:
        first = run_of(tmp_path / "first", [result_of(0), result_of(1), result_of(2)])
        results = [result_of(trial) for trial in (2, 0, 1)]
        found = compare_runs(first, run_of(tmp_path / "second", results) / "journal.bin")
        assert found.identical
        assert (found.difference, found.notes) == (None, ())
        assert (found.trials, found.sensing_actions, found.task_actions) == (3, 6, 9)
        assert found.describe() == (
            "identical: 3 trials, 6 sensing actions, 9 task actions and every state digest"
        )

    @pytest.mark.parametrize(
        ("second", "difference"),
        [
            (changed(2, (3, b"\x05" * 32, (0.3, 0.3))), ("sensing action", 2, "1", "3")),
            (
                changed(0, (2, b"\x05" * 32, (0.1, 0.0))),
                ("state digest after sensing", 0, "01" * 32, "05" * 32),
            ),
            (  # the last bit of a task action
                changed(2, (1, b"\x02" * 32, (0.3, 0.3))),
                ("task action[1]", 2, "0.30000000000000004", "0.3"),
            ),
            (changed(0, (2, b"\x01" * 32, (0.1, -0.0))), ("task action[1]", 0, "0.0", "-0.0")),
            (
                changed(1, (4, b"\x05" * 32, (0.2, 1.0))),
                ("next decision", 1, "a task action at step 1", "sensing action 4 at step 1"),
            ),
            (STEPS[:2], ("next decision", 2, "sensing action 1 at step 2", "none, the trial ends")),
            (
                result_of(1, last=b"\x08" * 32),
                ("digest of the last state", 3, "09" * 32, "08" * 32),
            ),
            (
                result_of(1, [(2, b"\x01" * 32, (0.1,))], action_size=1),
                ("size of the task actions", None, "2", "1"),
            ),
        ],
    )
    def test_what_differs_is_named(
        self, tmp_path: Path, second: TrialResult | list[Step], difference: tuple[object, ...]
    ) -> None:
        other = second if isinstance(second, TrialResult) else result_of(1, second)
        found = compared(tmp_path, [result_of(0), result_of(1)], [result_of(0), other])
        assert found.trials == 1
        what, step, first, last = difference
        assert difference_of(found) == (what, 1, step, first, last)

    def test_numbers_that_print_alike_are_shown_by_their_bits(self, tmp_path: Path) -> None:
        assert math.isnan(NAN)
        runs = [[result_of(0, changed(1, (None, b"", (nan, 1.0))))] for nan in (NAN, OTHER_NAN)]
        assert difference_of(compared(tmp_path, *runs)) == (
            *("task action[0]", 0, 1),
            *("nan (0x7ff8000000000000)", "nan (0x7ff8000000000001)"),
        )

    def test_the_first_difference_is_told(self, tmp_path: Path) -> None:
        other = result_of(2, changed(1, (None, b"", (0.2, 2.0))))
        found = compared(
            tmp_path,
            [result_of(trial) for trial in range(4)],
            [result_of(0), result_of(1), other, result_of(3, STEPS[:1])],
        )
        assert found.describe().splitlines() == [
            "different: trial 2, step 1, task action[1]",
            f"  {tmp_path / 'first'}:  1.0",
            f"  {tmp_path / 'second'}: 2.0",
        ]

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"reward": -2.0}, "outcome succeeded, reward -2.0"),
            ({"success": False, "failed": True}, "outcome failed, reward -1.0"),
        ],
    )
    def test_another_answer_of_the_world_is_noted(
        self, tmp_path: Path, change: dict[str, Any], words: str
    ) -> None:
        found = compared(
            tmp_path, [result_of(0)], [msgspec.structs.replace(result_of(0), **change)]
        )
        assert found.identical
        assert found.notes == (
            "the world answered otherwise: trial 0 has outcome succeeded, reward -1.0 in the first "
            f"run and {words} in the second",
        )


class TestRuns:
    @pytest.mark.parametrize(
        ("configuration", "what", "value"),
        [
            (CONFIGURATION.replace("seed: 5", "seed: 6"), "seed", "6"),
            (CONFIGURATION.replace("peg_in_hole_2d", "capsule_robot"), "problem", "capsule_robot"),
            ("problem: peg_in_hole_2d\n", "seed", "not given"),
        ],
    )
    def test_other_seeds_and_problems(
        self, tmp_path: Path, configuration: str, what: str, value: str
    ) -> None:
        found = difference_of(
            compared(tmp_path, [result_of(0)], [result_of(0)], configuration=configuration)
        )
        assert (found[0], found[1], found[-1]) == (what, None, value)

    def test_a_class_that_has_moved_since_is_the_same_problem(self, tmp_path: Path) -> None:
        first, second = (
            run_of(
                tmp_path / module,
                [result_of(0)],
                configuration=CONFIGURATION.replace("peg_in_hole_2d", f"{module}.testbed.pegs:Peg"),
            )
            for module in ("holdfast.lab", "holdfast_lab")
        )
        assert compare_runs(first, second).difference is None

    def test_other_versions_and_settings_are_noted(self, tmp_path: Path) -> None:
        other = CONFIGURATION.replace("0.1", "0.2").replace("400.0", "500.0")
        found = compared(
            tmp_path, [result_of(0)], [result_of(0)], configuration=other, version="2.0"
        )
        assert found.identical
        assert found.notes == (
            "made by holdfast 1.0 and by holdfast 2.0",
            "model.hole_tolerance is 0.1 in the first run and 0.2 in the second",
        )

    def test_a_trial_that_is_not_there(self, tmp_path: Path) -> None:
        found = compared(
            tmp_path, [result_of(0), result_of(2)], [result_of(trial) for trial in range(3)]
        )
        there = ("not in this run, which has 2 finished trials", "finished")
        assert difference_of(found) == ("state of the trial", 1, None, *there)

    def test_an_unfinished_trial(self, tmp_path: Path) -> None:
        first = run_of(tmp_path / "first", [result_of(0), result_of(1)])
        second = run_of(tmp_path / "second", [result_of(0)], unfinished=1)
        unfinished = "unfinished, 1 sensing action and 1 task action so far"
        for one, other, states in (
            (first, second, ("finished", unfinished)),
            (second, first, (unfinished, "finished")),
        ):
            found = compare_runs(one, other)
            assert found.trials == 1
            assert difference_of(found) == ("state of the trial", 1, None, *states)

    def test_a_trial_that_is_unfinished_in_both_runs(self, tmp_path: Path) -> None:
        """A killed run decided the same as itself, as far as it goes."""
        killed = run_of(tmp_path / "killed", [], unfinished=0)
        found = compare_runs(killed, killed)
        assert found.identical
        assert (found.trials, found.sensing_actions, found.task_actions) == (0, 1, 1)
        assert found.notes == ("trial 0 is unfinished in both runs: compared as far as it goes",)
        other = run_of(tmp_path / "other", [], unfinished=0, action=bytes(15) + b"\x3f")
        *where, one, another = difference_of(compare_runs(killed, other))
        assert where == ["task action[1]", 0, 0]
        assert one != another

    def test_runs_without_a_trial_are_not_the_same(self, tmp_path: Path) -> None:
        found = compare_runs(run_of(tmp_path / "first", []), run_of(tmp_path / "second", []))
        assert not found.identical
        assert "nothing to compare" in found.describe()

    def test_a_configuration_that_repeats_itself_is_refused(self, tmp_path: Path) -> None:
        """A few lines of aliases stand for billions of values."""
        lines = ["problem: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
        lines += [f"x{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 30)]
        for number, text in enumerate(["\n".join(lines), "[" * 2000, "a: *nobody"]):
            run = run_of(tmp_path / f"run{number}", [result_of(0)], configuration=text)
            with pytest.raises(HoldfastError, match="the configuration in a journal"):
                compare_runs(run, run)

    def test_a_record_forges_no_line(self, tmp_path: Path, workplace: Workplace) -> None:
        forged = 'problem: "peg\\nidentical: 3 trials"\n'
        first = run_of(tmp_path / "first", [result_of(0)], configuration=forged)
        second = run_of(tmp_path / "second", [result_of(0)], version="1\nidentical: 3 trials")
        third = run_of(tmp_path / "third", [result_of(0)])
        for one, other in ((first, second), (second, third)):
            said = workplace.run("compare", str(one), str(other))
            lines = (said.stdout + said.stderr).splitlines()
            assert "identical: 3 trials" not in lines

    def test_what_is_no_run_is_refused(self, tmp_path: Path) -> None:
        run = run_of(tmp_path / "first", [result_of(0)])
        (tmp_path / "empty").mkdir()
        (tmp_path / "file").write_bytes(b"no database, but long enough to look like one" * 30)
        for other, message in (
            ("missing", "no such directory"),
            ("empty", r"holds no journal\.bin"),
            ("file", r"is not a journal; name the directory of a run, or its journal\.bin"),
        ):
            for pair in ((run, tmp_path / other), (tmp_path / other, run)):
                with pytest.raises(OutputError, match=message):
                    compare_runs(*pair)

    def test_a_run_that_is_going_on_is_compared_as_it_is(self, tmp_path: Path) -> None:
        first = run_of(tmp_path / "first", [result_of(0)])
        second = run_of(tmp_path / "second", [result_of(0)])
        with Journal.open(second / "journal.bin") as journal:
            assert compare_runs(first, second).identical
            journal.add(result_of(1))
            assert not compare_runs(first, second).identical


class TestCommand:
    def test_identical(self, tmp_path: Path, workplace: Workplace) -> None:
        compared(tmp_path, [result_of(0)], [result_of(0)], version="2.0")
        assert workplace.run("compare", "first", "second") == (
            0,
            "identical: 1 trial, 2 sensing actions, 3 task actions and every state digest\n",
            "note: made by holdfast 1.0 and by holdfast 2.0\n",
        )

    def test_different(self, tmp_path: Path, workplace: Workplace) -> None:
        compared(tmp_path, [result_of(0)], [result_of(0, STEPS[:2])])
        said = workplace.run("compare", "first", "second")
        assert (said.code, said.stderr) == (1, "")
        assert said.stdout.startswith("different: trial 0, step 2, next decision\n")
        said = workplace.run("compare", "first", "second", "--json")
        found = json.loads(said.stdout)
        assert (said.code, found["identical"]) == (1, False)
        assert found["difference"] == {
            "what": "next decision",
            "trial": 0,
            "step": 2,
            "first": "sensing action 1 at step 2",
            "second": "none, the trial ends",
        }

    def test_what_cannot_be_read(self, workplace: Workplace) -> None:
        said = workplace.fails("compare", ".", "missing")
        assert said.startswith("holdfast: error: .: holds no journal.bin")
