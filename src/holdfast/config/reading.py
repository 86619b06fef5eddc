"""Files and endpoints that a person names: nothing is waited for, or read, for ever."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import stat
import time
from pathlib import Path

__all__ = ["absolute_endpoint", "read_bounded"]

_PIPE_TIMEOUT_S = 10.0
_PIPE_PAUSE_S = 0.02


def read_bounded(path: Path, most: int) -> bytes:
    """Read at most so many bytes of a file or pipe that the user names.

    A pipe may be a shell's ``<(command)``. Reading fails after 10 s without a writer or data.

    Raises
    ------
    OSError
        If it cannot be read, or is neither a file nor a pipe; ``strerror`` says what is wrong.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        mode = os.fstat(descriptor).st_mode
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if stat.S_ISFIFO(mode):
            return _read_pipe(descriptor, most, named=not path.is_symlink())
        if not stat.S_ISREG(mode):
            raise OSError(errno.EINVAL, "it is a device or socket, not a file")
        with os.fdopen(descriptor, "rb", closefd=False) as file:
            return file.read(most)
    finally:
        os.close(descriptor)


def _read_pipe(descriptor: int, most: int, *, named: bool) -> bytes:
    content = bytearray()
    deadline = time.monotonic() + _PIPE_TIMEOUT_S
    poll = select.poll()
    poll.register(descriptor, select.POLLIN)
    while len(content) < most:
        piece = b""
        left_s = deadline - time.monotonic()
        if left_s <= 0.0:
            raise TimeoutError(
                errno.ETIMEDOUT,
                f"it is a pipe, and no data arrived for {_PIPE_TIMEOUT_S:g} s",
            )
        if not poll.poll(1e3 * left_s):
            continue
        with contextlib.suppress(BlockingIOError):
            piece = os.read(descriptor, most - len(content))
            if not piece and (content or not named):
                break
        if piece:
            content += piece
            deadline = time.monotonic() + _PIPE_TIMEOUT_S
        else:
            # The pipe has no writer yet.
            time.sleep(_PIPE_PAUSE_S)
    return bytes(content)


def absolute_endpoint(endpoint: str, directory: Path | None = None) -> str:
    """Return an endpoint, the path of a local socket absolute; by default from where we are now."""
    protocol, _, place = endpoint.partition("/")
    if protocol != "unix" or not place:
        return endpoint
    return f"unix/{(directory or Path.cwd()) / place}"
