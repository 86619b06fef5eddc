"""How a service is doing, for Prometheus: counted by the service, told when somebody asks.

The service's machine counts what it does anyway; these numbers are read when Prometheus fetches
them and cost nothing otherwise. Only the distributions of times are fed decision by decision.
Everything stands in a registry of its own, so two services in one process, as in tests, do not mix.
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Literal, TypeAlias

from holdfast import __version__
from holdfast.errors import HoldfastError
from holdfast.session.messages import PROTOCOL_VERSION

if TYPE_CHECKING:
    from wsgiref.simple_server import WSGIServer

    from prometheus_client import CollectorRegistry
    from prometheus_client.core import Metric

    from holdfast.session.service_limits import ServiceStatistics

__all__ = [
    "BUCKETS_S",
    "DecisionKind",
    "MetricsError",
    "MetricsServer",
    "ServiceMetrics",
]

DecisionKind: TypeAlias = Literal["task", "sensing"]

BUCKETS_S = (
    *(50e-6, 100e-6, 250e-6, 500e-6),
    *(1e-3, 2.5e-3, 5e-3, 10e-3, 25e-3, 50e-3, 100e-3, 250e-3, 500e-3),
    *(1.0, 2.5, 5.0, 10.0, 30.0, 60.0),
)
"""Upper ends of the histograms' buckets: from a task action's arithmetic to a hopeless wait."""

_POLL_S = 0.1  # how soon a server that is closed notices
_PATIENCE_S = 2.0  # with somebody who connects and then says nothing


class MetricsError(HoldfastError):
    """Metrics cannot be offered: the port is taken, or a package is missing."""


class ServiceMetrics:
    """The metrics of one service.

    Parameters
    ----------
    statistics : callable
        Returns what the service has counted
        (:class:`holdfast.session.service_limits.ServiceStatistics`); called from a thread of the
        metrics server.
    name : str
        Of the service.

    Attributes
    ----------
    registry : prometheus_client.CollectorRegistry

    Raises
    ------
    MetricsError
        If ``prometheus_client`` is not installed.
    """

    def __init__(self, statistics: Callable[[], ServiceStatistics], *, name: str) -> None:
        try:
            from prometheus_client import (
                CollectorRegistry,
                Gauge,
                Histogram,
                ProcessCollector,
            )
        except ImportError as error:
            raise MetricsError(
                'metrics need the package prometheus-client: pip install "holdfast[service]"'
            ) from error
        self.registry: CollectorRegistry = CollectorRegistry()
        seconds = Histogram(
            "holdfast_decision_seconds",
            "Time to compute a decision.",
            ["kind"],
            buckets=BUCKETS_S,
            registry=self.registry,
        )
        self._waits = Histogram(
            "holdfast_wait_seconds",
            "Time for which a decision waited for its turn.",
            buckets=BUCKETS_S,
            registry=self.registry,
        )
        kinds: tuple[DecisionKind, ...] = ("task", "sensing")
        # Looked up once, so that a kind that has not come yet is there with zero.
        self._seconds = {kind: seconds.labels(kind) for kind in kinds}
        Gauge(
            "holdfast_build_info",
            "Version of holdfast and of its protocol, and the service's name.",
            ["version", "protocol", "service"],
            registry=self.registry,
        ).labels(__version__, str(PROTOCOL_VERSION), name).set(1)
        ProcessCollector(registry=self.registry)
        self.registry.register(_StatisticsCollector(statistics))

    def on_decision(self, kind: DecisionKind, computed_s: float, waited_s: float) -> None:
        """Note the times of a decision that was computed.

        Parameters
        ----------
        kind : {"task", "sensing"}
        computed_s : float
            How long it took.
        waited_s : float
            How long it had waited before.
        """
        self._seconds[kind].observe(computed_s)
        self._waits.observe(waited_s)

    def start(self, port: int, address: str = "127.0.0.1") -> MetricsServer:
        """Answer Prometheus at ``http://address:port/metrics``, from threads of its own.

        Parameters
        ----------
        port : int
            0 lets the system choose.
        address : str
            Loopback unless said otherwise: whoever reaches it can read, without credentials.

        Returns
        -------
        MetricsServer

        Raises
        ------
        MetricsError
            If it cannot listen there; the message names address and port.
        """
        if not 0 <= port <= 65535:
            raise MetricsError(f"metrics port {port} is not between 0 and 65535")
        try:
            server = _listen(port, address, self.registry)
        except OSError as error:
            taken = error.errno == errno.EADDRINUSE
            reason = "another program listens there" if taken else error.strerror or str(error)
            raise MetricsError(f"metrics at {address}:{port}: {reason}") from error
        return MetricsServer(server)


class MetricsServer:
    """Answers Prometheus until it is closed.

    Attributes
    ----------
    port : int
        Where it listens.
    """

    def __init__(self, server: WSGIServer) -> None:
        import threading

        self._server = server
        self._thread = threading.Thread(
            target=server.serve_forever, args=(_POLL_S,), name="metrics", daemon=True
        )
        self._thread.start()
        self._open = True
        self.port: int = server.server_port

    def close(self) -> None:
        """Listen no more, within about 0.1 s; may be repeated."""
        if not self._open:
            return
        self._open = False
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


def _listen(port: int, address: str, registry: CollectorRegistry) -> WSGIServer:
    """Make a server as ``prometheus_client`` does, but one that nobody can hold up."""
    import socket
    from socketserver import TCPServer, ThreadingMixIn
    from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

    from prometheus_client import make_wsgi_app

    family, *_, where = socket.getaddrinfo(
        address, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
    )[0]

    class Server(ThreadingMixIn, WSGIServer):
        address_family = family
        daemon_threads = True

        def server_bind(self) -> None:
            TCPServer.server_bind(self)
            # HTTPServer's would ask the name service for this machine's name, which can take long.
            self.server_name, self.server_port = address, self.socket.getsockname()[1]
            self.setup_environ()

        def handle_error(self, request: object, client_address: object) -> None:
            """Say nothing: whoever asked has gone away."""

    class Handler(WSGIRequestHandler):
        timeout = _PATIENCE_S

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002
            """Say nothing: a line for every time that somebody looks is too much."""

    server = Server((str(where[0]), port), Handler)
    server.set_app(make_wsgi_app(registry))
    return server


class _StatisticsCollector:
    """Turns a service's own counts into metrics at the moment they are asked for."""

    def __init__(self, statistics: Callable[[], ServiceStatistics]) -> None:
        self._statistics = statistics

    def describe(self) -> list[Metric]:
        """Return nothing: so nobody asks for the statistics only to learn the metrics' names."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yield the metrics."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        now = self._statistics()
        decisions = CounterMetricFamily(
            "holdfast_decisions", "Parts of answers computed.", labels=["kind"]
        )
        decisions.add_metric(["task"], now.task_parts)
        decisions.add_metric(["sensing"], now.sensing_parts)
        yield decisions
        refusals = CounterMetricFamily(
            "holdfast_refusals", "Requests refused, by code.", labels=["code"]
        )
        for code, count in sorted(dict(now.refusals).items()):
            refusals.add_metric([code], count)
        yield refusals
        for name, text, count in (
            ("restores", "States taken from a robot's checkpoint.", now.restores),
            (
                "state_requests",
                "Requests answered with the wish for the state.",
                now.state_requests,
            ),
            ("busy", "Requests turned away for want of capacity.", now.busy),
            ("cache_hits", "Requests answered from what was computed before.", now.cache_hits),
            ("attached", "Requests that joined one already in work.", now.attached),
            ("superseded", "Requests dropped for a newer one of the same robot.", now.superseded),
            ("sessions_opened", "Sessions opened.", now.sessions_opened),
            (
                "sessions_taken_over",
                "Sessions that a restarted robot went on with.",
                now.sessions_taken_over,
            ),
            ("sessions_evicted", "Sessions forgotten for want of room.", now.sessions_evicted),
        ):
            yield CounterMetricFamily(f"holdfast_{name}", text, count)
        for name, text, value in (
            ("sessions", "Sessions held.", now.sessions),
            ("state_bytes", "Size of all states held.", now.state_bytes),
            ("waiting_requests", "Requests that wait for their turn.", now.waiting),
            ("running_jobs", "Decisions being computed.", now.running),
        ):
            yield GaugeMetricFamily(f"holdfast_{name}", text, value)
