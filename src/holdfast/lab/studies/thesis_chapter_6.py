"""The thesis's chapter 6: what it costs to let a cloud choose what to sense, and to lose it.

The thesis's robot asks a service 87 ms away for each sensing action. The service dies; after a
timeout of five seconds a local one is launched; and when the cloud is back, it is used again. Its
figures 9 to 15 show how long all of that took, with 100 to 500 particles. Here the same is measured
of holdfast: real processes, a real SIGKILL, and an emulated path, of which every row of the tables
says how it was emulated.

Of the thesis's results no more is known than its text says; that is drawn as lines. Its machines
were others, so where a time is one of computing, nothing follows from a comparison.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import msgspec
import numpy as np
import pandas as pd

from holdfast.config.settings import (
    ActiveSensingSettings,
    ParticleFilterSettings,
    PlanningSettings,
    SelectorSettings,
)
from holdfast.lab.studies.cloud_trials import CloudTrials
from holdfast.lab.studies.statistics import Interval, cells_of, median_interval, rate_interval
from holdfast.lab.studies.study import Number, Report, Results, Scale
from holdfast.lab.studies.tables import Cell
from holdfast.lab.studies.tasks import Task
from holdfast.lab.studies.thesis_measurements import (
    FAR,
    NEAR,
    PARTICLES,
    PATHS,
    THESIS_CLOUD_ROUND_TRIP_MS,
    THESIS_FAILBACK_MS,
    THESIS_LAUNCH_MS,
    THESIS_SUCCESS,
    THESIS_SUCCESS_ABOVE_300,
    THESIS_TRIALS,
    NetworkPath,
    clustered_median,
    measured,
    paths_of,
    select,
)
from holdfast.lab.studies.trial_batches import TrialSeries, trial_tasks

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["ThesisChapter6", "series_of"]

_MAX_STEPS = 700
_TRIALS = 200
_QUICK_TRIALS = 20
_TRIALS_IN_EACH = 20

_RUNS_IN_EACH = 6
"""Runs of a task: less than a minute, so that not much is lost when it is interrupted."""

_UNITS_OF_RUN = 40
"""A run takes as long as about so many trials in process."""

_RATE_HZ = 100.0
_STEPS, _QUICK_STEPS = 400, 280
_LOCAL_DECISIONS, _QUICK_LOCAL_DECISIONS = 8, 4

_PICTURE_RATE_HZ = 30.0
"""At this rate the robot has up to 0.3 s of actions in hand when the cloud dies."""

_QUICK: dict[NetworkPath, tuple[int, ...]] = {
    NEAR: (100, 500),
    FAR: (200, 300, 400),
    NetworkPath("tls", 20.0, 0.0): (300,),
    NetworkPath("udp", 20.0, 0.0): (300,),
    NetworkPath("udp", THESIS_CLOUD_ROUND_TRIP_MS, 0.0): (300,),
    NetworkPath("tls", THESIS_CLOUD_ROUND_TRIP_MS, 0.05): (300,),
    NetworkPath("udp", THESIS_CLOUD_ROUND_TRIP_MS, 0.05): (300,),
}


def series_of(particles: int, num_trials: int, seed: int) -> TrialSeries:
    """Return the thesis's trials."""
    return TrialSeries(
        problem="peg_in_hole_2d",
        planning=PlanningSettings(
            particle_filter=ParticleFilterSettings(num_particles=particles),
            active_sensing=ActiveSensingSettings(
                num_observation_samples=10, num_nearest_neighbors=5, num_cores=1
            ),
            selector=SelectorSettings(method="action_entropy", estimator="nearest_neighbor"),
            sensing_interval=8,
        ),
        max_steps=_MAX_STEPS,
        seed=seed,
        num_trials=num_trials,
    )


class _Condition(NamedTuple):
    """Runs with the same settings."""

    path: NetworkPath
    particles: int
    runs: int


class ThesisChapter6:
    """The study ``thesis_chapter_6``."""

    name = "thesis_chapter_6"
    title = "The thesis's chapter 6: sensing and recovery times, 100 to 500 particles"

    def tasks(self, scale: Scale) -> list[Task]:
        """Return all that is to be computed, in the order in which to begin."""
        tasks = [_picture_task(scale)]
        tasks += [task for each in _conditions(scale) for task in _cloud_tasks(each, scale)]
        tasks += [task for count in PARTICLES for task in _trial_tasks(count, scale)]
        return tasks

    def report(self, scale: Scale, results: Results) -> Report:
        """Return what it comes to, from the results of all its tasks."""
        rows = pd.concat(
            [
                results.of(_cloud_tasks(each, scale)).assign(
                    condition=number,
                    particles=each.particles,
                    transport=each.path.transport,
                    path_round_trip_ms=each.path.round_trip_ms,
                    loss=each.path.loss,
                )
                for number, each in enumerate(_conditions(scale))
            ],
            ignore_index=True,
        )
        trials = pd.concat(
            [results.of(_trial_tasks(count, scale)).assign(particles=count) for count in PARTICLES]
        )
        picture = results.of([_picture_task(scale)])
        known, successes = measured(rows), _successes(trials)
        return Report(
            summary={
                "decisions": _decisions(known),
                "faults": _faults(known),
                "successes": successes,
            },
            raw={"cloud": rows, "in_process": trials, "cloud_dies": picture},
            figures={
                name: partial(_draw, drawing, known, successes, picture)
                for name, drawing in _DRAWINGS.items()
            },
            numbers=_numbers(known, picture),
        )


# -- what is run -----------------------------------------------------------------------------------


def _conditions(scale: Scale) -> list[_Condition]:
    if scale.quick:
        return [_Condition(path, count, 1) for path, counts in _QUICK.items() for count in counts]
    return [_Condition(path, count, _runs_over(path)) for path in PATHS for count in PARTICLES]


def _runs_over(path: NetworkPath) -> int:
    if path == NEAR:
        return THESIS_TRIALS
    return 1 if path.loss else 6  # the fewest of which a median has an interval


def _cloud_tasks(condition: _Condition, scale: Scale) -> list[Task]:
    path = condition.path
    tasks = []
    for first in range(0, condition.runs, _RUNS_IN_EACH):
        trials = CloudTrials(
            particles=condition.particles,
            transport=path.transport,
            round_trip_ms=path.round_trip_ms,
            loss=path.loss,
            first_run=first,
            runs=min(_RUNS_IN_EACH, condition.runs - first),
            seed=_seed_of(condition, scale),
            min_steps=_QUICK_STEPS if scale.quick else _STEPS,
            rate_hz=_RATE_HZ,
            local_decisions=_QUICK_LOCAL_DECISIONS if scale.quick else _LOCAL_DECISIONS,
            max_steps=_MAX_STEPS,
        )
        tasks.append(_task_of(trials))
    return tasks


def _seed_of(condition: _Condition, scale: Scale) -> int:
    """Return a seed of each condition's own: what is pooled over conditions must be independent."""
    path = condition.path
    name = f"{path.transport} {path.round_trip_ms} {path.loss} {condition.particles}"
    return scale.seed + zlib.crc32(name.encode())


def _picture_task(scale: Scale) -> Task:
    return _task_of(
        CloudTrials(
            particles=300,
            transport=FAR.transport,
            round_trip_ms=FAR.round_trip_ms,
            seed=scale.seed,
            min_steps=200,
            rate_hz=_PICTURE_RATE_HZ,
            local_decisions=5,
            max_steps=_MAX_STEPS,
            actions=True,
        )
    )


def _task_of(trials: CloudTrials) -> Task:
    return Task(
        kind="cloud_trials",
        parameters=msgspec.to_builtins(trials),
        units=_UNITS_OF_RUN * trials.runs,
        exclusive=True,
    )


def _trial_tasks(particles: int, scale: Scale) -> list[Task]:
    num_trials = _QUICK_TRIALS if scale.quick else _TRIALS
    return list(trial_tasks(series_of(particles, num_trials, scale.seed), _TRIALS_IN_EACH))


_DRAWINGS = {
    "fig09_10_11_sensing_time": "sensing_times",
    "fig12_round_trip": "round_trips",
    "fig13_successes": "successes",
    "fig14_launch": "launches",
    "fig15_failback": "failbacks",
    "cloud_dies": "cloud_dies",
}
"""Figures, and the functions that draw them."""


def _draw(
    drawing: str, known: pd.DataFrame, successes: pd.DataFrame, picture: pd.DataFrame
) -> Figure:
    # Matplotlib is imported there, so only when a figure is wanted.
    from holdfast.lab.studies import thesis_figures, thesis_picture

    if drawing == "successes":
        return thesis_figures.successes(successes)
    if drawing == "cloud_dies":
        return thesis_picture.cloud_dies(picture)
    draw: Callable[[pd.DataFrame], Figure] = getattr(thesis_figures, drawing)
    return draw(known)


# -- what comes of it ------------------------------------------------------------------------------


def _decisions(rows: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each path, number of particles and service that decided."""
    cells: list[dict[str, Cell]] = []
    for (_, particles, service), here in rows.groupby(
        ["path", "particles", "service"], observed=True
    ):
        sensing = select(here, what="sensing")
        if sensing.empty:
            continue
        cells.append(
            {
                **_names(here),
                "particles": particles,
                "service": service,
                "runs": here["whole_run"].nunique(),
                "sensing_decisions": len(sensing),
                **cells_of("computed_ms", clustered_median(sensing, "computed_ms")),
                **cells_of("answered_ms", clustered_median(sensing, "round_trip_ms")),
                **cells_of("round_trip_ms", clustered_median(here, "trip_ms")),
                "round_trip_p95_ms": _p95(here["trip_ms"]),
                **cells_of("waited_ms", clustered_median(sensing, "waited_ms")),
            }
        )
    return pd.DataFrame(cells)


def _faults(rows: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each path and number of particles."""
    cells: list[dict[str, Cell]] = []
    for (_, particles), here in rows.groupby(["path", "particles"], observed=True):
        kills = select(here, what="kill")
        if kills.empty:
            continue
        cold = kills[kills["launch_ms"].notna()]
        runs = here["whole_run"].nunique()
        cells.append(
            {
                **_names(here),
                "particles": particles,
                "runs": runs,
                "runs_as_their_references": runs - _diverged(here),
                "kills": len(kills),
                **_median_cells("found_ms", kills["found_ms"]),
                "launches": len(cold),
                **_median_cells("launch_ms", cold["launch_ms"]),
                **_median_cells("first_local_ms", cold["first_local_ms"]),
                **_median_cells("failback_ms", kills["failback_ms"]),
                **_median_cells("longest_wait_ms", kills["waited_ms"]),
            }
        )
    return pd.DataFrame(cells)


def _median_cells(name: str, times: pd.Series) -> dict[str, Cell]:
    return cells_of(name, median_interval(times.to_numpy(float)))


def _diverged(rows: pd.DataFrame) -> int:
    """Return how many runs differ from their reference runs."""
    return int(select(rows, identical=False)["whole_run"].nunique())


def _names(here: pd.DataFrame) -> dict[str, Cell]:
    first = here[["path", "transport", "path_round_trip_ms", "loss"]].iloc[0]
    return {**first.to_dict(), "emulated_by": ", ".join(sorted(set(here["emulated_by"])))}


def _p95(values: pd.Series) -> float | None:
    known = values.dropna()
    return round(float(np.percentile(known, 95.0)), 4) if len(known) else None


def _successes(trials: pd.DataFrame) -> pd.DataFrame:
    cells: list[dict[str, Cell]] = []
    for count in PARTICLES:
        here = trials["success"][trials["particles"] == count]
        for part in (here[:THESIS_TRIALS], here):
            found = int(part.sum())
            cells.append(
                {
                    "particles": count,
                    "trials": int(part.size),
                    "successes": found,
                    **cells_of("success", rate_interval(found, part.size)),
                    "success_thesis": _success_of_thesis(count),
                }
            )
    return pd.DataFrame(cells)


def _success_of_thesis(particles: int) -> float:
    return THESIS_SUCCESS_ABOVE_300 if particles > 300 else THESIS_SUCCESS


def _numbers(rows: pd.DataFrame, picture: pd.DataFrame) -> list[Number]:
    """Return what is pooled over the numbers of particles; the picture's run counts as well."""
    runs = rows["whole_run"].nunique() + 1
    same = runs - _diverged(rows) - int(not picture["identical"].all())
    kills, sensing = (
        len(select(rows, what=what)) + len(select(picture, what=what))
        for what in ("kill", "sensing")
    )
    return [
        Number(
            "disturbed runs identical to their reference runs",
            rate_interval(same, runs, 100),
            "%",
            runs,
        ),
        Number("kills of the cloud service", Interval(*[kills] * 3)),
        Number("sensing decisions", Interval(*[sensing] * 3)),
        *_numbers_of_times(rows),
        *_numbers_of_faults(rows),
        *_numbers_of_loss(rows),
        *_numbers_of_load(rows),
    ]


def _numbers_of_times(rows: pd.DataFrame) -> list[Number]:
    """Return medians of what was asked, by service."""
    wanted: list[tuple[str, str, dict[str, object]]] = [
        (
            f"computing a sensing action, {service}, {count} particles",
            "computed_ms",
            {"what": "sensing", "service": service, "particles": count},
        )
        for service in ("cloud", "local")
        for count in (PARTICLES[0], PARTICLES[-1])
    ]
    name = "round trip without computation"
    wanted.append((f"{name}, local", "trip_ms", {"service": "local", "what": "task"}))
    wanted += [
        (
            f"{name}, cloud, {path.label}",
            "trip_ms",
            {"path": path, "service": "cloud", "what": "task"},
        )
        for path in paths_of(rows)
        if path.loss == 0.0
    ]
    places: dict[str, dict[str, object]] = {
        f"cloud, {FAR.label}": {"service": "cloud", "path": FAR},
        "local": {"service": "local"},
    }
    wanted += [
        (f"waiting for {asked}, {place}", "waited_ms", {"what": what, **cells})
        for place, cells in places.items()
        for what, asked in (("sensing", "a sensing action"), ("task", "task actions"))
    ]
    found = [(name, column, select(rows, **cells)) for name, column, cells in wanted]
    return [
        Number(name, clustered_median(here, column), "ms", len(here))
        for name, column, here in found
        if len(here)
    ]


def _numbers_of_faults(rows: pd.DataFrame) -> list[Number]:
    """Return the times from kill to local recovery and back, and how many beat the thesis's."""
    kills = select(rows, what="kill")
    clean = {path.label: select(kills, path=path) for path in paths_of(rows) if path.loss == 0.0}
    numbers = [
        Number(
            f"from the kill until the robot detects it, {label}",
            median_interval(here["found_ms"].to_numpy(float)),
            "ms",
            len(here),
        )
        for label, here in clean.items()
        if len(here)
    ]
    numbers += _times_and_share(
        "from detection to the first decision of a launched local service",
        kills.loc[kills["launch_ms"].notna(), "first_local_ms"],
        THESIS_LAUNCH_MS,
    )
    for label, here in clean.items():
        numbers += _times_and_share(
            f"from the ready line of the restarted cloud to its first decision, {label}",
            here["failback_ms"],
            THESIS_FAILBACK_MS,
        )
    return numbers


def _times_and_share(name: str, times: pd.Series, limit_ms: float) -> list[Number]:
    """Return the median of times, and the share below a limit; NaN, of a run that ended, is not."""
    known = times.dropna().to_numpy(float)
    if not known.size:
        return []
    below = rate_interval(int(np.count_nonzero(known < limit_ms)), times.size, 100)
    return [
        Number(name, median_interval(known), "ms", known.size),
        Number(f"{name}, share below the thesis's {limit_ms:g} ms", below, "%", times.size),
    ]


def _numbers_of_loss(rows: pd.DataFrame) -> list[Number]:
    """Return what lost packets do to round trips, and how often the local service answered."""
    tasks = select(rows, what="task")
    killed_s = select(rows, what="kill").set_index("whole_run")["at_s"]
    before = tasks[tasks["at_s"] < tasks["whole_run"].map(killed_s).fillna(math.inf)]
    numbers = []
    for path in paths_of(rows):
        far = select(tasks, path=path, service="cloud")
        p95_ms = _p95(far["trip_ms"])
        if path.loss == 0.0 or p95_ms is None:
            continue
        asked = select(before, path=path)
        local = len(select(asked, service="local"))
        numbers += [
            Number(
                f"95th percentile of round trips, {path.label}",
                Interval(*[p95_ms] * 3),
                "ms",
                len(far),
            ),
            Number(
                f"answers of the local service before the kill, {path.label}",
                rate_interval(local, len(asked), 100),
                "%",
                len(asked),
            ),
        ]
    return numbers


def _numbers_of_load(rows: pd.DataFrame) -> list[Number]:
    """Return how busy the machine was when runs began, and how slow the slowest robot was."""
    runs = rows.drop_duplicates("whole_run")
    loads = runs["load"]
    load = Interval(loads.median(), loads.min(), loads.max())
    return [
        Number("processes that wanted a core (median, least and most)", load, "", len(runs)),
        Number("rate of the slowest robot", Interval(*[float(runs["rate_hz"].min())] * 3), "Hz"),
    ]
