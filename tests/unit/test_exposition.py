"""Metrics in the text format: the histogram of durations, and those of this process."""

import os

import pytest
from prometheus_client.core import GaugeMetricFamily
from tests.unit.test_service_metrics import samples_of

from holdfast.runtime.exposition import BUCKETS_S, Durations, exposition


def test_a_bucket_has_its_upper_end_and_all_below() -> None:
    durations = Durations()
    for seconds in (0.005, 0.005000001, 1e9, 0.0):
        durations.add(seconds)
    counts = dict(durations.cumulative())
    assert len(counts) == len(BUCKETS_S) + 1
    assert (counts["0.0025"], counts["0.005"], counts["0.01"]) == (1.0, 2.0, 3.0)
    assert (counts["60.0"], counts["+Inf"]) == (3.0, 4.0)
    assert durations.sum_s == pytest.approx(1e9 + 0.010000001)


def test_the_process_is_told_beside_the_metrics() -> None:
    text = exposition([GaugeMetricFamily("own", "Mine.", 3)], (os.getpid(),)).decode()
    values = {name: value for (name, _), value in samples_of(text).items()}
    assert values["own"] == 3
    assert values["process_cpu_seconds_total"] > 0
