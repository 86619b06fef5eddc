"""``holdfast serve``: brings the service and what it may offer to ROS together.

The service's own package knows nothing of ROS.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

from holdfast.errors import InvalidValueError, TransportError
from holdfast.service import process

if TYPE_CHECKING:
    from holdfast.config.loader import Configuration
    from holdfast.ros.active_sensing import ActiveSensing
    from holdfast.ros.ros1_service import Ros1Server
    from holdfast.ros.ros2_service import Ros2Server
    from holdfast.service.options import ServeOptions
    from holdfast.service.process import Extension

__all__ = ["main", "make_ros_services"]


def main(arguments: Sequence[str]) -> int:
    """Serve until a signal ends it, and return the exit code."""
    return process.main(arguments, make_ros_services)


def make_ros_services(options: ServeOptions) -> Sequence[Extension]:
    """Return the services in ROS that the options ask for.

    Raises
    ------
    HoldfastError
        If the configuration or an option cannot be used, or a library is missing.
    """
    from holdfast.config.loader import load
    from holdfast.ros.active_sensing import ActiveSensing

    assert options.configuration is not None
    configuration = load(options.configuration)
    services: list[Extension] = []
    if options.ros2_domain is not None:
        services.append(_Ros2(ActiveSensing(configuration), options))
    if options.ros1:
        services.append(_Ros1(configuration, options))
    return services


class _OfRos:
    """A server in ROS, and where it is."""

    _server: Ros1Server | Ros2Server
    _wire: ClassVar[str]
    _where: str
    _on_event: Callable[..., None] | None = None
    _on_shutdown: Callable[[str], None] | None = None

    @property
    def is_busy(self) -> bool:
        return self._server.is_busy

    def start(
        self, on_event: Callable[..., None], on_shutdown: Callable[[str], None]
    ) -> Mapping[str, str]:
        self._on_event = on_event
        self._on_shutdown = on_shutdown
        self._server.start()
        return {self._wire: self._where}

    def take_no_more(self) -> None:
        self._server.take_no_more()

    def close(self, timeout_s: float) -> None:
        self._server.close(timeout_s)

    def _tell(self, name: str, **fields: object) -> None:
        if self._on_event is not None:
            self._on_event(name, **fields)


class _Ros2(_OfRos):
    """The service in ROS 2, with rmw_zenoh's wire."""

    _wire = "ros2"

    def __init__(self, service: ActiveSensing, options: ServeOptions) -> None:
        from holdfast.ros.ros2_keys import check_service_name
        from holdfast.ros.ros2_service import Ros2Server
        from holdfast.ros.zenoh_session import zenoh_module

        endpoint = options.ros2_listen or options.ros2_router
        assert options.ros2_domain is not None and endpoint is not None
        name = check_service_name(options.ros2_name, "--ros2-name")
        try:
            zenoh_module()
        except InvalidValueError as error:
            raise InvalidValueError(f"--ros2-domain: {error}") from None
        via = "listening on" if options.ros2_listen else "router"
        self._where = f"/{name} in domain {options.ros2_domain} ({via} {endpoint})"
        self._server = Ros2Server(
            service,
            name,
            options.ros2_domain,
            endpoint,
            listens=options.ros2_listen is not None,
            on_event=self._tell,
        )


class _Ros1(_OfRos):
    """The service in ROS 1."""

    _wire = "ros1"

    def __init__(self, configuration: Configuration, options: ServeOptions) -> None:
        from holdfast.ros.ros1_service import Ros1Server
        from holdfast.transport.tcpros import RosEnvironment

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

    def _asked_to_end(self, reason: str) -> None:
        if self._on_shutdown is not None:
            self._on_shutdown(reason)
