"""Tasks on a Ray cluster.

Every node has the clone, with its root in PYTHONPATH, and a task travels as its name and
parameters, never as code. So a node could have other code than this machine, and its results would
be kept as if they were of ours: each task brings the digest of the code that it wants, and a node
with another one refuses.

Ray itself computes again what a killed process or node had. Nothing of Ray is imported before there
is something to compute.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import math
import os
import re
import signal
import socket
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from time import monotonic
from types import ModuleType
from typing import TYPE_CHECKING, Any, Self, cast

from holdfast.errors import HoldfastError, InvalidValueError
from studies.errors import TaskError
from studies.executors import (
    MOST_ATTEMPTS,
    compute_encoded,
    encode_task,
    table_of,
)
from studies.tasks import Task, code_of

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["RayExecutor"]

_ADDRESS = re.compile(r"ray://(?P<host>[A-Za-z0-9_.-]+|\[[0-9A-Fa-f:.]+\]):(?P<port>[0-9]{1,5})")
_HIGHEST_PORT = 65_535

_AHEAD = 2
"""Tasks that the cluster has for each of its cores, so that none is idle between two."""

_LONGEST_WAIT_S = 1.0
"""Ctrl-C is heard within it."""

_LOOK_INTERVAL_S = 10.0
"""Between two looks at how large the cluster is; it may grow."""

_WITHOUT_CORES_S = 120.0
"""For so long a cluster may have no core at all, as while its only node is replaced."""

_CONNECT_S = 10.0
_SHOWN_CHARACTERS = 500


class RayExecutor:
    """Computes tasks on a Ray cluster.

    Parameters
    ----------
    address : str or None
        ``ray://HOST:PORT`` of the cluster's client server; None joins the cluster that runs on this
        machine, or the one that ``RAY_ADDRESS`` names.
    """

    def __init__(self, address: str | None) -> None:
        self._address = address

    @classmethod
    def of(cls, place: str) -> Self:
        """Return the executor that a person has named: ``ray`` or ``ray://HOST:PORT``."""
        if place == "ray":
            return cls(None)
        found = _ADDRESS.fullmatch(place)
        if found is None or not 1 <= int(found["port"]) <= _HIGHEST_PORT:
            raise InvalidValueError(
                f"--executor {place}: must be local, ray (the cluster that runs on this machine) "
                "or ray://HOST:PORT (the cluster's client server; Ray's usual port is 10001)"
            )
        return cls(place)

    @property
    def description(self) -> str:
        """Where, for people."""
        return f"the Ray cluster at {self._place}"

    @property
    def _place(self) -> str:
        return (self._address or "this machine").removeprefix("ray://")

    def run(self, tasks: Sequence[Task], on_result: Callable[[Task, pd.DataFrame], None]) -> None:
        """Compute tasks; see :meth:`~studies.executors.Executor.run`."""
        if not tasks:
            return
        ray = _imported()
        try:
            self._join(ray)
            _compute(ray, self._place, tasks, on_result)
        except ConnectionError as error:
            raise TaskError(
                f"the connection to the Ray cluster at {self._place} was lost: {_line_of(error)}"
            ) from error
        finally:
            ray.shutdown()

    def _join(self, ray: ModuleType) -> None:
        address = self._address or _address_of_this_machine()
        try:
            _check_that_somebody_listens(address)
            with _own_handler_of_sigterm():
                ray.init(
                    address=self._address or "auto",
                    logging_level=logging.ERROR,
                    log_to_driver=False,
                )
        except Exception as error:
            where = self._place
            if self._address is None and address:
                where += f" ({address}, which RAY_ADDRESS or the last ray start names)"
            advice = "" if self._address else "; this starts one: ray start --head"
            raise HoldfastError(
                f"no Ray cluster can be joined at {where}: {_line_of(error)}{advice}"
            ) from error


def _imported() -> ModuleType:
    try:
        return importlib.import_module("ray")
    except ImportError as error:
        raise HoldfastError(
            f"--executor ray needs Ray, which cannot be imported ({_line_of(error)}): "
            "pip install 'ray[client]'"
        ) from error


def _address_of_this_machine() -> str:
    """Return where Ray will look; empty if it will look for running processes."""
    temporary = os.environ.get("RAY_TMPDIR") or os.environ.get("TMPDIR") or "/tmp"
    address = os.environ.get("RAY_ADDRESS", "")
    if not address:
        # Whoever starts a cluster leaves its address here; it may have been killed since.
        with contextlib.suppress(OSError):
            address = (Path(temporary) / "ray" / "ray_current_cluster").read_text().strip()
    return address


def _check_that_somebody_listens(address: str) -> None:
    """Find out at once what Ray would find out after minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), _CONNECT_S).close()


@contextlib.contextmanager
def _own_handler_of_sigterm() -> Iterator[None]:
    """Keep the handler, which Ray replaces without asking by one that exits."""
    handler = signal.getsignal(signal.SIGTERM)
    ended = False
    try:
        yield
    except SystemExit:
        ended = True
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, handler)
    if ended:
        signal.raise_signal(signal.SIGTERM)


class _Size:
    """How many cores a cluster has; it may grow and shrink."""

    def __init__(self, ray: ModuleType, place: str) -> None:
        self._ray = ray
        self._place = place
        self._cores = 0
        self._looked_at = -math.inf
        self._had_some_at = monotonic()

    def cores(self, tasks_left: int) -> int:
        """Return how many there are, as of late.

        It raises if there has been none for long: Ray itself would wait for ever, and say nothing.
        """
        now = monotonic()
        if now > self._looked_at + _LOOK_INTERVAL_S:
            self._cores = int(self._ray.cluster_resources().get("CPU", 0))
            self._looked_at = now
        if self._cores:
            self._had_some_at = now
        elif now > self._had_some_at + _WITHOUT_CORES_S:
            raise TaskError(
                f"the Ray cluster at {self._place} has had no core for {_WITHOUT_CORES_S:g} s: "
                f"start a node (ray start --address HOST:PORT); {tasks_left} tasks are left"
            )
        return self._cores


def _compute(
    ray: ModuleType,
    place: str,
    tasks: Sequence[Task],
    on_result: Callable[[Task, pd.DataFrame], None],
) -> None:
    remote = ray.remote(num_cpus=1, max_retries=MOST_ATTEMPTS - 1)(compute_encoded)
    pending = deque(tasks)
    running: dict[Any, Task] = {}
    size = _Size(ray, place)
    try:
        while pending or running:
            cores = size.cores(len(pending) + len(running))
            while pending and len(running) < max(1, _AHEAD * cores):
                task = pending.popleft()
                running[remote.remote(encode_task(task, code_of(task)))] = task
            done, _ = ray.wait(list(running), timeout=_LONGEST_WAIT_S)
            for reference in done:
                task = running.pop(reference)
                on_result(task, table_of(_answer(ray, reference, task)))
    except BaseException:
        # Nobody waits for what they still compute.
        for reference in running:
            # Whatever becomes of one, the others are cancelled, and the first error is told.
            with contextlib.suppress(Exception):
                ray.cancel(reference, force=True)
        raise


def _answer(ray: ModuleType, reference: object, task: Task) -> bytes:
    try:
        return cast(bytes, ray.get(reference))
    except ray.exceptions.RayTaskError as error:
        # Nothing of ours was run: compute_encoded raises nothing.
        raise TaskError(
            f"a node of the cluster cannot compute {task.kind} ({_line_of(error, last=True)}): "
            "install the same holdfast on every node"
        ) from error
    except _lost_with_its_process(ray) as error:
        raise TaskError(
            f"{MOST_ATTEMPTS} processes of the cluster were lost with {task.kind} "
            f"{task.parameters}; often a node is out of memory. Ray says: {_line_of(error)}"
        ) from error
    except ray.exceptions.RayError as error:
        raise TaskError(
            f"the cluster cannot compute {task.kind} {task.parameters}: {_line_of(error)}"
        ) from error


def _lost_with_its_process(ray: ModuleType) -> tuple[type[Exception], ...]:
    names = ("WorkerCrashedError", "NodeDiedError", "LocalRayletDiedError", "OutOfMemoryError")
    return tuple(getattr(ray.exceptions, name) for name in names)


def _line_of(error: BaseException, *, last: bool = False) -> str:
    """Return what an error says in one line; of a traceback, the last one."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    text = " ".join(lines[-1:] if last else lines)
    return text[:_SHOWN_CHARACTERS] or type(error).__name__
