"""Tasks on a Ray cluster.

Every node needs the same holdfast as this machine: a task is sent as its name and parameters, never
as code. Each worker compares the digest of the code that computes the task with ours, and refuses
to compute with another one. What a killed worker had is computed by another.

This module imports Ray; import it only where a cluster is asked for.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import msgspec

from holdfast.errors import HoldfastError, InvalidValueError
from holdfast.experiments.tables import Table
from holdfast.experiments.tasks import Task, TaskError, code_digest, run_task

__all__ = ["RayExecutor"]

try:
    import ray
except ImportError as _error:
    raise HoldfastError(
        "--executor ray needs Ray, which is not installed: pip install 'holdfast[cluster]'"
    ) from _error

_MOST_ATTEMPTS = 3
_AHEAD = 2
"""Tasks that wait for each core of the cluster, so that none is idle between two."""

_MOST_AT_A_TIME = 10_000
_LONGEST_WAIT_S = 1.0
"""Between two looks at the cluster; Ctrl-C is answered within it."""


class RayExecutor:
    """Computes tasks on a Ray cluster.

    Parameters
    ----------
    address : str or None
        ``ray://HOST:PORT`` of the cluster's client server; None joins that of this machine.
    at_a_time : int
        Tasks at the same time; 0 for as many as the cluster takes.

    Raises
    ------
    InvalidValueError
        If the number is out of bounds.
    """

    def __init__(self, address: str | None, at_a_time: int) -> None:
        if not 0 <= at_a_time <= _MOST_AT_A_TIME:
            raise InvalidValueError(f"--jobs {at_a_time}: must be from 0 to {_MOST_AT_A_TIME}")
        self._address = address
        self._at_a_time = at_a_time

    @property
    def description(self) -> str:
        """Where, for people."""
        return f"Ray at {self._address or 'this machine'}"

    def run(self, tasks: Sequence[Task], on_result: Callable[[Task, Table], None]) -> None:
        """Compute tasks; see :meth:`~holdfast.experiments.executors.Executor.run`."""
        if not tasks:
            return
        with self._joined():
            remote = ray.remote(num_cpus=1, max_retries=_MOST_ATTEMPTS - 1)(_run_encoded)
            pending = iter(tasks)
            running: dict[Any, Task] = {}
            try:
                self._run(remote, pending, running, on_result)
            except BaseException:
                for reference in running:
                    ray.cancel(reference, force=True)
                raise

    def _run(
        self,
        remote: Any,
        pending: Iterator[Task],
        running: dict[Any, Task],
        on_result: Callable[[Task, Table], None],
    ) -> None:
        while True:
            while len(running) < self._room():
                task = next(pending, None)
                if task is None:
                    break
                encoded = msgspec.msgpack.encode(task)
                running[remote.remote(encoded, code_digest(task.kind))] = task
            if not running:
                return
            done, _ = ray.wait(list(running), timeout=_LONGEST_WAIT_S)
            for reference in done:
                task = running.pop(reference)
                on_result(task, _result_of(reference, task))

    def _room(self) -> int:
        """Return how many tasks the cluster may have now; it may have grown."""
        cores = int(ray.cluster_resources().get("CPU", 1))
        return self._at_a_time or max(1, _AHEAD * cores)

    @contextlib.contextmanager
    def _joined(self) -> Iterator[None]:
        try:
            ray.init(
                address=self._address or "auto",
                logging_level=logging.ERROR,
                log_to_driver=False,
            )
        except Exception as error:
            first_line = str(error).strip().partition("\n")[0]
            raise HoldfastError(
                f"no Ray cluster can be reached at {self._address or 'this machine'}: {first_line}"
            ) from error
        try:
            yield
        finally:
            ray.shutdown()


def _run_encoded(encoded: bytes, code: str) -> bytes:
    """Compute a task on a worker; what it refuses comes back as text."""
    task = msgspec.msgpack.decode(encoded, type=Task)
    if code_digest(task.kind) != code:
        return msgspec.msgpack.encode(
            {"error": "a node of the cluster has another holdfast than this machine"}
        )
    try:
        return msgspec.msgpack.encode({"table": run_task(task)})
    except HoldfastError as error:
        return msgspec.msgpack.encode({"error": str(error)})


class _Answer(msgspec.Struct):
    table: Table | None = None
    error: str | None = None


def _result_of(reference: Any, task: Task) -> Table:
    try:
        answer = msgspec.msgpack.decode(ray.get(reference), type=_Answer)
    except ray.exceptions.RayError as error:
        first_line = str(error).strip().partition("\n")[0]
        raise TaskError(
            f"{task.kind} {task.parameters}: lost by the cluster: {first_line}"
        ) from error
    if answer.table is None:
        raise TaskError(answer.error or "an empty answer")
    return answer.table
