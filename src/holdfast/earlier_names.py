"""Names of earlier releases: each works for a while, and says once in a process when it will go.

A name that changes is entered here with its new name and the release that drops it, two minor
releases ahead. ``tests/unit/test_earlier_names.py`` fails in the release in which it is overdue.
"""

from __future__ import annotations

import functools
import warnings

EARLIER_NAMES = {"execute": ("limit_action", "0.3")}
"""What is said now, and the release without the earlier name."""


@functools.cache
def warn_of_earlier_name(name: str) -> None:
    """Warn with a ``DeprecationWarning``, the first time that a name is met."""
    now, goes = EARLIER_NAMES[name]
    warnings.warn(f"{name} is {now} now; {name} goes with holdfast {goes}", DeprecationWarning, 4)
