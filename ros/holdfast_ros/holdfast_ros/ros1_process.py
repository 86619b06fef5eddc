"""The process of ``holdfast ros1-serve``, with the options of ``holdfast serve`` and some more."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from holdfast.errors import InvalidValueError, TransportError
from holdfast.runtime.command_line import location, option
from holdfast.service.options import DEFAULT_NAME, ServeOptions

if TYPE_CHECKING:
    from holdfast_ros.ros1_service import Ros1Server


class Ros1ServeOptions(ServeOptions):
    """Offer a service in ROS 1, at the address of ROS_MASTER_URI and the like.

    It needs no ROS here. With --listen it serves other robots as well, as holdfast serve
    does; without, nothing but the node listens.
    """

    configuration: Path | None = option(
        read=location, metavar="FILE", help="Configuration for robots in ROS 1, which have none."
    )
    ros1_name: str = option(
        default=DEFAULT_NAME, metavar="NAME", help="Name of the service and of its node in ROS 1."
    )


def main(arguments: Sequence[str]) -> int:
    """Serve until a signal ends it, and return the exit code."""
    from holdfast.service.process import serve

    options = Ros1ServeOptions.parse("ros1-serve", arguments)
    if options.configuration is None:
        raise InvalidValueError(
            "--configuration is missing; it says for which problem and with which settings this "
            "service decides in ROS"
        )
    if options.processes > 1:
        raise InvalidValueError(f"--processes {options.processes}: a node of ROS 1 is one process")
    return serve(options, lambda: _server(options))


def _server(options: Ros1ServeOptions) -> Ros1Server:
    from holdfast.config.loader import load
    from holdfast_ros.ros1_environment import RosEnvironment
    from holdfast_ros.ros1_service import Ros1Server

    assert options.configuration is not None
    configuration = load(options.configuration)
    ros_environment = RosEnvironment.of()
    if ros_environment.bind != "127.0.0.1" and not options.insecure:
        raise InvalidValueError(
            "other machines can reach this service, and in ROS 1 no peer proves its identity; "
            "set ROS_HOSTNAME=127.0.0.1 for nodes of this machine alone, or say --insecure"
        )
    try:
        return Ros1Server(configuration, options.ros1_name, ros_environment)
    except TransportError as error:
        raise TransportError(f"--ros1-name: {error}") from None
