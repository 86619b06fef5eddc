"""What a process that ends still waits for."""

from __future__ import annotations

import subprocess
import sys
import threading
import time

import pytest

from holdfast.runtime.last_threads import join_until

CLOSED_AT_EXIT = """
import atexit, sys, threading, time
from holdfast.runtime import last_threads

def work():
    time.sleep(float(sys.argv[1]))
    print("done", flush=True)

thread = threading.Thread(target=work, daemon=True)
thread.start()
atexit.register(lambda: last_threads.join_until([thread], time.monotonic() + 0.05))
"""

IN_BRIEF = """
last_threads._EXIT_TIMEOUT_S = 0.1
last_threads._EXIT_TIMEOUT_WITH_STATUS_S = 0.1
"""


def ended(program: str, seconds: float) -> tuple[int, str, str]:
    done = subprocess.run(
        [sys.executable, "-c", program, str(seconds)], capture_output=True, text=True, timeout=60
    )
    return done.returncode, done.stdout, done.stderr


def test_one_that_is_left_by_what_is_called_at_exit_is_waited_for() -> None:
    assert ended(CLOSED_AT_EXIT, 0.5) == (0, "done\n", "")


def test_one_that_never_ends_is_not_waited_for_for_ever() -> None:
    assert ended(CLOSED_AT_EXIT + IN_BRIEF, 1e6) == (0, "", "")


@pytest.mark.parametrize("seconds", [0.0, 1e6])
def test_a_process_ends_with_the_status_that_was_told(seconds: float) -> None:
    program = CLOSED_AT_EXIT + IN_BRIEF + "last_threads.end_with(3)\n"
    program += "thread.join(0.1)\nprint('told', end='')\nsys.exit(3)\n"
    before = "done\n" if seconds == 0.0 else ""
    assert ended(program, seconds) == (3, before + "told", "")


def test_not_beyond_the_deadline() -> None:
    go = threading.Event()
    threads = [threading.Thread(target=go.wait, daemon=True) for _ in range(2)]
    for thread in threads:
        thread.start()
    join_until(threads, time.monotonic() + 0.01)
    assert all(thread.is_alive() for thread in threads)
    go.set()
    join_until(threads, time.monotonic() + 30.0)
    assert not any(thread.is_alive() for thread in threads)
