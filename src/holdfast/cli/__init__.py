"""The command line: options in, a run, and what a person at a terminal wants to see of it.

Nothing below this package prints or exits. Here an error that holdfast raises on purpose, or that a
problem's own code raises, becomes one message and exit code 2, or 3 if services answered otherwise
than the robot's own planner; Ctrl-C, SIGTERM and a terminal that
is closed end a run in order, with 128 and the signal's number; so does, with SIGPIPE's, a reader of
the standard output that has ended; and anything else is a defect and keeps its traceback.

There is one module for each command, and libraries that take long to import are imported where they
are used, so that ``--help`` and a mistyped option answer at once. ``serve`` goes past all of it: a
service that is started because another one died is waited for, and need not wait for a command
line that is made for people.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from types import TracebackType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from holdfast.service.beside import Beside
    from holdfast.service.options import Options

__all__ = ["main"]


def main() -> None:
    """Run the command line and exit."""
    if os.getpid() == 1:
        # The first process of a container does not get what it has no handler for.
        signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    from holdfast.cli.streams import (
        end_with_the_reader,
        forgive_unwritable_errors,
        replace_closed_streams,
    )
    from holdfast.errors import HoldfastError
    from holdfast.runtime.descriptors import allow_descriptors

    replace_closed_streams()
    forgive_unwritable_errors()
    sys.excepthook = _tell_defect
    arguments = sys.argv[1:]
    try:
        allow_descriptors()
        if arguments[:1] == ["serve"]:
            from holdfast.service.process import main as serve

            sys.exit(serve(arguments[1:], _make_beside))
        from holdfast.cli.application import run_application

        end_with_the_reader()
        try:
            run_application(arguments)
        finally:
            sys.stdout.flush()
    except HoldfastError as error:
        from holdfast.cli.endings import EXIT_ERROR, RunError, tell_error

        tell_error(error, arguments)
        sys.exit(error.exit_code if isinstance(error, RunError) else EXIT_ERROR)
    except KeyboardInterrupt as interruption:
        from holdfast.cli.endings import EXIT_SIGNAL, signal_of

        sys.exit(EXIT_SIGNAL + signal_of(interruption))


def _make_beside(options: Options) -> Sequence[Beside]:
    from holdfast.cli.ros_services import make_ros_services

    return make_ros_services(options)


def _tell_defect(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    from holdfast.cli.endings import tell_defect

    tell_defect(kind, error, trace)
