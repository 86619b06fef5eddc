"""A local socket that only this user's processes can reach, for a service that a robot launches."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Self

from holdfast.errors import TransportError
from holdfast.transport.endpoints import parse_endpoint

__all__ = ["PrivateSocket"]

_SOCKET, _LOCK = "s", "lock"
"""Files in the socket's directory."""


class PrivateSocket:
    """A local socket in a directory that no other user can enter.

    The permissions of the directory, not those of the socket, keep others out: a socket's own are
    set only after it can be connected to. Use it as a context, or call :meth:`remove`. What a
    process leaves that is killed before it can do that, the next one removes.

    Raises
    ------
    TransportError
        If the directory for temporary files has too long a path for a socket.
    """

    def __init__(self) -> None:
        import tempfile  # only robots that launch services need it

        prefix = f"holdfast-{os.getuid()}-"
        _remove_abandoned(Path(tempfile.gettempdir()), prefix)
        self._lock = -1
        while self._lock < 0:
            self._directory = Path(tempfile.mkdtemp(prefix=prefix))  # made with mode 0700
            self._lock = _locked(self._directory)
        self.endpoint = f"unix/{self._directory / _SOCKET}"
        try:
            parse_endpoint(self.endpoint)
        except TransportError as error:
            self.remove()
            raise TransportError(
                f"{error}; set TMPDIR to a directory for temporary files with a shorter path"
            ) from None

    def remove(self) -> None:
        """Remove the socket and its directory. May be repeated."""
        if self._lock >= 0:
            with contextlib.suppress(OSError), _opened(self._directory) as opened:
                _remove_directory(self._directory, opened)
            os.close(self._lock)
            self._lock = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.remove()


def _locked(directory: Path) -> int:
    """Show that a directory is in use until this process ends, however it does.

    Returns -1 if it was taken for an abandoned one before it could be locked.
    """
    lock = os.open(directory / _LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    fcntl.flock(lock, fcntl.LOCK_EX)
    if (directory / _LOCK).exists():
        return lock
    os.close(lock)
    return -1


@contextlib.contextmanager
def _opened(directory: Path) -> Iterator[int]:
    """Open a directory of this user; symbolic links are not followed.

    Raises
    ------
    OSError
        If it is none, or others can enter it.
    """
    opened = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        found = os.fstat(opened)
        if found.st_uid != os.getuid() or stat.S_IMODE(found.st_mode) != 0o700:
            raise PermissionError(errno.EPERM, os.strerror(errno.EPERM), str(directory))
        yield opened
    finally:
        os.close(opened)


def _remove_abandoned(parent: Path, prefix: str) -> None:
    """Remove the directories of sockets whose processes are gone."""
    for directory in parent.glob(f"{prefix}*"):
        # Errors: another user's directory, one that is being made, or one that is gone.
        with contextlib.suppress(OSError), _opened(directory) as opened:
            lock = os.open(_LOCK, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW, dir_fd=opened)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                _remove_directory(directory, opened)
            finally:
                os.close(lock)


def _remove_directory(directory: Path, opened: int) -> None:
    for name in (_SOCKET, _LOCK):
        with contextlib.suppress(FileNotFoundError):
            os.unlink(name, dir_fd=opened)
    directory.rmdir()
