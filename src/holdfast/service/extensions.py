"""Extensions of a service's process, such as a service in ROS.

This package knows none of them. The command that starts the service passes a function that makes
the extensions for its options; it is called only if the options ask for one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Protocol, TypeAlias

if TYPE_CHECKING:
    from holdfast.service.options import ServeOptions

__all__ = ["Extension", "MakeExtensions"]


class Extension(Protocol):
    """Runs in a service's process, on threads of its own."""

    @property
    def is_busy(self) -> bool:
        """Whether it owes answers."""
        ...

    def start(self, on_event: Callable[..., None]) -> Mapping[str, str]:
        """Start; return what is offered where, for the ready line.

        ``on_event(name, **fields)`` logs an event, from any thread. A start that raises a
        HoldfastError has released everything.
        """
        ...

    def take_no_more(self) -> None:
        """Finish open requests and refuse new ones."""
        ...

    def close(self, timeout_s: float) -> None:
        """Stop; wait at most this long for a running computation. May be repeated."""
        ...


MakeExtensions: TypeAlias = "Callable[[ServeOptions], Sequence[Extension]]"
"""Makes the extensions for some options; raises a HoldfastError if they cannot be used."""
