"""How a command ends: its exit codes, and signals that end it in order."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator

__all__ = [
    "EXIT_DIFFERENT",
    "EXIT_ERROR",
    "EXIT_SIGNAL",
    "EndedBySignal",
    "ended_by_signals",
    "signal_of",
]

EXIT_DIFFERENT = 1
"""Two runs that were compared did not decide the same."""

EXIT_ERROR = 2
"""Something that holdfast refuses, or that cannot be done."""

EXIT_SIGNAL = 128
"""Added to the number of the signal that ended a run, as shells do it."""


class EndedBySignal(KeyboardInterrupt):
    """A signal other than Ctrl-C's ended the run."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.signal = signal.Signals(number)


@contextlib.contextmanager
def ended_by_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end what is inside as Ctrl-C does, and exit with their numbers."""

    def end(number: int, frame: object) -> None:
        del frame
        # One is enough: another would cut short what the first one began.
        for handled in saved:
            signal.signal(handled, signal.SIG_IGN)
        raise EndedBySignal(number)

    # What is ignored from the start stays so: nohup asks for that.
    saved = {
        number: before
        for number in (signal.SIGTERM, signal.SIGHUP)
        if (before := signal.getsignal(number)) is not signal.SIG_IGN
    }
    try:
        for number in saved:
            signal.signal(number, end)
        yield
    except KeyboardInterrupt as interruption:
        raise SystemExit(EXIT_SIGNAL + signal_of(interruption)) from None
    finally:
        for number, before in saved.items():
            signal.signal(number, before)


def signal_of(interruption: KeyboardInterrupt) -> signal.Signals:
    """Return the signal that interrupted."""
    if isinstance(interruption, EndedBySignal):
        return interruption.signal
    return signal.SIGINT
