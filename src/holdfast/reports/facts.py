"""What happened in a recorded run, as a stream of facts in the order of their times.

:class:`holdfast.reports.replay.RecordedRun` produces them, and a :class:`FactSink` writes them as
tables, ROS messages or arrays. All times are on one clock.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import isnan
from typing import Any, NamedTuple, Protocol

from holdfast.journal.run_clock import Stamp
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.belief import Belief
from holdfast.planning.outcome import TrialResult
from holdfast.protocol.robot_events import Timing
from holdfast.robot.trial import LateStep, SensingStep, TaskStep

SCORES = {
    "action_entropy": "expected entropy of\nthe actions (nats)",
    "path_entropy": "expected entropies of\nthe actions, sum (nats)",
    "state_entropy": "expected entropy of\nthe state (nats)",
    "action_covariance": "expected covariance\nof the actions (trace)",
    "expected_return": "expected loss\n(minus the return)",
}
"""What a fact's entropies are, by the method that weighs them, in two lines."""

DECIDER = ("service", "status", "waited_ms", "round_trip_ms", "computed_ms")
"""What of the timing of a decision, the fact's ``decider``, stands beside it."""


def shown_decider(decider: Timing | None) -> dict[str, Any]:
    """Return what is known of :data:`DECIDER`.

    Of an action that came in the answer to an earlier request there are no times but the wait.
    """
    if decider is None:
        return {}
    known = {name: getattr(decider, name) for name in DECIDER}
    return {name: each for name, each in known.items() if isinstance(each, str) or not isnan(each)}


class TrialBeginFact(NamedTuple):
    """A trial begins."""

    trial: int
    time_ns: int


class SensingFact(NamedTuple):
    """A sensing step, and who chose its action; the choice may be not to sense."""

    step: SensingStep
    # When it was chosen, and when its observation was part of the belief.
    decided_ns: int
    observed_ns: int
    decider: Timing | None


class TaskFact(NamedTuple):
    """A task action that was ordered or performed, and who chose it."""

    step: TaskStep
    time_ns: int
    decider: Timing | None
    true_state: FloatArray | None = None  # before the action


class LateFact(NamedTuple):
    """An observation that came late, and when."""

    step: LateStep
    time_ns: int


class TrialEndFact(NamedTuple):
    """A trial ends, or its records do."""

    trial: int
    time_ns: int
    steps: int
    result: TrialResult | None  # None if the trial is not finished
    # After the last action, and the state that stood for the belief; None where the records end
    # before that.
    belief: Belief | None = None
    estimate: FloatArray | None = None
    true_state: FloatArray | None = None


class EventFact(NamedTuple):
    """A line of ``events.jsonl``: its time, its name (such as ``status``) and its other fields."""

    time_ns: int
    name: str
    fields: Mapping[str, Any]
    stamp: Stamp | None = None


class FactSink(Protocol):
    """Writes facts in the order in which they come. They are read-only and need no copy."""

    def trial_begins(self, fact: TrialBeginFact) -> None:
        """Write that a trial begins."""

    def sensed(self, fact: SensingFact) -> None:
        """Write a sensing step."""

    def acted(self, fact: TaskFact) -> None:
        """Write a task action."""

    def observed_late(self, fact: LateFact) -> None:
        """Write an observation that came late."""

    def trial_ends(self, fact: TrialEndFact) -> None:
        """Write the end of a trial."""

    def happened(self, fact: EventFact) -> None:
        """Write an event of the services."""
