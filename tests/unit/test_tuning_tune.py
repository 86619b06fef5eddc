"""A whole tuning, of a few short trials."""

from __future__ import annotations

import math
import resource
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.config.loader import load
from holdfast.errors import InvalidValueError, OutputError, TrialError
from holdfast.tuning.candidates import AS_CONFIGURED, RANDOM
from holdfast.tuning.tune import FRESH, Progress

RUN = """
problem: peg_in_hole_2d
particle_filter: {num_particles: 30}
active_sensing: {num_observation_samples: 3, num_cores: 1}
simulator: {max_steps: 25, seed: 3, sensing_intervals: 4}
"""


@pytest.fixture
def run(tmp_path: Path) -> Path:
    path = tmp_path / "run.yaml"
    path.write_text(RUN)
    return path


def tuned(path: Path, **more: Any) -> Any:
    return hf.tune(path, **{"vary": ["fixed"], "most": 6, "jobs": 1, "check": False, **more})


def test_what_it_finds_and_writes(run: Path) -> None:
    out = run.parent / "tuned"
    found = tuned(run, out=str(out))
    names = {each.candidate for each in found.candidates}
    assert names == {AS_CONFIGURED, RANDOM, "always x", "always y", "always θ"}
    assert found.objective == "steps"
    assert found.fresh_trials == 6
    assert {each.against for each in found.comparisons} >= {RANDOM, AS_CONFIGURED} - {found.choice}
    written = {each.name for each in out.iterdir()}
    assert written == {
        *("tuned.yaml", "tune.md", "candidates.csv", "trials.csv", "tune.json", "tune.png")
    }
    rows = (out / "trials.csv").read_text().splitlines()
    assert len(rows) == 1 + len(set(rows[1:]))
    trials = {int(row.rsplit(",", 7)[1]) for row in rows[1:]}
    assert trials == {*range(6), *range(FRESH, FRESH + 6)}
    # The same worlds, so a trial is what a run makes of it.
    result = hf.run_trial(
        hf.Planner(load(run).problem, load(run).planning), seed=3, trial=0, max_steps=25
    )
    assert rows[1].startswith(f"as configured,0,{int(result.success)},0,{result.steps},")


def test_it_goes_on_where_it_was_interrupted(run: Path) -> None:
    out, whole = run.parent / "tuned", run.parent / "whole"

    def interrupt(progress: Progress) -> None:
        if progress.trials == 17:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tuned(run, out=out, on_progress=interrupt)
    trials = out / "trials.csv"
    kept = trials.read_text()
    assert len(kept.splitlines()) == 1 + 17
    trials.write_text(kept + "as configured,9,1")  # a kill has cut it short
    found = tuned(run, out=out)
    assert trials.read_text().startswith(kept)
    again = tuned(run, out=whole)
    assert (found.sentence, found.choice) == (again.sentence, again.choice)
    assert found.comparisons == again.comparisons
    with pytest.raises(OutputError, match=r"objective was 'steps' and is 'success'"):
        tuned(run, out=out, objective="success")


def test_a_candidate_that_fails_leaves_the_race(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from holdfast.robot import trial_pool

    real = hf.run_trial

    def failing(planner: hf.Planner, *arguments: Any, **more: Any) -> Any:
        if planner.settings.selector.sensing_action == bad:
            raise hf.HoldfastError("no such sensor")
        return real(planner, *arguments, **more)

    monkeypatch.setattr(trial_pool, "run_trial", failing)
    bad = 2
    found = tuned(run)
    (row,) = (each for each in found.candidates if each.candidate == "always θ")
    assert row.state.startswith("refused: it fails: trial 0 (seed 3) of always θ: no such sensor")
    bad = 0
    with pytest.raises(TrialError, match="no such sensor"):
        tuned(run)


def test_slow_decisions_are_not_admitted(run: Path) -> None:
    with pytest.raises(InvalidValueError, match=r"as configured: a decision takes .* ms, and at"):
        tuned(run, max_decision_ms=1e-9)


def test_intervals_are_judged_beside_random_sensing_at_the_same(run: Path) -> None:
    found = tuned(run, vary=["interval"], most=20)
    (winner, *_) = found.candidates
    assert {each.candidate for each in found.candidates} > {AS_CONFIGURED, RANDOM}
    if "simulator.sensing_intervals" in winner.changes:
        rivals = {each.against for each in found.comparisons} | {found.choice}
        assert any(each.startswith("random, every") for each in rivals)


def test_damaged_files(run: Path) -> None:
    out = run.parent / "tuned"
    tuned(run, out=out)
    trials, settings = out / "trials.csv", out / "tune.json"
    whole, known = trials.read_bytes(), settings.read_bytes()
    head, first, rest = whole.split(b"\n", 2)
    odd = [b"", b"\xff\xfe", b"random,1,\x00", b'"always x', b"a" * 200_000, first[:-9] + b"inf"]
    trials.write_bytes(b"\n".join([head, *odd, rest]) + first[:-9])
    tuned(run, out=out)
    again = trials.read_bytes()
    assert again.startswith(b"\n".join([head, *odd, rest]))  # nothing was lost, nothing cut
    assert len(again.splitlines()) == len(whole.splitlines()) + len(odd)  # one trial was run again
    settings.write_bytes(b'{"objective": "\xff"}')
    with pytest.raises(OutputError, match=r"tune\.json: cannot be read: "):
        tuned(run, out=out)
    settings.unlink()
    with pytest.raises(OutputError, match=r"tune\.json: is gone, so nothing tells of which"):
        tuned(run, out=out)
    assert trials.read_bytes() == again
    settings.write_bytes(known)
    tuned(run, out=out)


def test_a_full_disk_is_an_error_in_words(run: Path) -> None:
    out = run.parent / "tuned"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2_500, before[1]))
    try:
        with pytest.raises(OutputError, match=r"trials\.csv: cannot be written: "):
            tuned(run, out=out, most=100)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    kept = (out / "trials.csv").read_bytes()
    assert len(kept) == 2_500
    tuned(run, out=out)
    assert (out / "trials.csv").read_bytes().startswith(kept[: kept.rfind(b"\n") + 1])


def test_no_process_has_a_problem_for_each_candidate(run: Path) -> None:
    """It may hold a large map: with one for each, a laptop's memory is soon full."""
    (run.parent / "counted.py").write_text(COUNTED)
    run.write_text(RUN.replace("peg_in_hole_2d", "counted:Counted"))
    found = tuned(run, vary=["methods", "resolution"], most=2, jobs=2)
    assert len(found.candidates) > 6
    held = [int(each) for each in (run.parent / "held").read_text().split()]
    # Beside the one of the process, one with which a candidate's settings are checked.
    assert max(held) <= 2


COUNTED = """
import pathlib
import weakref
from tests.line_problem import Line

HELD = weakref.WeakSet()

class Counted(Line):
    def __init__(self):
        HELD.add(self)
        with pathlib.Path(__file__).with_name("held").open("a") as file:
            file.write(f"{len(HELD)}\\n")
"""


def test_what_is_refused(run: Path) -> None:
    with pytest.raises(InvalidValueError, match=r"vary has 'method'; allowed are methods"):
        tuned(run, vary=["method"])
    for name, value, words in (
        ("most", 1, "most 1: allowed are whole numbers from 2 "),
        ("most", 2.5, "most 2.5: allowed are whole numbers from 2 "),
        ("jobs", 0, "jobs 0: allowed are whole numbers from 1 "),
        ("jobs", 2.5, "jobs 2.5: allowed are whole numbers from 1 "),
        ("budget_s", math.nan, "budget_s is nan; it must be a number above 0"),
        ("budget_s", "600", "budget_s is '600'; it must be a number above 0"),
        ("max_decision_ms", math.nan, "max_decision_ms is nan; it must be a number above 0"),
        ("objective", "speed", "objective is 'speed'; allowed are reward, steps, success"),
    ):
        with pytest.raises(InvalidValueError, match=words):
            tuned(run, **{name: value})
    (run.parent / "bare.py").write_text(BARE)
    run.write_text(RUN.replace("peg_in_hole_2d", "bare:Bare"))
    with pytest.raises(InvalidValueError, match=r"bare:Bare has neither rewards nor sensing_costs"):
        tuned(run, objective="reward")


BARE = """
from tests.line_problem import Line

class Bare(Line):
    pass
"""
