"""What a process that ends still waits for."""

from __future__ import annotations

import subprocess
import sys
import threading
import time

from holdfast.runtime.last_threads import join_until

CLOSED_AT_EXIT = """
import atexit, sys, threading, time
from holdfast.runtime.last_threads import join_until

def work():
    time.sleep(float(sys.argv[1]))
    print("done", flush=True)

thread = threading.Thread(target=work, daemon=True)
thread.start()
atexit.register(lambda: join_until([thread], time.monotonic() + 0.05))
"""


def output_of(seconds: float) -> str:
    done = subprocess.run(
        [sys.executable, "-c", CLOSED_AT_EXIT, str(seconds)],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


def test_one_that_is_left_by_what_is_called_at_exit_is_waited_for() -> None:
    assert output_of(0.5) == "done\n"


def test_one_that_never_ends_is_not_waited_for_for_ever() -> None:
    assert output_of(1e6) == ""


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
