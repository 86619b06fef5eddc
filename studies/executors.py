"""Where tasks are computed: in this process, or in others.

All places give the same results, since a task is a function of its parameters; only times differ.
The tasks of a killed process are computed again elsewhere. A task is given up when its process has
died several times. Only plain data travels, never code: another process must have the same
holdfast installed, and a request names the code that it wants.
"""

from __future__ import annotations

import socket
import traceback
from collections import Counter, deque
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from typing import Protocol

import msgspec
import pandas as pd

from holdfast import __version__
from holdfast.errors import HoldfastError, InvalidValueError
from holdfast.runtime.command_line import MAX_JOBS
from holdfast.runtime.workers import WorkerProcess, end_workers
from studies.errors import TaskCrashError, TaskError
from studies.tables import Columns, columns_of
from studies.tasks import Task, code_of, run_task

__all__ = [
    "MOST_ATTEMPTS",
    "Executor",
    "LocalExecutor",
    "compute_encoded",
    "encode_task",
    "table_of",
]

MOST_ATTEMPTS = 3
"""A task that is lost with its process this often is given up."""


class Executor(Protocol):
    """Computes tasks somewhere."""

    @property
    def description(self) -> str:
        """Where, for people."""
        ...

    def run(self, tasks: Sequence[Task], on_result: Callable[[Task, pd.DataFrame], None]) -> None:
        """Compute tasks, begun in this order; pass each with its result, in any order.

        However it ends, everything that it started has been ended. TaskError if a task cannot be
        computed, or was lost with its process several times.
        """
        ...


class LocalExecutor:
    """Computes tasks in processes of this machine; a single one is this process."""

    def __init__(self, processes: int) -> None:
        if not 1 <= processes <= MAX_JOBS:
            raise InvalidValueError(f"--jobs {processes}: must be from 1 to {MAX_JOBS}")
        self._processes = processes

    @property
    def description(self) -> str:
        """Where, for people."""
        return "this process" if self._processes == 1 else f"{self._processes} processes"

    def run(self, tasks: Sequence[Task], on_result: Callable[[Task, pd.DataFrame], None]) -> None:
        """Compute tasks; see :meth:`Executor.run`."""
        if self._processes == 1 or len(tasks) <= 1:
            for task in tasks:
                on_result(task, run_task(task))
            return
        pending = deque(enumerate(tasks))
        losses: Counter[int] = Counter()
        workers: list[_Worker] = []
        try:
            while pending or workers:
                while pending and len(workers) < self._processes:
                    workers.append(_Worker())
                    workers[-1].start()
                    workers[-1].give(*pending.popleft())
                for worker in _ready(workers):
                    number, task = worker.number, worker.task
                    answer = worker.receive()
                    if answer is None:
                        losses[number] += 1
                        if losses[number] == MOST_ATTEMPTS:
                            raise _given_up(worker)
                        pending.appendleft((number, task))
                    if answer is None or not pending:
                        end_workers([worker])
                        workers.remove(worker)
                    else:
                        # Before its answer is dealt with, so that it is never idle.
                        worker.give(*pending.popleft())
                    if answer is not None:
                        on_result(task, table_of(answer))
        finally:
            end_workers(workers)


class _Worker(WorkerProcess):
    """A worker, and the task that it has."""

    number: int
    task: Task

    def __init__(self) -> None:
        # One thread each: there are enough of them.
        super().__init__("holdfast-study", _work, (), 1)

    def give(self, number: int, task: Task) -> None:
        self.number, self.task = number, task
        # A worker imports what is on the disk by then: somebody may have edited it.
        self.send(encode_task(task, code_of(task)))


def _work(connection: Connection) -> None:
    """Compute tasks until the parent closes the pipe."""
    while True:
        connection.send_bytes(compute_encoded(connection.recv_bytes()))


def _ready(workers: Sequence[_Worker]) -> list[_Worker]:
    """Wait until there are workers that have answered or ended, and return them."""
    ready = wait([worker.connection for worker in workers])
    return [worker for worker in workers if worker.connection in ready]


def _given_up(worker: _Worker) -> TaskError:
    how, killed = worker.how_it_ended()
    advice = "; often the machine is out of memory: fewer processes (--jobs) need less"
    return TaskError(
        f"{MOST_ATTEMPTS} processes were lost with {worker.task.kind} {worker.task.parameters}, "
        f"and the last one {how}{advice if killed else ''}"
    )


# -- tasks and results as bytes --------------------------------------------------------------------


class _Request(msgspec.Struct):
    task: Task
    code: str


class _Computed(msgspec.Struct, tag="computed"):
    table: Columns


class _Failed(msgspec.Struct, tag="failed"):
    reason: str
    crashed: bool


_REQUEST_DECODER = msgspec.msgpack.Decoder(_Request)
_ANSWER_DECODER = msgspec.msgpack.Decoder(_Computed | _Failed)


def encode_task(task: Task, code: str) -> bytes:
    """Return a task as bytes, with the digest of the code that may compute it."""
    return msgspec.msgpack.encode(_Request(task, code))


def compute_encoded(request: bytes) -> bytes:
    """Compute a task in this process; return its result for :func:`table_of`, or why there is none.

    It always answers, also when it fails, so that an error is the same wherever it happens.
    """
    answer: _Computed | _Failed
    try:
        asked = _REQUEST_DECODER.decode(request)
        _check_code(asked)
        table = run_task(asked.task)
        # Modules were imported on the way, and may have been edited just before.
        _check_code(asked)
        answer = _Computed(columns_of(table))
    except HoldfastError as error:
        answer = _Failed(str(error), crashed=False)
    except Exception:  # noqa: BLE001 - raised again where it was asked for
        answer = _Failed(traceback.format_exc(), crashed=True)
    return msgspec.msgpack.encode(answer)


def _check_code(asked: _Request) -> None:
    own = code_of(asked.task)
    if own != asked.code:
        raise TaskError(
            f"a process on {socket.gethostname()} has other code for tasks of the kind "
            f"{asked.task.kind!r} (digest {own}, of holdfast {__version__}) than the one that asks "
            f"(digest {asked.code}), so the results would not belong together: install the same "
            "holdfast on every node, and edit nothing meanwhile"
        )


def table_of(answer: bytes) -> pd.DataFrame:
    """Return a task's result, from what :func:`compute_encoded` answered.

    Raises
    ------
    TaskError
        If its function refused the parameters, or the code is another.
    TaskCrashError
        If anything else went wrong there.
    """
    found = _ANSWER_DECODER.decode(answer)
    if isinstance(found, _Computed):
        return pd.DataFrame(found.table)
    if found.crashed:
        raise TaskCrashError(f"in another process:\n{found.reason}")
    raise TaskError(found.reason)
