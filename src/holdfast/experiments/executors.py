"""Where tasks are computed: in this process, or in others.

All places give the same results, for a task is a function of its parameters; they differ in time
alone. A process that is killed takes nothing with it but the tasks that it had: they are computed
again elsewhere, and only a task that has cost its process its life several times is given up.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
from collections import Counter, deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Protocol

from holdfast.errors import InvalidValueError
from holdfast.experiments.tables import Table
from holdfast.experiments.tasks import Task, TaskError, run_task
from holdfast.runtime.command_line import MAX_JOBS
from holdfast.runtime.trials import inherited_by_children

__all__ = ["Executor", "LocalExecutor"]


_MOST_ATTEMPTS = 3
"""A task that is lost with its process this often is given up."""

_AHEAD = 2
"""Tasks that wait for each process, so that none is idle between two."""

_PR_SET_PDEATHSIG = 1


class Executor(Protocol):
    """Computes tasks somewhere."""

    @property
    def description(self) -> str:
        """Where, for people."""
        ...

    def run(self, tasks: Sequence[Task], on_result: Callable[[Task, Table], None]) -> None:
        """Compute tasks.

        Parameters
        ----------
        tasks : sequence of Task
            Begun in this order.
        on_result : callable
            Called in this process with each task and what it came to, in any order.

        Raises
        ------
        TaskError
            If a task cannot be computed, or was lost with its process several times.
        HoldfastError
            If the function of a task refuses its parameters.
        KeyboardInterrupt
            After everything that it started has been ended.
        """
        ...


class LocalExecutor:
    """Computes tasks in processes of this machine.

    Parameters
    ----------
    processes : int
        1 computes all of them in this one.
    """

    def __init__(self, processes: int) -> None:
        if not 1 <= processes <= MAX_JOBS:
            raise InvalidValueError(f"--jobs {processes}: must be from 1 to {MAX_JOBS}")
        self._processes = processes

    @property
    def description(self) -> str:
        """Where, for people."""
        return "this process" if self._processes == 1 else f"{self._processes} processes"

    def run(self, tasks: Sequence[Task], on_result: Callable[[Task, Table], None]) -> None:
        """Compute tasks; see :meth:`Executor.run`."""
        if self._processes == 1 or len(tasks) <= 1:
            for task in tasks:
                on_result(task, run_task(task))
            return
        attempts: Counter[int] = Counter()
        pending = deque(enumerate(tasks))
        while pending:
            # A pool that lost a process is of no use any more; what it had is not lost.
            lost = self._run_pool(pending, on_result)
            attempts.update(number for number, _ in lost)
            for number, task in lost:
                if attempts[number] >= _MOST_ATTEMPTS:
                    raise TaskError(
                        f"a process was killed {attempts[number]} times while it computed "
                        f"{task.kind} {task.parameters}; often the machine is out of memory: "
                        "fewer processes (--jobs) need less"
                    )
            pending.extendleft(reversed(lost))

    def _run_pool(
        self, pending: deque[tuple[int, Task]], on_result: Callable[[Task, Table], None]
    ) -> list[tuple[int, Task]]:
        """Compute as long as no process is killed; return the tasks that were lost with one."""
        running: dict[Future[Table], tuple[int, Task]] = {}
        processes = min(self._processes, len(pending))
        others = set(multiprocessing.active_children())
        pool = ProcessPoolExecutor(
            processes,
            multiprocessing.get_context("spawn"),
            initializer=_end_with_parent,
            initargs=(os.getpid(),),
        )
        try:
            broken = False
            while not broken and (pending or running):
                while pending and len(running) < _AHEAD * processes:
                    # The first ones start the processes. One thread each: there are enough.
                    with inherited_by_children(1):
                        running[pool.submit(run_task, pending[0][1])] = pending[0]
                    pending.popleft()
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    if isinstance(future.exception(), BrokenProcessPool):
                        broken = True
                    else:
                        _, task = running.pop(future)
                        on_result(task, future.result())
        except BrokenProcessPool:
            pass  # between two tasks
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            # Nobody waits for what they still compute.
            for process in set(multiprocessing.active_children()) - others:
                process.kill()
                process.join()
        return sorted(running.values(), key=lambda entry: entry[0])


def _end_with_parent(parent: int) -> None:
    """Let this process end when its parent is killed: nobody is left who wants what it computes."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)
