"""The directory into which a command writes what it finds."""

from __future__ import annotations

import contextlib
import itertools
from pathlib import Path

from holdfast.errors import OutputError
from holdfast.runtime.files import shown_path


def claim_directory(out: Path | None, parent: Path, name: str) -> Path:
    """Create an empty output directory: ``out``, which may exist, or ``name`` in ``parent``.

    The latter has a number if it exists. OutputError if it cannot be made, or holds files.
    """
    place = (parent / name).absolute() if out is None else out
    try:
        if out is not None:
            place.mkdir(parents=True, exist_ok=True)
            if not any(place.iterdir()):
                return place
            raise OutputError(
                f"{shown_path(place)}: holds files already; remove it, or choose another directory "
                "(--out)"
            )
        place.parent.mkdir(parents=True, exist_ok=True)
        for number in itertools.count(2):
            with contextlib.suppress(FileExistsError):
                place.mkdir()
                break
            place = place.with_name(f"{name}-{number}")
    except OSError as error:
        raise OutputError(f"{shown_path(place)}: cannot be made: {error.strerror}") from error
    return place
