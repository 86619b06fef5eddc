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

from holdfast.experiments.cloud_trials import CloudTrials
from holdfast.experiments.medians import median_interval
from holdfast.experiments.statistics import Interval, cells_of
from holdfast.experiments.study import Report, Results, Scale
from holdfast.experiments.tables import Cell, Table
from holdfast.experiments.tasks import Task
from holdfast.experiments.thesis_measurements import (
    FAR,
    NEAR,
    PARTICLES,
    PATHS,
    THESIS_CLOUD_ROUND_TRIP_MS,
    THESIS_FAILBACK_MS,
    THESIS_LAUNCH_MS,
    THESIS_LOCAL_ROUND_TRIP_MS,
    THESIS_SUCCESS,
    THESIS_SUCCESS_ABOVE_300,
    THESIS_TIMEOUT_MS,
    THESIS_TRIALS,
    BoolArray,
    FloatArray,
    MeasuredRows,
    NetworkPath,
)
from holdfast.experiments.trial_batches import TrialSeries, trial_tasks
from holdfast.recording.tables import wilson_interval
from holdfast.settings import (
    ActiveSensingSettings,
    ParticleFilterSettings,
    PlanningSettings,
    SelectorSettings,
)

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
        report = Report()
        rows = Table({})
        for number, each in enumerate(_conditions(scale)):
            rows.extend(
                results.of(_cloud_tasks(each, scale)),
                condition=number,
                particles=each.particles,
                transport=each.path.transport,
                path_round_trip_ms=each.path.round_trip_ms,
                loss=each.path.loss,
            )
        trials = Table({})
        for count in PARTICLES:
            trials.extend(results.of(_trial_tasks(count, scale)), particles=count)
        measured = MeasuredRows(rows)
        successes = _successes(trials)
        picture = results.of([_picture_task(scale)])
        report.summary["decisions"] = _decisions(measured)
        report.summary["faults"] = _faults(measured)
        report.summary["successes"] = successes
        report.raw["cloud"] = rows
        report.raw["in_process"] = trials
        report.raw["cloud_dies"] = picture
        for name, drawing in _DRAWINGS.items():
            report.figures[name] = partial(_draw, drawing, measured, successes, picture)
        report.findings = _findings(measured, successes, picture)
        return report


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


def _draw(drawing: str, measured: MeasuredRows, successes: Table, picture: Table) -> Figure:
    # Matplotlib is imported there, so only when a figure is wanted.
    from holdfast.experiments import thesis_figures

    if drawing == "successes":
        return thesis_figures.successes(successes)
    if drawing == "cloud_dies":
        return thesis_figures.cloud_dies(picture)
    draw: Callable[[MeasuredRows], Figure] = getattr(thesis_figures, drawing)
    return draw(measured)


# -- what comes of it ------------------------------------------------------------------------------


def _decisions(rows: MeasuredRows) -> Table:
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
    return Table.of_records(cells)


def _faults(rows: MeasuredRows) -> Table:
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
                    "runs_as_their_twins": len(runs) - len(_diverged(rows, here)),
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
    return Table.of_records(cells)


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


def _successes(trials: Table) -> Table:
    particles, success = trials.numbers("particles"), trials.numbers("success")
    cells: list[dict[str, Cell]] = []
    for count in PARTICLES:
        here = success[particles == count]
        for part in (here[:THESIS_TRIALS], here):
            found = int(part.sum())
            low, high = wilson_interval(found, part.size)
            cells.append(
                {
                    "particles": count,
                    "trials": int(part.size),
                    "successes": found,
                    "success": found / part.size,
                    "success_low": low,
                    "success_high": high,
                    "success_thesis": _success_of_thesis(count),
                }
            )
    return Table.of_records(cells)


def _success_of_thesis(particles: int) -> float:
    return THESIS_SUCCESS_ABOVE_300 if particles > 300 else THESIS_SUCCESS


# -- sentences -------------------------------------------------------------------------------------


def _findings(rows: MeasuredRows, successes: Table, picture: Table) -> list[str]:
    findings = [_finding_of_twins(rows, picture), *_findings_of_successes(successes)]
    findings += _findings_of_times(rows)
    findings.append(_finding_of_waiting(rows))
    findings += _findings_of_faults(rows)
    findings += _findings_of_loss(rows)
    findings += [_finding_of_emulation(rows), _finding_of_load(rows)]
    return findings


def _finding_of_twins(rows: MeasuredRows, picture: Table) -> str:
    everywhere = rows.where()
    runs = len(set(rows.runs.tolist())) + 1
    diverged = len(_diverged(rows, everywhere)) + int(not all(picture.columns["identical"]))
    kills = int(rows.where(what="kill").sum()) + picture.columns["what"].count("kill")
    sensing = int(rows.where(what="sensing").sum()) + picture.columns["what"].count("sensing")
    _, high = wilson_interval(diverged, runs)
    return (
        f"{runs - diverged} of {runs} disturbed runs decided and acted as their undisturbed twins, "
        f"bit for bit: {kills} kills of the cloud, {sensing:,} sensing decisions (95 % interval of "
        f"the share of runs that do not: up to {100.0 * high:.1f} %, Wilson)"
    )


def _findings_of_successes(successes: Table) -> list[str]:
    def told(few: bool) -> str:
        return "; ".join(
            f"{row['particles']} particles {row['successes']} of {row['trials']}"
            + (
                ""
                if few
                else f" [{100.0 * float(row['success_low'] or 0.0):.1f}, "
                f"{100.0 * float(row['success_high'] or 0.0):.1f}] %"
            )
            for number, row in enumerate(successes.rows())
            if (number % 2 == 0) is few
        )

    return [
        f"successes in ten trials, as many as the thesis has: {told(few=True)} (the thesis: 8 of "
        "10, above 300 particles 9 of 10)",
        f"successes in more trials, with 95 % intervals (Wilson): {told(few=False)}",
    ]


def _told(interval: Interval) -> str:
    value = f"{_number(interval.value)} ms"
    if math.isfinite(interval.low):
        return f"{value} [{_number(interval.low)}, {_number(interval.high)}]"
    return f"{value} [too few for an interval]"


def _number(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}"


def _findings_of_times(rows: MeasuredRows) -> list[str]:
    findings = []
    for service in ("cloud", "local"):
        times = []
        for count in (PARTICLES[0], PARTICLES[-1]):
            here = rows.where(what="sensing", service=service, particles=count)
            if here.any():
                times.append(
                    f"{count} particles {_told(rows.median(rows.number('computed_ms'), here))}, "
                    f"n = {int(here.sum())}"
                )
        findings.append(
            f"choosing a sensing action, computing in the {service} service (median, 95 % interval "
            f"by the bootstrap over runs): {'; '.join(times)}"
        )
    trips = []
    local = rows.where(service="local", what="task")
    if local.any():
        trips.append(
            f"local {_told(rows.median(rows.round_trips, local))}, n = {int(local.sum())} (the "
            f"thesis: under {THESIS_LOCAL_ROUND_TRIP_MS:g} ms)"
        )
    for path in rows.paths:
        here = rows.where(path=path, service="cloud", what="task")
        if path.loss == 0.0 and here.any():
            trips.append(
                f"cloud over {path.label} {_told(rows.median(rows.round_trips, here))}, "
                f"n = {int(here.sum())}"
            )
    findings.append(
        "round trip with the computation taken out (median, 95 % interval by the bootstrap over "
        f"runs; all numbers of particles): {'; '.join(trips)} (the thesis: at least "
        f"{THESIS_CLOUD_ROUND_TRIP_MS:g} ms to its cloud)"
    )
    return findings


def _finding_of_waiting(rows: MeasuredRows) -> str:
    waits = []
    for service, path in (("cloud", FAR), ("local", None)):
        chosen = rows.where(service=service)
        if path is not None:
            chosen &= rows.where(path=path)
        sensing, task = (chosen & rows.where(what=what) for what in ("sensing", "task"))
        if sensing.any() and task.any():
            waited = rows.number("waited_ms")
            name = service if path is None else f"{service} over {path.label}"
            waits.append(
                f"{name} {_told(rows.median(waited, sensing))} for what to sense, "
                f"{_told(rows.median(waited, task))} for what to do until then, "
                f"n = {int(sensing.sum())} turns"
            )
    return (
        "how long the robot stood still, because sensing actions are computed while it moves "
        f"(median, 95 % interval by the bootstrap over runs): {'; '.join(waits)}"
    )


def _findings_of_faults(rows: MeasuredRows) -> list[str]:
    kills = rows.where(what="kill")
    cold = kills & ~np.isnan(rows.number("launch_ms"))
    found = [
        f"{path.label} {_told(median_interval(rows.number('found_ms')[chosen]))}, "
        f"n = {int(chosen.sum())}"
        for path in rows.paths
        if path.loss == 0.0 and (chosen := kills & rows.where(path=path)).any()
    ]
    findings = [
        "from the kill until the robot has found the cloud dead (median, 95 % interval of order "
        f"statistics): {'; '.join(found)} (the thesis: a timeout of {THESIS_TIMEOUT_MS:g} ms)"
    ]
    first_local_ms = rows.number("first_local_ms")[cold]
    if np.isfinite(first_local_ms).any():
        findings.append(
            "from the cloud found dead until the first decision of a local service that had to be "
            f"launched (all paths): median {_told(median_interval(_known(first_local_ms)))} (95 % "
            f"interval of order statistics); {_share_below(THESIS_LAUNCH_MS, first_local_ms)}"
        )
    failbacks = [
        f"{path.label} {_told(median_interval(_known(times)))}, "
        f"{_share_below(THESIS_FAILBACK_MS, times)}"
        for path in rows.paths
        if path.loss == 0.0
        for times in [rows.number("failback_ms")[kills & rows.where(path=path)]]
        if np.isfinite(times).any()
    ]
    if failbacks:
        findings.append(
            "from the ready line of the cloud that was started again until its first decision "
            f"(median, 95 % interval of order statistics): {'; '.join(failbacks)}"
        )
    return findings


def _known(times: FloatArray) -> FloatArray:
    return times[~np.isnan(times)]


def _share_below(limit_ms: float, times: FloatArray) -> str:
    """Say how many are below; those are not of which it is not known, because a run had ended."""
    below = int(np.count_nonzero(times < limit_ms))
    low, high = wilson_interval(below, times.size)
    ended = int(np.count_nonzero(np.isnan(times)))
    return (
        f"under the thesis's {limit_ms:g} ms in {below} of {times.size} ({100.0 * low:.0f} to "
        f"{100.0 * high:.0f} %, Wilson)" + (f", and {ended} ended before" if ended else "")
    )


def _findings_of_loss(rows: MeasuredRows) -> list[str]:
    kills = rows.where(what="kill")
    killed_s = dict(zip(rows.runs[kills], rows.number("at_s")[kills], strict=True))
    before = rows.number("at_s") < np.array([killed_s.get(run, math.inf) for run in rows.runs])
    shares = []
    for path in rows.paths:
        if path.loss == 0.0:
            continue
        cloud = rows.where(path=path, service="cloud", what="task")
        p95_ms = _percentile(rows.round_trips[cloud], 95.0)
        asked = rows.where(path=path, what="task") & before
        local = int((asked & rows.where(service="local")).sum())
        if p95_ms is not None:
            shares.append(
                f"{path.label} {_number(p95_ms)} ms, n = {int(cloud.sum())}; before its kill "
                f"{local} of {int(asked.sum())} answers came from the local service"
            )
    if not shares:
        return []
    return [
        "with packets lost, 95 % of the round trips to the cloud (without computation) are below: "
        + "; ".join(shares)
    ]


_EMULATIONS = {
    "nothing": "not at all (same machine)",
    "packets": (
        "as packets between two networks on one machine, each delayed by half the round trip and "
        "dropped at random each way (independently, in order, without jitter or a limit on "
        "bandwidth), with the system's own TCP and UDP at both ends"
    ),
    "tcp proxy": (
        "by a proxy where TCP ends; a lost packet is a piece that comes later by 200 ms, because a "
        "proxy cannot drop TCP's packets"
    ),
    "datagram proxy": "by a proxy that delays and drops UDP's datagrams",
}


def _finding_of_emulation(rows: MeasuredRows) -> str:
    ways = []
    for way, words in _EMULATIONS.items():
        here = rows.where(emulated_by=way)
        if here.any():
            labels = [path.label for path in rows.paths if (here & rows.where(path=path)).any()]
            ways.append(f"{words}: {len(labels)} of {len(rows.paths)} paths")
    return f"how the path was emulated: {'; '.join(ways)}"


def _finding_of_load(rows: MeasuredRows) -> str:
    _, first = np.unique(rows.runs, return_index=True)
    loads = rows.number("load")[first]
    return (
        "processes that wanted a core when a run began, over the minute before: median "
        f"{np.nanmedian(loads):.1f}, from {np.nanmin(loads):.1f} to {np.nanmax(loads):.1f}, "
        f"n = {loads.size} (our own processes, from the run before, are among them; with many more "
        "than there are cores, times are those of a busy machine); the robots ran at "
        f"{_rates(rows.number('rate_hz')[first])}"
    )


def _rates(rates_hz: FloatArray) -> str:
    """Say how fast the robots ran: where services start slowly they are slowed."""
    slowed = int(np.count_nonzero(rates_hz < _RATE_HZ))
    if not slowed:
        return f"{_RATE_HZ:g} Hz"
    return f"{_RATE_HZ:g} Hz, but {slowed} of {rates_hz.size} slower, down to {rates_hz.min():.0f}"
