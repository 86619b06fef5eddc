"""What a series comes to: its verdict and a row for each kind of fault, as numbers and as text.

Times of overlapping faults belong to none of them, so a combination has none; combinations are
there for the comparison with the reference run.
"""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec

from holdfast.cli.terminal import counted
from holdfast.runtime.files import write_atomically
from holdfast_lab.chaos.trial import TrialOutcome
from holdfast_lab.testbed.fault_times import Spread, spread_of
from holdfast_lab.testbed.faults import FaultKind
from holdfast_lab.testbed.machine import describe

WIDE = 142
"""Characters that the whole table needs; on a narrower terminal a part of it is left out."""

_SUMMARY_NAME = "summary.json"
_TABLE_NAME = "table.txt"
_TIMES = ("detection", "recovery", "launch", "failback")

_N_EXPLAINED = (
    "n: faults after which this was measured. After the others it did not come to it: the robot "
    "did not need what was struck, or its run was over."
)
_DASH_EXPLAINED = (
    "-: never measured. A robot cannot report its own death, and no robot returns to a local "
    "service; times of faults that overlap (combination) belong to none of them."
)


class KindRow(msgspec.Struct, frozen=True, kw_only=True):
    """The results of the trials of one kind."""

    kind: FaultKind
    trials: int
    faults: int  # injected faults
    wrong: int  # trials that are not identical with their reference runs
    # ``detection``, ``recovery``, ``launch`` and ``failback``, where they were measured.
    times: dict[str, Spread]


class ChaosSummary(msgspec.Struct, frozen=True, kw_only=True):
    """The content of ``summary.json``."""

    seed: int
    first: int
    trials: int
    finished: int
    # Trials by their verdicts.
    identical: int
    diverged: int
    failed: int
    timed_out: int
    faults: int  # in all of them
    # Compared with those of the reference runs and found the same.
    steps: int
    sensing_actions: int
    jobs: int
    kinds: tuple[KindRow, ...]
    wires: dict[str, int]
    left_out: dict[str, str]  # kinds that this machine cannot inject, and why
    machine: dict[str, str]


def kind_rows(outcomes: Sequence[TrialOutcome]) -> tuple[KindRow, ...]:
    """Return a row for each kind that has trials, in the order of the kinds."""
    return tuple(
        _row(kind, of_kind)
        for kind in FaultKind
        if (of_kind := [outcome for outcome in outcomes if outcome.kind is kind])
    )


def _row(kind: FaultKind, outcomes: Sequence[TrialOutcome]) -> KindRow:
    faults = [fault for outcome in outcomes for fault in outcome.faults]
    times: dict[str, Spread] = {}
    for name in _TIMES if kind is not FaultKind.COMBINATION else ():
        measured = [getattr(fault, f"{name}_ms") for fault in faults]
        spread = spread_of([time for time in measured if time is not None])
        if spread is not None:
            times[name] = spread
    return KindRow(
        kind=kind,
        trials=len(outcomes),
        faults=len(faults),
        wrong=sum(outcome.verdict != "identical" for outcome in outcomes),
        times=times,
    )


def summarise(
    outcomes: Sequence[TrialOutcome],
    trials: range,
    seed: int,
    jobs: int,
    left_out: Mapping[FaultKind, str],
) -> ChaosSummary:
    """Return the summary of a series."""
    verdicts = [outcome.verdict for outcome in outcomes]
    return ChaosSummary(
        seed=seed,
        first=trials.start,
        trials=len(trials),
        finished=len(outcomes),
        identical=verdicts.count("identical"),
        diverged=verdicts.count("diverged"),
        failed=verdicts.count("failed"),
        timed_out=verdicts.count("timed_out"),
        faults=sum(len(outcome.faults) for outcome in outcomes),
        steps=sum(outcome.steps for outcome in outcomes),
        sensing_actions=sum(outcome.sensing_actions for outcome in outcomes),
        jobs=jobs,
        kinds=kind_rows(outcomes),
        wires=dict(Counter(outcome.wire for outcome in outcomes)),
        left_out={kind.value: reason for kind, reason in left_out.items()},
        machine=describe(),
    )


def write_report(directory: Path, summary: ChaosSummary) -> None:
    """Write ``summary.json`` and ``table.txt``.

    Raises OutputError if they cannot be written.
    """
    text = msgspec.json.format(msgspec.json.encode(summary), indent=2)
    write_atomically(directory / _SUMMARY_NAME, text + b"\n")
    write_atomically(directory / _TABLE_NAME, text_of(summary, WIDE))


def text_of(summary: ChaosSummary, width: int) -> str:
    """Return the table and the verdict, whole or for a narrow terminal."""
    wide = width >= WIDE
    counts = ("trials", "faults", "wrong") if wide else ("trials", "wrong")
    cell = "   n median   p95   max" if wide else "median max"
    above = [f"{name}, ms" if wide else name for name in _TIMES]
    name_width = max(map(len, FaultKind))
    heads = "".join(f" {name}" for name in counts)
    lines = [
        " " * (name_width + len(heads)) + "".join(f" {name:>{len(cell)}}" for name in above),
        f"{'kind of trial':<{name_width}}{heads}" + f" {cell}" * len(above),
    ]
    for row in summary.kinds:
        numbers = "".join(f" {getattr(row, name):>{len(name)}}" for name in counts)
        spreads = (_cell(row.times.get(name), wide=wide) for name in _TIMES)
        cells = "".join(f" {text:>{len(cell)}}" for text in spreads)
        lines.append(f"{row.kind.value:<{name_width}}{numbers}{cells}")
    bad = summary.finished - summary.identical
    if bad:
        verdict = (
            f"{bad} of {counted(summary.finished, 'trial')} went wrong ({summary.diverged} "
            f"diverged, {summary.failed} failed, {summary.timed_out} timed out)"
        )
    else:
        trials = counted(summary.identical, "trial")
        verdict = f"no divergence: {trials} with {counted(summary.faults, 'fault')}"
    wires = ", ".join(f"{wire} ({count})" for wire, count in sorted(summary.wires.items()))
    verdict += (
        f", over {wires or 'no wire'}; {summary.steps:,} task actions and "
        f"{summary.sensing_actions:,} sensing actions are those of the runs without faults"
    )
    explained = [_N_EXPLAINED, _DASH_EXPLAINED] if wide else [_DASH_EXPLAINED]
    units = "" if wide else "Times in milliseconds. "
    lines += ["", *(textwrap.fill(text, width) for text in explained)]
    lines += ["", textwrap.fill(f"{units}{verdict}", width)]
    return "".join(f"{line}\n" for line in lines)


def _cell(spread: Spread | None, *, wide: bool) -> str:
    if spread is None:
        return "-"
    if wide:
        times = f"{spread.median_ms:6.0f} {spread.p95_ms:5.0f} {spread.max_ms:5.0f}"
        return f"{spread.count:4} {times}"
    return f"{spread.median_ms:.0f} {spread.max_ms:3.0f}"
