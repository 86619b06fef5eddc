"""``holdfast serve``: brings the service and what it may offer in ROS 1 together.

The service's own package knows nothing of ROS.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from holdfast.errors import InvalidValueError, TransportError
from holdfast.service import process

if TYPE_CHECKING:
    from holdfast.service.options import ServeOptions
    from holdfast.service.process import Extension

__all__ = ["main", "make_ros_service"]


def main(arguments: Sequence[str]) -> int:
    """Serve until a signal ends it, and return the exit code."""
    return process.main(arguments, make_ros_service)


def make_ros_service(options: ServeOptions) -> Extension:
    """Return the service in ROS 1 that the options ask for.

    Raises
    ------
    HoldfastError
        If the configuration or an option cannot be used, or a library is missing.
    """
    return _Ros1(options)


class _Ros1:
    """The service in ROS 1, and where it is."""

    _on_event: Callable[..., None] | None = None
    _on_shutdown: Callable[[str], None] | None = None

    def __init__(self, options: ServeOptions) -> None:
        from holdfast.config.loader import load
        from holdfast.ros.ros1_service import Ros1Server
        from holdfast.transport.tcpros import RosEnvironment

        assert options.configuration is not None
        configuration = load(options.configuration)
        ros_environment = RosEnvironment.of()
        if ros_environment.bind != "127.0.0.1" and not options.insecure:
            raise InvalidValueError(
                "--ros1: other machines can reach this service, and in ROS 1 no peer proves "
                "its identity; set ROS_HOSTNAME=127.0.0.1 for nodes of this machine alone, or say "
                "--insecure"
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
