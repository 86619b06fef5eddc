"""Metrics as Prometheus reads them, parsed by its own parser; and how they are added up."""

import os
import subprocess
import sys
from collections.abc import Sequence

import msgspec
import pytest
from prometheus_client.parser import text_string_to_metric_families
from tests.programs import said_by

from holdfast import __version__
from holdfast.protocol.messages import PROTOCOL_VERSION
from holdfast.protocol.service_limits import ServiceStatistics
from holdfast.runtime.exposition import BUCKETS_S
from holdfast.service.metrics import DecisionTimes, ServiceReport, service_exposition, summed

Samples = dict[tuple[str, tuple[tuple[str, str], ...]], float]


def samples_of(text: str) -> Samples:
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def told(report: ServiceReport, processes: Sequence[int] = ()) -> Samples:
    own = (os.getpid(),)
    text = service_exposition("cloud_active_sensing", report, processes or own).decode()
    return samples_of(text)


class TestWhatIsTold:
    def test_statistics(self) -> None:
        counted = ServiceStatistics()
        counted.sessions, counted.waiting, counted.restores = 3, 2, 5
        counted.busy, counted.cache_hits = 7, 11
        counted.task_parts, counted.sensing_parts, counted.state_bytes = 13, 17, 19
        counted.refusals = {"version": 1, "stale_epoch": 4}
        samples = told(ServiceReport(counted))
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

    def test_nothing_that_is_counted_is_kept_back(self) -> None:
        for field in ServiceStatistics.__struct_fields__:
            value = {"version": 12345} if field == "refusals" else 12345
            statistics = msgspec.structs.replace(ServiceStatistics(), **{field: value})
            ours = [
                each
                for (name, _), each in told(ServiceReport(statistics)).items()
                if "fast" in name
            ]
            assert ours.count(12345) == 1, field

    def test_decisions_are_timed_by_kind(self) -> None:
        times = DecisionTimes()
        times.add("task", 40e-6, 0.0)
        times.add("sensing", 0.003, 0.0002)
        times.add("sensing", 0.005, 0.0002)  # a bucket's upper end belongs to it
        times.add("sensing", 120.0, 0.5)
        samples = told(ServiceReport(times=times))
        task, sensing = (("kind", "task"),), (("kind", "sensing"),)
        assert samples["holdfast_decision_seconds_count", task] == 1
        assert samples["holdfast_decision_seconds_count", sensing] == 3
        assert samples["holdfast_decision_seconds_sum", sensing] == pytest.approx(120.008)
        in_bucket = {
            dict(labels)["le"]: value
            for (name, labels), value in samples.items()
            if name == "holdfast_decision_seconds_bucket" and dict(labels)["kind"] == "sensing"
        }
        assert in_bucket["0.0025"] == 0
        assert in_bucket["0.005"] == in_bucket["60.0"] == 2
        assert in_bucket["+Inf"] == 3
        assert len(in_bucket) == len(BUCKETS_S) + 1
        assert samples["holdfast_wait_seconds_count", ()] == 4

    def test_all_is_there_before_anything_has_happened(self) -> None:
        samples = told(ServiceReport())
        for kind in ("task", "sensing"):
            assert samples["holdfast_decisions_total", (("kind", kind),)] == 0
            assert samples["holdfast_decision_seconds_count", (("kind", kind),)] == 0
        labels = (
            ("protocol", str(PROTOCOL_VERSION)),
            ("service", "cloud_active_sensing"),
            ("version", __version__),
        )
        assert samples["holdfast_build_info", labels] == 1
        assert samples["holdfast_process_restarts_total", ()] == 0

    @pytest.mark.skipif(sys.platform != "linux", reason="the system tells it there")
    def test_processes_are_told_as_one(self) -> None:
        one = told(ServiceReport())
        child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
        try:
            ids = [os.getpid(), child.pid]
            both = told(ServiceReport(), ids)
        finally:
            child.communicate(b"\n", timeout=120)
        assert one["process_resident_memory_bytes", ()] > 1e6
        assert both["process_open_fds", ()] > one["process_open_fds", ()]
        assert both["process_start_time_seconds", ()] == one["process_start_time_seconds", ()]
        assert both["process_max_fds", ()] == one["process_max_fds", ()]
        # What has ended still counts.
        after = told(ServiceReport())
        assert after["process_cpu_seconds_total", ()] >= both["process_cpu_seconds_total", ()]


class TestAddingUp:
    def test_counts_gauges_and_times(self) -> None:
        reports = []
        for index in (1, 2):
            times = DecisionTimes()
            times.add("task", 0.001 * index, 0.5)
            statistics = ServiceStatistics(task_parts=index, sessions=10 * index)
            statistics.refusals = {"version": 1, f"only_{index}": index}
            reports.append(ServiceReport(statistics, times))
        total = summed(reports)
        assert total.statistics.task_parts == 3
        assert total.statistics.sessions == 30
        assert total.statistics.refusals == {"version": 2, "only_1": 1, "only_2": 2}
        samples = told(total)
        assert samples["holdfast_decision_seconds_count", (("kind", "task"),)] == 2
        assert samples["holdfast_decision_seconds_sum", (("kind", "task"),)] == pytest.approx(0.003)
        assert samples["holdfast_wait_seconds_sum", ()] == 1.0
        # The summands are as they were.
        assert reports[0].statistics.refusals == {"version": 1, "only_1": 1}
        assert sum(reports[0].times.task.counts) == 1

    def test_a_process_that_has_ended_holds_nothing_but_counts(self) -> None:
        statistics = ServiceStatistics(task_parts=5, busy=2, sessions=3, state_bytes=7, waiting=1)
        left = ServiceReport(statistics).without_gauges().statistics
        assert (left.task_parts, left.busy) == (5, 2)
        assert (left.sessions, left.state_bytes, left.waiting, left.running, left.calls) == (0,) * 5
        assert statistics.sessions == 3


def test_without_the_package_the_error_says_how_to_get_it() -> None:
    program = (
        "import sys; sys.modules['prometheus_client'] = None\n"
        "from holdfast.errors import MetricsError\n"
        "from holdfast.runtime.exposition import require_prometheus\n"
        "try:\n    require_prometheus()\n"
        "except MetricsError as error:\n    print(error)\n"
    )
    assert "pip install prometheus-client" in said_by(program)


def test_the_package_is_not_imported_before_it_is_used() -> None:
    modules = "sys, holdfast.service.metrics, holdfast.robot.metrics"
    program = f"import {modules}; print('prometheus_client' in sys.modules)"
    assert said_by(program) == "False\n"
