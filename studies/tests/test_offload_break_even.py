"""The offload break-even: what it times, and the whole of it at a tiny scale."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from holdfast.errors import InvalidValueError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.belief import Belief
from holdfast.planning.inputs import Sensed
from holdfast.planning.planner import Planner
from holdfast.planning.settings import ParticleFilterSettings, PlanningSettings
from studies import offload_break_even, offload_figures, plots
from studies.executors import LocalExecutor
from studies.offload_break_even import OffloadBreakEven
from studies.running import Workload, compute, write_report
from studies.sensing_times import history_of, measure_sensing, state_in
from studies.study import Scale
from studies.trial_batches import problem_of

BRIEF: dict[str, Any] = {
    "problem": "peg_in_hole_2d",
    "num_sensing_actions": 3,
    "particles": (50, 100),
    "num_trials": 3,
    "seed": 3,
    "repeat_s": 0.001,
    "least_repetitions": 1,
}


def planning(num_particles: int) -> PlanningSettings:
    return PlanningSettings(particle_filter=ParticleFilterSettings(num_particles=num_particles))


def test_a_story_is_told_to_beliefs_of_any_size() -> None:
    problem = problem_of("peg_in_hole_2d")

    def spread(belief: Belief) -> FloatArray:
        mean = belief.weights @ belief.states
        return np.sqrt(belief.weights @ (belief.states - mean) ** 2)

    for trial, place in enumerate((0.25, 0.5, 0.75)):
        story = history_of(problem, planning(200), 3, trial)
        decisions = sum(isinstance(event, Sensed) for event in story)
        found = [state_in(problem, planning(n), 3, trial, story) for n in (5_000, 12_500)]
        assert [state.step for state in found] == [int(place * decisions) * 9] * 2
        # They approximate the same posterior: the means differ by less than the states are spread.
        few, many = (state.belief for state in found)
        means = [belief.weights @ belief.states for belief in (few, many)]
        assert (np.abs(means[0] - means[1]) < spread(many)).all()
        # And know more than at first.
        first = Planner(problem, planning(12_500)).init(3, trial).belief
        assert spread(many)[:2].prod() < 0.5 * spread(first)[:2].prod()


def test_what_is_measured() -> None:
    table = measure_sensing(**BRIEF, threads=(1, 2))
    assert table["particles"].tolist() == [50] * 6 + [100] * 6
    assert table["threads"].tolist() == [1, 2] * 6
    assert table["belief"].tolist() == [0, 0, 1, 1, 2, 2] * 2
    assert (table["median_ms"] >= table["fastest_ms"]).all()
    assert (table["fastest_ms"] > 0.0).all()
    assert ((table["share"] >= 0.0) & (table["share"] <= 1.0)).all()


def test_what_takes_too_long_is_left_out() -> None:
    particles = (50, 100, 1_000_000)
    table = measure_sensing(**{**BRIEF, "particles": particles, "limit_s": 1.0})
    assert set(table["particles"]) == {50, 100}
    with pytest.raises(InvalidValueError, match=r"particles 50: a round .* limit_s 1e-07"):
        measure_sensing(**BRIEF, limit_s=1e-7)


@pytest.mark.slow
def test_the_whole_study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(offload_break_even, "_QUICK_PARTICLES", (100, 200))
    scale = Scale(quick=True, seed=3)
    study = OffloadBreakEven()
    workload = Workload([study], scale, tmp_path)
    assert all(task.exclusive for task in workload.tasks)
    compute(workload, LocalExecutor(1), lambda _: None)
    report = study.report(scale, workload.result_of)
    lines = report.summary["break_even"]
    assert set(lines["path_ms"]) == {20.0, 87.0}
    assert set(lines["service_cores"]) == {8, 36, 32, 144}
    # A decision on 200 particles takes a millisecond or so: no path of 87 ms is worth it.
    for row in lines.to_dict("records"):
        if row["path_ms"] == 87.0 and row["horizon"] == 1:
            assert math.isnan(row["particles"])
    times = report.summary["sensing_times"]
    assert set(times["particles"]) == {100, 200}
    # Nor need any be, where other programs slow this one down.
    plots.save(offload_figures.break_even_lines(lines.assign(particles=np.nan)), tmp_path, "none")
    names = write_report(study, scale, report, tmp_path / "report")
    for figure in ("sensing_time", "break_even"):
        assert f"{figure}.png" in names
        assert (tmp_path / "report" / f"{figure}.svg").stat().st_size > 5000
