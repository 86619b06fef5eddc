"""The results of a series: a row for each kind of fault, a row for each fault, and a summary.

Times of overlapping faults belong to none of them, so those of combinations are in the table of all
faults alone; combinations are there for the comparison with the reference run.
"""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec

from holdfast.files import write_atomically
from holdfast.lab.chaos.series import SeriesPlan
from holdfast.lab.chaos.trial import TrialOutcome
from holdfast.lab.testbed.fault_times import FaultTimes, Spread, spread_of
from holdfast.lab.testbed.faults import FaultKind
from holdfast.recording.machine import describe

__all__ = [
    "FAULTS_NAME",
    "SUMMARY_NAME",
    "ChaosSummary",
    "KindRow",
    "kind_rows",
    "summarise",
    "write_tables",
]

FAULTS_NAME = "chaos.csv"
SUMMARY_NAME = "summary.json"

_TRIAL_COLUMNS = ("trial", "trial_kind", "wire", "verdict", "launch", "fault")


class KindRow(msgspec.Struct, frozen=True, kw_only=True):
    """The results of the trials of one kind.

    Attributes
    ----------
    faults : int
        Injected faults.
    unnoticed : int
        Faults after which the robot neither lost nor awaited anything.
    wrong : int
        Trials that are not identical with their reference runs.
    detection, recovery, launch, failback : Spread or None
        None where nothing was measured; always for combinations.
    longest_wait_ms : float or None
        Longest time that a robot stood still for a decision.
    """

    kind: FaultKind
    trials: int
    faults: int
    unnoticed: int
    wrong: int
    detection: Spread | None
    recovery: Spread | None
    launch: Spread | None
    failback: Spread | None
    longest_wait_ms: float | None


class ChaosSummary(msgspec.Struct, frozen=True, kw_only=True):
    """The content of ``summary.json``.

    Attributes
    ----------
    identical, diverged, failed, timed_out : int
        Trials by their verdicts.
    faults, robot_processes : int
        In all of them.
    steps, sensing_actions : int
        Compared with those of the reference runs and found the same.
    left_out : dict of str to str
        Kinds that this machine cannot inject, and why.
    holdfast_version, commit : str
        As they were when the series began.
    trials_took_s : float
        The sum over all trials.
    """

    seed: int
    first: int
    trials: int
    finished: int
    identical: int
    diverged: int
    failed: int
    timed_out: int
    faults: int
    robot_processes: int
    steps: int
    sensing_actions: int
    jobs: int
    kinds: tuple[KindRow, ...]
    wires: dict[str, int]
    left_out: dict[str, str]
    holdfast_version: str
    commit: str
    machine: dict[str, str]
    trials_took_s: float


def kind_rows(outcomes: Sequence[TrialOutcome]) -> tuple[KindRow, ...]:
    """Return a row for each kind that has trials, in the order of the kinds."""
    return tuple(
        _row(kind, of_kind)
        for kind in FaultKind
        if (of_kind := [outcome for outcome in outcomes if outcome.kind is kind])
    )


def _row(kind: FaultKind, outcomes: Sequence[TrialOutcome]) -> KindRow:
    faults = [fault for outcome in outcomes for fault in outcome.faults]
    measured = [] if kind is FaultKind.COMBINATION else faults

    def spread(name: str) -> Spread | None:
        times = [getattr(fault, name) for fault in measured]
        return spread_of([time for time in times if time is not None])

    waits = [fault.longest_wait_ms for fault in faults if fault.longest_wait_ms is not None]
    return KindRow(
        kind=kind,
        trials=len(outcomes),
        faults=len(faults),
        unnoticed=sum(
            fault.detection_ms is None and fault.recovery_ms is None for fault in measured
        ),
        wrong=sum(outcome.verdict != "identical" for outcome in outcomes),
        detection=spread("detection_ms"),
        recovery=spread("recovery_ms"),
        launch=spread("launch_ms"),
        failback=spread("failback_ms"),
        longest_wait_ms=max(waits, default=None),
    )


def summarise(
    plan: SeriesPlan,
    outcomes: Sequence[TrialOutcome],
    *,
    trials: int,
    jobs: int,
    left_out: Mapping[FaultKind, str],
) -> ChaosSummary:
    """Return the summary of a series."""
    verdicts = [outcome.verdict for outcome in outcomes]
    return ChaosSummary(
        seed=plan.seed,
        first=plan.first,
        trials=trials,
        finished=len(outcomes),
        identical=verdicts.count("identical"),
        diverged=verdicts.count("diverged"),
        failed=verdicts.count("failed"),
        timed_out=verdicts.count("timed_out"),
        faults=sum(len(outcome.faults) for outcome in outcomes),
        robot_processes=sum(outcome.robots for outcome in outcomes),
        steps=sum(outcome.steps for outcome in outcomes),
        sensing_actions=sum(outcome.sensing_actions for outcome in outcomes),
        jobs=jobs,
        kinds=kind_rows(outcomes),
        wires=dict(Counter(outcome.wire for outcome in outcomes)),
        left_out={kind.value: reason for kind, reason in left_out.items()},
        holdfast_version=plan.holdfast_version,
        commit=plan.commit,
        machine=describe(),
        trials_took_s=round(sum(outcome.took_s for outcome in outcomes), 1),
    )


def write_tables(directory: Path, summary: ChaosSummary, outcomes: Sequence[TrialOutcome]) -> None:
    """Write ``chaos.csv`` and ``summary.json``.

    Raises
    ------
    OutputError
        If they cannot be written.
    """
    write_atomically(directory / FAULTS_NAME, _fault_table(outcomes))
    text = msgspec.json.format(msgspec.json.encode(summary), indent=2)
    write_atomically(directory / SUMMARY_NAME, text + b"\n")


def _fault_table(outcomes: Sequence[TrialOutcome]) -> str:
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    columns = FaultTimes.__struct_fields__
    writer.writerow((*_TRIAL_COLUMNS, *columns))
    for outcome in sorted(outcomes, key=lambda outcome: outcome.trial):
        head = (
            outcome.trial,
            outcome.kind.value,
            outcome.wire,
            outcome.verdict,
            outcome.launch,
        )
        for number, fault in enumerate(outcome.faults):
            values = (getattr(fault, column) for column in columns)
            writer.writerow(
                (*head, number, *(int(v) if isinstance(v, bool) else v for v in values))
            )
    return text.getvalue()
