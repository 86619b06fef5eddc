"""Errors in code that is not ours: what the author of a problem needs to see of them.

A problem is a person's own code that holdfast calls. When it fails, the frames that matter are that
person's; those of holdfast and of the libraries between them only hide these. When no frame is the
person's, the defect is ours and nothing may be hidden.
"""

from __future__ import annotations

import sysconfig
import traceback
from pathlib import Path

__all__ = ["account_of_user_error", "is_users_file"]

_HOLDFAST = Path(__file__).resolve().parent
_LIBRARIES = tuple(
    Path(path).resolve()
    for name in ("stdlib", "platstdlib", "purelib", "platlib")
    if (path := sysconfig.get_path(name))
)
_PACKAGE_FOLDERS = frozenset({"site-packages", "dist-packages"})


def is_users_file(name: str) -> bool:
    """Tell whether a source file belongs neither to holdfast nor to an installed library.

    Parameters
    ----------
    name : str
        Path of the file, or what Python says where there is none (``<string>``).
    """
    if name.startswith("<"):
        return False
    path = Path(name).resolve()
    return _PACKAGE_FOLDERS.isdisjoint(path.parts) and not any(
        path.is_relative_to(folder) for folder in (_HOLDFAST, *_LIBRARIES)
    )


def account_of_user_error(error: BaseException, name: str) -> str | None:
    """Say what the user's code raised and where, without the frames of anybody else.

    Parameters
    ----------
    error : BaseException
        What was raised, caught in holdfast.
    name : str
        What to call the code, usually the problem's name.

    Returns
    -------
    str or None
        One line with the type and the message, then file, line and source of each frame of the
        user's; None if the user's code had no part in it.
    """
    ours = False
    frames = []
    for frame in traceback.extract_tb(error.__traceback__):
        # Whatever calls holdfast (a script, a notebook) comes first and is not at fault.
        ours = ours or Path(frame.filename).resolve().is_relative_to(_HOLDFAST)
        if ours and is_users_file(frame.filename):
            frames.append(frame)
    if isinstance(error, SyntaxError) and error.filename and is_users_file(error.filename):
        # A file that cannot be parsed has no frame; the error itself says where.
        where = f'  File "{error.filename}", line {error.lineno}\n    {(error.text or "").strip()}'
    elif frames:
        where = "".join(traceback.format_list(frames)).rstrip()
    else:
        return None
    text = error.msg if isinstance(error, SyntaxError) else str(error)
    kind = type(error).__name__
    return f"{name} raised {kind}{': ' if text else ''}{text}\n{where}"
