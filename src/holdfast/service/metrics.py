"""A service's metrics for Prometheus, formatted when they are read.

The service's state machine has counters, and each decision adds to histograms of times. A
:class:`ServiceReport` holds both. Reports of several processes are summed, with those of ended
processes, so that no counter decreases. ``prometheus_client`` could add them up, too, but then each
process would load it at its start, while robots may wait: 45 ms.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Literal, TypeAlias

import msgspec

from holdfast import __version__
from holdfast.protocol.messages import PROTOCOL_VERSION
from holdfast.protocol.service_limits import ServiceStatistics
from holdfast.runtime.exposition import Durations, exposition

if TYPE_CHECKING:
    from prometheus_client.core import Metric

DecisionKind: TypeAlias = Literal["task", "sensing"]

_COUNTERS = (
    ("restores", "States taken from a robot's checkpoint."),
    ("state_requests", "Requests answered with the wish for the state."),
    ("states_diverged", "States that came out otherwise than on the robot."),
    ("busy", "Requests turned away for want of capacity."),
    ("cache_hits", "Requests answered from what was computed before."),
    ("attached", "Requests that joined one already in work."),
    ("superseded", "Requests dropped for a newer one of the same robot."),
    ("sessions_opened", "Sessions opened."),
    ("sessions_taken_over", "Sessions that a restarted robot went on with."),
    ("sessions_evicted", "Sessions forgotten for want of room."),
    ("defects", "Unexpected exceptions, each of which has ended a request or a link."),
)
_GAUGES = (
    ("sessions", "sessions", "Sessions held."),
    ("state_bytes", "state_bytes", "Size of all states held."),
    ("waiting", "waiting_requests", "Requests that wait for their turn."),
    ("running", "running_jobs", "Decisions being computed."),
    ("calls", "open_calls", "Calls that have not ended."),
)


class DecisionTimes(msgspec.Struct):
    """The computing times of decisions by kind, and their waiting times."""

    task: Durations = msgspec.field(default_factory=Durations)
    sensing: Durations = msgspec.field(default_factory=Durations)
    waited: Durations = msgspec.field(default_factory=Durations)

    def add(self, kind: DecisionKind, computed_s: float, waited_s: float) -> None:
        """Count the times of a decision."""
        (self.task if kind == "task" else self.sensing).add(computed_s)
        self.waited.add(waited_s)


class ServiceReport(msgspec.Struct):
    """The counters of one process of a service, or the sum of several."""

    statistics: ServiceStatistics = msgspec.field(default_factory=ServiceStatistics)
    times: DecisionTimes = msgspec.field(default_factory=DecisionTimes)
    restarts: int = 0
    """Worker processes that ended and were started again."""
    certificate_expires_s: float | None = None
    """The earliest end of a certificate in use, in seconds since 1970."""
    stale_credentials: int = 0
    """Processes that could not read their changed credentials."""
    why_not_ready: str | None = None
    """Why a process takes no robots; None if it does."""

    def without_gauges(self) -> ServiceReport:
        """Return the report of an ended process: its counters, without what it held."""
        nothing_held = {field: 0 for field, _, _ in _GAUGES}
        return ServiceReport(msgspec.structs.replace(self.statistics, **nothing_held), self.times)


def summed(reports: Iterable[ServiceReport]) -> ServiceReport:
    """Return the sum of reports, as an independent copy."""
    total = ServiceReport()
    for report in reports:
        total.restarts += report.restarts
        total.stale_credentials += report.stale_credentials
        ends = (total.certificate_expires_s, report.certificate_expires_s)
        total.certificate_expires_s = min((end for end in ends if end is not None), default=None)
        mine, theirs = total.statistics, report.statistics
        for field in theirs.__struct_fields__:
            value = getattr(theirs, field)
            if isinstance(value, dict):
                counts = getattr(mine, field)
                for key, count in value.items():
                    counts[key] = counts.get(key, 0) + count
            else:
                setattr(mine, field, getattr(mine, field) + value)
        for field in total.times.__struct_fields__:
            sums, summands = getattr(total.times, field), getattr(report.times, field)
            sums.counts = [a + b for a, b in zip(sums.counts, summands.counts, strict=True)]
            sums.sum_s += summands.sum_s
    return total


def service_exposition(
    name: str, report: ServiceReport, processes: Sequence[int], *, is_ready: bool = True
) -> bytes:
    """Return a service's report in Prometheus's text format.

    The memory and time of the processes are summed; this process is the first.
    """
    return exposition(_families(name, report, is_ready), processes)


def _families(name: str, report: ServiceReport, is_ready: bool) -> Iterator[Metric]:
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily

    now, times = report.statistics, report.times
    build = GaugeMetricFamily(
        "holdfast_build_info",
        "Version of holdfast and of its protocol, and the service's name.",
        labels=["version", "protocol", "service"],
    )
    build.add_metric([__version__, str(PROTOCOL_VERSION), name], 1)
    yield build
    yield GaugeMetricFamily("holdfast_ready", "Whether robots are welcome.", int(is_ready))
    if report.certificate_expires_s is not None:
        yield GaugeMetricFamily(
            "holdfast_certificate_expiry_timestamp_seconds",
            "When the certificate in use expires, in seconds since 1970.",
            report.certificate_expires_s,
        )
        yield GaugeMetricFamily(
            "holdfast_credentials_stale",
            "Processes that could not read changed credentials: they use the previous ones, "
            "and know of no later revocation.",
            report.stale_credentials,
        )
    decisions = CounterMetricFamily(
        "holdfast_decisions", "Parts of answers computed.", labels=["kind"]
    )
    decisions.add_metric(["task"], now.task_parts)
    decisions.add_metric(["sensing"], now.sensing_parts)
    yield decisions
    seconds = HistogramMetricFamily(
        "holdfast_decision_seconds", "Time to compute a decision.", labels=["kind"]
    )
    seconds.add_metric(["task"], times.task.cumulative(), times.task.sum_s)
    seconds.add_metric(["sensing"], times.sensing.cumulative(), times.sensing.sum_s)
    yield seconds
    yield HistogramMetricFamily(
        "holdfast_wait_seconds",
        "Time for which a decision waited for its turn.",
        buckets=times.waited.cumulative(),
        sum_value=times.waited.sum_s,
    )
    refusals = CounterMetricFamily(
        "holdfast_refusals", "Requests refused, by code.", labels=["code"]
    )
    for code, count in sorted(now.refusals.items()):
        refusals.add_metric([code], count)
    yield refusals
    for field, text in _COUNTERS:
        yield CounterMetricFamily(f"holdfast_{field}", text, getattr(now, field))
    for field, gauge, text in _GAUGES:
        yield GaugeMetricFamily(f"holdfast_{gauge}", text, getattr(now, field))
    yield CounterMetricFamily(
        "holdfast_process_restarts", "Processes of the service started again.", report.restarts
    )
