"""Where tasks are computed: in processes of this machine, or on a Ray cluster.

All places give the same results, since a task is a function of its parameters; only times differ.
Only plain data travels, never code: another process must have the same clone, and each request
brings the digest of the code that it wants. One with other code refuses.
"""

from __future__ import annotations

import contextlib
import logging
import re
import socket
import traceback
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any, Protocol

import msgspec
import pandas as pd

from holdfast.errors import HoldfastError, InvalidValueError
from holdfast.runtime.command_line import MAX_JOBS
from holdfast.runtime.workers import WorkerProcess, end_workers
from studies.errors import TaskCrashError, TaskError
from studies.tables import Columns, columns_of
from studies.tasks import Task, code_of, run_task

_MOST_RETRIES = 2
_AT_A_TIME = 256
"""Tasks that a cluster is given at a time."""

_LONGEST_WAIT_S = 1.0
"""Ctrl-C is heard within it."""

_OnResult = Callable[[Task, pd.DataFrame], None]


class Executor(Protocol):
    """Computes tasks somewhere; ``description`` says where, for people."""

    description: str

    def run(self, tasks: Sequence[Task], on_result: _OnResult) -> None:
        """Compute tasks, begun in this order; pass each with its result, in any order.

        However it ends, everything that it started has been ended. TaskError if a task cannot be
        computed, or was lost with its process.
        """
        ...


class LocalExecutor:
    """Computes tasks in processes of this machine; a single one is this process."""

    def __init__(self, processes: int) -> None:
        if not 1 <= processes <= MAX_JOBS:
            raise InvalidValueError(f"--jobs {processes}: must be from 1 to {MAX_JOBS}")
        self._processes = processes
        self.description = "this process" if processes == 1 else f"{processes} processes"

    def run(self, tasks: Sequence[Task], on_result: _OnResult) -> None:
        """Compute tasks; see :meth:`Executor.run`."""
        if self._processes == 1 or len(tasks) <= 1:
            for task in tasks:
                on_result(task, run_task(task))
            return
        pending = iter(tasks)
        # One thread each: there are enough of them.
        workers = [
            WorkerProcess("holdfast-study", _work, (), 1)
            for _ in range(min(self._processes, len(tasks)))
        ]
        given: dict[Connection, tuple[WorkerProcess, Task]] = {}

        def give(worker: WorkerProcess) -> None:
            task = next(pending, None)
            if task is not None:
                worker.send(encode_task(task))
                given[worker.connection] = worker, task

        try:
            for worker in workers:
                worker.start()
                give(worker)
            while given:
                for connection in wait(list(given)):
                    assert isinstance(connection, Connection)
                    worker, task = given.pop(connection)
                    answer = worker.receive()
                    if answer is None:
                        how, killed = worker.how_it_ended()
                        advice = "; often the machine is out of memory: use fewer --jobs"
                        raise TaskError(
                            f"a process {how} with {task.kind} {task.parameters}"
                            f"{advice if killed else ''}"
                        )
                    give(worker)  # before its answer is dealt with, so that it is never idle
                    on_result(task, table_of(answer))
        finally:
            end_workers(workers)


def _work(connection: Connection) -> None:
    """Compute tasks until the parent closes the pipe."""
    while True:
        connection.send_bytes(compute_encoded(connection.recv_bytes()))


class RayExecutor:
    """Computes tasks on a Ray cluster, whose nodes have the clone's root in PYTHONPATH.

    Ray computes again what a killed process or node had.

    Parameters
    ----------
    place : str
        ``ray``: the cluster of this machine, or the one that ``RAY_ADDRESS`` names;
        ``ray://HOST:PORT``: the cluster whose client server listens there.
    """

    def __init__(self, place: str) -> None:
        if not re.fullmatch(r"ray|ray://\S+:[0-9]+", place):
            raise InvalidValueError(
                f"--executor {place}: must be local, ray (the cluster of this machine) or "
                "ray://HOST:PORT"
            )
        self._address = "auto" if place == "ray" else place
        self.description = f"the Ray cluster at {place}"

    def run(self, tasks: Sequence[Task], on_result: _OnResult) -> None:
        """Compute tasks; see :meth:`Executor.run`. HoldfastError if no cluster can be joined."""
        if not tasks:
            return
        try:
            import ray
        except ImportError as error:
            raise HoldfastError(
                "--executor ray needs Ray, which cannot be imported: pip install 'ray[client]'"
            ) from error
        try:
            ray.init(address=self._address, logging_level=logging.ERROR, log_to_driver=False)
        except Exception as error:
            raise HoldfastError(f"{self.description} cannot be joined: {error}") from error
        remote = ray.remote(num_cpus=1, max_retries=_MOST_RETRIES)(compute_encoded)
        pending = iter(tasks)
        running: dict[Any, Task] = {}
        try:
            while True:
                while len(running) < _AT_A_TIME and (task := next(pending, None)) is not None:
                    running[remote.remote(encode_task(task))] = task
                if not running:
                    return
                for done in ray.wait(list(running), timeout=_LONGEST_WAIT_S)[0]:
                    task = running.pop(done)
                    on_result(task, table_of(ray.get(done)))
        except ray.exceptions.RayError as error:
            raise TaskError(f"{self.description} cannot compute a task: {error}") from error
        finally:
            # Nobody waits for what is still computed there.
            for reference in running:
                with contextlib.suppress(Exception):
                    ray.cancel(reference, force=True)
            ray.shutdown()


# -- tasks and results as bytes --------------------------------------------------------------------


class _Request(msgspec.Struct):
    task: Task
    code: str


class _Computed(msgspec.Struct, tag="computed"):
    table: Columns


class _Failed(msgspec.Struct, tag="failed"):
    reason: str
    crashed: bool


def encode_task(task: Task) -> bytes:
    """Return a task as bytes, with the digest of the code that may compute it."""
    return msgspec.msgpack.encode(_Request(task, code_of(task)))


def compute_encoded(request: bytes) -> bytes:
    """Compute a task in this process; return its result for :func:`table_of`, or why there is none.

    It always answers, also when it fails, so that an error is the same wherever it happens.
    """
    answer: _Computed | _Failed
    try:
        asked = msgspec.msgpack.decode(request, type=_Request)
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
            f"{asked.task.kind!r} (digest {own}) than the one that asks (digest {asked.code}), so "
            "the results would not belong together: every node needs the same clone; edit nothing "
            "meanwhile"
        )


def table_of(answer: bytes) -> pd.DataFrame:
    """Return a task's result, from what :func:`compute_encoded` answered.

    TaskError if its function refused the parameters, or the code is another; TaskCrashError if
    anything else went wrong there.
    """
    found = msgspec.msgpack.decode(answer, type=_Computed | _Failed)
    if isinstance(found, _Computed):
        return pd.DataFrame(found.table)
    if found.crashed:
        raise TaskCrashError(f"in another process:\n{found.reason}")
    raise TaskError(found.reason)
