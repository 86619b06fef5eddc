"""How signals are told."""

from __future__ import annotations

import signal

from holdfast.runtime.signal_names import signal_name


def test_by_name_or_by_number() -> None:
    assert signal_name(signal.SIGKILL) == "SIGKILL"
    unnamed = signal.SIGRTMIN + 6
    assert signal_name(unnamed) == f"signal {unnamed:d}"
