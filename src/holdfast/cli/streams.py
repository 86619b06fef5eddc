"""The standard streams of the command, which may be closed, full, or without a reader.

A standard error that cannot be written is no reason to end a run. The standard output holds
results: a command whose reader has ended (``holdfast simulate --story | head``) ends quietly, as
the system's own tools do.
"""

from __future__ import annotations

import io
import os
import signal
import sys
from typing import TYPE_CHECKING, TextIO

from holdfast.errors import UnwritableOutputError

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer


EXIT_UNREAD = 128 + signal.SIGPIPE
"""The standard output has no reader any more: 141, as after SIGPIPE."""


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


def escape_unencodable() -> None:
    """Escape what the streams' encoding lacks, such as the ü of a path where that is ASCII."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def ignore_unwritable_stderr() -> None:
    """Drop output that cannot be written to the standard error, and go on.

    A full disk, a terminal that is gone or a pipe whose reader has ended would otherwise raise
    wherever something is said, and once more at the end of the process.
    """
    before = sys.stderr
    # Otherwise it was replaced, by a test for instance.
    if before is sys.__stderr__ and isinstance(before, io.TextIOWrapper):
        sys.stderr = _over(before, _LossyFile, line_buffering=True)


def end_with_reader() -> None:
    """End the command when the standard output cannot be written.

    Quietly with :data:`EXIT_UNREAD` if it has no reader, otherwise by an
    :class:`UnwritableOutputError`. Later output, such as the rest of a buffer, is lost.
    """
    before = sys.stdout
    # Otherwise it was replaced, by a test for instance.
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


class _LossyFile(io.FileIO):
    """A file that drops what it cannot write."""

    def write(self, data: ReadableBuffer, /) -> int:
        try:
            written: int | None = super().write(data)
        except OSError:
            written = None
        # None also if it would block: an unread pipe that is set to non-blocking.
        return memoryview(data).nbytes if written is None else written
