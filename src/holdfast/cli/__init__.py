"""The command line: from options to a run, and what a person at a terminal sees of it.

Nothing below this package prints or exits. Here an error that holdfast raises on purpose, or that a
problem's own code raises, becomes one message and exit code 2 (3 if a service answered otherwise
than the robot's own planner, 4 if the run can go on). Ctrl-C, SIGTERM and a closed terminal end a
run in order, with 128 and the signal's number; so does a closed reader of the standard output.
Anything else is a defect and keeps its traceback.

Each command has one module, and slow libraries are imported where they are used: ``--help`` and a
mistyped option answer at once, and a service that replaces a dead one starts quickly.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Callable, Sequence
from types import TracebackType


def main(application: Callable[[Sequence[str]], int] | None = None) -> None:
    """Run the command line and exit.

    ``application`` is run with the arguments instead of the commands of ``holdfast``; it returns
    the exit code.
    """
    if os.getpid() == 1:
        # The first process of a container does not get what it has no handler for.
        signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    from holdfast.cli.streams import (
        end_with_reader,
        escape_unencodable,
        ignore_unwritable_stderr,
        replace_closed_streams,
    )
    from holdfast.runtime.descriptors import allow_descriptors

    replace_closed_streams()
    escape_unencodable()
    ignore_unwritable_stderr()
    sys.excepthook = _print_defect
    arguments = sys.argv[1:]
    is_service = False
    try:
        allow_descriptors()
        if application is None:
            from holdfast.cli.application import find_command

            gc.disable()  # importing modules leaves no garbage
            try:
                application, is_service = find_command(arguments)
            finally:
                gc.enable()
            arguments = arguments[1:]
        # A service, and what guards one, go on when nobody reads their output.
        if is_service:
            sys.exit(application(arguments))
        end_with_reader()
        try:
            code = application(arguments)
        finally:
            sys.stdout.flush()
        sys.exit(code)
    except (Exception, KeyboardInterrupt) as error:
        from holdfast.cli.exit_codes import EXIT_ERROR, EXIT_SIGNAL, print_error, signal_of
        from holdfast.errors import HoldfastError, RunError

        # While a class is made, Python 3.11 raises a RuntimeError from Ctrl-C.
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, KeyboardInterrupt):
                sys.exit(EXIT_SIGNAL + signal_of(cause))
            cause = cause.__cause__
        if not isinstance(error, HoldfastError):
            raise
        print_error(error, arguments, "service" if is_service else "robot")
        sys.exit(error.exit_code if isinstance(error, RunError) else EXIT_ERROR)


def _print_defect(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    """Print an unexpected exception with its traceback, as the interpreter would."""
    import traceback

    from holdfast.printable import printable

    sys.stderr.write(printable("".join(traceback.format_exception(kind, error, trace))))
