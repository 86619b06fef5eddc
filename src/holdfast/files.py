"""Files that are written completely or not at all.

A file is written under a temporary name in the same directory and then renamed. A rename is atomic:
after a crash, and for every reader, the path holds the old file or the new one, never a part.
Directories whose files belong together, such as a key and its certificate, appear the same way.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import select
import stat
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from holdfast.errors import OutputError

__all__ = [
    "NewFile",
    "claim_directory",
    "create_directory_atomically",
    "directory_beside",
    "move_into_place",
    "read_bounded",
    "remove_unfinished",
    "replace_directory",
    "require_free",
    "restore_directory",
    "write_atomically",
]

_MAX_DEFAULT_DIRECTORIES = 10_000

_UNFINISHED = re.compile(r"\..+\.\d+\.tmp")
_LONGEST_WRITE_S = 600.0

_PIPE_TIMEOUT_S = 10.0
_PIPE_PAUSE_S = 0.02


class NewFile(NamedTuple):
    """A file of a new directory.

    Attributes
    ----------
    mode : int
        Its permissions, before the process's umask.
    """

    content: bytes
    mode: int


def read_bounded(path: Path, most: int) -> bytes:
    """Read a file or pipe that the user names, with bounds on size and time.

    A pipe may be a shell's ``<(command)``. Reading fails after 10 s without a writer or data.

    Parameters
    ----------
    most : int
        Maximum number of bytes to read.

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


def write_atomically(path: Path, content: bytes | Iterable[str]) -> None:
    """Write a file atomically; a file that exists is replaced.

    Parameters
    ----------
    content : bytes, str or iterable of str
        Text is encoded as UTF-8, piece by piece.

    Raises
    ------
    OutputError
        If it cannot be written; then the path is unchanged.
    """
    pieces: Iterable[bytes]
    if isinstance(content, bytes):
        pieces = (content,)
    else:
        pieces = (piece.encode() for piece in ((content,) if isinstance(content, str) else content))
    # In the same folder, because a rename is atomic only within one file system.
    temporary = _unfinished(path)
    try:
        with temporary.open("wb") as file:
            file.writelines(pieces)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError):
            raise OutputError(f"{path}: cannot be written: {error.strerror}") from error
        raise


def remove_unfinished(directory: Path, *, below: bool = False) -> None:
    """Remove temporary files of killed writers; a young one may belong to a running writer.

    Parameters
    ----------
    directory : Path
        It may be missing.
    below : bool
        Whether to search its subdirectories, too.
    """
    latest = time.time() - _LONGEST_WRITE_S
    for path in directory.rglob(".*.tmp") if below else directory.glob(".*.tmp"):
        if not _UNFINISHED.fullmatch(path.name):
            continue
        with contextlib.suppress(OSError):
            if path.stat().st_mtime < latest:
                path.unlink()


def _unfinished(path: Path) -> Path:
    """Return the temporary path of a file or directory."""
    return path.with_name(f".{path.name}.{os.getpid()}.tmp")


def create_directory_atomically(path: Path, files: Mapping[str, NewFile]) -> None:
    """Create a directory that only its owner can enter, with all its files, atomically.

    Parameters
    ----------
    path : Path
        Its parent must exist. An empty directory at this path is replaced.
    files : mapping of str to NewFile
        The files by name.

    Raises
    ------
    OutputError
        If the path exists or cannot be written; then nothing is changed.
    """
    temporary = _unfinished(path)
    try:
        temporary.mkdir(mode=0o700)
        for name, new in files.items():
            # The mode is set at creation, so that a key is never readable by others.
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL
            with os.fdopen(os.open(temporary / name, flags, new.mode), "wb") as file:
                file.write(new.content)
                file.flush()
                os.fsync(file.fileno())
        temporary.rename(path)
    except BaseException as error:
        _remove_tree(temporary)
        if isinstance(error, OSError):
            # A rename onto a directory with files fails with one of several errors.
            reason = "it exists already" if path.exists() else error.strerror
            raise OutputError(f"{path}: cannot be created: {reason}") from error
        raise


def replace_directory(path: Path, files: Mapping[str, NewFile]) -> None:
    """Replace a directory; the old one is removed.

    No reader sees files of both. If the process is killed meanwhile, the path may be missing until
    :func:`restore_directory` is called.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    restore_directory(path)
    new, old = _beside(path)
    create_directory_atomically(new, files)
    try:
        path.rename(old)
        new.rename(path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be replaced: {error.strerror}") from error
    _remove_tree(old)


def restore_directory(path: Path) -> None:
    """Complete a replacement whose process was killed, and remove its temporary directories.

    No other process may use the directory meanwhile.

    Raises
    ------
    OutputError
        If the directory cannot be renamed.
    """
    new, old = _beside(path)
    if old.exists() and not path.exists():
        try:
            (new if new.exists() else old).rename(path)
        except OSError as error:
            raise OutputError(f"{path}: cannot be restored: {error.strerror}") from error
    for name in (path.name, new.name):
        for unfinished in path.parent.glob(f".{name}.*.tmp"):
            _remove_tree(unfinished)
    for left in (new, old):
        _remove_tree(left)


def _beside(path: Path) -> tuple[Path, Path]:
    """Return the temporary paths of the new and of the old directory."""
    return path.with_name(f".{path.name}.new"), path.with_name(f".{path.name}.old")


def claim_directory(out: Path | None, parent: Path, name: str) -> Path:
    """Create an empty output directory for a command.

    Parameters
    ----------
    out : Path or None
        The directory; it may exist if it is empty. None: ``name`` in ``parent``, with a number if
        it exists.
    parent : Path
        Created if missing.

    Raises
    ------
    OutputError
        If the directory is not empty or cannot be created.
    """
    try:
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            if any(out.iterdir()):
                raise OutputError(
                    f"{out}: holds files already; remove it, or choose another directory (--out)"
                )
            return out
        parent.mkdir(parents=True, exist_ok=True)
        for number in range(1, _MAX_DEFAULT_DIRECTORIES):
            path = parent / (f"{name}-{number}" if number > 1 else name)
            with contextlib.suppress(FileExistsError):
                path.mkdir()
                return path
    except OSError as error:
        raise OutputError(f"{out or parent}: cannot be made: {error.strerror}") from error
    raise OutputError(f"{parent}: more than {_MAX_DEFAULT_DIRECTORIES} of {name}; give --out")


def require_free(path: Path, option: str, *, directory: bool) -> None:
    """Check that a file or directory can be created: the path is free, and its parent exists.

    Parameters
    ----------
    option : str
        The option that named the path, for messages.
    directory : bool
        Whether to create a directory: then an empty one may exist.

    Raises
    ------
    OutputError
        If it cannot be created.
    """
    try:
        if directory and path.is_dir():
            if any(path.iterdir()):
                raise OutputError(
                    f"{path}: holds files already; remove it, or choose another directory "
                    f"({option})"
                )
        elif path.is_symlink() or path.exists():
            raise OutputError(f"{path}: exists already; remove it, or choose another ({option})")
        elif not path.parent.is_dir():
            raise OutputError(f"{path}: cannot be made: there is no directory {path.parent}")
    except OSError as error:
        raise OutputError(f"{path}: cannot be made: {error.strerror}") from error


@contextlib.contextmanager
def directory_beside(path: Path) -> Iterator[Path]:
    """Create a temporary directory, and remove it after the block.

    Parameters
    ----------
    path : Path
        The final path (:func:`move_into_place`); the directory is created beside it.

    Raises
    ------
    OutputError
        If it cannot be created, or the block raises OSError, as on a full disk.
    """
    temporary = _unfinished(path)
    try:
        temporary.mkdir()
        yield temporary
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        _remove_tree(temporary)


def move_into_place(made: Path, path: Path) -> None:
    """Write a file, or a directory of files, through to the disk, and rename it to its path.

    Raises
    ------
    OutputError
        If a system call fails.
    """
    try:
        for file in sorted(made.iterdir()) if made.is_dir() else [made]:
            descriptor = os.open(file, os.O_RDONLY | os.O_CLOEXEC)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
        made.rename(path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error


def _remove_tree(directory: Path) -> None:
    import shutil  # slow to load, and few processes need it

    shutil.rmtree(directory, ignore_errors=True)
