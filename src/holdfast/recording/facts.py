"""What happened in a recorded run, as a stream of facts in the order of their times.

:class:`holdfast.recording.replay.RecordedRun` produces them, and a :class:`FactSink` writes them as
tables, ROS messages or arrays. All times are on one clock.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from holdfast.numerics.arrays import FloatArray
from holdfast.planning.belief import Belief
from holdfast.planning.outcome import TrialResult
from holdfast.planning.planner import digest
from holdfast.recording.run_clock import Stamp
from holdfast.robot.trial import LateStep, SensingStep

__all__ = [
    "SCORES",
    "Decider",
    "EventFact",
    "FactSink",
    "LateFact",
    "SensingFact",
    "TaskFact",
    "TrialBeginFact",
    "TrialEndFact",
]


SCORES = {
    "action_entropy": "expected entropy of\nthe actions (nats)",
    "path_entropy": "expected entropies of\nthe actions, sum (nats)",
    "state_entropy": "expected entropy of\nthe state (nats)",
    "action_covariance": "expected covariance\nof the actions (trace)",
    "expected_return": "expected loss\n(minus the return)",
}
"""What a fact's entropies are, by the method that weighs them, in two lines."""


class Decider(NamedTuple):
    """Who made a decision, and how long it took; from ``timings.csv``.

    Attributes
    ----------
    waited_ms : float
        How long the robot stood still for it.
    round_trip_ms, computed_ms : float or None
        None for an action that came in the answer to an earlier request.
    """

    service: str
    status: str
    waited_ms: float
    round_trip_ms: float | None
    computed_ms: float | None

    @classmethod
    def of(cls, answer: Any) -> Decider:
        """Return that of a ``Timing``, or of a row of the table."""
        return cls(*(getattr(answer, name) for name in cls._fields))


class TrialBeginFact(NamedTuple):
    """A trial begins."""

    trial: int
    time_ns: int


class SensingFact(NamedTuple):
    """A sensing action and its observation.

    ``sensing_action`` may be the choice not to sense, one more than the last.

    Attributes
    ----------
    observation : array or None
        None too if it comes late, or never.
    decided_ns, observed_ns : int
        When it was chosen, and when its observation was part of the belief.
    state_digest : bytes
        Of the planning state after the observation.
    before, after : Belief
        The beliefs before and after the observation.
    entropies : array of shape (num_sensing_actions,) or None
        What was minimised, in nats; None if nothing was.
    """

    trial: int
    step: int
    decided_ns: int
    observed_ns: int
    sensing_action: int
    state_digest: bytes
    decider: Decider | None
    before: Belief
    after: Belief
    stage: int
    entropies: FloatArray | None = None
    observation: FloatArray | None = None
    explained: bool | None = None
    resampled: bool | None = None
    effective_sample_size: float | None = None
    mahalanobis_distance: float | None = None

    @classmethod
    def of(
        cls, step: SensingStep, decided_ns: int, observed_ns: int, decider: Decider | None
    ) -> SensingFact:
        """Return the fact of a step."""
        before, after, entropies = step.before, step.after, step.sensing_info.entropies
        info = step.observation_info
        return cls(
            trial=before.trial,
            step=before.step,
            decided_ns=decided_ns,
            observed_ns=observed_ns,
            sensing_action=step.sensing_action,
            state_digest=digest(after),
            decider=decider,
            before=before.belief,
            after=after.belief,
            stage=before.stage,
            entropies=None if entropies is None else np.array(entropies, dtype=np.float64),
            observation=step.observation,
            explained=info.explained,
            resampled=info.resampled,
            effective_sample_size=info.effective_sample_size,
            mahalanobis_distance=info.mahalanobis_distance,
        )


class TaskFact(NamedTuple):
    """A task action that was performed.

    Attributes
    ----------
    action : array of shape (action_size,)
        As it was executed.
    belief, estimate : Belief, array of shape (state_size,)
        From which it was chosen, and the state with which the policy was evaluated.
    true_state : array of shape (state_size,) or None
        Before the action.
    motion, observation : array or None
        What the move has shown.
    """

    trial: int
    step: int
    time_ns: int
    action: FloatArray
    decider: Decider | None
    belief: Belief
    stage: int
    estimate: FloatArray
    true_state: FloatArray | None = None
    reward: float | None = None
    motion: FloatArray | None = None
    observation: FloatArray | None = None


class LateFact(NamedTuple):
    """An observation that came late.

    Attributes
    ----------
    step, taken : int
        Task actions performed when it came, and when it was taken.
    after : Belief
        After it was folded in at its step, and all that followed again.
    """

    trial: int
    step: int
    time_ns: int
    taken: int
    observation: FloatArray
    after: Belief
    explained: bool

    @classmethod
    def of(cls, step: LateStep, time_ns: int) -> LateFact:
        """Return the fact of a late observation."""
        late, after = step.late, step.after
        explained = step.observation_info.explained
        return cls(
            after.trial, after.step, time_ns, late.step, late.observation, after.belief, explained
        )


class TrialEndFact(NamedTuple):
    """A trial ends, or its records do.

    Attributes
    ----------
    result : TrialResult or None
        None if the trial is not finished.
    belief, estimate, true_state
        As in :class:`TaskFact`, after the last action; None where the records end before that.
    """

    trial: int
    time_ns: int
    steps: int
    result: TrialResult | None
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
