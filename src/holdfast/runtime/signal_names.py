"""Names of the signals that have ended a process."""

from __future__ import annotations

import signal

__all__ = ["signal_name"]


def signal_name(number: int) -> str:
    """Return a signal's name; a real-time signal has none, and is told by its number."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
