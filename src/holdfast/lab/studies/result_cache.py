"""Results of tasks on the disk, under the digest of all that they depend on.

One file each, written whole or not at all. A file that is damaged, of an earlier format or of
another task counts as missing: the task is computed again.
"""

from __future__ import annotations

import contextlib
import zlib
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from holdfast.errors import InvalidValueError, OutputError
from holdfast.files import write_atomically
from holdfast.lab.studies.tables import Columns, columns_of, frame_of
from holdfast.lab.studies.tasks import Task, task_key

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["ResultCache"]

_CHECKSUM_BYTES = 4


class _Kept(msgspec.Struct, array_like=True, forbid_unknown_fields=True):
    task: Task
    table: Columns


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

    def load(self, task: Task) -> pd.DataFrame | None:
        """Return a task's result; None if it is not known.

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
        if _plain(kept.task) != _plain(task):
            return None
        with contextlib.suppress(InvalidValueError):
            return frame_of(kept.table)
        return None

    def store(self, task: Task, table: pd.DataFrame) -> None:
        """Keep a task's result.

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
        payload = msgspec.msgpack.encode(_Kept(task, columns_of(table)))
        checksum = zlib.crc32(payload).to_bytes(_CHECKSUM_BYTES, "little")
        write_atomically(path, payload + checksum)

    def _path_of(self, task: Task) -> Path:
        key = task_key(task)
        return self._directory / task.kind / key[:2] / f"{key}.table"


def _plain(task: Task) -> bytes:
    return msgspec.json.encode(task, order="sorted")
