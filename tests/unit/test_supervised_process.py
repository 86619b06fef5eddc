"""When a process of a service is taken for stuck, and killed; the test is the clock."""

import subprocess
from typing import cast

import pytest

from holdfast.service.metrics import ServiceReport
from holdfast.service.supervisor import _KILL_S, _SILENT_S, _START_S, _Child

WATCHDOG_S = 20.0


class Started:
    pid = 7
    killed = False

    def kill(self) -> None:
        self.killed = True


@pytest.mark.parametrize("serves", [False, True])
def test_one_that_says_nothing_is_stuck_after_a_while(*, serves: bool) -> None:
    process = Started()
    child = _Child(cast("subprocess.Popen[bytes]", process))
    if serves:
        child.report = ServiceReport()
    bound_s = _SILENT_S if serves else _START_S
    for _ in range(bound_s):
        child.note_second(WATCHDOG_S)
    assert child.trouble() is None
    child.note_second(WATCHDOG_S)
    assert child.trouble() == f"process 7 has said nothing for {bound_s + 1} s"
    assert not process.killed
    # One that starts may have a problem to load; systemd and a cluster see /livez.
    for _ in range(int(WATCHDOG_S) + _KILL_S - _SILENT_S):
        child.note_second(WATCHDOG_S)
    assert process.killed == serves == str(child.failure).startswith("said nothing for 26 s, so")
