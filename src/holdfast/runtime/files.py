"""Files that are written completely or not at all.

A file is written under a temporary name in the same directory and then renamed. A rename is atomic:
after a crash, and for every reader, the path holds the old file or the new one, never a part.
Directories whose files belong together, such as a key and its certificate, appear the same way. One
that exists is never swapped for another: a container that has mounted it would keep the old one.

All functions but those that read raise :class:`~holdfast.errors.OutputError` if the system
refuses something, or what they would write is there already.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple

from holdfast.errors import OutputError

_started_in: Path | None = None
"""Where the command was started; the code of a problem or robot may change the directory later."""

_UNFINISHED = re.compile(r"\..+\.\d+\.tmp")
_MAX_LINE = 1 << 20
_MARKED = 1000  # bytes in which a file says that holdfast wrote it


class NewFile(NamedTuple):
    """A file of a new directory; ``mode`` is its permissions, before the process's umask."""

    content: bytes
    mode: int


def bounded_lines(path: Path) -> Iterator[str]:
    """Yield the lines of a UTF-8 file that anybody may have written, longer ones in pieces.

    Raises OSError if it cannot be read, or is no file: a pipe would be waited for, and a device has
    no end.
    """
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError(errno.EINVAL, "it is no file")
    with path.open(encoding="utf-8", errors="replace", newline="") as file:
        while line := file.readline(_MAX_LINE):
            yield line


def remember_directory() -> None:
    """Remember the current directory as the one in which the user has started the command."""
    global _started_in
    with contextlib.suppress(OSError):  # it was removed
        _started_in = Path.cwd()


def started_in() -> Path | None:
    """Return where the command was started, None if that is not known or not there any more."""
    return _started_in if _started_in is not None and _started_in.is_dir() else None


def shown_path(path: Path) -> str:
    """Return a path as the user, who is where the command was started, can write it."""
    if _started_in is not None and path.is_relative_to(_started_in):
        return str(path.relative_to(_started_in))
    return str(path)


@contextlib.contextmanager
def _refusals(path: Path, what: str) -> Iterator[None]:
    """Turn the system's refusals into errors about the path."""
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"{shown_path(path)}: cannot be {what}: {error.strerror or error}"
        ) from error


@contextlib.contextmanager
def _synchronized(path: Path, mode: int) -> Iterator[BinaryIO]:
    """Make a file, never through a link that is there; after the block its content is on the disk.

    The mode is set at creation, so that a key is never readable by others.
    """
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL
    with os.fdopen(os.open(path, flags, mode), "wb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())


@contextlib.contextmanager
def _replacing(path: Path, mode: int = 0o666) -> Iterator[BinaryIO]:
    """Make a file that takes the place of a path after the block, if nothing fails."""
    # In the same folder, because a rename is atomic only within one file system.
    temporary = _unfinished(path)
    with _refusals(path, "written"):
        try:
            temporary.unlink(missing_ok=True)
            with _synchronized(temporary, mode) as file:
                yield file
            temporary.replace(path)
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink()
            raise


def write_atomically(path: Path, content: bytes | Iterable[str]) -> None:
    """Write a file atomically; a file that exists is replaced, or unchanged if that fails.

    Text is encoded as UTF-8, piece by piece.
    """
    pieces: Iterable[bytes]
    if isinstance(content, bytes):
        pieces = (content,)
    else:
        pieces = (piece.encode() for piece in ((content,) if isinstance(content, str) else content))
    with _replacing(path) as file:
        file.writelines(pieces)


def _unfinished(path: Path) -> Path:
    """Return the temporary path of a file or directory."""
    return path.with_name(f".{path.name}.{os.getpid()}.tmp")


@contextlib.contextmanager
def _unfinished_directory(path: Path, mode: int = 0o777) -> Iterator[Path]:
    """Create the temporary directory of a path, and remove it after the block if it is there."""
    temporary = _unfinished(path)
    try:
        temporary.mkdir(mode)
        yield temporary
    finally:
        _remove_tree(temporary)


def create_directory_atomically(path: Path, files: Mapping[str, NewFile]) -> None:
    """Create a directory that only its owner can enter, with all its files by name, atomically.

    Its parent must exist. An empty directory at this path is replaced.
    """
    try:
        with _unfinished_directory(path, 0o700) as temporary:
            for name, new in files.items():
                with _synchronized(temporary / name, new.mode) as file:
                    file.write(new.content)
            temporary.rename(path)
    except OSError as error:
        # A rename onto a directory with files fails with one of several errors.
        reason = "it exists already" if path.exists() else error.strerror
        raise OutputError(f"{path}: cannot be created: {reason}") from error


def replace_file(path: Path, content: bytes, mode: int, *, like: Path | None = None) -> None:
    """Write a file atomically, readable by the same users as the one that it replaces.

    It gets the owner and permissions of that file, or of ``like``; a new one gets ``mode``, and the
    owner of its directory. (Only root can give a file to somebody else.)
    """
    with _refusals(path, "written"):
        try:
            before = (like or path).stat()
            mode = stat.S_IMODE(before.st_mode)
        except FileNotFoundError:
            before = path.parent.stat()
        with _replacing(path, 0o600) as file:
            if os.geteuid() == 0:
                os.fchown(file.fileno(), before.st_uid, before.st_gid)
            os.fchmod(file.fileno(), mode)
            file.write(content)


def remove_unfinished_of(directory: Path) -> None:
    """Remove what killed writers left of a directory and in it, where no other process writes."""
    for left in (*directory.parent.glob(f".{directory.name}.*.tmp"), *directory.glob(".*.tmp")):
        if not _UNFINISHED.fullmatch(left.name):
            continue
        if left.is_dir():
            _remove_tree(left)
        else:
            with _refusals(left, "removed"):
                left.unlink()


def require_free(path: Path, option: str, *, directory: bool, ours: bytes = b"") -> None:
    """Check that the file or directory of an option can be created.

    The path is free, or an empty directory where one is wanted, and its parent exists. A file that
    begins with lines that have ``ours`` may be there: holdfast wrote it, and may replace it.
    """
    with _refusals(path, "made"):
        if directory and path.is_dir():
            _require_empty(path, option)
        elif path.is_symlink() or path.exists():
            if ours and not path.is_symlink() and path.is_file():
                with path.open("rb") as file:
                    if ours in file.read(_MARKED):
                        return
            what = "exists already, and holdfast did not write it" if ours else "exists already"
            raise OutputError(
                f"{shown_path(path)}: {what}; remove it, or choose another ({option})"
            )
        elif not path.parent.is_dir():
            raise OutputError(
                f"{shown_path(path)}: cannot be made: there is no directory "
                f"{shown_path(path.parent)}"
            )


def _require_empty(path: Path, option: str) -> None:
    if any(path.iterdir()):
        raise OutputError(
            f"{shown_path(path)}: holds files already; remove it, or choose another directory "
            f"({option})"
        )


@contextlib.contextmanager
def directory_beside(path: Path) -> Iterator[Path]:
    """Create a temporary directory beside a final path, and remove it after the block.

    An OSError of the block, as of a full disk, is an OutputError, too. What was made in it goes to
    its path by :func:`move_into_place`.
    """
    with _refusals(path, "written"), _unfinished_directory(path) as temporary:
        yield temporary


def move_into_place(moves: Sequence[tuple[Path, Path]]) -> None:
    """Write files, or directories of files, through to the disk, then rename each to its path."""
    for made, path in moves:
        with _refusals(path, "written"):
            for file in sorted(made.iterdir()) if made.is_dir() else [made]:
                synchronize(file)
    for made, path in moves:
        with _refusals(path, "written"):
            made.rename(path)


def synchronize(path: Path) -> None:
    """Write a file, or the names in a directory, through to the disk; OSError if that fails."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _remove_tree(directory: Path) -> None:
    import shutil  # slow to load, and few processes need it

    shutil.rmtree(directory, ignore_errors=True)
