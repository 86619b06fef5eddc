"""Metrics in the text format of Prometheus, for services and robots; made when they are read.

The names and the numbers are the caller's; the standard metrics of processes are added here.
"""

from __future__ import annotations

import os
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

import msgspec

from holdfast.errors import MetricsError, how_to_install

if TYPE_CHECKING:
    from prometheus_client.core import Metric


BUCKETS_S = (
    *(50e-6, 100e-6, 250e-6, 500e-6),
    *(1e-3, 2.5e-3, 5e-3, 10e-3, 25e-3, 50e-3, 100e-3, 250e-3, 500e-3),
    *(1.0, 2.5, 5.0, 10.0, 30.0, 60.0),
)
"""Upper bounds of the histograms' buckets."""

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
"""Media type of what :func:`exposition` returns."""


class Durations(msgspec.Struct):
    """A histogram of durations: a count per bucket of :data:`BUCKETS_S`, and one beyond."""

    counts: list[int] = msgspec.field(default_factory=lambda: [0] * (len(BUCKETS_S) + 1))
    sum_s: float = 0.0

    def add(self, seconds: float) -> None:
        """Count a duration."""
        self.counts[bisect_left(BUCKETS_S, seconds)] += 1
        self.sum_s += seconds

    def cumulative(self) -> list[tuple[str, float]]:
        """Return the upper bounds and Prometheus's cumulative counts."""
        buckets, count = [], 0
        for end, own in zip((*map(str, BUCKETS_S), "+Inf"), self.counts, strict=True):
            count += own
            buckets.append((end, float(count)))
        return buckets


def require_prometheus() -> None:
    """Raise MetricsError if ``prometheus_client`` is not installed."""
    try:
        import prometheus_client  # noqa: F401
    except ImportError as error:
        advice = how_to_install("prometheus-client")
        raise MetricsError(f"metrics need the package prometheus-client: {advice}") from error


def exposition(families: Iterable[Metric], processes: Sequence[int]) -> bytes:
    """Return the metrics and those of the processes, summed; this process is the first."""
    from prometheus_client import CollectorRegistry, generate_latest

    registry = CollectorRegistry(auto_describe=False)
    registry.register(_FixedCollector([*families, *_process_families(processes)]))
    return generate_latest(registry)


def _process_families(processes: Sequence[int]) -> Iterator[Metric]:
    """Yield the standard process metrics, summed over all processes.

    The start time and the limit on descriptors are the first process's. Its ended children
    count too, so that the computing time does not decrease.
    """
    first, *others = map(_process_metrics, processes)
    for family in first:
        (sample,) = family.samples
        value = sample.value
        if family.name not in ("process_start_time_seconds", "process_max_fds"):
            value += sum(
                other.samples[0].value
                for families in others
                for other in families
                if other.name == family.name
            )
        if family.name == "process_cpu_seconds":
            ended = os.times()
            # Rounded, so that floating-point noise cannot make it decrease.
            value = round(value + ended.children_user + ended.children_system, 6)
        family.samples = [sample._replace(value=value)]
        yield family


def _process_metrics(process: int) -> list[Metric]:
    from prometheus_client import ProcessCollector

    return list(ProcessCollector(pid=lambda: process, registry=None).collect())


class _FixedCollector:
    def __init__(self, families: list[Metric]) -> None:
        self._families = families

    def collect(self) -> list[Metric]:
        return self._families
