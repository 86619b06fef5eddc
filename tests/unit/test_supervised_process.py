"""When a process of a service is taken for stuck, with a clock of the test's own."""

from __future__ import annotations

import subprocess
from typing import cast

import pytest

from holdfast.service.metrics import ServiceReport
from holdfast.service.supervisor import _SILENT_S, _START_S, _Child


class Started:
    pid = 7


@pytest.mark.parametrize("serves", [False, True])
def test_one_that_says_nothing_is_stuck_after_a_while(*, serves: bool) -> None:
    child = _Child(cast("subprocess.Popen[bytes]", Started()))
    if serves:
        child.report = ServiceReport()
    bound_s = _SILENT_S if serves else _START_S
    assert child.trouble(child.heard_at + bound_s) is None
    told = child.trouble(child.heard_at + bound_s + 0.1)
    assert told == f"process 7 has said nothing for {bound_s:.0f} s"
