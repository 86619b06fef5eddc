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

from holdfast.arrays import BoolArray, FloatArray
from holdfast.config.settings import (
    ActiveSensingSettings,
    ParticleFilterSettings,
    PlanningSettings,
    SelectorSettings,
)
from holdfast.lab.studies.cloud_trials import CloudTrials
from holdfast.lab.studies.statistics import Interval, cells_of, median_interval
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
    MeasuredRows,
    NetworkPath,
)
from holdfast.lab.studies.trial_batches import TrialSeries, trial_tasks
from holdfast.recording.tables import wilson_interval

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
        measured, successes = MeasuredRows(rows), _successes(trials)
        return Report(
            summary={
                "decisions": _decisions(measured),
                "faults": _faults(measured),
                "successes": successes,
            },
            raw={"cloud": rows, "in_process": trials, "cloud_dies": picture},
            figures={
                name: partial(_draw, drawing, measured, successes, picture)
                for name, drawing in _DRAWINGS.items()
            },
            numbers=_numbers(measured, picture),
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
    drawing: str, measured: MeasuredRows, successes: pd.DataFrame, picture: pd.DataFrame
) -> Figure:
    # Matplotlib is imported there, so only when a figure is wanted.
    from holdfast.lab.studies import thesis_figures, thesis_picture

    if drawing == "successes":
        return thesis_figures.successes(successes)
    if drawing == "cloud_dies":
        return thesis_picture.cloud_dies(picture)
    draw: Callable[[MeasuredRows], Figure] = getattr(thesis_figures, drawing)
    return draw(measured)


# -- what comes of it ------------------------------------------------------------------------------


def _decisions(rows: MeasuredRows) -> pd.DataFrame:
    """Return a row for each path, number of particles and service that decided."""
    cells: list[dict[str, Cell]] = []
    for path in rows.paths:
        for particles in PARTICLES:
            for service in ("cloud", "local"):
                here = rows.where(path=path, particles=particles, service=service)
                sensing = here & rows.where(what="sensing")
                if not sensing.any():
                    continue
                cells.append(
                    {
                        **_names(path, rows, here),
                        "particles": particles,
                        "service": service,
                        "runs": len(set(rows.runs[here].tolist())),
                        "sensing_decisions": int(sensing.sum()),
                        **cells_of("computed_ms", rows.median(rows.number("computed_ms"), sensing)),
                        **cells_of(
                            "answered_ms", rows.median(rows.number("round_trip_ms"), sensing)
                        ),
                        **cells_of("round_trip_ms", rows.median(rows.round_trips, here)),
                        "round_trip_p95_ms": _percentile(rows.round_trips[here], 95.0),
                        **cells_of("waited_ms", rows.median(rows.number("waited_ms"), sensing)),
                    }
                )
    return pd.DataFrame(cells)


def _faults(rows: MeasuredRows) -> pd.DataFrame:
    """Return a row for each path and number of particles."""
    cells: list[dict[str, Cell]] = []
    for path in rows.paths:
        for particles in PARTICLES:
            here = rows.where(path=path, particles=particles)
            kills = here & rows.where(what="kill")
            if not kills.any():
                continue
            runs = sorted(set(rows.runs[here].tolist()))
            cold = kills & ~np.isnan(rows.number("launch_ms"))
            cells.append(
                {
                    **_names(path, rows, here),
                    "particles": particles,
                    "runs": len(runs),
                    "runs_as_their_references": len(runs) - len(_diverged(rows, here)),
                    "kills": int(kills.sum()),
                    **cells_of("found_ms", median_interval(rows.number("found_ms")[kills])),
                    "launches": int(cold.sum()),
                    **cells_of("launch_ms", median_interval(rows.number("launch_ms")[cold])),
                    **cells_of(
                        "first_local_ms", median_interval(rows.number("first_local_ms")[cold])
                    ),
                    **cells_of("failback_ms", median_interval(rows.number("failback_ms")[kills])),
                    **cells_of("longest_wait_ms", median_interval(rows.number("waited_ms")[kills])),
                }
            )
    return pd.DataFrame(cells)


def _diverged(rows: MeasuredRows, here: BoolArray) -> set[float]:
    return set(rows.runs[here & (rows.number("identical") == 0.0)].tolist())


def _names(path: NetworkPath, rows: MeasuredRows, here: BoolArray) -> dict[str, Cell]:
    ways = sorted({str(way) for way in rows.word("emulated_by")[here]})
    return {
        "path": path.label,
        "transport": path.transport,
        "path_round_trip_ms": path.round_trip_ms,
        "loss": path.loss,
        "emulated_by": ", ".join(ways),
    }


def _percentile(values: FloatArray, share: float) -> float | None:
    known = values[~np.isnan(values)]
    return round(float(np.percentile(known, share)), 4) if known.size else None


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
                    **cells_of("success", _share(found, part.size)),
                    "success_thesis": _success_of_thesis(count),
                }
            )
    return pd.DataFrame(cells)


def _success_of_thesis(particles: int) -> float:
    return THESIS_SUCCESS_ABOVE_300 if particles > 300 else THESIS_SUCCESS


def _share(successes: int, count: int, factor: float = 1.0) -> Interval:
    """Return a share with Wilson's interval."""
    ends = (successes / count, *wilson_interval(successes, count))
    return Interval(*(factor * end for end in ends))


def _numbers(rows: MeasuredRows, picture: pd.DataFrame) -> list[Number]:
    """Return what is pooled over the numbers of particles; the picture's run counts as well."""
    everywhere = rows.where()
    runs = len(set(rows.runs.tolist())) + 1
    same = runs - len(_diverged(rows, everywhere)) - int(not picture["identical"].all())
    kills, sensing = (
        int(rows.where(what=what).sum() + (picture["what"] == what).sum())
        for what in ("kill", "sensing")
    )
    return [
        Number(
            "disturbed runs identical to their reference runs", _share(same, runs, 100), "%", runs
        ),
        Number("kills of the cloud service", Interval(*[kills] * 3)),
        Number("sensing decisions", Interval(*[sensing] * 3)),
        *_numbers_of_times(rows),
        *_numbers_of_faults(rows),
        *_numbers_of_loss(rows),
        *_numbers_of_load(rows),
    ]


def _numbers_of_times(rows: MeasuredRows) -> list[Number]:
    """Return medians of what was asked, by service."""

    def median(name: str, values: FloatArray, here: BoolArray) -> list[Number]:
        if not here.any():
            return []
        return [Number(name, rows.median(values, here), "ms", int(here.sum()))]

    numbers = []
    for service in ("cloud", "local"):
        for count in (PARTICLES[0], PARTICLES[-1]):
            here = rows.where(what="sensing", service=service, particles=count)
            name = f"computing a sensing action, {service}, {count} particles"
            numbers += median(name, rows.number("computed_ms"), here)
    name = "round trip without computation"
    numbers += median(f"{name}, local", rows.round_trips, rows.where(service="local", what="task"))
    for path in rows.paths:
        here = rows.where(path=path, service="cloud", what="task")
        if path.loss == 0.0:
            numbers += median(f"{name}, cloud, {path.label}", rows.round_trips, here)
    places: dict[str, dict[str, object]] = {
        f"cloud, {FAR.label}": {"service": "cloud", "path": FAR},
        "local": {"service": "local"},
    }
    for place, wanted in places.items():
        for what, asked in (("sensing", "a sensing action"), ("task", "task actions")):
            here = rows.where(what=what, **wanted)
            numbers += median(f"waiting for {asked}, {place}", rows.number("waited_ms"), here)
    return numbers


def _numbers_of_faults(rows: MeasuredRows) -> list[Number]:
    """Return the times from kill to local recovery and back, and how many beat the thesis's."""
    kills = rows.where(what="kill")
    clean = [path for path in rows.paths if path.loss == 0.0]
    found_ms, failback_ms = rows.number("found_ms"), rows.number("failback_ms")
    numbers = []
    for path in clean:
        here = kills & rows.where(path=path)
        if here.any():
            interval = median_interval(found_ms[here])
            name = f"from the kill until the robot detects it, {path.label}"
            numbers.append(Number(name, interval, "ms", int(here.sum())))
    cold = kills & ~np.isnan(rows.number("launch_ms"))
    numbers += _times_and_share(
        "from detection to the first decision of a launched local service",
        rows.number("first_local_ms")[cold],
        THESIS_LAUNCH_MS,
    )
    for path in clean:
        numbers += _times_and_share(
            f"from the ready line of the restarted cloud to its first decision, {path.label}",
            failback_ms[kills & rows.where(path=path)],
            THESIS_FAILBACK_MS,
        )
    return numbers


def _times_and_share(name: str, times: FloatArray, limit_ms: float) -> list[Number]:
    """Return the median of times, and the share below a limit; NaN, of a run that ended, is not."""
    known = times[~np.isnan(times)]
    if not known.size:
        return []
    below = _share(int(np.count_nonzero(known < limit_ms)), times.size, 100)
    return [
        Number(name, median_interval(known), "ms", known.size),
        Number(f"{name}, share below the thesis's {limit_ms:g} ms", below, "%", times.size),
    ]


def _numbers_of_loss(rows: MeasuredRows) -> list[Number]:
    """Return what lost packets do to round trips, and how often the local service answered."""
    kills = rows.where(what="kill")
    killed_s = dict(zip(rows.runs[kills], rows.number("at_s")[kills], strict=True))
    before = rows.number("at_s") < np.array([killed_s.get(run, math.inf) for run in rows.runs])
    numbers = []
    for path in rows.paths:
        p95_ms = _percentile(
            rows.round_trips[rows.where(path=path, service="cloud", what="task")], 95.0
        )
        if path.loss == 0.0 or p95_ms is None:
            continue
        asked = rows.where(path=path, what="task") & before
        local = int((asked & rows.where(service="local")).sum())
        count = int(rows.where(path=path, service="cloud", what="task").sum())
        total = int(asked.sum())
        numbers += [
            Number(
                f"95th percentile of round trips, {path.label}",
                Interval(*[p95_ms] * 3),
                "ms",
                count,
            ),
            Number(
                f"answers of the local service before the kill, {path.label}",
                _share(local, total, 100),
                "%",
                total,
            ),
        ]
    return numbers


def _numbers_of_load(rows: MeasuredRows) -> list[Number]:
    """Return how busy the machine was when runs began, and how slow the slowest robot was."""
    _, first = np.unique(rows.runs, return_index=True)
    loads, rates_hz = rows.number("load")[first], rows.number("rate_hz")[first]
    load = Interval(float(np.nanmedian(loads)), float(np.nanmin(loads)), float(np.nanmax(loads)))
    return [
        Number("processes that wanted a core (median, least and most)", load, "", loads.size),
        Number("rate of the slowest robot", Interval(*[float(rates_hz.min())] * 3), "Hz"),
    ]
