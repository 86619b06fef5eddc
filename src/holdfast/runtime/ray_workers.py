"""Workers on a Ray cluster: an actor takes the place of a worker's process.

A thread of this process carries the messages between the worker's pipe and the actor, so whoever
waits for pipes and replaces what has died does the same for both. Nodes need the same holdfast and
the modules of the problem at the same path.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import signal
import socket
import threading
from multiprocessing.connection import Connection
from typing import Self

from holdfast.errors import HoldfastError, InvalidValueError, how_to_install
from holdfast.printable import one_line

_ERROR = 40  # the level of Python's logging
_CONNECT_S = 10.0
_END_S = 5.0
_MAX_TEXT = 300


class RayCluster:
    """A cluster that this process has joined, to be used in a ``with`` statement.

    Its address is ``auto`` (that of this machine), ``HOST:PORT`` (this machine is one of its nodes)
    or ``ray://HOST:PORT`` (of its client server; Ray's usual port is 10001). Raises
    InvalidValueError if Ray is not installed; HoldfastError if the cluster cannot be joined, or has
    no core.
    """

    def __init__(self, address: str) -> None:
        self._address = address
        try:
            self.ray = importlib.import_module("ray")
        except ImportError as error:
            advice = how_to_install("ray[client]", "ray")
            raise InvalidValueError(f"Ray cannot be imported ({error}): {advice}") from error

    def __enter__(self) -> Self:
        handler = signal.getsignal(signal.SIGTERM)
        try:
            host, _, port = self._address.removeprefix("ray://").rpartition(":")
            if host and port.isdecimal():  # Ray would try for minutes
                socket.create_connection((host.strip("[]"), int(port)), _CONNECT_S).close()
            self.ray.init(address=self._address, logging_level=_ERROR, log_to_driver=False)
            self.cores = int(self.ray.cluster_resources().get("CPU", 0))
            if not self.cores:
                raise ValueError("it has no core")  # noqa: TRY301
        except Exception as error:
            self.ray.shutdown()
            raise HoldfastError(
                f"no Ray cluster can be used at {self._address}: {_line_of(error)}"
            ) from error
        finally:
            # Ray sets its own, which exits.
            if threading.current_thread() is threading.main_thread():
                signal.signal(signal.SIGTERM, handler)
        return self

    def __exit__(self, *exception: object) -> None:
        self.ray.shutdown()


class RayProcess:
    """An actor in place of a process: its class's ``all_answers`` gets a message, returns several.

    ``how`` it ended is the predicate of a sentence.
    """

    def __init__(self, cluster: RayCluster, runner: type, pipe: Connection, threads: int) -> None:
        self._ray = cluster.ray
        self._runner, self._threads = runner, threads
        self._given = pipe
        self._thread = threading.Thread(target=self._carry, daemon=True)
        self.pid: int | None = None
        self.how = "was lost"

    def start(self) -> None:
        """Ask the cluster for the actor."""
        self.pid = 0
        self._pipe = Connection(os.dup(self._given.fileno()))  # the caller closes the other one
        self._actor = self._ray.remote(num_cpus=1)(self._runner).remote(self._threads)
        self._thread.start()

    def _carry(self) -> None:
        with self._pipe:
            try:
                while True:
                    # All at once: Ray's client knows no generators.
                    asked = self._actor.all_answers.remote(self._pipe.recv_bytes())
                    for answer in self._ray.get(asked):
                        self._pipe.send_bytes(answer)
            except (EOFError, OSError):
                return
            except Exception as error:  # noqa: BLE001 - whatever it is, the worker is lost
                self.how = f"was lost ({_line_of(error)})"

    def kill(self) -> None:
        """End the actor at once."""
        self.pid = None
        with contextlib.suppress(Exception):  # the cluster may be gone
            self._ray.kill(self._actor)

    def join(self, timeout: float | None = _END_S) -> None:
        """Wait until nothing is carried any more."""
        if self._thread.is_alive():
            self._thread.join(timeout)


def _line_of(error: BaseException) -> str:
    return one_line(" ".join(str(error).split()))[:_MAX_TEXT] or type(error).__name__
