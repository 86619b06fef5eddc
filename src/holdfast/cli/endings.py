"""How a command ends: its exit codes, its last words, and signals that end it in order."""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Iterator, Sequence
from types import TracebackType

from holdfast.errors import HoldfastError
from holdfast.printable import printable
from holdfast.runtime.command_line import wants_json

__all__ = [
    "EXIT_CAN_GO_ON",
    "EXIT_DIFFERENT",
    "EXIT_ERROR",
    "EXIT_SIGNAL",
    "EXIT_WRONG_ANSWER",
    "EndedBySignal",
    "RunError",
    "ended_by_signals",
    "signal_of",
    "tell_defect",
    "tell_error",
]

EXIT_DIFFERENT = 1
"""Two runs that were compared did not decide the same."""

EXIT_ERROR = 2
"""Something that holdfast refuses, or that cannot be done."""

EXIT_WRONG_ANSWER = 3
"""A service answered otherwise than the robot's own planner; events.jsonl says which and when."""

EXIT_CAN_GO_ON = 4
"""An error has ended a run that can go on as soon as the reason is gone."""

EXIT_SIGNAL = 128
"""Added to the number of the signal that ended a run, as shells do it."""


class RunError(HoldfastError):
    """What ended a run.

    Parameters
    ----------
    error : HoldfastError
    command : str or None
        The command that goes on; None if none would.
    exit_code : int

    Attributes
    ----------
    reason : str
    command : str or None
        Both of them; the message has them together.
    exit_code : int
    """

    def __init__(
        self, error: HoldfastError, command: str | None, exit_code: int = EXIT_ERROR
    ) -> None:
        super().__init__(f"{error}\nGo on with: {command}" if command else str(error))
        self.reason = str(error)
        self.command = command
        self.exit_code = exit_code


def tell_error(error: HoldfastError, arguments: Sequence[str]) -> None:
    """Say on the standard error what ended a command: as text, or as the last of its events.

    Parameters
    ----------
    error : HoldfastError
    arguments : sequence of str
        What stands after ``holdfast``; they say which of both.
    """
    if not wants_json(arguments):
        sys.stderr.write(f"holdfast: error: {printable(str(error))}\n")
        return
    from holdfast.runtime.logs import tell_event

    text = error.reason if isinstance(error, RunError) else str(error)
    # The rest, such as lines of the user's code, apart: a value of an event has its bound.
    reason, _, details = text.partition("\n")
    fields = {"reason": reason}
    if details:
        fields["details"] = details
    if isinstance(error, RunError) and error.command:
        fields["resume_command"] = error.command
    component = {"serve": "service", "chaos": "chaos"}.get(arguments[0], "robot")
    tell_event(component, "error", **fields)


def tell_defect(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    """Say on the standard error what nobody has expected, as the interpreter would.

    Parameters
    ----------
    kind, error, trace
        As those of :func:`sys.excepthook`.
    """
    import traceback

    sys.stderr.write(printable("".join(traceback.format_exception(kind, error, trace))))


class EndedBySignal(KeyboardInterrupt):
    """A signal ended the run, with a handler of our own: mostly another one than Ctrl-C's."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.signal = signal.Signals(number)


@contextlib.contextmanager
def ended_by_signals(*, once: bool = False) -> Iterator[None]:
    """Let SIGTERM and SIGHUP end what is inside as Ctrl-C does, and exit with their numbers.

    Parameters
    ----------
    once : bool
        Whether the first signal is the last one that is heard, up to the end of the process, and
        Ctrl-C is one of them: for a command that has processes to end, which more of them would
        keep it from.
    """
    ended = False

    def end(number: int, frame: object) -> None:
        nonlocal ended
        del frame
        ended = True
        # One is enough: another would cut short what the first one began. Of one that has come
        # already when it is to be ignored, Python would complain; so it is heard, for nothing.
        for handled in saved:
            signal.signal(handled, _take_no_notice)
        raise EndedBySignal(number)

    # What is ignored from the start stays so: nohup asks for that.
    numbers = (signal.SIGTERM, signal.SIGHUP, *((signal.SIGINT,) if once else ()))
    saved = {
        number: before
        for number in numbers
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
            signal.signal(number, signal.SIG_IGN if once and ended else before)


def _take_no_notice(number: int, frame: object) -> None:
    del number, frame


def signal_of(interruption: KeyboardInterrupt) -> signal.Signals:
    """Return the signal that interrupted."""
    if isinstance(interruption, EndedBySignal):
        return interruption.signal
    return signal.SIGINT
