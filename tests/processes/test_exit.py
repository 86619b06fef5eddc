"""How a process ends that uses the kernel."""

from __future__ import annotations

import subprocess
import sys

IN_A_DAEMON_THREAD = """
import threading, time
import numpy as np
from holdfast.entropy import entropy

points = np.random.default_rng(0).normal(size=(2000, 3))
weights = np.random.default_rng(1).random((64, 2000))
work = lambda: [entropy(points, weights, threads=1) for _ in range(1000)]
threading.Thread(target=work, daemon=True).start()
time.sleep(0.3)
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


def test_a_daemon_thread_in_the_kernel_does_not_abort_the_process() -> None:
    ends_quietly(IN_A_DAEMON_THREAD)


def test_a_problem_that_is_alive_at_the_end_is_no_leak() -> None:
    ends_quietly(ALIVE_AT_THE_END)
