"""A whole tuning, of a few short trials."""

import math
import re
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.config.loader import Configuration, load
from holdfast.errors import InvalidValueError, WorkerDiedError
from holdfast.tuning.candidates import AS_CONFIGURED, RANDOM
from holdfast.tuning.kept_trials import FRESH
from holdfast.tuning.tune import Progress

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


def tuned(run: Path | Configuration, **more: Any) -> Any:
    return hf.tune(run, **{"vary": ["fixed"], "most": 6, "jobs": 1, "check": False, **more})


def test_what_it_finds_and_writes(run: Path) -> None:
    out = run.parent / "tuned"
    found = tuned(run, out=str(out))
    names = {each.candidate for each in found.candidates}
    assert names == {AS_CONFIGURED, RANDOM, "always x", "always y", "always θ"}
    assert found.objective == "steps"
    assert found.fresh_trials == 12
    assert {each.against for each in found.comparisons} >= {RANDOM, AS_CONFIGURED} - {found.choice}
    written = {each.name for each in out.iterdir()}
    assert written == {
        *("tuned.yaml", "tune.md", "candidates.csv", "trials.csv", "tune.json", "tune.png")
    }
    rows = (out / "trials.csv").read_text().splitlines()
    assert len(rows) == 1 + len(set(rows[1:]))
    trials = {int(row.rsplit(",", 8)[1]) for row in rows[1:]}
    assert trials == {*range(6), *range(FRESH, FRESH + 12)}
    # The same worlds, so a trial is what a run makes of it.
    result = hf.run_trial(
        hf.Planner(load(run).problem, load(run).planning), seed=3, trial=0, max_steps=25
    )
    assert rows[1].startswith(f"as configured,0,{int(result.success)},0,,{result.steps},")


def test_candidates_that_die_hang_or_fail_leave_the_race(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("holdfast.tuning.tune._PATIENCE_S", 1.0)
    monkeypatch.setattr("holdfast.tuning.tune._FIRST_SHARE", 0.0)
    (run.parent / "mean.py").write_text(MEAN)
    run.write_text(OF_MEAN)
    found = tuned(run, vary=["particles", "fixed"])
    states = {each.candidate: each.state for each in found.candidates}
    (winner,) = {name.rpartition(",")[0] for name in states if name.endswith("90 particles")}
    died = "it died: its process ended with exit code 9 in trial"
    assert states[f"{winner}, 90 particles"].startswith(f"refused: {died}")
    hung = r"refused: it is too slow, or hangs: trial . was ended after [1-9]\.\d s"
    assert re.fullmatch(hung, states[f"{winner}, 10 particles"])
    for name in ("always second", RANDOM):
        assert re.match("(?s)refused: it fails: .* ValueError: not mine", states[name])
    assert f" {winner}, 90 particles was left out: {died} " in found.sentence


@pytest.mark.parametrize(
    ("particles", "error", "message"),
    [
        (10, WorkerDiedError, "your configuration: it is too slow, or hangs: trial . was ended"),
        (90, WorkerDiedError, "your configuration: it died: its process ended with exit code 9 in"),
    ],
)
def test_the_configuration_itself_dies_or_hangs(
    run: Path, monkeypatch: pytest.MonkeyPatch, particles: int, error: type[Exception], message: str
) -> None:
    monkeypatch.setattr("holdfast.tuning.tune._PATIENCE_S", 1.0)
    monkeypatch.setattr("holdfast.tuning.tune._FIRST_SHARE", 0.0)
    (run.parent / "mean.py").write_text(MEAN)
    run.write_text(OF_MEAN.replace("num_particles: 30", f"num_particles: {particles}"))
    with pytest.raises(error, match=message):
        tuned(run)


def test_it_says_that_particles_are_too_few(run: Path) -> None:
    (run.parent / "bits.py").write_text("from tests.unit.test_lost_values import Bit\n")
    base = load(run, problem="bits:Bit", overrides={"simulator.max_steps": 20})
    found = tuned(base, vary="fixed", most=20)
    assert "was not tried" not in found.sentence
    assert [each.state for each in found.candidates][1] == "in the race: judged"
    given = f"{run} --problem bits:Bit --set simulator.max_steps=20"
    assert f" Your configuration, here, is {given}." in found.sentence
    more = f"tune {given} --set particle_filter.num_particles=300."
    assert re.search(rf" But \d+ of 40 trials ended sure of a wrong .* {more}", found.sentence)


OF_MEAN = RUN.replace("peg_in_hole_2d", "mean:Mean") + "selector: {method: fixed}\n"
MEAN = """
import os
import pathlib
import signal
from tests.line_problem import Line

class Mean(Line):
    def observation_mean(self, states, sensing_action):
        flag = pathlib.Path(__file__).with_name("flag")
        if sensing_action == 1:
            raise ValueError("not mine")
        command = pathlib.Path("/proc/self/cmdline").read_text()
        if "spawn_main" in command or "ray::" in command:  # in a worker
            if not flag.exists():  # the memory is short, once
                flag.touch()
                os.kill(os.getpid(), signal.SIGKILL)
            if states.shape[0] == 90:
                os._exit(9)
            while states.shape[0] == 10:
                pass
        return super().observation_mean(states, sensing_action)
"""


@pytest.mark.parametrize(("last", "why"), [(60, "for lack of time"), (1000, "others were chosen")])
def test_no_trial_begins_when_time_is_up(
    run: Path, monkeypatch: pytest.MonkeyPatch, last: int, why: str
) -> None:
    now_s = 0.0
    monkeypatch.setattr("holdfast.tuning.tune.monotonic", lambda: now_s)
    judging: list[int] = []

    def shows(progress: Progress) -> None:
        nonlocal now_s
        if progress.doing.endswith("judged on fresh trials"):
            judging.append(progress.trials)
        if judging or progress.trials == last:
            now_s = 601.0

    found = tuned(run, most=20, on_progress=shows)
    assert found.sentence.startswith("The budget was too short to judge: ")
    assert len(judging) <= 20  # what the worker had
    assert not found.changes and not found.comparisons
    states = {each.candidate: each.state for each in found.candidates}
    assert states["always θ"] == f"in the race: not judged, {why}"
    note = " 3 more candidates were neither beaten nor judged: a larger budget goes on (--resume;"
    assert (note in found.sentence) == (last == 60)


def test_slow_decisions_are_not_admitted(run: Path) -> None:
    with pytest.raises(InvalidValueError, match=r"as configured: a decision takes .* ms, and at"):
        tuned(run, max_decision_ms=1e-9)


def test_intervals_are_judged_beside_random_sensing_at_the_same(run: Path) -> None:
    found = tuned(run, vary=["interval"], most=20)
    assert f" not tried: holdfast tune {run} --vary methods,fixed does that." in found.sentence
    (winner, *_) = found.candidates
    assert {each.candidate for each in found.candidates} > {AS_CONFIGURED, RANDOM}
    if "simulator.sensing_intervals" in winner.changes:
        rivals = {each.against for each in found.comparisons} | {found.choice}
        assert any(each.startswith("random, every") for each in rivals)


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
    says = r"vary has 'method'; allowed are methods, .*; did you mean methods\?"
    with pytest.raises(InvalidValueError, match=says):
        tuned(run, vary=["method"])
    for name, value, words in (
        ("most", 1, "most 1: allowed are whole numbers from 2 "),
        ("jobs", 0, "jobs 0: allowed are whole numbers from 1 "),
        ("budget_s", math.nan, "budget_s is nan; it must be a number above 0"),
        ("budget_s", "600", "budget_s is '600'; it must be a number above 0"),
        ("max_decision_ms", math.nan, "max_decision_ms is nan; it must be a number above 0"),
        ("objective", "speed", "objective is 'speed'; allowed are reward, steps, success"),
    ):
        with pytest.raises(InvalidValueError, match=words):
            tuned(run, **{name: value})
    with pytest.raises(InvalidValueError, match="is 3; it must be a path, or what load_"):
        hf.tune(3)  # type: ignore[arg-type]
    (run.parent / "bare.py").write_text("from tests.line_problem import Line\n")
    run.write_text(RUN.replace("peg_in_hole_2d", "bare:Line"))
    with pytest.raises(InvalidValueError, match=r"bare:Line has neither rewards nor sensing_costs"):
        tuned(run, objective="reward")
