"""A robot's metrics for Prometheus: what its machine has counted, and who decided how soon."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING

from holdfast import __version__
from holdfast.planning.outcome import TrialResult
from holdfast.protocol.messages import PROTOCOL_VERSION
from holdfast.protocol.robot import Robot
from holdfast.protocol.robot_events import Timing
from holdfast.protocol.status import Status
from holdfast.runtime.exposition import Durations, exposition, require_prometheus

if TYPE_CHECKING:
    from prometheus_client.core import Metric

_COUNTERS = (
    ("wrong_answer", "wrong_answers", "Wrong answers; their service is asked no more in this run."),
    ("no_reading", "missing_observations", "Sensing actions that gave no reading."),
    ("unexplained", "unexplained_observations", "Observations that no particle explains."),
    ("lost", "lost", "Times that the robot was found lost."),
    ("sensor_suspect", "sensor_suspects", "Times that a sensing action was found suspect."),
    ("reinitialised", "reinitialisations", "Times that the belief began anew."),
)


class RobotMetrics:
    """Counts what this process of a robot does, and writes it in Prometheus's text format.

    Raises a MetricsError if ``prometheus_client`` is not installed.
    """

    def __init__(self) -> None:
        require_prometheus()
        self._decisions: Counter[tuple[str, str]] = Counter()
        self._waited = Durations()
        self._trials: Counter[str] = Counter()

    def timed(self, timing: Timing) -> None:
        """Count a decision."""
        self._decisions[timing.service, timing.kind] += 1
        self._waited.add(1e-3 * timing.waited_ms)

    def ended(self, result: TrialResult) -> None:
        """Count a trial."""
        self._trials[result.outcome] += 1

    def text(self, robot: Robot, *, is_deciding: bool) -> bytes:
        """Return the metrics."""
        return exposition(self._families(robot, is_deciding), (os.getpid(),))

    def _families(self, robot: Robot, is_deciding: bool) -> Iterator[Metric]:
        from prometheus_client.core import (
            CounterMetricFamily,
            GaugeMetricFamily,
            HistogramMetricFamily,
        )

        build = GaugeMetricFamily(
            "holdfast_robot_build_info",
            "Version of holdfast and of its protocol.",
            labels=["version", "protocol"],
        )
        build.add_metric([__version__, str(PROTOCOL_VERSION)], 1)
        yield build
        yield GaugeMetricFamily(
            "holdfast_robot_deciding", "Whether anybody decides, as /readyz.", int(is_deciding)
        )
        yield GaugeMetricFamily(
            "holdfast_robot_holding", "Whether it holds still.", int(robot.is_holding)
        )
        status = GaugeMetricFamily(
            "holdfast_robot_status", "1 for the status that it is in.", labels=["status"]
        )
        for each in Status:
            status.add_metric([each.value], int(each is robot.status))
        yield status
        if (state := robot.state) is not None:
            yield GaugeMetricFamily("holdfast_robot_trial", "The current trial.", state.trial)
            yield GaugeMetricFamily("holdfast_robot_step", "The step in that trial.", state.step)
        trials = CounterMetricFamily(
            "holdfast_robot_trials", "Trials finished, by outcome.", labels=["outcome"]
        )
        for outcome, count in sorted(self._trials.items()):
            trials.add_metric([outcome], count)
        yield trials
        decisions = CounterMetricFamily(
            "holdfast_robot_decisions",
            "Answers used, by who gave them and by kind.",
            labels=["service", "kind"],
        )
        for labels, count in sorted(self._decisions.items()):
            decisions.add_metric(labels, count)
        yield decisions
        yield HistogramMetricFamily(
            "holdfast_robot_wait_seconds",
            "Time for which the robot stood still for an answer.",
            buckets=self._waited.cumulative(),
            sum_value=self._waited.sum_s,
        )
        yield CounterMetricFamily(
            "holdfast_robot_steps", "Task actions performed.", robot.num_performed
        )
        yield CounterMetricFamily(
            "holdfast_robot_missed_ticks", "Ticks of --rate that were missed.", robot.missed_ticks
        )
        for kind, name, text in _COUNTERS:
            yield CounterMetricFamily(f"holdfast_robot_{name}", text, robot.reports.counts[kind])
