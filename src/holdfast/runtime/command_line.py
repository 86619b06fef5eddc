"""What has to be known of a command line before it is parsed, and also if it cannot be."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

__all__ = ["MAX_JOBS", "wants_json"]

MAX_JOBS = 1024
"""Largest number of worker processes that a command can be asked for (``--jobs``)."""


def wants_json(arguments: Sequence[str]) -> bool:
    """Tell whether a command line asks for events as JSON, though it may not be a valid one.

    Parameters
    ----------
    arguments : sequence of str
        With ``--log json`` or ``--log=json`` among them.
    """
    chosen = "text"
    for option, value in itertools.pairwise([*arguments, ""]):
        if option == "--log":
            chosen = value
        elif option.startswith("--log="):
            chosen = option.removeprefix("--log=")
    return chosen == "json"
