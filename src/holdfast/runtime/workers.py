"""Worker processes, each with a pipe of its own.

They replace ``concurrent.futures`` for two reasons: when a worker is killed, the message must say
what it was computing, and on Ctrl-C the workers must end at once. No thread stands between the
processes, so a worker can be killed without waiting.
"""

from __future__ import annotations

import atexit
import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import weakref
from collections.abc import Callable, Iterable, Iterator
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from types import ModuleType
from typing import Any

from holdfast.runtime.parent_death import end_with_parent
from holdfast.runtime.process_ends import signal_name
from holdfast.runtime.ray_workers import RayProcess

_ENDING_SIGNALS = frozenset({signal.SIGINT, signal.SIGTERM, signal.SIGHUP})

_END_S = 10.0

_STARTING = threading.Lock()

_STARTED: weakref.WeakSet[WorkerProcess] = weakref.WeakSet()


@atexit.register
def _kill_remaining() -> None:
    """Kill workers at exit: they block the signal with which multiprocessing would end them."""
    for worker in list(_STARTED):
        with contextlib.suppress(ValueError):
            worker.kill()


class WorkerProcess:
    """A worker process as its parent sees it.

    It ends with this process, however this one ends (Linux), and blocks the signals that a terminal
    or a batch system sends to all processes: only the parent handles them. Store the object before
    you call :meth:`start`, so that an interrupt cannot lose a started worker.

    ``work`` is a module's function, called with its end of the pipe and ``arguments``, which must
    be picklable; ``threads`` are those of NumPy's BLAS in the worker; ``connection`` is this end of
    the pipe, for :func:`multiprocessing.connection.wait`.
    """

    def __init__(
        self, name: str, work: Callable[..., None], arguments: tuple[Any, ...], threads: int
    ) -> None:
        context = multiprocessing.get_context("spawn")
        self._threads = threads
        self.connection, self._theirs = context.Pipe()
        self._process: SpawnProcess | RayProcess = context.Process(
            target=_begin, args=(os.getpid(), work, self._theirs, arguments), name=name, daemon=True
        )

    def start(self) -> None:
        """Start it, once."""
        # Started first, because its start would undo the mask set below.
        resource_tracker.ensure_running()
        _STARTED.add(self)
        # One at a time: two threads that run trials would restore what the other one has set.
        with _STARTING, _inherited_by_children(self._threads):
            self._process.start()
        # Only the child must hold this end, else its death would not close the pipe.
        self._theirs.close()

    def send(self, message: bytes) -> None:
        """Send a message; a dead worker shows when its pipe is read."""
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self.connection.send_bytes(message)

    def receive(self) -> bytes | None:
        """Wait for its next message; return None if it has ended."""
        try:
            return self.connection.recv_bytes()
        except (EOFError, OSError):
            return None

    def kill(self) -> None:
        """End it at once, if it was started; it is not waited for."""
        if self._process.pid is not None:
            self._process.kill()

    def how_it_ended(self) -> tuple[str, bool]:
        """Return how it ended, as a part of a sentence, and whether a signal did it."""
        self._process.join(_END_S)
        if isinstance(self._process, RayProcess):
            return self._process.how, True
        code = self._process.exitcode
        if code is not None and code < 0:
            return f"was killed by {signal_name(-code)}", True
        return f"ended with exit code {code}", False


def end_workers(workers: Iterable[WorkerProcess]) -> None:
    """Kill workers and wait until they are gone; may be repeated."""
    workers = list(workers)
    started = [worker for worker in workers if worker._process.pid is not None]
    with _no_signals():
        for worker in started:
            worker.kill()
    for worker in started:
        worker._process.join()
    for worker in workers:
        worker.connection.close()
        worker._theirs.close()


@contextlib.contextmanager
def _inherited_by_children(threads: int) -> Iterator[None]:
    """Start children with few threads, and with the signals blocked that end a run.

    Ctrl-C, a closed terminal and a batch system's SIGTERM reach every process of the group, and
    only the parent handles them. Blocking them here also covers the child's first moments.

    They do not import the parent's main module: a user's script would begin anew in each.
    """
    variables = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    saved = {name: os.environ.get(name) for name in variables}
    os.environ.update(dict.fromkeys(variables, str(threads)))
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        with _no_signals():
            yield
    finally:
        sys.modules["__main__"] = main
        for name, value in saved.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextlib.contextmanager
def _no_signals() -> Iterator[None]:
    """Block the ending signals inside."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    late: KeyboardInterrupt | None = None
    try:
        # A signal that came just before may be raised here, when they are blocked already.
        try:
            signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING_SIGNALS)
        except KeyboardInterrupt as interruption:
            late = interruption
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    if late is not None:
        raise late


def _begin(
    parent: int, work: Callable[..., None], connection: Connection, arguments: tuple[Any, ...]
) -> None:
    end_with_parent(parent)
    # The parent may end at any time.
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        work(connection, *arguments)
