"""Metrics: read over HTTP as Prometheus reads them, parsed by its own parser."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from collections.abc import Callable

import pytest
from prometheus_client.parser import text_string_to_metric_families

from holdfast import __version__
from holdfast.runtime.metrics import BUCKETS_S, MetricsError, ServiceMetrics
from holdfast.session.messages import PROTOCOL_VERSION
from holdfast.session.service_limits import ServiceStatistics

Samples = dict[tuple[str, tuple[tuple[str, str], ...]], float]


def fetch(port: int, address: str = "127.0.0.1") -> Samples:
    url = f"http://{address}:{port}/metrics"
    with urllib.request.urlopen(url, timeout=30) as answer:
        text = answer.read().decode()
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def serving(statistics: Callable[[], ServiceStatistics]) -> ServiceMetrics:
    return ServiceMetrics(statistics, name="cloud_active_sensing")


class TestWhatIsTold:
    def test_statistics_are_read_when_asked_for(self) -> None:
        counted = ServiceStatistics()
        server = serving(lambda: counted).start(0)
        try:
            assert fetch(server.port)["holdfast_sessions", ()] == 0
            counted.sessions, counted.waiting, counted.restores = 3, 2, 5
            counted.busy, counted.cache_hits = 7, 11
            counted.task_parts, counted.sensing_parts, counted.state_bytes = 13, 17, 19
            counted.refusals = {"version": 1, "stale_epoch": 4}
            samples = fetch(server.port)
        finally:
            server.close()
        assert samples["holdfast_sessions", ()] == 3
        assert samples["holdfast_waiting_requests", ()] == 2
        assert samples["holdfast_restores_total", ()] == 5
        assert samples["holdfast_busy_total", ()] == 7
        assert samples["holdfast_cache_hits_total", ()] == 11
        assert samples["holdfast_decisions_total", (("kind", "task"),)] == 13
        assert samples["holdfast_decisions_total", (("kind", "sensing"),)] == 17
        assert samples["holdfast_state_bytes", ()] == 19
        assert samples["holdfast_refusals_total", (("code", "version"),)] == 1
        assert samples["holdfast_refusals_total", (("code", "stale_epoch"),)] == 4

    def test_decisions_are_timed_by_kind(self) -> None:
        metrics = serving(ServiceStatistics)
        metrics.on_decision("task", 40e-6, 0.0)
        metrics.on_decision("sensing", 0.003, 0.0002)
        metrics.on_decision("sensing", 120.0, 0.5)
        server = metrics.start(0)
        try:
            samples = fetch(server.port)
        finally:
            server.close()
        task, sensing = (("kind", "task"),), (("kind", "sensing"),)
        assert samples["holdfast_decision_seconds_count", task] == 1
        assert samples["holdfast_decision_seconds_count", sensing] == 2
        assert samples["holdfast_decision_seconds_sum", sensing] == pytest.approx(120.003)
        in_bucket = {
            dict(labels)["le"]: value
            for (name, labels), value in samples.items()
            if name == "holdfast_decision_seconds_bucket" and dict(labels)["kind"] == "sensing"
        }
        assert in_bucket["0.0025"] == 0
        assert in_bucket["0.005"] == in_bucket["60.0"] == 1
        assert in_bucket["+Inf"] == 2
        assert len(in_bucket) == len(BUCKETS_S) + 1
        assert samples["holdfast_wait_seconds_count", ()] == 3

    def test_all_is_there_before_anything_has_happened(self) -> None:
        server = serving(ServiceStatistics).start(0)
        try:
            samples = fetch(server.port)
        finally:
            server.close()
        for kind in ("task", "sensing"):
            assert samples["holdfast_decisions_total", (("kind", kind),)] == 0
        labels = (
            ("protocol", str(PROTOCOL_VERSION)),
            ("service", "cloud_active_sensing"),
            ("version", __version__),
        )
        assert samples["holdfast_build_info", labels] == 1
        if sys.platform == "linux":
            assert samples["process_resident_memory_bytes", ()] > 1e6

    def test_two_services_in_one_process_do_not_mix(self) -> None:
        first, second = (
            serving(lambda: ServiceStatistics(sessions=1)),
            serving(lambda: ServiceStatistics(sessions=2)),
        )
        first.on_decision("task", 0.001, 0.0)
        servers = [first.start(0), second.start(0)]
        try:
            samples = [fetch(server.port) for server in servers]
        finally:
            for server in servers:
                server.close()
        assert [read["holdfast_sessions", ()] for read in samples] == [1, 2]
        task = (("kind", "task"),)
        assert [read["holdfast_decision_seconds_count", task] for read in samples] == [1, 0]

    def test_threads_may_count_at_once(self) -> None:
        metrics = serving(ServiceStatistics)

        def decide() -> None:
            for _ in range(1000):
                metrics.on_decision("task", 0.001, 0.0)

        threads = [threading.Thread(target=decide) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        server = metrics.start(0)
        try:
            assert fetch(server.port)["holdfast_wait_seconds_count", ()] == 4000
        finally:
            server.close()


class TestServer:
    def test_a_port_that_is_taken_is_named(self) -> None:
        with socket.socket() as other:
            other.bind(("127.0.0.1", 0))
            other.listen()
            port = other.getsockname()[1]
            with pytest.raises(
                MetricsError, match=rf"127\.0\.0\.1:{port}: another program listens there"
            ):
                serving(ServiceStatistics).start(port)

    def test_an_address_that_is_not_this_machines_is_named(self) -> None:
        with pytest.raises(MetricsError, match=r"metrics at 192\.0\.2\.1:0: "):
            serving(ServiceStatistics).start(0, "192.0.2.1")

    @pytest.mark.parametrize("port", [-1, 65536])
    def test_a_port_out_of_bounds_is_named(self, port: int) -> None:
        with pytest.raises(MetricsError, match=f"{port} is not between 0 and 65535"):
            serving(ServiceStatistics).start(port)

    def test_after_close_nobody_listens_and_no_thread_is_left(self) -> None:
        before = threading.active_count()
        server = serving(ServiceStatistics).start(0)
        fetch(server.port)
        server.close()
        server.close()
        with pytest.raises(urllib.error.URLError):
            fetch(server.port)
        assert threading.active_count() == before

    def test_nobody_is_held_up_by_a_client_that_says_nothing(self) -> None:
        server = serving(ServiceStatistics).start(0)
        try:
            with socket.create_connection(("127.0.0.1", server.port), timeout=30) as silent:
                assert ("holdfast_sessions", ()) in fetch(server.port)
                assert silent.recv(1) == b""  # it was sent away
        finally:
            server.close()

    @pytest.mark.skipif(not socket.has_dualstack_ipv6(), reason="no IPv6 here")
    def test_it_listens_on_an_address_of_version_6_too(self) -> None:
        server = serving(ServiceStatistics).start(0, "::1")
        try:
            assert ("holdfast_sessions", ()) in fetch(server.port, "[::1]")
        finally:
            server.close()

    def test_the_port_is_free_again_at_once(self) -> None:
        server = serving(ServiceStatistics).start(0)
        fetch(server.port)
        server.close()
        again = serving(ServiceStatistics).start(server.port)
        try:
            assert ("holdfast_sessions", ()) in fetch(again.port)
        finally:
            again.close()


def test_without_the_package_the_error_says_how_to_get_it() -> None:
    program = (
        "import sys; sys.modules['prometheus_client'] = None\n"
        "from holdfast.runtime.metrics import MetricsError, ServiceMetrics\n"
        "try:\n    ServiceMetrics(lambda: None, name='x')\n"
        "except MetricsError as error:\n    print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert 'pip install "holdfast[service]"' in done.stdout


def test_the_package_is_not_imported_before_it_is_used() -> None:
    program = "import sys, holdfast.runtime.metrics; print('prometheus_client' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout == "False\n"
