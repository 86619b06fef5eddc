"""An observer that records one trial for its figure."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.floating_mode import in_own_mode
from holdfast.planning.belief import Belief, estimate, standard_deviation
from holdfast.planning.outcome import TrialResult
from holdfast.planning.planner import Planner, PlanningState
from holdfast.problems.attributes import circular_states
from holdfast.robot.environment import Environment
from holdfast.robot.trial import SensingStep, TaskStep, TrialObserver

__all__ = ["Recorder", "SensingRecord", "TrialRecord"]

MAX_PARTICLES_KEPT = 500
"""Particles kept of a belief; more would not show in a figure."""

MAX_STEPS_KEPT = 100_000
"""Steps kept of a trial, so that a recorder's memory is bounded."""


@dataclass(frozen=True)
class SensingRecord:
    """One sensing step.

    Attributes
    ----------
    entropies : array of shape (num_sensing_actions,) or None
        What was minimised; None if nothing was.
    before, after : array of shape (at most 500, state_size)
        Particles of the belief before and after the observation.
    weights : array of shape (at most 500,)
        Of the particles after, normalised.
    explained : bool
        Whether any particle explained the observation.
    """

    step: int
    sensing_action: int
    entropies: FloatArray | None
    before: FloatArray
    after: FloatArray
    weights: FloatArray
    explained: bool


@dataclass
class TrialRecord:
    """One trial, step by step.

    Attributes
    ----------
    true_states : list of array
        The world's states, before the first step and after each; empty if the world hides them.
    estimates, standard_deviations : list of array
        Of the belief from which each task action was chosen, and of the last belief.
    actions : list of array
        Executed task actions.
    rewards : list of float
        NaN where the environment reported none.
    result : TrialResult or None
        None while the trial runs.
    """

    true_states: list[FloatArray] = field(default_factory=list)
    estimates: list[FloatArray] = field(default_factory=list)
    standard_deviations: list[FloatArray] = field(default_factory=list)
    actions: list[FloatArray] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    sensing: list[SensingRecord] = field(default_factory=list)
    result: TrialResult | None = None


class Recorder(TrialObserver):
    """An observer that records one trial and ignores all others.

    A planner says what is estimated, and its problem which coordinates are angles; without one the
    estimate is the mean.

    Attributes
    ----------
    record : TrialRecord
        Complete when ``record.result`` is not None.
    """

    def __init__(self, trial: int, planner: Planner | None = None) -> None:
        self.trial = trial
        self._planner = planner
        self.record = TrialRecord()

    def trial_began(self, environment: Environment, state: PlanningState) -> None:
        """Start a new record if this is the trial."""
        if state.trial == self.trial:
            self.record = TrialRecord()
            self._keep_true_state(environment)

    @in_own_mode
    def sensed(self, step: SensingStep) -> None:
        """Keep a sensing step."""
        if not self._keeps(step.before):
            return
        entropies = step.sensing_info.entropies
        self.record.sensing.append(
            SensingRecord(
                step=step.before.step,
                sensing_action=step.sensing_action,
                entropies=None if entropies is None else np.array(entropies, dtype=np.float64),
                before=_some_particles(step.before.belief),
                after=_some_particles(step.after.belief),
                weights=_some_weights(step.after.belief),
                explained=step.observation_info.explained,
            )
        )

    @in_own_mode
    def acted(self, step: TaskStep) -> None:
        """Keep a step."""
        if not self._keeps(step.state):
            return
        mean = np.array(step.task_info.estimate, dtype=np.float64)
        self._keep_true_state(step.environment)
        self.record.estimates.append(mean)
        self.record.standard_deviations.append(self._deviation(step.state))
        self.record.actions.append(np.array(step.executed, dtype=np.float64))
        self.record.rewards.append(float("nan") if step.reward is None else float(step.reward))

    @in_own_mode
    def trial_ended(self, state: PlanningState, result: TrialResult) -> None:
        """Keep the last belief and the outcome."""
        if state.trial != self.trial:
            return
        if self._keeps(state):
            self.record.estimates.append(self._estimate(state))
            self.record.standard_deviations.append(self._deviation(state))
        self.record.result = result

    def _deviation(self, state: PlanningState) -> FloatArray:
        circular = () if self._planner is None else circular_states(self._planner.problem)
        return standard_deviation(state.belief, circular)

    def _estimate(self, state: PlanningState) -> FloatArray:
        return estimate(state.belief) if self._planner is None else self._planner.estimate(state)

    def _keeps(self, state: PlanningState) -> bool:
        return state.trial == self.trial and state.step < MAX_STEPS_KEPT

    def _keep_true_state(self, environment: Environment) -> None:
        # Only a simulated world knows its own state; a robot's does not have the attribute.
        state = getattr(environment, "state", None)
        if state is not None:
            self.record.true_states.append(np.array(state, dtype=np.float64))


def _some_particles(belief: Belief) -> FloatArray:
    return np.array(belief.states[:: _stride(belief)], dtype=np.float64)


def _some_weights(belief: Belief) -> FloatArray:
    weights = np.array(belief.weights[:: _stride(belief)], dtype=np.float64)
    total = weights.sum()
    # None of these few need have any.
    return np.asarray(weights / total if total > 0.0 else np.full(len(weights), 1 / len(weights)))


def _stride(belief: Belief) -> int:
    return -(-len(belief.states) // MAX_PARTICLES_KEPT)
