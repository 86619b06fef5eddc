"""How a process ends that uses the kernel."""

from __future__ import annotations

import subprocess
import sys

import pytest

# Short calls end when the interpreter does: a thread is then about to ask for it, or waits for it.
IN_DAEMON_THREADS = """
import threading, time
import numpy as np
from holdfast.entropy import entropy

points = np.random.default_rng(0).normal(size=({count}, 3))
weights = np.random.default_rng(1).random((64, {count}))

def work():
    while True:
        entropy(points, weights, threads=1)

for _ in range({threads}):
    threading.Thread(target=work, daemon=True).start()
time.sleep(0.2)
"""

ALIVE_AT_THE_END = """
from holdfast.problems.peg_in_hole_2d import PegInHole2D
problem = PegInHole2D()
"""


def ends_quietly(program: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize(("count", "threads"), [(2000, 1), (50, 8)])
def test_daemon_threads_in_the_kernel_do_not_abort_the_process(count: int, threads: int) -> None:
    ends_quietly(IN_DAEMON_THREADS.format(count=count, threads=threads))


def test_a_problem_that_is_alive_at_the_end_is_no_leak() -> None:
    ends_quietly(ALIVE_AT_THE_END)
