"""NumPy's floating-point mode: one of our own inside, the caller's in the caller's code.

``np.seterr(all="raise")``, also by some library, makes NumPy raise where a tiny number becomes 0,
which is harmless in a belief. So what a user calls runs in NumPy's default mode, and the functions
of a user's problem get the caller's mode back while they run. Where the caller has the default
mode, which is nearly always, both cost a comparison. The kernel sees to the processor's own mode.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextvars import ContextVar
from typing import Any, ParamSpec, TypeVar

import numpy as np

__all__ = ["as_caller", "in_own_mode"]

P = ParamSpec("P")
R = TypeVar("R")

_OWN: dict[str, Any] = {"divide": "warn", "over": "warn", "under": "ignore", "invalid": "warn"}

_callers: ContextVar[dict[str, Any] | None] = ContextVar("callers_mode", default=None)
"""The mode of who called, while it is not ours."""


def in_own_mode(function: Callable[P, R]) -> Callable[P, R]:
    """Make a function of the public face run in NumPy's default mode."""

    @functools.wraps(function)
    def in_mode(*arguments: P.args, **keywords: P.kwargs) -> R:
        mode: dict[str, Any] = dict(np.geterr())
        if mode == _OWN:
            return function(*arguments, **keywords)
        token = _callers.set(mode)
        try:
            with np.errstate(**_OWN):
                return function(*arguments, **keywords)
        finally:
            _callers.reset(token)

    return in_mode


def as_caller(function: Callable[P, R], *arguments: P.args, **keywords: P.kwargs) -> R:
    """Call a user's function in the mode of who called us; one of ours in our own."""
    mode = _callers.get()
    if mode is None or (getattr(function, "__module__", None) or "").startswith("holdfast."):
        return function(*arguments, **keywords)
    token = _callers.set(None)
    try:
        with np.errstate(**mode):
            return function(*arguments, **keywords)
    finally:
        _callers.reset(token)
