"""Starts the local service: a process of the same program that ends with the robot.

It connects to the robot, which already listens, so that no discovery is needed. It ends when its
standard input closes, so it does not survive the robot, however that dies.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO

from holdfast.protocol.events import RecoveryExited

__all__ = ["RecoveryLauncher"]


class RecoveryLauncher:
    """Starts the local service, watches it, and ends it.

    ``deliver`` is called from a thread when a process ends other than by :meth:`launch` or
    :meth:`close`; the file at ``log_path`` gets what the service writes.
    """

    def __init__(
        self,
        arguments: Sequence[str],
        deliver: Callable[[RecoveryExited], None],
        log_path: Path | None = None,
    ) -> None:
        # -P: files in the current directory must not shadow modules.
        self._command = [sys.executable, "-P", "-m", "holdfast", "serve", *arguments]
        self._deliver = deliver
        self._log_path = log_path
        self._process: subprocess.Popen[bytes] | None = None
        self._lock = threading.Lock()

    def launch(self, number: int) -> None:
        """Start a process, and end the one before; whatever goes wrong is delivered."""
        self.close()
        try:
            with self._output() as output:
                process = subprocess.Popen(
                    self._command,
                    stdin=subprocess.PIPE,
                    stdout=output,
                    stderr=output,
                    # Ctrl-C is the robot's to answer; it may still need this service to end well.
                    start_new_session=True,
                )
        except OSError as error:
            self._deliver(RecoveryExited(number, f"cannot be started: {error.strerror}"))
            return
        self._process = process
        if process.stdin is not None:
            _close_in_forked_children(process.stdin)
        threading.Thread(
            target=self._watch, args=(process, number), name="holdfast-recovery", daemon=True
        ).start()

    def close(self) -> None:
        """End the process, if there is one."""
        with self._lock:
            process, self._process = self._process, None
        if process is None:
            return
        # It holds nothing that would have to be kept, and it may be stopped or stuck.
        process.kill()
        process.wait()
        if process.stdin is not None:
            with contextlib.suppress(OSError):
                process.stdin.close()

    def _watch(self, process: subprocess.Popen[bytes], number: int) -> None:
        code = process.wait()
        with self._lock:
            if self._process is not process:
                return
        if code < 0:
            reason = f"was ended by {signal.Signals(-code).name}"
        else:
            reason = f"ended with exit code {code}"
            if self._log_path is not None:
                reason += f"; see {self._log_path}"
        self._deliver(RecoveryExited(number, reason))

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
