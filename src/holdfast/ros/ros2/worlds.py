"""What the node's robot acts on, if it is not an executive that calls ``~/decide``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from holdfast.ros.ros2.parameters import Parameters
from holdfast.runtime.environment import EnvironmentMaker, load_environment

__all__ = ["World", "make_world"]


class World(NamedTuple):
    """A maker of environments, and how to stop one.

    Attributes
    ----------
    maker : EnvironmentMaker or None
        None for an executive, which has one for each part of a run.
    interrupt : callable
        Ends the call that goes on, if that can be; given the reason.
    close : callable
    """

    maker: EnvironmentMaker | None
    interrupt: Callable[[str], None]
    close: Callable[[], None]


def make_world(node: Any, parameters: Parameters) -> World:
    """Make what the parameters name.

    Raises
    ------
    HoldfastError
        If that cannot be.
    """
    del node
    if parameters.environment == "executive":
        return World(None, _nothing, _nothing)
    return World(load_environment(parameters.configuration), _nothing, _nothing)


def _nothing(*_: object) -> None:
    pass
