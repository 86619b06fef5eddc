"""What a tuning leaves in its directory: the configuration, tables and a figure.

``tuned.yaml`` is the user's configuration with the keys that changed, ``tune.md`` says why,
``candidates.csv`` has the race, ``tune.png`` shows both.
"""

from __future__ import annotations

import contextlib
import functools
import io
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from holdfast.config.loader import Configuration
from holdfast.config.source import SECTIONS, SETTINGS
from holdfast.config.yaml_document import write
from holdfast.reports.table_formats import Table
from holdfast.runtime.files import write_atomically
from holdfast.tuning.candidates import Objective
from holdfast.tuning.verdict import FAMILY_LEVEL, Comparison

CONFIGURATION_NAME = "tuned.yaml"


class CandidateRow(msgspec.Struct, frozen=True, kw_only=True):
    """What the race has found of a candidate.

    Its ``difference`` to the configuration's cost, over the trials of both, is what the choice
    rests on, so the best of many looks too good.
    """

    candidate: str
    changes: dict[str, Any]  # values that differ from the configuration's, by section.key
    trials: int  # in the race; of fewer trials than others' they are the first
    cost: float | None = None  # mean steps, rate of no success, or negative reward
    difference: float | None = None
    interval: tuple[float, float] | None = None
    success: float | None = None
    decision_ms: float | None = None  # median time to choose a sensing action
    trial_s: float = 0.0  # seconds of a processor that a trial takes
    state: str  # how it left the race, and why


class Tuning(Table, msgspec.Struct, frozen=True, kw_only=True):
    """What a tuning has found; as a table, a row for each candidate of the race."""

    sentence: str  # what to do, and how sure that is
    choice: str  # the candidate to take
    changes: dict[str, Any]  # in what it differs from the configuration, by section.key
    matters: bool  # whether any two of those judged differed beyond noise
    objective: Objective
    fresh_trials: int  # that had no part in the race
    comparisons: tuple[Comparison, ...]  # of the choice with each other one, on the fresh trials
    candidates: tuple[CandidateRow, ...]  # as the race ended, the winner first

    def columns(self) -> Sequence[str]:
        """Return the names of the columns, for programs."""
        return [*(name for name in _COLUMNS if name != "interval"), "low", "high"]

    def rows(self) -> list[tuple[object, ...]]:
        """Return a row for each candidate."""
        rows: list[tuple[object, ...]] = []
        for each in self.candidates:
            values = [getattr(each, name) for name in self.columns()[:-2]]
            values[1] = msgspec.json.encode(each.changes).decode()
            rows.append((*values, *(each.interval or (None, None))))
        return rows

    def shown(self) -> list[tuple[str, ...]]:
        """Return a row for each candidate, for people."""
        head = ("race", "trials", self.objective, "to as configured", "95 % interval")
        more = ("success (%)", "decision (ms)", "trial (s)", "state")
        return [(*head, *more), *(_raced(each, self.objective) for each in self.candidates)]

    def legend(self) -> str:
        """Return how to read the table."""
        return (
            "The race, from which the winner was chosen, so that its own numbers look too good. A "
            "difference is over the trials of both; what is slow has had fewer. candidates.csv has "
            "reasons whole. Steps are arithmetic means; a trial that did not reach the goal counts "
            "as its limit, simulator.max_steps."
        )


_COLUMNS = CandidateRow.__struct_fields__


def _in_its_unit(objective: Objective, *costs: float) -> list[float]:
    """Return steps, success or reward of costs, in ascending order."""
    return sorted(costs if objective == "steps" else (0.0 - cost for cost in costs))


def _raced(each: CandidateRow, objective: Objective) -> tuple[str, ...]:
    state = textwrap.shorten(each.state, 60, placeholder=" ...")
    if each.cost is None or each.difference is None or each.interval is None:
        return (each.candidate, str(each.trials), *6 * ("",), state)
    value, difference = (_in_its_unit(objective, cost)[0] for cost in (each.cost, each.difference))
    low, high = _in_its_unit(objective, *each.interval)
    return (
        each.candidate,
        str(each.trials),
        f"{value:.4g}",
        f"{difference:+.3g}",
        f"[{low:+.3g}, {high:+.3g}]",
        f"{100.0 * (each.success or 0.0):.3g}",
        f"{each.decision_ms or 0.0:.3g}",
        f"{each.trial_s:.3g}",
        state,
    )


def write_report(out: Path, configuration: Configuration, found: Tuning) -> None:
    """Write all files; the figure only if matplotlib is installed."""
    write_atomically(out / CONFIGURATION_NAME, tuned_yaml(configuration, found).encode())
    write_atomically(out / "tune.md", tuning_tables(found).encode())
    found.to_csv(out / "candidates.csv")
    with contextlib.suppress(ImportError):
        write_atomically(out / "tune.png", tuning_figure(found))


def tuned_yaml(configuration: Configuration, found: Tuning) -> str:
    """Return what was tuned, as a file, with the keys that changed, and what they were.

    It has the keys that were given, and what is not by default; its paths are absolute.
    """
    resolved = configuration.plain()["configuration"]
    data = {key: resolved[key] for key in ("problem", "problem_directory") if key in resolved}
    for section in SECTIONS:
        now, given = resolved[section], configuration.given.get(section, ())
        plain = msgspec.to_builtins(SETTINGS[section]()) if section in SETTINGS else now
        kept = {key: now[key] for key in now if key in given or now[key] != plain[key]}
        data |= {section: kept} if kept else {}
    head = [f"# {line}\n" for line in ("By holdfast tune.", " ".join(found.sentence.split()))]
    for key, value in found.changes.items():
        section, _, name = key.partition(".")
        before = msgspec.json.encode(resolved[section][name]).decode()
        head.append(f"# {key} was {before}.\n")
        data[section] = {**data.get(section, {}), name: value}
    return "".join(head) + write(data)


# -- tables ----------------------------------------------------------------------------------------


class _Judged(Table, msgspec.Struct, frozen=True):
    """The comparisons on fresh trials."""

    found: Tuning

    def shown(self) -> list[tuple[str, ...]]:
        """Return a row for each measure of each rival."""
        names = ("measure", self.found.choice, "against", "its value", "difference")
        return [(*names, "interval", "finding"), *map(self._cells, self.found.comparisons)]

    @staticmethod
    def _cells(each: Comparison) -> tuple[str, ...]:
        scale, unit = (100.0, " (%)") if each.measure == "success" else (1.0, "")
        low, high = (scale * end for end in each.interval)
        return (
            f"{each.measure}{unit}",
            f"{scale * each.value:.4g}",
            each.against,
            f"{scale * each.other:.4g}",
            f"{scale * each.difference:+.3g}",
            f"[{low:+.3g}, {high:+.3g}]",
            {1: "better", 0: "within noise", -1: "worse"}[each.finding],
        )


def tuning_tables(found: Tuning) -> str:
    """Return the finding and its two tables as Markdown."""
    judged = ""
    if found.comparisons:
        judged = (
            f"Judged on {found.fresh_trials:,} fresh trials in the same worlds. The intervals of "
            f"{found.objective} hold together at {FAMILY_LEVEL:.0%}.\n\n"
            f"{_Judged(found).to_markdown()}\n"
        )
    return f"{found.sentence}\n\n{judged}{found.to_markdown()}"


# -- figure ----------------------------------------------------------------------------------------


def tuning_figure(found: Tuning) -> bytes:
    """Return a picture (PNG) of the differences to the configuration, and of those judged."""
    import matplotlib as mpl  # slow, and perhaps not there
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from holdfast.reports.figure import STYLE

    in_unit = functools.partial(_in_its_unit, found.objective)
    raced: list[tuple[Any, ...]] = [
        (each.candidate, *in_unit(each.difference or 0.0), in_unit(*each.interval))
        for each in found.candidates
        if each.interval is not None
    ]
    decisive = [each for each in found.comparisons if each.measure == found.objective]
    judged = [(each.against, each.difference, each.interval) for each in decisive]
    side = "left" if found.objective == "steps" else "right"
    titles = (
        f"{found.choice}, on {found.fresh_trials} fresh trials: {found.objective} less that of "
        f"({side} is better)",
        f"the race: {found.objective} less that of the configuration",
    )
    with mpl.rc_context(STYLE):
        height = 1.6 + 0.24 * (len(raced) + len(judged))
        figure = Figure(figsize=(8.0, height), layout="constrained")
        FigureCanvasAgg(figure)
        ratios = (len(judged) + 0.5, len(raced) + 0.5)
        panels = figure.subplots(2, 1, height_ratios=ratios)
        for panel, title, points in zip(panels, titles, (judged[::-1], raced[::-1]), strict=True):
            panel.set_title(title, loc="left")
            panel.axvline(0.0, color="#8A9099", linewidth=0.8)
            for place, (_, middle, ends) in enumerate(points):
                panel.plot(ends, (place, place), color="#2F6DB3", linewidth=1.6)
                panel.plot(middle, place, "o", color="#111111", markersize=4.0)
            panel.set_yticks(range(len(points)), [name for name, *_ in points])
            panel.set_ylim(-0.6, len(points) - 0.4)
            panel.grid(visible=True, axis="x")
        picture = io.BytesIO()
        figure.savefig(picture, format="png", dpi=150)
    return picture.getvalue()
