"""Looks on at one trial and keeps what a figure of it needs.

A robot's own world cannot be run again for a figure. But all that the planner had of it is in the
journal: the same observations, given to the same planner, lead to the same
beliefs. What the world's true state was nobody knows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from holdfast.belief import Belief, estimate, standard_deviation
from holdfast.outcome import Done, TrialResult
from holdfast.planning import PlanningState
from holdfast.problems.problem import FloatArray
from holdfast.runtime.environment import Environment
from holdfast.runtime.trial import SensingStep, TaskStep
from holdfast.session.messages import numbers_from, numbers_to
from holdfast.session.records import (
    ActingRecord,
    ObservedRecord,
    PerformedRecord,
    Record,
    RecordError,
)

__all__ = [
    "DecidedOtherwiseError",
    "RecordedEnvironment",
    "Recorder",
    "SensingRecord",
    "TrialRecord",
]

MAX_PARTICLES_KEPT = 500
"""Particles kept of a belief; more would not show in a figure."""

MAX_STEPS_KEPT = 100_000
"""Steps kept of a trial, so that a recorder's memory is bounded."""


class DecidedOtherwiseError(RecordError):
    """A trial is decided otherwise when it is computed again.

    Attributes
    ----------
    step : int
    kind : {"sensing", "task"} or None
        Of the decision in the records; None where they end.
    """

    def __init__(self, trial: int, step: int, kind: str | None) -> None:
        super().__init__(
            f"trial {trial} is decided otherwise at step {step} when it is computed again: the "
            "problem is not deterministic, or a service has decided otherwise"
        )
        self.step = step
        self.kind = kind


@dataclass(frozen=True)
class SensingRecord:
    """What happened at one sensing step.

    Attributes
    ----------
    step : int
    sensing_action : int
    observation : array
    entropies : array of shape (num_sensing_actions,) or None
        What was minimised; None if nothing was.
    before, after : array of shape (at most 500, state_size)
        Particles of the belief before and after the observation.
    explained : bool
        Whether any particle explained the observation.
    """

    step: int
    sensing_action: int
    observation: FloatArray
    entropies: FloatArray | None
    before: FloatArray
    after: FloatArray
    explained: bool


@dataclass
class TrialRecord:
    """What happened in one trial, step by step.

    Attributes
    ----------
    true_states : list of array
        The world's states, before the first step and after each; empty if the world hides them.
    estimates, standard_deviations : list of array
        Of the belief from which each task action was chosen, and of the last belief.
    actions : list of array
        Executed task actions.
    rewards : list of float
        The rewards of the steps, NaN where the environment reported none.
    sensing : list of SensingRecord
    result : TrialResult or None
        The outcome; None while the trial runs.
    """

    true_states: list[FloatArray] = field(default_factory=list)
    estimates: list[FloatArray] = field(default_factory=list)
    standard_deviations: list[FloatArray] = field(default_factory=list)
    actions: list[FloatArray] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    sensing: list[SensingRecord] = field(default_factory=list)
    result: TrialResult | None = None


class Recorder:
    """An observer that records one trial, and looks away from all others.

    Parameters
    ----------
    trial : int
        Number of the trial to record.

    Attributes
    ----------
    record : TrialRecord
        What was seen; complete when ``record.result`` is not None.
    """

    def __init__(self, trial: int) -> None:
        self.trial = trial
        self.record = TrialRecord()

    def trial_began(self, environment: Environment, state: PlanningState) -> None:
        """Start a new record if this is the trial."""
        if state.trial == self.trial:
            self.record = TrialRecord()
            self._keep_true_state(environment)

    def sensed(self, step: SensingStep) -> None:
        """Keep a sensing step."""
        if not self._keeps(step.before):
            return
        entropies = step.sensing_info.entropies
        self.record.sensing.append(
            SensingRecord(
                step=step.before.step,
                sensing_action=step.sensing_action,
                observation=np.array(step.observation, dtype=np.float64),
                entropies=None if entropies is None else np.array(entropies, dtype=np.float64),
                before=_some_particles(step.before.belief),
                after=_some_particles(step.after.belief),
                explained=step.observation_info.explained,
            )
        )

    def acted(self, step: TaskStep) -> None:
        """Keep a step."""
        if not self._keeps(step.state):
            return
        mean = np.array(step.task_info.estimate, dtype=np.float64)
        self._keep_true_state(step.environment)
        self.record.estimates.append(mean)
        self.record.standard_deviations.append(standard_deviation(step.state.belief))
        self.record.actions.append(np.array(step.executed, dtype=np.float64))
        self.record.rewards.append(float("nan") if step.reward is None else float(step.reward))

    def trial_ended(self, state: PlanningState, result: TrialResult) -> None:
        """Keep the last belief and the outcome."""
        if state.trial != self.trial:
            return
        if self._keeps(state):
            self.record.estimates.append(estimate(state.belief))
            self.record.standard_deviations.append(standard_deviation(state.belief))
        self.record.result = result

    def _keeps(self, state: PlanningState) -> bool:
        return state.trial == self.trial and state.step < MAX_STEPS_KEPT

    def _keep_true_state(self, environment: Environment) -> None:
        # Only a simulated world knows its own state; a robot's does not have the attribute.
        state = getattr(environment, "state", None)
        if state is not None:
            self.record.true_states.append(np.array(state, dtype=np.float64))


class RecordedEnvironment:
    """The world of a trial that has ended: it answers what its records say that it answered.

    Parameters
    ----------
    records : sequence of Record
        Of the trial, in the order in which they were written; the one of the last performance may
        be missing.
    result : TrialResult
        What it came to.
    """

    def __init__(self, records: Sequence[Record], result: TrialResult) -> None:
        self.result = result
        self._records = [
            record
            for record in records
            if isinstance(record, ObservedRecord | ActingRecord | PerformedRecord)
        ]
        self._next = 0
        self._step = 0

    def from_the_beginning(self) -> RecordedEnvironment:
        """Return the same world before the trial."""
        return RecordedEnvironment(self._records, self.result)

    def perform_sensing(self, sensing_action: int) -> FloatArray:
        """Return the observation that was made.

        Raises
        ------
        DecidedOtherwiseError
            If another sensing action was performed, or none.
        """
        record = self._take()
        if not isinstance(record, ObservedRecord) or record.sensing_action != sensing_action:
            raise self._otherwise(record)
        return numbers_from(record.observation, len(record.observation) // 8)

    def perform(self, task_action: FloatArray) -> float | None:
        """Return the reward; None where there was none, or it is not in the records.

        Raises
        ------
        DecidedOtherwiseError
            If another task action was performed, or none.
        """
        record = self._take()
        if not isinstance(record, ActingRecord) or record.action != numbers_to(task_action):
            raise self._otherwise(record)
        self._step += 1
        performed = self._take()
        return performed.reward if isinstance(performed, PerformedRecord) else None

    def is_done(self) -> Done:
        """Tell whether the task was done, or had failed."""
        if self._step < self.result.steps:
            return False
        return "failed" if self.result.failed else self.result.success

    def _take(self) -> ObservedRecord | ActingRecord | PerformedRecord | None:
        if self._next == len(self._records):
            return None
        self._next += 1
        return self._records[self._next - 1]

    def _otherwise(self, record: Record | None) -> DecidedOtherwiseError:
        kinds = {ObservedRecord: "sensing", ActingRecord: "task"}
        kind = None if record is None else kinds.get(type(record))
        return DecidedOtherwiseError(self.result.trial, self._step, kind)


def _some_particles(belief: Belief) -> FloatArray:
    stride = -(-len(belief.states) // MAX_PARTICLES_KEPT)
    return np.array(belief.states[::stride], dtype=np.float64)
