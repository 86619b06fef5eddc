"""Files that are there whole or not at all.

A file is written beside its place and then renamed to it, because a rename happens at once: a
reader, or a crash, meets the old file or the new one, never a part. Directories whose files belong
together, a key and its certificate, appear the same way.
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

from holdfast.errors import HoldfastError

__all__ = [
    "NewFile",
    "OutputError",
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


class OutputError(HoldfastError):
    """The output of a run cannot be written or read, or does not belong to this run."""


class NewFile(NamedTuple):
    """A file of a new directory.

    Attributes
    ----------
    content : bytes
    mode : int
        Its permissions; what the process's umask forbids is taken away from them.
    """

    content: bytes
    mode: int


def read_bounded(path: Path, most: int) -> bytes:
    """Read a file that a person names, and neither wait for ever nor read without end.

    A pipe is read, too: a shell's ``<(command)`` is one. It is waited for as long as there is no
    writer yet, or nothing comes, but only so long.

    Parameters
    ----------
    path : Path
    most : int
        Bytes after which nothing more is read.

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
                f"it is a pipe through which nothing came for {_PIPE_TIMEOUT_S:g} s",
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
            # Nobody has opened it for writing yet.
            time.sleep(_PIPE_PAUSE_S)
    return bytes(content)


def write_atomically(path: Path, content: bytes | Iterable[str]) -> None:
    """Write a file so that no reader, and no crash, ever sees a part of it.

    Parameters
    ----------
    path : Path
        Where it shall be; what is there already is replaced.
    content : bytes, str or iterable of str
        Text is encoded as UTF-8, piece by piece.

    Raises
    ------
    OutputError
        If it cannot be written; then whatever was there is unchanged.
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
    """Remove what writers left that were killed; what is young may be of one that writes.

    Parameters
    ----------
    directory : Path
        Need not be there.
    below : bool
        Whether its directories are looked through, too.
    """
    latest = time.time() - _LONGEST_WRITE_S
    for path in directory.rglob(".*.tmp") if below else directory.glob(".*.tmp"):
        if not _UNFINISHED.fullmatch(path.name):
            continue
        with contextlib.suppress(OSError):
            if path.stat().st_mtime < latest:
                path.unlink()


def _unfinished(path: Path) -> Path:
    """Return where a file or directory is made, before it gets its name."""
    return path.with_name(f".{path.name}.{os.getpid()}.tmp")


def create_directory_atomically(path: Path, files: Mapping[str, NewFile]) -> None:
    """Create a directory that only its owner can enter, and all its files at once.

    Parameters
    ----------
    path : Path
        Where it shall be, in a directory that exists. An empty directory there is replaced.
    files : mapping of str to NewFile
        By name.

    Raises
    ------
    OutputError
        If something is there already, or it cannot be written; then nothing is changed.
    """
    temporary = _unfinished(path)
    try:
        temporary.mkdir(mode=0o700)
        for name, new in files.items():
            # With its mode from the start: a key is at no time open to others.
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL
            with os.fdopen(os.open(temporary / name, flags, new.mode), "wb") as file:
                file.write(new.content)
                file.flush()
                os.fsync(file.fileno())
        temporary.rename(path)
    except BaseException as error:
        _remove_tree(temporary)
        if isinstance(error, OSError):
            # A rename onto a directory that has files fails with one of several reasons.
            reason = "it exists already" if path.exists() else error.strerror
            raise OutputError(f"{path}: cannot be created: {reason}") from error
        raise


def replace_directory(path: Path, files: Mapping[str, NewFile]) -> None:
    """Put a new directory in the place of one that is there, which is removed.

    No reader ever sees files of both. A process that is killed on the way may leave none there,
    until :func:`restore_directory` is called.

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
    """Finish a replacement during which a process was killed, and remove what such ones left.

    Nobody may be at it meanwhile.

    Raises
    ------
    OutputError
        If it cannot be put in its place.
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
    """Return where a directory waits for its place, and where the one before it goes."""
    return path.with_name(f".{path.name}.new"), path.with_name(f".{path.name}.old")


def claim_directory(out: Path | None, parent: Path, name: str) -> Path:
    """Make the directory of a command that writes into an empty one.

    Parameters
    ----------
    out : Path or None
        It may be there already if it is empty. None: the name in the parent, numbered if taken.
    parent : Path
        Made if it is not there.
    name : str

    Raises
    ------
    OutputError
        If it holds something, or cannot be made.
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
    """Make sure that something can be made at a place: nothing is there, but what it lies in is.

    Parameters
    ----------
    path : Path
    option : str
        By which a person has named it, for messages.
    directory : bool
        Whether it will be a directory: then an empty one may be there.

    Raises
    ------
    OutputError
        If not.
    """
    try:
        if directory and path.is_dir():
            if any(path.iterdir()):
                raise OutputError(
                    f"{path}: holds files already; remove it, or choose another directory "
                    f"({option})"
                )
        elif path.is_symlink() or path.exists():
            raise OutputError(f"{path}: is there already; remove it, or choose another ({option})")
        elif not path.parent.is_dir():
            raise OutputError(f"{path}: cannot be made: there is no directory {path.parent}")
    except OSError as error:
        raise OutputError(f"{path}: cannot be made: {error.strerror}") from error


@contextlib.contextmanager
def directory_beside(path: Path) -> Iterator[Path]:
    """Make a directory in which something can grow, and remove it in the end, whatever happens.

    Parameters
    ----------
    path : Path
        Where it shall be when it is whole (:func:`move_into_place`): in the same file system.

    Raises
    ------
    OutputError
        If it cannot be made, or what is inside raises OSError: the disk is full, say.
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
    """Give a file, or a directory of files, its name, once all of it is on the disk.

    Raises
    ------
    OutputError
        If that fails.
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
    import shutil  # which few processes need, and which takes long to load

    shutil.rmtree(directory, ignore_errors=True)
