"""Ending a computation that nobody awaits any more, from another thread.

A computation calls :func:`check` between batches, and the kernel looks between its tasks. Its
caller makes an :class:`Interruption` that of its thread (:func:`interruptible`), and may set it
from any other. Without one the check does nothing. No result depends on it: a computation ends as
it would have, or with an exception.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import numpy as np

from holdfast import _kernel
from holdfast.errors import InterruptedComputationError

__all__ = ["Interruption", "check", "interruptible"]

_MESSAGE = "nobody awaits this computation any more"


class Interruption:
    """Whether a computation is to end."""

    def __init__(self) -> None:
        # Where the kernel's threads can look at it.
        self.flag = np.zeros(1, dtype=np.uint8)

    @property
    def is_set(self) -> bool:
        """Whether it is to end."""
        return bool(self.flag[0])

    def set(self) -> None:
        """End the computation at its next check; from any thread."""
        self.flag[0] = 1


_current: ContextVar[Interruption | None] = ContextVar("interruption", default=None)


@contextmanager
def interruptible(interruption: Interruption) -> Iterator[None]:
    """Let an interruption end what is computed in this context, on this thread."""
    before = _current.get()
    token = _current.set(interruption)
    _kernel.watch_interruption(interruption.flag)
    try:
        yield
    except Exception as error:
        # Whatever went wrong: the kernel says it with an error of its own.
        if interruption.is_set:
            raise InterruptedComputationError(_MESSAGE) from error
        raise
    finally:
        _kernel.watch_interruption(None if before is None else before.flag)
        _current.reset(token)


def check() -> None:
    """Raise InterruptedComputationError if this computation is to end."""
    interruption = _current.get()
    if interruption is not None and interruption.is_set:
        raise InterruptedComputationError(_MESSAGE)
