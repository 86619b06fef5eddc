"""A report to send: what was run and how it went, the worst trials, who decided, how to repeat it.

Whoever gets the file has neither the run nor holdfast. So it has what they would ask for, bounded:
the worst trials alone, of them not every step, of a long time line what stands out.
"""

from __future__ import annotations

import csv
import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from holdfast.config.loader import Configuration
from holdfast.config.source_digest import core_version
from holdfast.config.user_code import describe_problem_error
from holdfast.errors import HoldfastError, OutputError, UntrustedCodeError
from holdfast.journal.fingerprint import read_earlier
from holdfast.journal.journal_reader import JournalReader
from holdfast.journal.run_directory import TIMINGS_NAME, VERIFICATION_NAME, recorded_configuration
from holdfast.journal.timings import TimingRow, count_answers, count_verified
from holdfast.planning.outcome import COUNTS, TrialResult
from holdfast.printable import one_line
from holdfast.reports.facts import EventFact
from holdfast.reports.html_page import HtmlPage, chart_part
from holdfast.reports.outcome_comparison import (
    compare_results,
    estimates_of,
    outcomes_of,
    read_outcomes,
    shown_estimate,
)
from holdfast.reports.replay import RecordedRun
from holdfast.reports.step_times import RunTimes, read_times
from holdfast.reports.trial_chart import MAX_PARTICLES, TrialChart
from holdfast.runtime.events import severity
from holdfast.runtime.files import bounded_lines
from holdfast.runtime.log_lines import fields_as_text

_STEPS = 300
"""Steps of all shown trials together, evenly spread; and as many of sensing actions."""

_TRIALS, _DECISIONS, _EVENTS = 2_000, 2_000, 600
"""Points of the charts: of a longer run every second, every third, ... and what stands out."""

_RESULTS = ("tune.json", "sweep.json", "origin.json")
"""What the directories of a tuning, a sweep and a study have, and a run's has not."""

_SHOWN = ("candidates.csv", "table.csv", "trials.csv")  # as charts, or too long
_ROWS = 30
_MOST = 10**9  # a number of a trial or step; a damaged table may have any

_ZOOM = "Drag to move, Ctrl and the wheel (or a pinch) to zoom, a double click to go back."


def is_run(path: Path) -> bool:
    """Return whether a path is a run's, as far as no tuning, sweep or study is there."""
    return not any((path / name).is_file() for name in _RESULTS)


def worst_trials(results: Iterable[TrialResult], count: int) -> list[TrialResult]:
    """Return the worst trials, the worst first: failed, then truncated, then those of most steps.

    With rewards, trials of one outcome are ordered by these.
    """
    order = ["failed", "truncated", "succeeded"]

    def rank(result: TrialResult) -> tuple[int, float, int]:
        merit = -float(result.steps) if result.reward is None else result.reward
        return order.index(result.outcome), merit, result.trial

    return sorted(results, key=rank)[:count]


def run_page(
    run: Path,
    *,
    worst: int = 3,
    problem_directory: Path | None = None,
    on_trial: Callable[[int], None] = lambda _: None,
) -> tuple[bytes, list[str]]:
    """Return the report of a recorded run, and notes on what it lacks.

    Without ``problem_directory`` no code that the run names is run: the report of a problem of
    one's own then lacks the trials step by step, and says so. Raises OutputError if it is no run,
    is damaged, or its report would be larger than 3 MB. The ``worst`` trials, at most 12, are shown
    step by step; ``on_trial`` gets the number of those that are computed.
    """
    with JournalReader.read_run(run, "report") as journal:
        outcomes = outcomes_of(journal, run.name)
        meta, directory = journal.meta(), journal.path.parent
        unfinished = journal.unfinished()
    results = [outcomes.results[trial] for trial in sorted(outcomes.results)]
    problem = one_line(str(outcomes.world["problem"]))
    wins = sum(result.success for result in results)
    page = HtmlPage(f"{problem}: {wins:,} of {len(results):,} trials succeeded")
    page.paragraph(
        f"Seed {outcomes.seed}, at most {outcomes.step_limit:,} steps a trial. "
        + ("The world was simulated." if outcomes.simulated else "The world was the robot's own.")
    )
    if not outcomes.is_finished:
        begun = "" if unfinished is None else f"; trial {unfinished.trial} was begun"
        page.paragraph(f"The run is not finished{begun}.")
    page.section("Outcome")
    _add_estimates(page, results, outcomes.step_limit)
    sums = {name: sum(getattr(each, name) for each in results) for name in COUNTS}
    page.table([], [(words, f"{sums[name]:,}") for name, words in COUNTS.items() if sums[name]])
    _add_trials(page, results)
    page.section("Who decided")
    times = read_times(directory)
    _add_deciders(page, directory, set(outcomes.results), times)
    page.section("Worst trials")
    notes = _add_worst(page, run, worst_trials(results, worst), problem_directory, on_trial)
    for note in [*notes, *times.notes]:
        page.paragraph(f"Note: {one_line(note)}", muted=True)
    page.section("Settings")
    page.code(meta.get("configuration", ""), summary="All settings, with defaults")
    _add_origin(page, meta, simulated=outcomes.simulated)
    return page.html(), notes


def _add_estimates(page: HtmlPage, results: Sequence[TrialResult], step_limit: int) -> None:
    estimates = map(shown_estimate, estimates_of(results, step_limit=step_limit))
    page.table(["", "value", "95 % interval"], estimates)


def _add_trials(page: HtmlPage, results: Sequence[TrialResult]) -> None:
    every = -(-len(results) // _TRIALS) or 1
    values = [
        {
            "trial": each.trial,
            "steps": each.steps,
            "outcome": each.outcome,
            "reward": each.reward,
            "sensing": each.sensing_decisions,
        }
        for number, each in enumerate(results)
        if number % every == 0 or each.failed
    ][: 2 * _TRIALS]
    if values:
        page.chart(chart_part("trials", values=values))
    if every > 1:
        page.paragraph(f"One trial of {every} is shown, and those that failed.", muted=True)


def _add_deciders(page: HtmlPage, directory: Path, trials: set[int], times: RunTimes) -> None:
    answers = count_answers(directory / TIMINGS_NAME, trials)
    verified = count_verified(directory / VERIFICATION_NAME)
    if answers is None:
        page.paragraph("The robot's own planner, in the process of the run; no services.")
    else:
        by_task = answers.task_answers_by_service
        services = dict.fromkeys([*answers.sensing_decisions_by_service, *by_task])
        rows = [
            (name, answers.sensing_decisions_by_service.get(name, 0), by_task.get(name, 0))
            for name in services
        ]
        page.table(["service", "sensing actions", "answers with task actions"], rows)
    if verified is not None:
        wrong = ", ".join(f"{name}: {count}" for name, count in verified.wrong_answers.items())
        page.paragraph(
            f"{verified.verified_answers:,} answers were computed again; wrong: {wrong or 'none'}."
        )
    decisions = [row for each in times.rows.values() for row in each.values()]
    if decisions or times.events:
        _add_timeline(page, decisions, times.events)


def _add_timeline(
    page: HtmlPage, decisions: Sequence[TimingRow], events: Sequence[EventFact]
) -> None:
    """Add waits and events over time, and a table of the longest waits."""
    longest = sorted(decisions, key=lambda row: -row.timing.waited_ms)[: _DECISIONS // 4]
    shown = {id(row): row for row in [*longest, *_thinned(decisions, _DECISIONS)]}
    happened = [each for each in events if each.name != "trial"]
    bad = [each for each in happened if severity(each.name, each.fields) != "INFO"]
    chosen = [*_thinned(bad, _EVENTS // 2), *_thinned(happened, _EVENTS // 2)]
    moments = [row.time_ns for row in decisions] + [each.time_ns for each in happened]
    first = min(moments, default=0)

    def seconds(time_ns: int) -> float:
        return round(1e-9 * (time_ns - first), 3)

    points = [
        {
            "t": seconds(time_ns),
            "waited": round(each.waited_ms, 3),
            "service": one_line(each.service)[:40],
            "status": one_line(each.status)[:40],
            "trial": min(each.trial, _MOST),
            "step": min(each.step, _MOST),
            "kind": one_line(each.kind)[:40],
        }
        for each, time_ns, _ in shown.values()
    ]
    ticks = [
        {
            "t": seconds(each.time_ns),
            "event": one_line(each.name)[:40],
            "severity": severity(each.name, each.fields),
            "text": one_line(fields_as_text(each.fields))[:160],
        }
        for each in {id(each): each for each in chosen}.values()
    ]
    names = len({each["event"] for each in ticks})
    end = max(seconds(max(moments, default=0)), 1e-3)
    height = max(30, 17 * names)
    page.heading("Decisions, pauses, faults")
    page.chart(chart_part("timeline", decisions=points, events=ticks, end=end, height=height))
    left_out = len(decisions) - len(points), len(happened) - len(ticks)
    text = _ZOOM
    if any(left_out):
        text += f" Left out: {left_out[0]:,} decisions of short waits, {left_out[1]:,} events."
    page.paragraph(text, muted=True)
    page.heading("Longest pauses")
    head = ["waited (ms)", "time (s)", "trial", "step", "kind", "decided by", "status"]
    page.table(
        head,
        [
            (f"{each.waited_ms:.1f}", seconds(time_ns), *each[:5])
            for each, time_ns, _ in longest[:8]
            if each.waited_ms > 0.0
        ],
    )


def _add_worst(
    page: HtmlPage,
    run: Path,
    worst: Sequence[TrialResult],
    problem_directory: Path | None,
    on_trial: Callable[[int], None],
) -> list[str]:
    """Add the worst trials step by step; return notes on those that cannot be."""
    if not worst:
        page.paragraph("No trial is shown step by step.")
        return []
    notes = []
    try:
        with RecordedRun(run, "report", problem_directory=problem_directory) as recorded:
            for number, result in enumerate(worst, start=1):
                page.heading(f"Trial {result.trial} {result.in_words()}")
                most = max(20, _STEPS // len(worst))
                settings, why = recorded.configuration, ""
                try:
                    chart = TrialChart(settings, result, most)
                    list(recorded.replay([result.trial], [chart]))
                except HoldfastError as error:
                    why = str(error)
                except Exception as error:  # noqa: BLE001 - of the problem's own code
                    why = describe_problem_error(settings.problem_name, error)
                else:
                    _add_trial(page, chart, settings)
                if why:
                    notes.append(why)
                    page.paragraph("It cannot be shown step by step: see the note below.")
                on_trial(number)
    except UntrustedCodeError as error:
        notes.append(str(error))
        page.table(
            ["trial", "outcome", "steps", "reward"],
            [(each.trial, each.outcome, each.steps, each.reward) for each in worst],
        )
    return notes


def _add_trial(page: HtmlPage, chart: TrialChart, configuration: Configuration) -> None:
    page.chart(chart.chart())
    particles = configuration.planning.particle_filter.num_particles
    thinned = f" {MAX_PARTICLES} of {particles:,} particles." if particles > MAX_PARTICLES else ""
    steps = " Not every step is shown." if chart.left_out else ""
    page.paragraph(
        "Black: the true state; blue: the estimate, with two standard deviations. "
        f"{_ZOOM}{thinned}{steps}",
        muted=True,
    )


def _add_origin(page: HtmlPage, meta: Mapping[str, str], *, simulated: bool) -> None:
    page.section("Machine and versions")
    made = meta.get("holdfast_core") or meta.get("holdfast_version") or "of an unknown version"
    rows = [("run by holdfast", made), ("run on", meta.get("machine", "not recorded"))]
    if "wall_time_s" in meta:
        rows.append(("computing time (s)", one_line(meta["wall_time_s"])[:8]))
    rows += [("before", each.in_words()) for each in read_earlier(meta.get("earlier_code"))]
    rows.append(("report by holdfast", f"{core_version()}, Python {platform.python_version()}"))
    page.table([], rows)
    page.section("Repeat it")
    modules, options = _elsewhere(meta.get("configuration", ""))
    beside = f", and beside it {' and '.join(modules)}" if modules else ""
    page.paragraph(
        f"With that version of holdfast, save the settings as config.yaml{beside}; then:"
    )
    page.code(f"holdfast run config.yaml{options} --out again\nholdfast compare RUN again")
    page.paragraph("The decisions are the same, bit for bit, where compare says so.")
    if not simulated:
        page.paragraph("This acts in the robot's own world again, which may show other things.")


def _elsewhere(configuration: str) -> tuple[list[str], str]:
    """Return the modules that a run needs on another machine, and the options that it needs there.

    Its modules lie elsewhere there, and its services are not there; the robot decides the same.
    """
    told = recorded_configuration(configuration)
    acting = (told.get("environment") or {}).get("object")
    named = {" --problem-directory .": told["problem"], " --set environment.directory=.": acting}
    own = {option: name for option, name in named.items() if ":" in str(name)}
    modules = {f"the module {one_line(name.partition(':')[0]):.100}" for name in own.values()}
    has_services = (told.get("offload") or {}).get("services")
    return sorted(modules), "".join([*own, " --set 'offload.services=[]'" * bool(has_services)])


def comparison_page(runs: Sequence[Path]) -> tuple[bytes, list[str]]:
    """Return the report of several runs, compared with the first; notes as of :func:`run_page`."""
    outcomes = [read_outcomes(run, str(run)) for run in runs]
    found = compare_results(outcomes, strict=True)
    page = HtmlPage(f"{len(runs)} runs, compared with {found.baseline}")
    page.section("Comparison")
    page.table(found.shown()[0], found.shown()[1:])
    for line in found.legend().splitlines():
        page.paragraph(line, muted=True)
    _add_effects(page, found.columns(), found.rows())
    for run in outcomes:
        page.section(run.name)
        results = list(run.results.values())
        _add_estimates(page, results, run.step_limit)
        _add_trials(page, results)
    return page.html(), []


def results_page(directory: Path) -> tuple[bytes, list[str]]:
    """Return the report of a tuning, a sweep or a study: of what is in its directory.

    Its texts and tables (Markdown, CSV), figures (SVG), and settings. Raises OutputError if there
    is nothing of these in it.
    """
    page = HtmlPage(f"Results in {directory.absolute().name}")
    found = {path.name: path for path in sorted(directory.glob("*")) if path.is_file()}
    for name in ("tune.md", "table.md"):
        if name in found:
            page.section("Finding")
            page.markdown(_text_of(found.pop(name)))
    for name in ("candidates.csv", "table.csv"):
        if name in found:
            columns, *rows = _rows_of(found[name])
            _add_effects(page, columns, rows)
    for name in [each for each in found if each.endswith(".svg")]:
        page.section(name.removesuffix(".svg").replace("_", " "))
        page.picture(found[name].read_bytes(), name)
    for name in [each for each in found if each.endswith(".csv") and each not in _SHOWN]:
        page.section(name)
        columns, *rows = _rows_of(found[name])
        page.table(columns, [list(map(_readable, row)) for row in rows], _ROWS)
    for name in [each for each in ("tuned.yaml", *_RESULTS) if each in found]:
        page.section("Machine and versions" if name == "origin.json" else name)
        page.code(_text_of(found[name]), summary="All settings" if name == "tune.json" else "")
    if not page.sections:
        raise OutputError(f"{directory}: has neither a run nor results of tune, sweep or a study")
    return page.html(), []


def _add_effects(page: HtmlPage, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Add a chart for each measure of a comparison, or one for the candidates of a race."""
    panels: dict[str, list[dict[str, object]]] = {}
    for row in (dict(zip(columns, each, strict=False)) for each in rows):
        low, high = _number(row.get("low")), _number(row.get("high"))
        if low is None or high is None:
            continue
        what = (
            f"{row.get('kind')} of {row['measure']}" if "measure" in row else "difference of cost"
        )
        panels.setdefault(what, []).append(
            {
                "name": one_line(str(row.get("run", row.get("candidate"))))[:60],
                "effect": _number(row.get("effect", row.get("difference"))),
                "low": low,
                "high": high,
                "finding": one_line(str(row.get("verdict", row.get("state"))))[:60],
            }
        )
    for what, values in panels.items():
        height = 26 * len(values) + 10
        none = 1.0 if what.startswith("ratio") else 0.0
        title = f"{what.replace('_', ' ')} to the baseline, 95 % intervals"
        letters = max(len(str(each["name"])) for each in values)
        looks = {"height": height, "none": none, "letters": letters}
        page.chart(chart_part("effects", values=values, title=title, axis=what, **looks))


def _number(value: object) -> float | None:
    try:
        return float(str(value))
    except ValueError:
        return None


def _readable(cell: str) -> str:
    number = _number(cell) if "." in cell else None
    return cell if number is None else f"{number:.4g}"


def _thinned(items: Sequence[Any], most: int) -> Sequence[Any]:
    return items[:: -(-len(items) // most) or 1]


def _text_of(path: Path) -> str:
    return "".join(bounded_lines(path))


def _rows_of(path: Path) -> list[list[str]]:
    try:
        return list(csv.reader(bounded_lines(path))) or [[]]
    except (OSError, csv.Error) as error:
        raise OutputError(f"{path}: cannot be read: {error}") from error
