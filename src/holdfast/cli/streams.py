"""The standard streams of the command, which may be closed, full, or read by nobody any more.

What is said there is for whoever looks on. Nobody looking on is no reason to end a run.
"""

from __future__ import annotations

import io
import os
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

__all__ = ["forgive_unwritable_errors", "replace_closed_streams"]


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
    if before is not sys.__stderr__ or not isinstance(before, io.TextIOWrapper):
        return  # somebody else's
    try:
        descriptor = before.fileno()
    except (OSError, ValueError):
        return
    sys.stderr = io.TextIOWrapper(
        io.BufferedWriter(_ForgivingFile(descriptor, "w", closefd=False)),
        encoding=before.encoding,
        errors=before.errors,
        line_buffering=True,
    )


class _ForgivingFile(io.FileIO):
    """A file of which whatever cannot be written counts as written."""

    def write(self, data: ReadableBuffer, /) -> int:
        try:
            written: int | None = super().write(data)
        except OSError:
            written = None
        # None also if it would block: an unread pipe that somebody else has set so.
        return memoryview(data).nbytes if written is None else written
