"""What a master knew, in a file: for a guard that is started after both were killed.

The file reaches the page cache only. It survives the processes but not the machine, like the nodes.
"""

from __future__ import annotations

import os
import pickle
from pathlib import Path

from ros1_master_guard.process import HEAD, MasterState, decoded, encoded

_MAGIC = b"ros1_master_guard 2\n"


def read_journal(path: Path) -> MasterState | None:
    """Return what a journal holds, or None without one; raise ValueError if it is none."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    start = len(_MAGIC) + HEAD.size
    if not content.startswith(_MAGIC):
        raise ValueError("is no journal of a ROS 1 master")
    try:
        return MasterState(**decoded(content[start:]))
    except (pickle.UnpicklingError, EOFError, TypeError, AttributeError) as error:
        raise ValueError(f"is no whole journal of a ROS 1 master: {error}") from error


def write_journal(path: Path, state: MasterState) -> None:
    """Write a journal in one piece, or keep the one before; its directory is made if it is gone."""
    path.parent.mkdir(mode=0o700, exist_ok=True)
    new = path.with_name(f"{path.name}.new")
    new.unlink(missing_ok=True)
    # Never through a link that somebody else has put there.
    descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with open(descriptor, "wb") as file:  # noqa: PTH123 (a descriptor)
        file.write(_MAGIC + encoded(vars(state)))
    new.replace(path)
