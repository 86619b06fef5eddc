"""Ending a computation that nobody awaits any more, or that takes too long.

A computation calls :func:`check` between batches, and the kernel looks between its tasks. Its
caller makes an :class:`Interruption` that of its thread (:func:`interruptible`), and may set it
from any other. Without one the check does nothing. No result depends on it: a computation ends as
it would have, or with an exception.

How long one may take is measured in the processor time of its thread. So it says how much was
computed, and not how busy the machine was meanwhile.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import numpy as np

from holdfast import _kernel
from holdfast.errors import InterruptedComputationError

__all__ = ["Interruption", "check", "interruptible"]

_AWAITED, _NOT_AWAITED, _TOO_LONG = range(3)
"""Values of the flag; the kernel sets the last one."""


class Interruption:
    """Whether a computation is to end.

    Parameters
    ----------
    most_s : float, optional
        Processor time after which it ends by itself, from :meth:`start_clock` on, in seconds.
    """

    def __init__(self, most_s: float = math.inf) -> None:
        self.most_s = most_s
        # Where the kernel's threads can look at it.
        self.flag = np.zeros(1, dtype=np.uint8)  # not full(), which takes five times as long

    @property
    def is_set(self) -> bool:
        """Whether it is to end."""
        return bool(self.flag[0] != _AWAITED)

    @property
    def took_too_long(self) -> bool:
        """Whether it is to end because it has used up its time."""
        return bool(self.flag[0] == _TOO_LONG)

    def set(self) -> None:
        """End the computation at its next check; from any thread."""
        self.flag[0] = _NOT_AWAITED

    def start_clock(self) -> None:
        """Count the processor time of this thread from now on, to the end of its context."""
        _kernel.watch_interruption(self.flag, self.most_s)

    def use_up(self) -> None:
        """Have it end as if its time was used up."""
        self.flag[0] = _TOO_LONG


_current: ContextVar[Interruption | None] = ContextVar("interruption", default=None)


@contextmanager
def interruptible(interruption: Interruption) -> Iterator[None]:
    """Let an interruption end what is computed in this context, on this thread.

    Such contexts are not nested.
    """
    token = _current.set(interruption)
    _kernel.watch_interruption(interruption.flag, math.inf)
    try:
        yield
    except Exception as error:
        # Whatever went wrong: the kernel says it with an error of its own.
        if interruption.is_set:
            raise _error_of(interruption) from error
        raise
    finally:
        _kernel.watch_interruption(None, math.inf)
        _current.reset(token)


def check() -> None:
    """Raise InterruptedComputationError if this computation is to end."""
    interruption = _current.get()
    if interruption is not None and _kernel.is_interrupted():
        raise _error_of(interruption)


def _error_of(interruption: Interruption) -> InterruptedComputationError:
    if interruption.took_too_long:
        return InterruptedComputationError(
            f"this computation takes more than {interruption.most_s:g} s"
        )
    return InterruptedComputationError("nobody awaits this computation any more")
