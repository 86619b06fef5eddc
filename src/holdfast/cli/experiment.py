"""``holdfast experiment``: the tables and figures behind what the project claims."""

from __future__ import annotations

import contextlib
import shlex
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from holdfast.cli.endings import RunError, ended_by_signals, signal_of
from holdfast.cli.options import MAX_SEED, location, whole_number
from holdfast.errors import HoldfastError, InvalidValueError
from holdfast.runtime.command_line import MAX_JOBS

if TYPE_CHECKING:
    from holdfast.experiments.executors import Executor
    from holdfast.experiments.running import Workload
    from holdfast.experiments.study import Report, Scale, Study

__all__ = ["experiment"]

_DEFAULT_DIRECTORY = Path("runs") / "experiments"

_MOST_FINDINGS = 20
"""Sentences of a study that are printed; all of them are kept."""

_NOTE = "all kept"
"""What is to be said of the trials that are finished."""


def experiment(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="NAME...", show_default=False, help="Which, or all; see --list."),
    ] = None,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick", help="Few trials: minutes, to see that everything works. No evidence."
        ),
    ] = False,
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            metavar="DIR",
            parser=location("--out"),
            help="Directory for the results.",
        ),
    ] = _DEFAULT_DIRECTORY,
    seed: Annotated[
        int,
        typer.Option(
            "--seed",
            metavar="S",
            parser=whole_number("--seed", 0, MAX_SEED),
            help="Seed of all trials. Where something is chosen (selectors, parameters), by these; "
            "those by which it is judged have the next seed.",
        ),
    ] = 2017,
    jobs: Annotated[
        int,
        typer.Option(
            "--jobs",
            "-j",
            metavar="N",
            parser=whole_number("--jobs", 0, MAX_JOBS),
            help="Processes; 0: one for each core. Changes time only.",
        ),
    ] = 0,
    place: Annotated[
        str,
        typer.Option(
            "--executor",
            metavar="local|ray[://HOST:PORT]",
            help="Where: in processes of this machine, or on a Ray cluster (extra cluster): the "
            "one that runs on this machine, or the one whose client server listens at HOST:PORT. "
            "Every node needs the same holdfast. What measures times stays here. "
            "Changes time only.",
        ),
    ] = "local",
    source: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="FILE",
            parser=location("--from"),
            show_default=False,
            help="Run nothing: make the tables and figures of selectors or parameters anew from "
            "their trials in FILE (trials.parquet).",
        ),
    ] = None,
    list_names: Annotated[
        bool, typer.Option("--list", help="List the experiments and end.")
    ] = False,
) -> None:
    """Regenerate tables and figures: run what is not known yet, and draw.

    What was computed is kept in DIR/cache under the digest of everything that it depends on, code
    included. So the same command goes on after Ctrl-C, and draws at once what is complete. Each
    experiment has a directory in DIR with its tables (CSV), figures (PNG and SVG), every trial (CSV
    or Parquet), and where it all comes from.
    """
    from holdfast.experiments.registry import studies_of
    from holdfast.experiments.study import Scale

    if list_names:
        if names:
            raise InvalidValueError(f"--list: lists all; {' '.join(names)} has no effect")
        for study in studies_of(["all"]):
            sys.stdout.write(f"{study.name:18} {study.title}\n")
        sys.stdout.flush()
        return
    if not names:
        raise InvalidValueError("which experiment? Say all, or names that --list shows")
    studies = studies_of(names)
    if source is not None:
        if quick:
            raise InvalidValueError("--quick: has no effect with --from, which runs nothing")
        _make_anew(studies, source, out)
        return
    words = ["holdfast", "experiment", *names]
    words += ["--quick"] if quick else []
    words += ["--seed", str(seed)]
    words += ["--jobs", str(jobs)] if jobs else []
    words += ["--executor", place] if place != "local" else []
    again = shlex.join([*words, "--out", str(out)])
    # One signal is enough: another would cut short what ends the processes.
    with ended_by_signals(once=True):
        _run(studies, Scale(quick=quick, seed=seed), out, _executor_of(place, jobs), again)


def _make_anew(studies: list[Study], source: Path, directory: Path) -> None:
    from holdfast.experiments.running import check_packages, write_report
    from holdfast.experiments.study import TrialStudy
    from holdfast.experiments.trial_files import read_trials

    check_packages()
    kept = read_trials(source)
    if [study.name for study in studies] != [kept.study]:
        raise InvalidValueError(
            f"--from {source}: has the trials of {kept.study}, not of "
            f"{', '.join(study.name for study in studies)}"
        )
    study = studies[0]
    if not isinstance(study, TrialStudy):
        raise InvalidValueError(f"--from {source}: {study.name} makes nothing of trials in a file")
    report = study.report_of(kept.trials)
    place = directory / study.name
    _show(study, report, write_report(study, kept.scale, report, place, kept.machine), place)


def _executor_of(place: str, jobs: int) -> Executor:
    from holdfast.experiments.executors import LocalExecutor
    from holdfast.experiments.ray_executor import RayExecutor
    from holdfast.runtime.trials import available_cores

    if place == "local":
        return LocalExecutor(jobs or available_cores())
    executor = RayExecutor.of(place)
    if jobs:
        raise InvalidValueError(
            f"--jobs {jobs}: has no effect with --executor {place}, where the cluster's cores say "
            "how many tasks there are at a time; leave it out"
        )
    return executor


def _run(
    studies: list[Study], scale: Scale, directory: Path, executor: Executor, again: str
) -> None:
    from holdfast.experiments.running import Workload, check_packages

    check_packages()
    workload: Workload | None = None
    try:
        workload = Workload(studies, scale, directory)
        _compute(workload, directory, executor)
        for study in studies:
            _report(study, scale, workload, directory / study.name)
    except KeyboardInterrupt as interruption:
        ended = signal_of(interruption)
        how = "Interrupted" if ended == signal.SIGINT else f"Ended by {ended.name}"
        with contextlib.suppress(OSError):
            kept = "all that was finished is kept"
            if workload is not None:
                kept = f"{workload.finished_units:,} of {workload.units:,} trials are kept"
            sys.stderr.write(f"\n{how}; {kept}.\nGo on with: {again}\n")
        raise
    except HoldfastError as error:
        raise RunError(error, again) from error


def _compute(workload: Workload, directory: Path, executor: Executor) -> None:
    from holdfast.cli.terminal import counted, progress_line
    from holdfast.experiments.running import compute

    if not workload.pending:
        return
    line = progress_line(workload.units, quiet=False)
    title = f"{counted(workload.units, 'trial')} in {executor.description}"
    if workload.finished_units:
        title += f", {workload.finished_units:,} known before"
    line.start(f"{title}; results in {directory}", workload.finished_units, _NOTE)
    try:
        compute(workload, executor, lambda finished: line.show(finished, _NOTE))
    finally:
        with contextlib.suppress(OSError):
            line.stop()


def _report(study: Study, scale: Scale, workload: Workload, directory: Path) -> None:
    from holdfast.experiments.running import write_report

    report = study.report(scale, workload.results)
    _show(study, report, write_report(study, scale, report, directory), directory)


def _show(study: Study, report: Report, names: list[str], directory: Path) -> None:
    sys.stdout.write(f"\n{study.title}\n\n")
    for finding in report.findings[:_MOST_FINDINGS]:
        sys.stdout.write(f"- {finding}\n")
    if len(report.findings) > _MOST_FINDINGS:
        others = len(report.findings) - _MOST_FINDINGS
        sys.stdout.write(f"- {others} more: {directory / 'origin.json'}\n")
    sys.stdout.write(f"\n{directory}/\n  {'  '.join(names)}\n")
    sys.stdout.flush()
