"""The study of the thesis's chapter 6: what is run, and what is made of the rows."""

import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pandas as pd
import pytest

from holdfast.config.loader import load
from holdfast_lab.testbed.fault_times import FaultTimes
from holdfast_lab.testbed.records import DecisionTable
from studies import cloud_trials, thesis_chapter_6
from studies.cloud_trials import COLUMNS, CloudTrials, rows_of_run
from studies.running import write_report
from studies.study import Number, Report, Scale
from studies.tasks import Task, run_task, task_key
from studies.thesis_chapter_6 import ThesisChapter6, series_of
from studies.thesis_measurements import (
    FAR,
    NEAR,
    PARTICLES,
    PATHS,
    NetworkPath,
    measured,
    paths_of,
    select,
)

THESIS = Path(__file__).parents[2] / "examples" / "thesis.yaml"

TIMINGS = """\
trial,step,kind,service,status,waited_ms,round_trip_ms,computed_ms,time
0,0,sensing,tcp/10.77.0.2:7447,standard,90.0,89.0,1.5,2026-01-01T00:00:00.000000Z
0,0,task,tcp/10.77.0.2:7447,standard,88.0,88.0,0.5,2026-01-01T00:00:00.100000Z
0,9,sensing,cloud_active_sensing_recovery,local_recovery,0.000,4.0,1.0,2026-01-01T00:00:01.500000Z
"""


def kill(**times: float | None) -> FaultTimes:
    plain = dict.fromkeys(
        ("away_ms", "detection_ms", "recovery_ms", "launch_ms", "failback_ms", "longest_wait_ms")
    )
    return msgspec.convert(
        {"kind": "cloud_killed", "target": "t", "in_use": True, **plain, **times}, FaultTimes
    )


def rows_of(tmp_path: Path, fault: FaultTimes | None) -> list[dict[str, Any]]:
    path = tmp_path / "timings.csv"
    path.write_text(TIMINGS)
    table = DecisionTable(path)
    table.read()
    table.close()
    killed_at = table.rows[0].at + 1.0
    rows = rows_of_run(7, table, fault, killed_at, identical=True, emulated_by="packets")
    assert tuple(rows.columns) == COLUMNS
    known = rows.astype(object).where(rows.notna(), None)
    return list(known.to_dict("records"))


class TestRows:
    def test_a_row_for_each_decision_and_one_for_the_kill(self, tmp_path: Path) -> None:
        rows = rows_of(
            tmp_path, kill(detection_ms=45.0, recovery_ms=245.0, launch_ms=140.0, failback_ms=80.0)
        )
        assert [row["what"] for row in rows] == ["sensing", "task", "sensing", "kill"]
        assert [row["at_s"] for row in rows] == [0.0, 0.1, 1.5, 1.0]
        assert [row["service"] for row in rows] == ["cloud", "cloud", "local", None]
        assert rows[1]["round_trip_ms"] == 88.0
        assert rows[1]["computed_ms"] == 0.5
        assert rows[2]["status"] == "local_recovery"
        assert rows[3]["found_ms"] == 45.0
        assert rows[3]["first_local_ms"] == 200.0
        assert rows[3]["launch_ms"] == 140.0
        assert all(row["run"] == 7 and row["emulated_by"] == "packets" for row in rows)

    def test_what_was_not_seen_is_left_out(self, tmp_path: Path) -> None:
        assert len(rows_of(tmp_path, None)) == 3
        last = rows_of(tmp_path, kill(detection_ms=45.0))[-1]
        assert last["first_local_ms"] is None
        assert last["failback_ms"] is None


def test_the_settings_are_the_thesis_s() -> None:
    """In process and with services."""
    thesis = load(THESIS)
    series = series_of(100, 10, seed=0)
    assert series.problem == thesis.problem_name
    assert series.planning.particle_filter == thesis.planning.particle_filter
    assert series.planning.sensing_interval == thesis.planning.sensing_interval
    assert series.planning.selector == thesis.planning.selector
    assert series.max_steps == thesis.simulator.max_steps == cloud_trials.MAX_STEPS
    for settings in (series.planning.active_sensing, cloud_trials.SENSING):
        sensing = thesis.planning.active_sensing
        assert settings.num_observation_samples == sensing.num_observation_samples
        assert settings.num_nearest_neighbors == sensing.num_nearest_neighbors
    assert thesis.planning.sensing_interval == cloud_trials.SENSING_INTERVAL


@pytest.mark.parametrize("quick", [True, False])
def test_what_is_run(quick: bool) -> None:
    tasks = ThesisChapter6().tasks(Scale(quick=quick, seed=3))
    assert len({task_key(task) for task in tasks}) == len(tasks)
    clouds = [task for task in tasks if task.kind == "cloud_trials"]
    assert all(task.exclusive for task in clouds)
    wanted = [msgspec.convert(task.parameters, CloudTrials) for task in clouds]
    assert {each.particles for each in wanted} == set(PARTICLES)
    paths = {NetworkPath(each.transport, each.round_trip_ms, each.loss) for each in wanted}
    if quick:
        assert {NEAR, FAR} < paths < set(PATHS)
    else:
        assert paths == set(PATHS)
        near = [e.runs for e in wanted if e.round_trip_ms == 0.0 and e.particles == 300]
        assert sum(near) == 10
    in_process = [task for task in tasks if task.kind == "trials"]
    assert sum(task.units for task in in_process) == 5 * (20 if quick else 200)


def made_up(task: Task) -> pd.DataFrame:
    """Return rows as a run may leave them, without running anything."""
    if task.kind == "trials":
        first, count = task.parameters["first_trial"], task.parameters["num_trials"]
        trials = range(first, first + count)
        outcomes = [(number, number % 10 != 3) for number in trials]
        return pd.DataFrame(outcomes, columns=["trial", "success"])
    wanted = msgspec.convert(task.parameters, CloudTrials)
    chance = np.random.default_rng(wanted.particles)
    rows: list[tuple[Any, ...]] = []
    for run in range(wanted.first_run, wanted.first_run + wanted.runs):
        rate_hz = 50.0 if wanted.particles == 500 else 100.0
        end = (None, None, None, None, None, True, "packets", 0.5, rate_hz, 90_000)
        for number in range(40):
            away = 10 <= number < 25
            service = "local" if away else "cloud"
            status = "local_recovery" if away else "standard" if number < 10 else "keep_alive"
            trip_ms = (3.0 if away else wanted.round_trip_ms + 3.0) * chance.uniform(1.0, 1.1)
            for what, computed_ms in (("sensing", 0.002 * wanted.particles), ("task", 0.1)):
                times = (0.0, trip_ms + computed_ms, computed_ms)
                rows.append((run, what, 0.1 * number, 0, 9 * number, service, status, *times, *end))
        fault = (120.0, None, None, 45.0, 150.0, 120.0, 1100.0, 60.0, *end[-5:])
        rows.append((run, "kill", 1.05, None, None, None, None, *fault))
        if wanted.actions:
            rows += [
                (run, "action", 0.011 * number, 0, number, *[None] * 10, *end[-5:])
                for number in range(360)
            ]
    return pd.DataFrame(rows, columns=list(COLUMNS))


def number_of(report: Report, name: str) -> Number:
    (found,) = (number for number in report.numbers if number.name == name)
    return found


@pytest.fixture(scope="module")
def report() -> Any:
    scale = Scale(quick=True, seed=3)
    study = ThesisChapter6()
    return study.report(scale, made_up)


class TestReport:
    def test_a_slowed_robot_is_told_of(self, report: Any) -> None:
        assert number_of(report, "rate of the slowest robot").interval.value == 50.0

    def test_the_tables_say_what_was_measured(self, report: Any) -> None:
        decisions = list(report.summary["decisions"].to_dict("records"))
        near = [row for row in decisions if row["path"] == "same machine"]
        assert [(row["particles"], row["service"]) for row in near] == [
            (particles, service) for particles in (100, 500) for service in ("cloud", "local")
        ]
        assert [row["computed_ms"] for row in near] == [0.2, 0.2, 1.0, 1.0]
        assert all(row["sensing_decisions"] == (25 if row["service"] == "cloud" else 15)
                   for row in decisions)  # fmt: skip
        far = [r for r in decisions if r["path"] == "tls, 87 ms" and r["service"] == "cloud"]
        assert all(90.0 <= row["round_trip_ms"] <= 99.0 for row in far)
        assert all(math.isnan(row["round_trip_ms_low"]) for row in far)  # a single run
        faults = list(report.summary["faults"].to_dict("records"))
        assert all(row["found_ms"] == 45.0 and row["kills"] == 1 for row in faults)
        assert all(row["runs_as_their_references"] == row["runs"] for row in faults)

    def test_successes_have_ten_trials_and_all(self, report: Any) -> None:
        rows = list(report.summary["successes"].to_dict("records"))
        assert [row["particles"] for row in rows] == [each for each in PARTICLES for _ in "ab"]
        assert [row["trials"] for row in rows] == [10, 20] * 5
        assert [row["successes"] for row in rows] == [9, 18] * 5
        assert [row["success_thesis"] for row in rows] == [0.8] * 6 + [0.9] * 4

    def test_a_run_that_differs_is_told_of(self) -> None:
        scale = Scale(quick=True, seed=3)
        study = ThesisChapter6()
        tasks = study.tasks(scale)
        changed = next(task for task in tasks if task.kind == "cloud_trials" and
                       not task.parameters["actions"])  # fmt: skip

        def result_of(task: Task) -> pd.DataFrame:
            table = made_up(task)
            return table.assign(identical=False) if task == changed else table

        report = study.report(scale, result_of)
        runs = sum(task.parameters["runs"] for task in tasks if task.kind == "cloud_trials")
        number = number_of(report, "disturbed runs identical to their reference runs")
        assert number.n == runs
        assert number.interval.value == pytest.approx(100 * (runs - 1) / runs)
        assert (report.summary["faults"]["runs_as_their_references"] == 0).sum() == 1

    def test_the_numbers(self, report: Any) -> None:
        same = number_of(report, "disturbed runs identical to their reference runs")
        assert (same.n, same.interval.value) == (11, 100.0)
        assert number_of(report, "kills of the cloud service").interval.value == 11
        launched = number_of(
            report, "from detection to the first decision of a launched local service"
        )
        assert (launched.n, launched.interval.value) == (10, 150.0)
        back = "from the ready line of the restarted cloud to its first decision, tls, 87 ms"
        assert number_of(report, back).interval.value == 60.0
        below = number_of(report, f"{back}, share below the thesis's 1000 ms")
        assert (below.n, below.interval.value) == (3, 100.0)
        assert below.interval.low == pytest.approx(44.0, abs=0.5)
        local = "answers of the local service before the kill, tls, 87 ms, 5 % lost"
        assert number_of(report, local).n == 11
        assert all("nan" not in str(each) for each in report.numbers)

    def test_every_figure_is_drawn(self, report: Any, tmp_path: Path) -> None:
        names = write_report(ThesisChapter6(), Scale(quick=True, seed=3), report, tmp_path)
        assert {"times.png", "recovery.png", "cloud_dies.png"} < set(names)


def test_rows_are_found_by_what_they_say() -> None:
    table = made_up(Task(kind="cloud_trials", parameters={"particles": 100}))
    tables = []
    for number, path in enumerate((NEAR, FAR)):
        tables.append(table.assign(condition=number, particles=100, transport=path.transport,
                     path_round_trip_ms=path.round_trip_ms, loss=path.loss))  # fmt: skip
    rows = measured(pd.concat(tables, ignore_index=True))
    assert paths_of(rows) == [NEAR, FAR]
    assert rows["whole_run"].nunique() == 2
    assert len(select(rows, path=FAR)) == len(table)
    assert select(rows, what="sensing")["trip_ms"].isna().all()
    assert (select(rows, what="task")["trip_ms"] < 3.4).all()


@pytest.mark.slow
def test_really(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Real processes on three paths, one of them over the proxy; every decision is the twin's."""
    monkeypatch.setattr(thesis_chapter_6, "_QUICK", {NEAR: (100,), FAR: (100,)})
    monkeypatch.setattr(thesis_chapter_6, "_QUICK_TRIALS", 2)
    study = ThesisChapter6()
    scale = Scale(quick=True, seed=5)
    report = study.report(scale, run_task)
    same = number_of(report, "disturbed runs identical to their reference runs")
    assert (same.n, same.interval.value) == (3, 100.0)
    rows = report.raw["cloud"]
    assert {"standard", "local_recovery", "keep_alive"} >= set(rows["status"].dropna())
    assert "local_recovery" in set(rows["status"])
    assert (rows["what"] == "kill").sum() == 2
    far = rows["path_round_trip_ms"] == 87.0
    cloud = rows["service"] == "cloud"
    # No answer is faster than its line; that is no matter of how fast the machine is.
    assert (rows["round_trip_ms"][far & cloud] >= 87.0).all()
    write_report(study, scale, report, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("transport", ["tcp", "tls", "udp"])
def test_over_a_proxy(transport: str) -> None:
    table = cloud_trials.run_cloud_trials(
        particles=50,
        transport=transport,
        round_trip_ms=20.0,
        loss=0.01,
        first_run=4,
        runs=2,
        min_steps=200,
        packets=False,
    )
    assert table["identical"].all()
    assert set(table["run"]) == {4, 5}
    way = "datagram proxy" if transport == "udp" else "tcp proxy"
    assert set(table["emulated_by"]) == {way}
    assert "local" in set(table["service"])
