"""What tasks came to, kept under the digest of all that they depend on.

A file each, written whole or not at all. What cannot be read, because it was damaged or is of an
earlier format, or what is of another task, is as good as not there: the task is computed again.
"""

from __future__ import annotations

import zlib
from pathlib import Path

import msgspec

from holdfast.experiments.tables import Table
from holdfast.experiments.tasks import Task, task_key
from holdfast.files import OutputError, write_atomically

__all__ = ["ResultCache"]

_CHECKSUM_BYTES = 4


class _Kept(msgspec.Struct, array_like=True, forbid_unknown_fields=True):
    task: Task
    table: Table


class ResultCache:
    """Keeps tables in a directory.

    Parameters
    ----------
    directory : Path
        Made when something is kept.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._decoder = msgspec.msgpack.Decoder(_Kept)

    def load(self, task: Task) -> Table | None:
        """Return what a task came to; None if that is not known.

        Raises
        ------
        OutputError
            If the file is there and cannot be read.
        """
        path = self._path_of(task)
        try:
            content = path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise OutputError(f"{path}: cannot be read: {error.strerror}") from error
        payload, checksum = content[:-_CHECKSUM_BYTES], content[-_CHECKSUM_BYTES:]
        if zlib.crc32(payload).to_bytes(_CHECKSUM_BYTES, "little") != checksum:
            return None
        try:
            kept = self._decoder.decode(payload)
        except msgspec.DecodeError:
            return None
        rows = {len(cells) for cells in kept.table.columns.values()}
        return kept.table if _plain(kept.task) == _plain(task) and len(rows) <= 1 else None

    def store(self, task: Task, table: Table) -> None:
        """Keep what a task came to.

        Raises
        ------
        OutputError
            If it cannot be written.
        """
        path = self._path_of(task)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{path.parent}: cannot be made: {error.strerror}") from error
        payload = msgspec.msgpack.encode(_Kept(task, table))
        checksum = zlib.crc32(payload).to_bytes(_CHECKSUM_BYTES, "little")
        write_atomically(path, payload + checksum)

    def _path_of(self, task: Task) -> Path:
        key = task_key(task)
        return self._directory / task.kind / key[:2] / f"{key}.table"


def _plain(task: Task) -> bytes:
    return msgspec.json.encode(task, order="sorted")
