"""The directory into which a command of the laboratory writes what it finds."""

from __future__ import annotations

import contextlib
from pathlib import Path

from holdfast.errors import OutputError
from holdfast.runtime.files import shown_path

__all__ = ["claim_directory"]

_MOST = 10_000


def claim_directory(out: Path | None, parent: Path, name: str) -> Path:
    """Create an empty output directory for a command.

    It is ``out``, which may exist if it is empty; or ``name`` in ``parent``, which is created if
    missing, with a number if it exists.

    Raises
    ------
    OutputError
        If it cannot be made, or holds files already.
    """
    place = parent.absolute() if out is None else out
    try:
        place.mkdir(parents=True, exist_ok=True)
        if out is not None:
            if any(out.iterdir()):
                raise OutputError(
                    f"{shown_path(out)}: holds files already; remove it, or choose another "
                    "directory (--out)"
                )
            return out
        for number in range(1, _MOST):
            path = place / (f"{name}-{number}" if number > 1 else name)
            with contextlib.suppress(FileExistsError):
                path.mkdir()
                return path
    except OSError as error:
        raise OutputError(f"{shown_path(place)}: cannot be made: {error.strerror}") from error
    raise OutputError(f"{parent}: more than {_MOST} of {name}; give --out")
