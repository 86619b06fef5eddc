"""How a command ends: exit codes, the message of an error, and signals that end a run in order."""

from __future__ import annotations

import contextlib
import shlex
import signal
import sys
from collections.abc import Iterator, Sequence

from holdfast.errors import HoldfastError, RunError
from holdfast.printable import printable
from holdfast.runtime.command_line import Options, wants_json

EXIT_DIFFERENT = 1
"""The decisions of two compared runs differ."""

EXIT_ERROR = 2
"""An error: holdfast refuses something, or it cannot be done."""

EXIT_WRONG_ANSWER = 3
"""A service answered otherwise than the robot's own planner; events.jsonl says which and when."""

EXIT_CAN_GO_ON = 4
"""An error ended the run; the run can go on once the reason is gone."""

EXIT_REBOOTED = 5
"""The machine was rebooted; the run goes on once a person says so (``--after-reboot``)."""

EXIT_SIGNAL = 128
"""Added to the number of the signal that ended a run, as shells do it."""


def print_error(error: HoldfastError, arguments: Sequence[str], component: str) -> None:
    """Print what ended a command on the standard error: as text, or as the last of its events."""
    if not wants_json(arguments):
        sys.stderr.write(f"holdfast: error: {printable(str(error))}\n")
        return
    from holdfast.runtime.logs import write_event

    text = error.reason if isinstance(error, RunError) else str(error)
    # The rest, such as lines of the user's code, apart: a value of an event has its bound.
    reason, _, details = text.partition("\n")
    fields = {"reason": reason}
    if details:
        fields["details"] = details
    if isinstance(error, RunError) and error.command:
        fields["resume_command"] = error.command
    write_event(component, "error", **fields)


@contextlib.contextmanager
def goes_on(resuming: Options | None, command: str) -> Iterator[None]:
    """Let an error of the user's code end what is resumed with the command that goes on.

    That code may lack something outside, a licence or a port, that is there the next time.
    """
    try:
        yield
    except RunError:
        raise
    except HoldfastError as error:
        from holdfast.config.user_code import is_of_user

        if resuming is None or not is_of_user(error):
            raise
        again = shlex.join(["holdfast", command, *resuming.words("quiet")])
        raise RunError(error, again, EXIT_CAN_GO_ON) from error


class EndedBySignal(KeyboardInterrupt):
    """A signal other than Ctrl-C's, or one that our handler took, ended the run."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.signal = signal.Signals(number)


@contextlib.contextmanager
def ended_by_signals(*, once: bool = False) -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the block as Ctrl-C does, and exit with their numbers.

    With ``once`` later signals, Ctrl-C included, are ignored up to the end of the process: for a
    command that must end its child processes undisturbed.
    """
    ended = False

    def end(number: int, frame: object) -> None:
        nonlocal ended
        del frame
        ended = True
        # A second signal must not cut the orderly end short. A handler that does nothing, because
        # Python complains of a pending signal that is set to SIG_IGN.
        for handled in saved:
            signal.signal(handled, lambda *_: None)
        raise EndedBySignal(number)

    # A signal that is ignored from the start stays ignored, as nohup expects.
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


def signal_of(interruption: KeyboardInterrupt) -> signal.Signals:
    """Return the signal that interrupted."""
    return interruption.signal if isinstance(interruption, EndedBySignal) else signal.SIGINT


def interrupted_by(interruption: KeyboardInterrupt) -> str:
    """Return the words for a person: ``Interrupted`` after Ctrl-C, else ``Ended by SIGTERM``."""
    number = signal_of(interruption)
    return "Interrupted" if number == signal.SIGINT else f"Ended by {number.name}"


def say_interrupted(how: str, kept: str, command: str) -> None:
    """Print how a command was interrupted, what is kept, and the command that goes on."""
    sys.stderr.write(printable(f"\n{how}. {kept}\nGo on with: {command}\n"))
