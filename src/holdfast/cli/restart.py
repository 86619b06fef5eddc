"""``holdfast run --restart``: starts the run again when its process dies, in a process of its own.

A container engine that restarts a container does so after a reboot, and after its own restart, too;
then a robot would move by itself. So in a container the engine restarts nothing (``restart:
"no"``), and this process, which a person has started with the container, does. It only waits, so
little in it can fail.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from types import FrameType

from holdfast.cli.exit_codes import EXIT_REBOOTED, EXIT_SIGNAL, EXIT_WRONG_ANSWER
from holdfast.runtime.command_line import wants_json
from holdfast.runtime.log_lines import LogFormat
from holdfast.runtime.logs import EventLog
from holdfast.runtime.parent_death import parent_death_prefix
from holdfast.runtime.process_ends import how_it_ended, restart_delay_s

_ENDING = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)

_STEADY_S = 10.0
"""One that has lived for so long is started again at once."""

_FIRST_DELAY_S, _LAST_DELAY_S = 1.0, 30.0
_PAUSE_S = 0.05


def run_until_it_ends(arguments: Sequence[str]) -> int:
    """Run ``holdfast`` with these arguments until it ends for good; return its exit code.

    A signal that ends a run is passed on, and nothing is started after it.
    """
    # -P: modules in the current directory are not imported.
    command = [*parent_death_prefix(), sys.executable, "-P", "-m", "holdfast", *arguments]
    received: list[int] = []
    running: subprocess.Popen[bytes] | None = None

    def pass_on(number: int, frame: FrameType | None) -> None:
        del frame
        received.append(number)
        if running is not None and running.returncode is None:
            os.kill(running.pid, number)

    for number in _ENDING:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, pass_on)
    early_ends = 0
    while True:
        started = time.monotonic()
        # In a session of its own: a terminal's Ctrl-C comes from here, once.
        running = subprocess.Popen(command, start_new_session=True)
        if received:  # before there was anything to pass it on to
            os.kill(running.pid, received[-1])
        code = _wait_for(running)
        running = None
        if received or ends_for_good(code):
            return code if code >= 0 else EXIT_SIGNAL - code
        early_ends = 0 if time.monotonic() - started >= _STEADY_S else early_ends + 1
        delay_s = restart_delay_s(early_ends, _FIRST_DELAY_S, _LAST_DELAY_S)
        until = time.monotonic() + delay_s
        log: LogFormat = "json" if wants_json(arguments) else "text"
        EventLog(sys.stderr, format=log, component="robot").event(
            "process_ended", reason=how_it_ended(code), again_in_s=delay_s
        )
        while not received and time.monotonic() < until:
            time.sleep(_PAUSE_S)
        if received:
            return EXIT_SIGNAL + received[-1]


def ends_for_good(code: int) -> bool:
    """Return whether nothing is started after this exit code; a negative one is a signal's."""
    return code in (0, EXIT_WRONG_ANSWER, EXIT_REBOOTED) or code - EXIT_SIGNAL in _ENDING


def _wait_for(process: subprocess.Popen[bytes]) -> int:
    """Wait for a process, and reap those that became this one's, as a container's first process."""
    while True:
        pid, status = os.wait()
        if pid == process.pid:
            process.returncode = os.waitstatus_to_exitcode(status)
            return process.returncode
