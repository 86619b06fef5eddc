"""``python -m studies``: the tables and figures behind what the project claims."""

from __future__ import annotations

import contextlib
import importlib.util
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from holdfast.cli.exit_codes import ended_by_signals, interrupted_by
from holdfast.errors import HoldfastError, InvalidValueError, OptionError, RunError
from holdfast.printable import did_you_mean
from holdfast.runtime.command_line import (
    MAX_JOBS,
    MAX_SEED,
    Options,
    argument,
    flag,
    location,
    option,
    whole_number,
)

if TYPE_CHECKING:
    from studies.executors import Executor
    from studies.running import Workload
    from studies.study import Report, Scale, Study


_ALL = "all"

_PACKAGES = ("scipy", "pandas", "matplotlib", "pyarrow")

_STUDIES: Mapping[str, str] = {
    "thesis_chapter_6": "studies.thesis_chapter_6:ThesisChapter6",
    "offload_break_even": "studies.offload_break_even:OffloadBreakEven",
    "published_2017": "studies.published_2017:Published2017",
    "published_worlds": "studies.published_worlds:PublishedWorlds",
    "selectors": "studies.selectors:Selectors",
    "parameters": "studies.parameters:Parameters",
    "estimates": "studies.estimates:Estimates",
    "myopic": "studies.myopic:Myopic",
    "sensing_price": "studies.sensing_price:SensingPrice",
}
"""Where each is; imported when it is needed."""

_DEFAULT_DIRECTORY = Path("runs") / "experiments"

_MOST_NUMBERS = 20
"""Most numbers of a study that are printed; numbers.csv has all."""

_NOTE = "all kept"
"""The note of the progress bar."""


class StudyOptions(Options):
    """Regenerate tables and figures: run what is not known yet, and draw.

    Results are kept in DIR/cache under the digest of everything that they depend on, code included.
    So the same command goes on after Ctrl-C, and draws at once what is complete. Each study
    has a directory in DIR with its tables (CSV), figures (PNG and SVG), every trial (CSV or
    Parquet), and the origin of all of it.
    """

    needs_arguments = True
    program = "python -m"

    names: tuple[str, ...] = argument(
        "NAME", "Names that --list shows, or all.", many=True, least=0
    )
    quick: bool = flag(help="Few trials: minutes, to see that everything works. No evidence.")
    out: Path = option(
        "-o",
        metavar="DIR",
        read=location,
        default=_DEFAULT_DIRECTORY,
        help="Directory for the results.",
    )
    seed: int = option(
        metavar="S",
        read=whole_number(0, MAX_SEED),
        default=2017,
        help="Seed of all trials. Where something is chosen (selectors, parameters), the trials "
        "that judge the choice have the next seed.",
    )
    jobs: int = option(
        "-j",
        metavar="N",
        read=whole_number(0, MAX_JOBS),
        default=0,
        help="Processes; 0: one for each core. Changes time only.",
    )
    executor: str = option(
        metavar="WHERE",
        default="local",
        help="Where it runs: local (processes of this machine), ray (the Ray cluster of this "
        "machine) or ray://HOST:PORT (the cluster whose client server listens there). Every node "
        "needs the same clone, and its root in PYTHONPATH. Measurements of times stay here. "
        "Changes time only.",
    )
    source: Path | None = option(
        "--from",
        metavar="FILE",
        read=location,
        help="Run nothing: make the tables and figures of selectors or parameters anew from their "
        "trials in FILE (trials.parquet).",
    )
    list: bool = flag(help="List the studies and end.")


def study_names() -> list[str]:
    """Return the names of all studies, in the order in which ``all`` runs them."""
    return list(_STUDIES)


def studies_of(names: Sequence[str]) -> list[Study]:
    """Return the studies of some names, each once, in the order of :func:`study_names`.

    ``all`` stands for all of them. InvalidValueError if there is no study of a name; HoldfastError
    if a package is missing that studies need.
    """
    for name in names:
        if name != _ALL and name not in _STUDIES:
            hint = did_you_mean(name, [_ALL, *_STUDIES])
            raise InvalidValueError(
                f"study {name!r}: there are {', '.join(_STUDIES)} and {_ALL}{hint}"
            )
    missing = [name for name in _PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        raise HoldfastError(
            f"the studies need {', '.join(missing)}, not installed here; make install brings all "
            "that they need"
        )
    wanted = [name for name in _STUDIES if _ALL in names or name in names]
    places = (_STUDIES[name].partition(":") for name in wanted)
    return [
        getattr(importlib.import_module(module), attribute)() for module, _, attribute in places
    ]


def main(arguments: Sequence[str]) -> int:
    """Run the studies and return the exit code."""
    options = StudyOptions.parse("studies", arguments)
    if options.list:
        if options.names:
            raise OptionError(f"--list shows all; leave {' '.join(options.names)} out")
        for study in studies_of(["all"]):
            sys.stdout.write(f"{study.name:18} {study.title}\n")
        return 0
    if not options.names:
        raise OptionError("NAME is missing; give all, or names that --list shows")
    studies = studies_of(options.names)
    if options.source is not None:
        if options.quick:
            raise OptionError("--quick has no effect with --from, which runs nothing")
        _make_anew(studies, options.source, options.out)
        return 0
    out = options.table()["out"].words(options.out)
    again = shlex.join(["python", "-m", "studies", *options.words("out"), *out])
    from studies.study import Scale

    scale = Scale(quick=options.quick, seed=options.seed)
    executor = _executor_of(options.executor, options.jobs)
    # One signal is enough: another would cut short what ends the processes.
    with ended_by_signals(once=True):
        _run(studies, scale, options.out, executor, again)
    return 0


def _make_anew(studies: list[Study], source: Path, directory: Path) -> None:
    from studies.study import TRIALS, TrialStudy
    from studies.trial_files import read_trials

    kept = read_trials(source)
    names = [study.name for study in studies]
    if names != [kept.study]:
        raise InvalidValueError(
            f"--from {source}: has the trials of {kept.study}, not of {', '.join(names)}"
        )
    (study,) = studies
    if not isinstance(study, TrialStudy):
        raise InvalidValueError(f"--from {source}: {study.name} makes nothing of trials in a file")
    report = study.report_of({TRIALS: kept.trials})
    report = msgspec.structs.replace(report, trials=kept.trials)
    _show(study, kept.scale, report, directory / study.name, kept.machine)


def _executor_of(place: str, jobs: int) -> Executor:
    from holdfast.runtime.machine import available_cores
    from studies.executors import LocalExecutor, RayExecutor

    if place == "local":
        return LocalExecutor(jobs or available_cores())
    executor = RayExecutor(place)
    if jobs:
        raise InvalidValueError(
            f"--jobs {jobs}: has no effect with --executor {place}, where the cluster's cores say "
            "how many tasks there are at a time; leave it out"
        )
    return executor


def _run(
    studies: list[Study], scale: Scale, directory: Path, executor: Executor, again: str
) -> None:
    from holdfast.cli.terminal import counted, progress_line
    from studies.running import Workload, compute

    workload: Workload | None = None
    try:
        workload = Workload(studies, scale, directory)
        if workload.pending:
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
        for study in studies:
            report = study.report(scale, workload.result_of)
            _show(study, scale, report, directory / study.name)
    except KeyboardInterrupt as interruption:
        how = interrupted_by(interruption)
        with contextlib.suppress(OSError):
            kept = "all that was finished is kept"
            if workload is not None:
                kept = f"{workload.finished_units:,} of {workload.units:,} trials are kept"
            sys.stderr.write(f"\n{how}; {kept}.\nGo on with: {again}\n")
        raise
    except HoldfastError as error:
        raise RunError(error, again) from error


def _show(
    study: Study,
    scale: Scale,
    report: Report,
    directory: Path,
    machine: dict[str, str] | None = None,
) -> None:
    """Write a report, and print its numbers and the names of its files."""
    from studies.running import write_report

    names = write_report(study, scale, report, directory, machine)
    sys.stdout.write(f"\n{study.title}\n\n")
    for number in report.numbers[:_MOST_NUMBERS]:
        sys.stdout.write(f"- {number}\n")
    if len(report.numbers) > _MOST_NUMBERS:
        others = len(report.numbers) - _MOST_NUMBERS
        sys.stdout.write(f"- {others} more: {directory / 'numbers.csv'}\n")
    sys.stdout.write(f"\n{directory}/\n  {'  '.join(names)}\n")
    sys.stdout.flush()
