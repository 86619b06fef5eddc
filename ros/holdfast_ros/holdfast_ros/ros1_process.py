"""A service's process with the typed service of ROS 1: its options, and how it is started."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from holdfast.errors import InvalidValueError, TransportError
from holdfast.runtime.command_line import location, option
from holdfast.service.options import DEFAULT_NAME, ServeOptions

__all__ = ["Ros1ServeOptions", "main"]


class Ros1ServeOptions(ServeOptions):
    """Offer a service in ROS 1, at the address of ROS_MASTER_URI and the like.

    It needs no ROS here. With --listen it serves other robots as well, as holdfast serve
    does; without, nothing but the node listens.
    """

    configuration: Path | None = option(
        read=location,
        metavar="FILE",
        help="Configuration for robots in ROS 1, which have none.",
    )
    ros1_name: str = option(
        default=DEFAULT_NAME,
        metavar="NAME",
        help="Name of the service and of its node in ROS 1.",
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
    return serve(options, lambda: _Ros1(options))


class _Ros1:
    """The service in ROS 1 as an extension of a service's process, and where it is."""

    _on_event: Callable[..., None] | None = None
    _on_shutdown: Callable[[str], None] | None = None

    def __init__(self, options: Ros1ServeOptions) -> None:
        from holdfast.config.loader import load
        from holdfast_ros.ros1_service import Ros1Server
        from holdfast_ros.tcpros import RosEnvironment

        assert options.configuration is not None
        configuration = load(options.configuration)
        ros_environment = RosEnvironment.of()
        if ros_environment.bind != "127.0.0.1" and not options.insecure:
            raise InvalidValueError(
                "other machines can reach this service, and in ROS 1 no peer proves its identity; "
                "set ROS_HOSTNAME=127.0.0.1 for nodes of this machine alone, or say --insecure"
            )
        try:
            self._server = Ros1Server(
                configuration,
                options.ros1_name,
                ros_environment,
                on_shutdown=self._asked_to_end,
                on_event=self._tell,
            )
        except TransportError as error:
            raise TransportError(f"--ros1-name: {error}") from None
        self._where = f"{self._server.name} (master {ros_environment.master})"

    @property
    def is_busy(self) -> bool:
        return self._server.is_busy

    def start(
        self, on_event: Callable[..., None], on_shutdown: Callable[[str], None]
    ) -> Mapping[str, str]:
        self._on_event = on_event
        self._on_shutdown = on_shutdown
        self._server.start()
        return {"ros1": self._where}

    def take_no_more(self) -> None:
        self._server.take_no_more()

    def close(self, timeout_s: float) -> None:
        self._server.close(timeout_s)

    def _tell(self, name: str, **fields: object) -> None:
        if self._on_event is not None:
            self._on_event(name, **fields)

    def _asked_to_end(self, reason: str) -> None:
        if self._on_shutdown is not None:
            self._on_shutdown(reason)
