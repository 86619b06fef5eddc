"""Running studies: load known results, compute the others, write the report."""

from __future__ import annotations

import contextlib
import re
import tempfile
import time
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import pandas as pd

from holdfast import __version__
from holdfast.errors import OutputError
from holdfast.runtime.files import write_atomically
from holdfast_lab.testbed.machine import describe
from studies.errors import TaskError
from studies.executors import Executor, LocalExecutor
from studies.study import Report, Scale, Study
from studies.tables import Columns, columns_of, to_csv
from studies.tasks import Task, task_key
from studies.trial_files import TRIALS_NAME, TrialFile

_CACHE = "cache"
_CHECKSUM_BYTES = 4
_LONGEST_WRITE_S = 600.0


class _Kept(msgspec.Struct, array_like=True, forbid_unknown_fields=True):
    task: Task
    table: Columns


class ResultCache:
    """Results of tasks in a directory, under the digest of all that they depend on.

    One file each, written whole or not at all. A file that is damaged, of an earlier format or of
    another task counts as missing: the task is computed again. The directory is made when something
    is kept.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._decoder = msgspec.msgpack.Decoder(_Kept)

    def load(self, task: Task) -> pd.DataFrame | None:
        """Return a task's result; None if it is not known."""
        path = self._path_of(task)
        try:
            content = path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise OutputError(f"{path}: cannot be read: {error.strerror}") from error
        payload = content[:-_CHECKSUM_BYTES]
        if content != payload + _checksum(payload):
            return None
        try:
            kept = self._decoder.decode(payload)
        except msgspec.DecodeError:
            return None
        return pd.DataFrame(kept.table) if task_key(kept.task) == task_key(task) else None

    def store(self, task: Task, table: pd.DataFrame) -> None:
        """Keep a task's result."""
        path = self._path_of(task)
        _make(path.parent)
        payload = msgspec.msgpack.encode(_Kept(task, columns_of(table)))
        write_atomically(path, payload + _checksum(payload))

    def _path_of(self, task: Task) -> Path:
        key = task_key(task)
        return self._directory / task.kind / key[:2] / f"{key}.table"


def _checksum(payload: bytes) -> bytes:
    return zlib.crc32(payload).to_bytes(_CHECKSUM_BYTES, "little")


def _make(directory: Path) -> None:
    """Make a directory in which something can be kept."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=directory).close()
    except OSError as error:
        raise OutputError(f"{directory}: cannot be written in: {error.strerror}") from error


class Workload:
    """The tasks of some studies, each once, with the results that are known already.

    ``pending`` are those still to be computed; ``units`` is how much work all are, and
    ``finished_units`` how much of it is done.
    """

    def __init__(self, studies: Sequence[Study], scale: Scale, directory: Path) -> None:
        self._cache = ResultCache(directory / _CACHE)
        _remove_unfinished(directory / _CACHE)
        tasks = {task_key(task): task for study in studies for task in study.tasks(scale)}
        loaded = {key: self._cache.load(task) for key, task in tasks.items()}
        self._tables = {key: table for key, table in loaded.items() if table is not None}
        self._keys = frozenset(tasks)
        self.tasks = list(tasks.values())
        self.pending = [task for key, task in tasks.items() if key not in self._tables]
        self.units = sum(task.units for task in self.tasks)
        self.finished_units = self.units - sum(task.units for task in self.pending)
        if self.pending:
            _make(directory)

    def keep(self, task: Task, table: pd.DataFrame) -> None:
        """Keep the result of a task.

        TaskError if its code was edited since this was made: it came of one or the other.
        """
        key = task_key(task)
        if key not in self._keys:
            raise TaskError(
                f"the code of tasks of the kind {task.kind!r} was edited while they were computed, "
                "so it is not known which code this result is of; it is not kept. Edit nothing "
                "meanwhile"
            )
        self._cache.store(task, table)
        self._tables[key] = table
        self.finished_units += task.units

    def result_of(self, task: Task) -> pd.DataFrame:
        """Return the result of a task that is not pending."""
        return self._tables[task_key(task)]


def compute(workload: Workload, executor: Executor, on_progress: Callable[[int], None]) -> None:
    """Compute the pending tasks and keep their results.

    ``on_progress`` gets how many units of work are finished.
    What was finished before a failure or an interruption is kept.
    """

    def keep(task: Task, table: pd.DataFrame) -> None:
        workload.keep(task, table)
        on_progress(workload.finished_units)

    executor.run([task for task in workload.pending if not task.exclusive], keep)
    # What measures times has this machine to itself.
    LocalExecutor(1).run([task for task in workload.pending if task.exclusive], keep)


class _Origin(msgspec.Struct, kw_only=True, omit_defaults=True):
    """The origin of the numbers; the content of ``origin.json``."""

    study: str
    quick: bool
    seed: int
    holdfast_version: str
    machine: dict[str, str]
    claim_seed: int | None = None


def write_report(
    study: Study,
    scale: Scale,
    report: Report,
    directory: Path,
    machine: dict[str, str] | None = None,
) -> list[str]:
    """Write a study's tables and figures into its directory; return the names of the files.

    ``machine`` is the one on which its trials were run; this one by default. ``origin.json`` comes
    last: where it is not there, the rest may be of two runs.
    """
    _make(directory)
    origin_path = directory / "origin.json"
    origin_path.unlink(missing_ok=True)
    machine = describe() if machine is None else machine
    raw = {f"{name}_trials": table for name, table in report.raw.items()}
    files = {f"{name}.csv": to_csv(table).encode() for name, table in (report.tables | raw).items()}
    if report.trials is not None:
        kept = TrialFile(study=study.name, scale=scale, machine=machine, trials=report.trials)
        files[TRIALS_NAME] = kept.encoded()
    for name, content in files.items():
        write_atomically(directory / name, content)
    names = list(files)
    if report.figures:
        from studies import plots
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
        claim_seed=None if report.trials is None else scale.claim_seed,
    )
    text = msgspec.json.format(msgspec.json.encode(origin), indent=2)
    write_atomically(origin_path, text + b"\n")
    return [*names, "origin.json"]


def _remove_unfinished(directory: Path) -> None:
    """Remove temporary files of killed writers; a young one may belong to a running writer."""
    latest = time.time() - _LONGEST_WRITE_S
    for path in directory.rglob(".*.tmp"):
        with contextlib.suppress(OSError):
            if re.fullmatch(r"\..+\.\d+\.tmp", path.name) and path.stat().st_mtime < latest:
                path.unlink()
