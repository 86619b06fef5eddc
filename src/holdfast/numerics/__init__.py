"""What everything computes with: arrays, random streams, functions, angles, collisions.

``from holdfast import numerics`` is for problems of users: ``numerics.exp`` and the like, with the
same bits on every machine (:mod:`holdfast.numerics.reproducible`). Each is imported when it is
first used; holdfast itself imports from the modules.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from holdfast.numerics.reproducible import (
        all_finite,
        arcsin,
        arctan2,
        cos,
        exp,
        log,
        sin,
        sum,  # noqa: A004 - always used as numerics.sum
        weighted_mean,
        wrapped,
    )

__all__ = [
    "all_finite",
    "arcsin",
    "arctan2",
    "cos",
    "exp",
    "log",
    "sin",
    "sum",
    "weighted_mean",
    "wrapped",
]

if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        """Import a function (PEP 562)."""
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from holdfast.numerics import reproducible

        value = globals()[name] = getattr(reproducible, name)
        return value


def __dir__() -> list[str]:
    """Return the functions, imported or not."""
    return list(__all__)
