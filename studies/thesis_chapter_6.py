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
from collections.abc import Iterator, Mapping

import msgspec
import numpy as np
import pandas as pd

from holdfast.planning.settings import ParticleFilterSettings, PlanningSettings, SelectorSettings
from studies.cloud_trials import (
    MAX_STEPS,
    PROBLEM,
    SENSING,
    SENSING_INTERVAL,
    CloudTrials,
)
from studies.statistics import (
    Interval,
    cells_of,
    exactly,
    median_interval,
    rate_interval,
)
from studies.study import Number, Part, Report, Scale, Study, drawn
from studies.tables import Cell
from studies.tasks import Task
from studies.thesis_measurements import (
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
from studies.trial_batches import TrialSeries, trial_tasks

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
        problem=PROBLEM,
        planning=PlanningSettings(
            particle_filter=ParticleFilterSettings(num_particles=particles),
            active_sensing=msgspec.structs.replace(SENSING, num_cores=1),
            selector=SelectorSettings(method="action_entropy", estimator="nearest_neighbor"),
            sensing_interval=SENSING_INTERVAL,
        ),
        max_steps=MAX_STEPS,
        seed=seed,
        num_trials=num_trials,
    )


class ThesisChapter6(Study):
    """The study ``thesis_chapter_6``."""

    name = "thesis_chapter_6"
    title = "The thesis's chapter 6: sensing and recovery times, 100 to 500 particles"

    def parts(self, scale: Scale) -> Iterator[Part]:
        """Yield the run of the picture, the runs of each condition, and trials in process."""
        picture = CloudTrials(
            particles=300,
            transport=FAR.transport,
            round_trip_ms=FAR.round_trip_ms,
            seed=scale.seed,
            min_steps=200,
            rate_hz=_PICTURE_RATE_HZ,
            local_decisions=5,
            actions=True,
        )
        yield Part({}, [_task_of(picture)], "cloud_dies")
        for number, (path, particles, runs) in enumerate(_conditions(scale)):
            names = {
                "condition": number,
                "particles": particles,
                "transport": path.transport,
                "path_round_trip_ms": path.round_trip_ms,
                "loss": path.loss,
            }
            yield Part(names, list(_cloud_tasks(path, particles, runs, scale)), "cloud")
        for count in PARTICLES:
            series = series_of(count, _QUICK_TRIALS if scale.quick else _TRIALS, scale.seed)
            yield Part(
                {"particles": count}, list(trial_tasks(series, _TRIALS_IN_EACH)), "in_process"
            )

    def report_of(self, tables: Mapping[str, pd.DataFrame]) -> Report:
        """Return the report on the rows of all parts."""
        picture, known = tables["cloud_dies"], measured(tables["cloud"])
        decisions, faults = _decisions(known), _faults(known)
        return Report(
            summary={
                "decisions": decisions,
                "faults": faults,
                "successes": _successes(tables["in_process"]),
            },
            figures={
                "times": drawn("thesis_figures:times", decisions),
                "recovery": drawn("thesis_figures:recovery", faults),
                "cloud_dies": drawn("thesis_picture:cloud_dies", picture),
            },
            numbers=_numbers(known, picture),
        )


# -- what is run -----------------------------------------------------------------------------------


def _conditions(scale: Scale) -> list[tuple[NetworkPath, int, int]]:
    """Return paths, numbers of particles, and of runs with these."""
    if scale.quick:
        return [(path, count, 1) for path, counts in _QUICK.items() for count in counts]
    return [(path, count, _runs_over(path)) for path in PATHS for count in PARTICLES]


def _runs_over(path: NetworkPath) -> int:
    if path == NEAR:
        return THESIS_TRIALS
    return 1 if path.loss else 6  # the fewest of which a median has an interval


def _cloud_tasks(path: NetworkPath, particles: int, runs: int, scale: Scale) -> Iterator[Task]:
    # A seed of each condition's own: what is pooled over conditions must be independent.
    name = f"{path.transport} {path.round_trip_ms} {path.loss} {particles}"
    for first in range(0, runs, _RUNS_IN_EACH):
        yield _task_of(
            CloudTrials(
                particles=particles,
                transport=path.transport,
                round_trip_ms=path.round_trip_ms,
                loss=path.loss,
                first_run=first,
                runs=min(_RUNS_IN_EACH, runs - first),
                seed=scale.seed + zlib.crc32(name.encode()),
                min_steps=_QUICK_STEPS if scale.quick else _STEPS,
                rate_hz=_RATE_HZ,
                local_decisions=_QUICK_LOCAL_DECISIONS if scale.quick else _LOCAL_DECISIONS,
            )
        )


def _task_of(trials: CloudTrials) -> Task:
    return Task(
        kind="cloud_trials",
        parameters=msgspec.to_builtins(trials),
        units=_UNITS_OF_RUN * trials.runs,
        exclusive=True,
    )


# -- what comes of it ------------------------------------------------------------------------------


def _decisions(rows: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each path, number of particles and service that decided."""
    groups = rows.groupby(["path", "particles", "service"], observed=True)
    return pd.DataFrame(
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
        for (_, particles, service), here in groups
        if len(sensing := select(here, what="sensing"))
    )


def _faults(rows: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each path and number of particles."""
    return pd.DataFrame(
        {
            **_names(here),
            "particles": particles,
            "runs": (runs := here["whole_run"].nunique()),
            "runs_as_their_references": runs - _diverged(here),
            "kills": len(kills),
            **cells_of("found_ms", median_interval(kills["found_ms"])),
            "launches": len(cold := kills[kills["launch_ms"].notna()]),
            **cells_of("launch_ms", median_interval(cold["launch_ms"])),
            **cells_of("first_local_ms", median_interval(cold["first_local_ms"])),
            **cells_of("failback_ms", median_interval(kills["failback_ms"])),
            **cells_of("longest_wait_ms", median_interval(kills["waited_ms"])),
        }
        for (_, particles), here in rows.groupby(["path", "particles"], observed=True)
        if len(kills := select(here, what="kill"))
    )


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
    return pd.DataFrame(
        {
            "particles": count,
            "trials": part.size,
            "successes": (found := int(part.sum())),
            **cells_of("success", rate_interval(found, part.size)),
            "success_thesis": THESIS_SUCCESS_ABOVE_300 if count > 300 else THESIS_SUCCESS,
        }
        for count in PARTICLES
        for part in (
            trials["success"][trials["particles"] == count][:THESIS_TRIALS],
            trials["success"][trials["particles"] == count],
        )
    )


def _numbers(rows: pd.DataFrame, picture: pd.DataFrame) -> list[Number]:
    """Return what is pooled over the numbers of particles; the picture's run counts as well."""
    runs = rows["whole_run"].nunique() + 1
    same = runs - _diverged(rows) - int(not picture["identical"].all())
    identical = rate_interval(same, runs, 100)
    kills, sensing = (
        len(select(rows, what=what)) + len(select(picture, what=what))
        for what in ("kill", "sensing")
    )
    loads = rows.drop_duplicates("whole_run")["load"]
    load = Interval(loads.median(), loads.min(), loads.max())
    return [
        Number("disturbed runs identical to their reference runs", identical, "%", runs),
        Number("kills of the cloud service", exactly(kills)),
        Number("sensing decisions", exactly(sensing)),
        *_numbers_of_times(rows),
        *_numbers_of_faults(rows),
        *_numbers_of_loss(rows),
        # How busy the machine was when runs began.
        Number("processes that wanted a core (median, least and most)", load, "", len(loads)),
        Number("rate of the slowest robot", exactly(float(rows["rate_hz"].min())), "Hz"),
    ]


def _numbers_of_times(rows: pd.DataFrame) -> Iterator[Number]:
    """Yield medians of what was asked, by service."""
    trip, clean = "round trip without computation", _clean_paths(rows)
    far = f"cloud, {FAR.label}"
    wanted: list[tuple[str, str, dict[str, object]]] = [
        (
            f"computing a sensing action, {service}, {count} particles",
            "computed_ms",
            {"what": "sensing", "service": service, "particles": count},
        )
        for service in ("cloud", "local")
        for count in (PARTICLES[0], PARTICLES[-1])
    ]
    wanted.append((f"{trip}, local", "trip_ms", {"what": "task", "service": "local"}))
    wanted += [
        (f"{trip}, cloud, {each.label}", "trip_ms",
         {"what": "task", "service": "cloud", "path": each}) for each in clean
    ]  # fmt: skip
    wanted += [
        (f"waiting for {asked}, {place}", "waited_ms", {"what": what, **cells})
        for place, cells in (
            (far, {"service": "cloud", "path": FAR}),
            ("local", {"service": "local"}),
        )
        for what, asked in (("sensing", "a sensing action"), ("task", "task actions"))
    ]
    for name, column, cells in wanted:
        if len(here := select(rows, **cells)):
            yield Number(name, clustered_median(here, column), "ms", len(here))


def _clean_paths(rows: pd.DataFrame) -> list[NetworkPath]:
    return [path for path in paths_of(rows) if path.loss == 0.0]


def _numbers_of_faults(rows: pd.DataFrame) -> Iterator[Number]:
    """Yield the times from kill to local recovery and back, and how many beat the thesis's."""
    kills = select(rows, what="kill")
    clean = {path.label: select(kills, path=path) for path in _clean_paths(rows)}
    for label, here in clean.items():
        if len(here):
            found = median_interval(here["found_ms"])
            name = f"from the kill until the robot detects it, {label}"
            yield Number(name, found, "ms", len(here))
    cold = kills.loc[kills["launch_ms"].notna(), "first_local_ms"]
    name = "from detection to the first decision of a launched local service"
    yield from _times_and_share(name, cold, THESIS_LAUNCH_MS)
    for label, here in clean.items():
        name = f"from the ready line of the restarted cloud to its first decision, {label}"
        yield from _times_and_share(name, here["failback_ms"], THESIS_FAILBACK_MS)


def _times_and_share(name: str, times: pd.Series, limit_ms: float) -> Iterator[Number]:
    """Yield the median of times, and the share below a limit; NaN, of a run that ended, is not."""
    known = times.dropna()
    if len(known):
        below = rate_interval(int((known < limit_ms).sum()), times.size, 100)
        yield Number(name, median_interval(known), "ms", known.size)
        yield Number(f"{name}, share below the thesis's {limit_ms:g} ms", below, "%", times.size)


def _numbers_of_loss(rows: pd.DataFrame) -> Iterator[Number]:
    """Yield what lost packets do to round trips, and how often the local service answered."""
    tasks = select(rows, what="task")
    killed_s = select(rows, what="kill").set_index("whole_run")["at_s"]
    before = tasks[tasks["at_s"] < tasks["whole_run"].map(killed_s).fillna(math.inf)]
    for path in paths_of(rows):
        far = select(tasks, path=path, service="cloud")
        p95_ms = _p95(far["trip_ms"])
        if path.loss == 0.0 or p95_ms is None:
            continue
        asked = select(before, path=path)
        local = rate_interval(len(select(asked, service="local")), len(asked), 100)
        where = path.label
        yield Number(f"95th percentile of round trips, {where}", exactly(p95_ms), "ms", len(far))
        name = f"answers of the local service before the kill, {where}"
        yield Number(name, local, "%", len(asked))
