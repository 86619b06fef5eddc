"""Files that are there whole or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable
from pathlib import Path

from holdfast.errors import HoldfastError

__all__ = ["OutputError", "write_atomically"]


class OutputError(HoldfastError):
    """The output of a run cannot be written or read, or does not belong to this run."""


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
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
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
