"""What happens between a robot and its services, as seen from the robot's end of the wire.

A call is one request and any number of replies; it always ends. A call that ends without the answer
says that whoever was asked is gone.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

__all__ = ["Appeared", "Ended", "Replied", "TransportEvent", "Vanished"]


class Appeared(NamedTuple):
    """A service is there: its liveliness token is seen.

    Attributes
    ----------
    service : str
        The robot's name for it.
    boot : str
        Of the service's process; another one is another process, with another memory.
    """

    service: str
    boot: str


class Vanished(NamedTuple):
    """A service is gone: it closed, its process died, or the link to it did."""

    service: str
    boot: str


class Replied(NamedTuple):
    """A reply to a call."""

    call: int
    payload: bytes


class Ended(NamedTuple):
    """No more replies come to a call."""

    call: int


TransportEvent: TypeAlias = Appeared | Vanished | Replied | Ended
