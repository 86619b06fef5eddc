"""The standard streams of the command, which may be closed, full, or read by nobody any more.

What is said on the standard error is for whoever looks on. Nobody looking on is no reason to end a
run. What is written to the standard output was asked for: a command whose reader has had enough
(``holdfast simulate --story | head``) ends as the system's own tools do, without a word.
"""

from __future__ import annotations

import io
import os
import signal
import sys
from typing import TYPE_CHECKING, TextIO

from holdfast.errors import HoldfastError

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

__all__ = [
    "EXIT_UNREAD",
    "UnwritableOutputError",
    "end_with_the_reader",
    "forgive_unwritable_errors",
    "replace_closed_streams",
]

EXIT_UNREAD = 128 + signal.SIGPIPE
"""Nobody reads the standard output any more: 141, as of a program that SIGPIPE has ended."""


class UnwritableOutputError(HoldfastError):
    """The standard output cannot be written, for another reason than that nobody reads it."""


def replace_closed_streams() -> None:
    """Give a process that was started without a terminal or file (``2>&-``) somewhere to write.

    It also keeps the three first descriptors taken, which otherwise the next file would get, and
    with it whatever a library writes to "the standard error".
    """
    for descriptor, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        if getattr(sys, name) is None:
            stream = open(os.devnull, mode)  # noqa: SIM115, PTH123 - open as long as the process
            if stream.fileno() != descriptor:
                os.dup2(stream.fileno(), descriptor)
            setattr(sys, name, stream)


def forgive_unwritable_errors() -> None:
    """Let what cannot be written to the standard error be lost, and nothing else.

    A full disk, a terminal that is gone or a pipe whose reader has ended would otherwise raise
    wherever something is said, and once more at the end of the process.
    """
    before = sys.stderr
    # Else it is somebody else's.
    if before is sys.__stderr__ and isinstance(before, io.TextIOWrapper):
        sys.stderr = _over(before, _ForgivingFile, line_buffering=True)


def end_with_the_reader() -> None:
    """Let what cannot be written to the standard output end the command.

    Quietly with :data:`EXIT_UNREAD` if nobody reads it, else by an :class:`UnwritableOutputError`;
    what comes after that, such as what is still buffered, is lost.
    """
    before = sys.stdout
    # Else it is somebody else's.
    if before is sys.__stdout__ and isinstance(before, io.TextIOWrapper):
        sys.stdout = _over(before, _EndingFile)


def _over(
    stream: io.TextIOWrapper, kind: type[io.FileIO], *, line_buffering: bool = False
) -> TextIO:
    """Return a stream like another, over a file of its descriptor; that one if it has none."""
    try:
        descriptor = stream.fileno()
    except (OSError, ValueError):
        return stream
    return io.TextIOWrapper(
        io.BufferedWriter(kind(descriptor, "w", closefd=False)),
        encoding=stream.encoding,
        errors=stream.errors,
        line_buffering=line_buffering or stream.line_buffering or stream.write_through,
    )


class _EndingFile(io.FileIO):
    """A file that ends the program, once, when it cannot be written."""

    _ends = False

    def write(self, data: ReadableBuffer, /) -> int:
        if self._ends:
            return memoryview(data).nbytes
        try:
            return super().write(data)
        except BrokenPipeError:
            self._ends = True
            raise SystemExit(EXIT_UNREAD) from None
        except OSError as error:
            self._ends = True
            raise UnwritableOutputError(
                f"the standard output cannot be written: {error.strerror}"
            ) from error


class _ForgivingFile(io.FileIO):
    """A file of which whatever cannot be written counts as written."""

    def write(self, data: ReadableBuffer, /) -> int:
        try:
            written: int | None = super().write(data)
        except OSError:
            written = None
        # None also if it would block: an unread pipe that somebody else has set so.
        return memoryview(data).nbytes if written is None else written
