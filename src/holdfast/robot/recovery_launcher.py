"""Starts the local service: a process of the same program that ends with the robot.

It inherits one end of a pair of sockets, and the robot has the other: there is no address, so
nobody else can reach it. It ends when its standard input closes, so it does not survive the robot,
however that dies.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO

from holdfast.protocol.robot_events import RecoveryExited
from holdfast.runtime.files import started_in
from holdfast.runtime.pool import ThreadPool
from holdfast.runtime.process_ends import how_it_ended


class RecoveryLauncher:
    """Starts the local service, watches it, and ends it; all on the thread of an event loop.

    ``attach`` gets the robot's end of the connection to each process. The file at ``log_path`` gets
    what the service writes.
    """

    def __init__(
        self,
        arguments: Sequence[str],
        attach: Callable[[socket.socket], None],
        log_path: Path | None = None,
    ) -> None:
        self._attach = attach
        # -P: files in the current directory must not shadow modules.
        self._command = [sys.executable, "-P", "-m", "holdfast", "serve", *arguments]
        self._log_path = log_path
        self._process: subprocess.Popen[bytes] | None = None
        self._waiting = ThreadPool(1, "holdfast-recovery")

    def launch(self, number: int, deliver: Callable[[RecoveryExited], None]) -> None:
        """Start a process, and end the one before.

        ``deliver`` is called, on the loop, if the process ends other than by :meth:`launch` or
        :meth:`close`; at once if it cannot be started.
        """
        self._end()
        ours, theirs = socket.socketpair()
        ours.setblocking(False)
        try:
            with theirs, self._output() as output:
                process = subprocess.Popen(
                    [*self._command, "--until-stdin-closes", f"--robot={theirs.fileno()}"],
                    pass_fds=[theirs.fileno()],
                    stdin=subprocess.PIPE,
                    stdout=output,
                    stderr=output,
                    # Not where the robot's own code may have gone: a problem may read files.
                    cwd=started_in(),
                    # Ctrl-C is the robot's to answer; it may still need this service to end well.
                    start_new_session=True,
                )
        except OSError as error:
            ours.close()
            deliver(RecoveryExited(number, f"cannot be started: {error.strerror}"))
            return
        self._process = process
        self._attach(ours)
        if process.stdin is not None:
            _close_in_forked_children(process.stdin)

        def ended(code: int) -> None:
            if self._process is process:
                deliver(RecoveryExited(number, self._account_of(code)))

        self._waiting.submit(process.wait, ended)

    def close(self) -> None:
        """End the process, if there is one. May be repeated."""
        self._waiting.close()
        self._end()

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        # It holds nothing that would have to be kept, and it may be stopped or stuck.
        process.kill()
        process.wait()
        if process.stdin is not None:
            with contextlib.suppress(OSError):
                process.stdin.close()

    def _account_of(self, code: int) -> str:
        log = "" if self._log_path is None or code < 0 else f"; see {self._log_path}"
        return f"{how_it_ended(code)}{log}"

    def _output(self) -> contextlib.AbstractContextManager[IO[bytes] | int]:
        if self._log_path is None:
            return contextlib.nullcontext(subprocess.DEVNULL)
        return self._log_path.open("ab")


def _close_in_forked_children(stream: IO[bytes]) -> None:
    """Keep a copy of this process from holding the stream open when this process is gone."""
    kept = weakref.ref(stream)

    def close() -> None:
        inherited = kept()
        if inherited is not None:
            with contextlib.suppress(OSError):
                inherited.close()

    os.register_at_fork(after_in_child=close)
