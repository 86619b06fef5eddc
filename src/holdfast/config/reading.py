"""Files and endpoints that a person names: of none is more read than it may have."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path


def read_bounded(path: Path, most: int) -> bytes:
    """Read at most so many bytes of a file or pipe that the user names.

    A pipe may be a shell's ``<(command)``; it is waited for, as other tools do. Raises OSError if
    it cannot be read, or is neither a file nor a pipe; ``strerror`` says what is wrong.
    """
    mode = path.stat().st_mode
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not (stat.S_ISREG(mode) or stat.S_ISFIFO(mode)):
        raise OSError(errno.EINVAL, "it is a device or socket, not a file")
    with path.open("rb") as file:
        return file.read(most)


def absolute_endpoint(endpoint: str, directory: Path | None = None) -> str:
    """Return an endpoint, the path of a local socket absolute; by default from where we are now."""
    protocol, _, place = endpoint.partition("/")
    if protocol != "unix" or not place:
        return endpoint
    return f"unix/{(directory or Path.cwd()) / place}"
