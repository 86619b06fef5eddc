"""What else a service's process may offer, besides the service: a service in ROS, for example.

This package knows nothing of it. Whoever starts the service hands in a function that makes what
the options ask for, and it is called only if they ask for something.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Protocol, TypeAlias

if TYPE_CHECKING:
    from holdfast.service.options import Options

__all__ = ["Beside", "MakeBeside"]


class Beside(Protocol):
    """Something that runs in a service's process, on threads of its own."""

    @property
    def is_busy(self) -> bool:
        """Whether it owes answers."""
        ...

    def start(self, on_event: Callable[..., None]) -> Mapping[str, str]:
        """Begin, and return what the ready line is to say: where what is offered.

        Parameters
        ----------
        on_event : callable
            Logs an event, ``on_event(name, **fields)``, from any thread.

        Raises
        ------
        HoldfastError
            If it cannot begin; then nothing of it is left.
        """
        ...

    def take_no_more(self) -> None:
        """Answer what is owed, and nothing that comes from now on."""
        ...

    def close(self, timeout_s: float) -> None:
        """End; wait so long at most for what is being computed. May be repeated."""
        ...


MakeBeside: TypeAlias = "Callable[[Options], Sequence[Beside]]"
"""Makes what the options ask for; raises a HoldfastError if that cannot be used."""
