"""Ending a computation that nobody awaits any more, from another thread.

Whoever computes calls :func:`check` between batches; whoever started it makes an
:class:`Interruption` the one of its thread, and may set it from anywhere. Without one the check
does nothing: no result depends on it, since a computation either ends as it would have or not at
all.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

from holdfast.errors import InterruptedComputationError

__all__ = ["Interruption", "check", "interruptible"]


class Interruption:
    """Whether a computation is to end."""

    def __init__(self) -> None:
        self.is_set = False

    def set(self) -> None:
        """End the computation at its next check; from any thread."""
        self.is_set = True


_current: ContextVar[Interruption | None] = ContextVar("interruption", default=None)


@contextmanager
def interruptible(interruption: Interruption) -> Iterator[None]:
    """Let an interruption end what is computed in this context."""
    token = _current.set(interruption)
    try:
        yield
    finally:
        _current.reset(token)


def check() -> None:
    """Raise InterruptedComputationError if this computation is to end."""
    interruption = _current.get()
    if interruption is not None and interruption.is_set:
        raise InterruptedComputationError("nobody awaits this computation any more")
