"""How a process has ended, and how soon the next one starts in its place."""

from __future__ import annotations

import signal

_MOST_DOUBLINGS = 30


def signal_name(number: int) -> str:
    """Return a signal's name; a real-time signal has none, and is named by its number."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def how_it_ended(code: int) -> str:
    """Describe an exit code, or the negative number of a signal, as a part of a sentence."""
    return f"ended with exit code {code}" if code >= 0 else f"was ended by {signal_name(-code)}"


def restart_delay_s(early_ends: int, first_s: float, last_s: float) -> float:
    """Return the delay before the next start, after so many short lives in a row.

    None after the first; ``first_s`` after the second, doubled with each further one up to
    ``last_s``.
    """
    if early_ends <= 1:
        return 0.0
    return min(first_s * 2.0 ** min(early_ends - 2, _MOST_DOUBLINGS), last_s)
