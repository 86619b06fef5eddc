"""Processes that end with the one that started them."""

import os
import select
import subprocess
import sys

import pytest
from tests.contracts.wires import PATIENCE_S

from holdfast.runtime.parent_death import parent_death_prefix

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="Linux's parent-death signal")

CHILD = "import os, sys; os.write(1, b'up'); sys.stdin.read()"

PARENT = f"""
import subprocess, sys, time
from holdfast.runtime.parent_death import parent_death_prefix
subprocess.Popen(
    [*parent_death_prefix(), sys.executable, "-c", {CHILD!r}], stdin=int(sys.argv[1]),
    stdout=int(sys.argv[2]), close_fds=True,
)
sys.stdin.read()
"""


def test_a_child_ends_when_its_parent_is_killed() -> None:
    # The child's end shows as the end of the pipe that it alone writes to.
    kept_open, unread = os.pipe()
    reading, writing = os.pipe()
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT, str(kept_open), str(writing)],
        stdin=subprocess.PIPE,
        pass_fds=[kept_open, writing],
    )
    os.close(writing)
    assert os.read(reading, 2) == b"up"
    parent.kill()
    parent.communicate()
    assert select.select([reading], [], [], PATIENCE_S)[0]
    assert os.read(reading, 1) == b""
    for descriptor in (kept_open, unread, reading):
        os.close(descriptor)


def test_a_child_whose_parent_is_gone_already_does_not_start() -> None:
    command = list(parent_death_prefix())
    command[-1] = str(os.getpid() + 1)  # not this test's process
    done = subprocess.run([*command, sys.executable, "-c", "print('up')"], capture_output=True)
    assert done.returncode == 1
    assert done.stdout == b""
