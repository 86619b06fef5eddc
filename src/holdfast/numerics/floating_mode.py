"""The floating-point mode: our own inside, the caller's in the caller's code.

``np.seterr(all="raise")``, perhaps by some library, makes NumPy raise where a tiny number becomes
0, which is harmless in a belief. Other libraries make the processor round otherwise, or take tiny
numbers for 0. So what a user calls runs in the standard mode of both. The functions of a user's
problem get the caller's mode of NumPy back while they run; the processor's stays standard, for what
they compute must have the same bits everywhere. Where the caller has both standard modes, which is
nearly always, all this costs a comparison.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextvars import ContextVar
from typing import Any, ParamSpec, TypeVar

import numpy as np

from holdfast import _kernel

P = ParamSpec("P")
R = TypeVar("R")

_OWN: dict[str, Any] = {"divide": "warn", "over": "warn", "under": "ignore", "invalid": "warn"}

_callers: ContextVar[dict[str, Any] | None] = ContextVar("callers_mode", default=None)
"""The caller's mode of NumPy; None while it is ours."""


def in_own_mode(function: Callable[P, R]) -> Callable[P, R]:
    """Make a public function run in the standard floating-point mode."""

    @functools.wraps(function)
    def in_mode(*arguments: P.args, **keywords: P.kwargs) -> R:
        processor = _kernel.enter_standard_mode()
        mode: Any = np.geterr()
        if not processor and mode == _OWN:
            return function(*arguments, **keywords)
        token = _callers.set(None if mode == _OWN else mode)
        try:
            with np.errstate(**_OWN):
                return function(*arguments, **keywords)
        finally:
            _callers.reset(token)
            if processor:
                _kernel.restore_mode(processor)

    return in_mode


def as_caller(function: Callable[P, R], *arguments: P.args, **keywords: P.kwargs) -> R:
    """Call a user's function in the caller's mode of NumPy, and a function of holdfast in ours."""
    mode = _callers.get()
    if mode is None or (getattr(function, "__module__", None) or "").startswith("holdfast."):
        return function(*arguments, **keywords)
    token = _callers.set(None)
    try:
        with np.errstate(**mode):
            return function(*arguments, **keywords)
    finally:
        _callers.reset(token)
