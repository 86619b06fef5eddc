"""Tasks and their results as bytes, for processes that compute them elsewhere.

A worker always answers, also when it fails, so that an error is the same wherever it happens. Only
plain data travels, never code: a worker must have holdfast installed, and a request can demand the
same code.
"""

from __future__ import annotations

import socket
import traceback
from typing import TYPE_CHECKING

import msgspec

from holdfast import __version__
from holdfast.errors import HoldfastError
from holdfast.lab.errors import TaskCrashError, TaskError
from holdfast.lab.studies.tables import Columns, columns_of, frame_of
from holdfast.lab.studies.tasks import Task, code_of, run_task

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["compute_encoded", "encode_task", "table_of"]


class _Request(msgspec.Struct):
    task: Task
    code: str | None


class _Computed(msgspec.Struct, tag="computed"):
    table: Columns


class _Refused(msgspec.Struct, tag="refused"):
    reason: str


class _Crashed(msgspec.Struct, tag="crashed"):
    account: str


_REQUEST_DECODER = msgspec.msgpack.Decoder(_Request)
_Answer = _Computed | _Refused | _Crashed

_ANSWER_DECODER = msgspec.msgpack.Decoder(_Answer)


def encode_task(task: Task, code: str | None = None) -> bytes:
    """Return a task as bytes.

    Parameters
    ----------
    code : str, optional
        The digest of the code that may compute it (:func:`~.tasks.code_of`). None if the worker is
        known to have the same code.
    """
    return msgspec.msgpack.encode(_Request(task, code))


def compute_encoded(request: bytes) -> bytes:
    """Compute a task in this process; return its result, or why there is none.

    Parameters
    ----------
    request : bytes
        From :func:`encode_task`.

    Returns
    -------
    bytes
        For :func:`table_of`.
    """
    answer: _Answer
    try:
        asked = _REQUEST_DECODER.decode(request)
        _check_code(asked)
        table = run_task(asked.task)
        # Modules were imported on the way, and may have been edited just before.
        _check_code(asked)
        answer = _Computed(columns_of(table))
    except HoldfastError as error:
        answer = _Refused(str(error))
    except Exception:  # noqa: BLE001 - raised again where it was asked for
        answer = _Crashed(traceback.format_exc())
    return msgspec.msgpack.encode(answer)


def _check_code(asked: _Request) -> None:
    if asked.code is None:
        return
    kind = asked.task.kind
    own = code_of(asked.task)
    if own != asked.code:
        raise TaskError(
            f"a process on {socket.gethostname()} has other code for tasks of the kind {kind!r} "
            f"(digest {own}, of holdfast {__version__}) than the one that asks (digest "
            f"{asked.code}), so the results would not belong together: install the same holdfast "
            "on every node, and edit nothing meanwhile"
        )


def table_of(answer: bytes) -> pd.DataFrame:
    """Return a task's result.

    Parameters
    ----------
    answer : bytes
        From :func:`compute_encoded`.

    Raises
    ------
    TaskError
        If its function refused the parameters, or the code is another.
    TaskCrashError
        If anything else went wrong there.
    """
    found: _Answer = _ANSWER_DECODER.decode(answer)
    if isinstance(found, _Refused):
        raise TaskError(found.reason)
    if isinstance(found, _Crashed):
        raise TaskCrashError(f"in another process:\n{found.account}")
    return frame_of(found.table)
