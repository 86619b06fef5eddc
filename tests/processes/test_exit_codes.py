"""How a process ends that uses the kernel."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

# Short calls end when the interpreter does: a thread is then about to ask for it, or waits for it.
IN_DAEMON_THREADS = """
import threading, time
import numpy as np
from holdfast.planning.estimators import entropy

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
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=120
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize(("count", "threads"), [(2000, 1), (50, 8)])
def test_daemon_threads_in_the_kernel_do_not_abort_the_process(count: int, threads: int) -> None:
    ends_quietly(IN_DAEMON_THREADS.format(count=count, threads=threads))


def test_a_problem_that_is_alive_at_the_end_is_no_leak() -> None:
    ends_quietly(ALIVE_AT_THE_END)


@pytest.mark.skipif(os.geteuid() != 0, reason="a namespace of processes takes root")
def test_the_first_process_of_a_container_ends_while_it_starts() -> None:
    """The system gives it no signal that it has no handler for."""
    # It hangs where a start takes long: at the imports.
    program = (
        "import builtins, os, sys, time\n"
        "import holdfast.cli\n"
        "def slow(name, *rest):\n"
        "    builtins.__import__ = really\n"
        "    print(os.getpid(), flush=True)\n"
        "    time.sleep(60)\n"
        "really, builtins.__import__ = builtins.__import__, slow\n"
        "holdfast.cli.main()\n"
    )
    command = ("unshare", "--pid", "--fork", sys.executable, "-c", program)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as unshare:
        assert unshare.stdout is not None
        assert unshare.stdout.readline() == "1\n"
        (child,) = Path(f"/proc/{unshare.pid}/task/{unshare.pid}/children").read_text().split()
        os.kill(int(child), signal.SIGTERM)
        assert unshare.wait(timeout=120) == 128 + signal.SIGTERM
