"""Running studies: what is known already, what is computed, what is written."""

from __future__ import annotations

import importlib.util
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec

from holdfast import __version__
from holdfast.errors import HoldfastError
from holdfast.experiments.executors import Executor, LocalExecutor
from holdfast.experiments.result_cache import ResultCache
from holdfast.experiments.study import Report, Results, Scale, Study
from holdfast.experiments.tables import Table
from holdfast.experiments.tasks import Task, TaskError, task_key
from holdfast.experiments.trial_files import TRIALS_NAME, TrialFile
from holdfast.files import OutputError, remove_unfinished, write_atomically
from holdfast.recording.machine import describe

__all__ = ["Workload", "check_packages", "compute", "write_report"]

_CACHE = "cache"

_PACKAGES = ("scipy", "matplotlib", "pyarrow")


class Workload:
    """The tasks of some studies, and what of them is known already.

    Parameters
    ----------
    studies : sequence of Study
    scale : Scale
    directory : Path
        Where results are kept.

    Attributes
    ----------
    tasks : list of Task
        Each once, although several studies may have it.
    pending : list of Task
        Of these, those that are still to be computed.
    units, finished_units : int
        How much work they are, and how much of it is done.
    """

    def __init__(self, studies: Sequence[Study], scale: Scale, directory: Path) -> None:
        self._cache = ResultCache(directory / _CACHE)
        self._tables: dict[str, Table] = {}
        # Only where nobody but this program writes: the directory itself may be anybody's.
        remove_unfinished(directory / _CACHE, below=True)
        for study in studies:
            remove_unfinished(directory / study.name)
        tasks = {task_key(task): task for study in studies for task in study.tasks(scale)}
        self.tasks = list(tasks.values())
        self._keys = frozenset(tasks)
        self.pending: list[Task] = []
        for key, task in tasks.items():
            table = self._cache.load(task)
            if table is None:
                self.pending.append(task)
            else:
                self._tables[key] = table
        self.units = sum(task.units for task in self.tasks)
        self.finished_units = self.units - sum(task.units for task in self.pending)
        if self.pending:
            _check_room(directory)

    def keep(self, task: Task, table: Table) -> None:
        """Take what a task came to.

        Raises
        ------
        TaskError
            If its code was edited since this was made: it came of one or the other.
        OutputError
            If it cannot be kept.
        """
        key = task_key(task)
        if key not in self._keys:
            raise TaskError(
                f"the code of tasks of the kind {task.kind!r} was edited while they were computed, "
                "so nobody knows which code this result is of; it is not kept. Edit nothing "
                "meanwhile"
            )
        self._cache.store(task, table)
        self._tables[key] = table
        self.finished_units += task.units

    @property
    def results(self) -> Results:
        """What all tasks came to, once none is pending."""
        return Results(self._tables, task_key)


def compute(workload: Workload, executor: Executor, on_progress: Callable[[int], None]) -> None:
    """Compute what is still to be computed, and keep it.

    Parameters
    ----------
    workload : Workload
    executor : Executor
    on_progress : callable
        Gets how many units of work are finished.

    Raises
    ------
    HoldfastError
        If a task fails; what was finished before is kept.
    KeyboardInterrupt
        After everything that was started has been ended; what was finished is kept.
    """

    def keep(task: Task, table: Table) -> None:
        workload.keep(task, table)
        on_progress(workload.finished_units)

    executor.run([task for task in workload.pending if not task.exclusive], keep)
    # What measures times has this machine to itself.
    LocalExecutor(1).run([task for task in workload.pending if task.exclusive], keep)


class _Origin(msgspec.Struct, kw_only=True, omit_defaults=True):
    """Where numbers come from; the content of ``origin.json``."""

    study: str
    quick: bool
    seed: int
    holdfast_version: str
    machine: dict[str, str]
    findings: list[str]
    claim_seed: int | None = None


def write_report(
    study: Study,
    scale: Scale,
    report: Report,
    directory: Path,
    machine: dict[str, str] | None = None,
) -> list[str]:
    """Write a study's tables, figures and findings.

    ``origin.json`` comes last: where it is not there, the rest may be of two runs.

    Parameters
    ----------
    study : Study
    scale : Scale
    report : Report
    directory : Path
        Of this study; made if it is not there.
    machine : dict, optional
        On which its trials were run; this one by default.

    Returns
    -------
    list of str
        The names of the files.

    Raises
    ------
    OutputError
        If one cannot be written.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{directory}: cannot be made: {error.strerror}") from error
    origin_path = directory / "origin.json"
    try:
        origin_path.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"{origin_path}: cannot be replaced: {error.strerror}") from error
    machine = describe() if machine is None else machine
    names = []
    for name, table in report.summary.items():
        write_atomically(directory / f"{name}.csv", table.to_csv().encode())
        names.append(f"{name}.csv")
    for name, table in report.raw.items():
        write_atomically(directory / f"{name}_trials.csv", table.to_csv().encode())
        names.append(f"{name}_trials.csv")
    if report.trials is not None:
        kept = TrialFile(study=study.name, scale=scale, machine=machine, trials=report.trials)
        write_atomically(directory / TRIALS_NAME, kept.encoded())
        names.append(TRIALS_NAME)
    if report.figures:
        from holdfast.experiments import plots
    for name, draw in report.figures.items():
        figure = draw()
        if scale.quick:
            plots.mark(figure, "quick: few trials, no evidence")
        names += plots.save(figure, directory, name)
    origin = _Origin(
        study=study.name,
        quick=scale.quick,
        seed=scale.seed,
        holdfast_version=__version__,
        machine=machine,
        findings=report.findings,
        claim_seed=None if report.trials is None else scale.claim_seed,
    )
    text = msgspec.json.format(msgspec.json.encode(origin), indent=2)
    write_atomically(origin_path, text + b"\n")
    names.append("origin.json")
    return names


def check_packages() -> None:
    """Make sure that what studies need is installed, before anything is computed for them.

    Raises
    ------
    HoldfastError
        If a package is missing.
    """
    missing = [name for name in _PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        raise HoldfastError(
            f"experiments need {', '.join(missing)}, not installed here: pip install "
            f"{' '.join(missing)}"
        )


def _check_room(directory: Path) -> None:
    """Make sure that results can be kept, before there are any."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=directory).close()
    except OSError as error:
        raise OutputError(f"{directory}: cannot be written in: {error.strerror}") from error
