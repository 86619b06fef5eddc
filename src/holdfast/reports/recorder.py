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
from holdfast.robot.lost_values import LostValues
from holdfast.robot.trial import SensingStep, TaskStep

MAX_PARTICLES_KEPT = 500
"""Particles kept of a belief; more would not show in a figure."""

MAX_STEPS_KEPT = 100_000
"""Steps kept of a trial, so that a recorder's memory is bounded."""


@dataclass
class TrialRecord:
    """One trial, step by step."""

    # The world's states, before the first step and after each; empty if the world hides them.
    true_states: list[FloatArray] = field(default_factory=list)
    # Of the belief from which each task action was chosen, and of the last belief.
    estimates: list[FloatArray] = field(default_factory=list)
    standard_deviations: list[FloatArray] = field(default_factory=list)
    actions: list[FloatArray] = field(default_factory=list)  # executed task actions
    rewards: list[float] = field(default_factory=list)  # NaN where the environment reported none
    # Of their beliefs at most 500 particles each, with weights that are normalised.
    sensing: list[SensingStep] = field(default_factory=list)
    result: TrialResult | None = None  # None while the trial runs
    lost_values: tuple[str, ...] = ()  # :class:`LostValues`, of a simulated world


class Recorder(LostValues):
    """An observer that records one trial, and of all others only the values that they lose.

    A planner says what is estimated, and its problem which coordinates are angles; without one the
    estimate is the mean. ``record`` is complete when ``record.result`` is not None.
    """

    def __init__(self, trial: int, planner: Planner | None = None) -> None:
        self.trial = trial
        self._planner = planner
        self.record = TrialRecord()

    def trial_began(self, environment: Environment, state: PlanningState) -> None:
        """Start a new record if this is the trial."""
        super().trial_began(environment, state)
        if state.trial == self.trial:
            self.record = TrialRecord()
            self._keep(true_state(environment))

    @in_own_mode
    def sensed(self, step: SensingStep) -> None:
        """Keep a sensing step."""
        if not self._keeps(step.before):
            return
        info = step.sensing_info._replace(samples=None)
        before, after = _thinned(step.before), _thinned(step.after)
        self.record.sensing.append(step._replace(before=before, after=after, sensing_info=info))

    @in_own_mode
    def acted(self, step: TaskStep) -> None:
        """Keep a step."""
        if not self._keeps(step.state):
            return
        mean = np.array(step.task_info.estimate, dtype=np.float64)
        self._keep(true_state(step.environment))
        self.record.estimates.append(mean)
        self.record.standard_deviations.append(self._deviation(step.state))
        self.record.actions.append(np.array(step.executed, dtype=np.float64))
        self.record.rewards.append(float("nan") if step.reward is None else float(step.reward))

    @in_own_mode
    def trial_ended(self, state: PlanningState, result: TrialResult) -> None:
        """Keep the last belief and the outcome."""
        super().trial_ended(state, result)
        if state.trial != self.trial:
            return
        if self._keeps(state):
            self.record.estimates.append(self._estimate(state))
            self.record.standard_deviations.append(self._deviation(state))
        self.record.result, self.record.lost_values = result, self.lost

    def _deviation(self, state: PlanningState) -> FloatArray:
        circular = () if self._planner is None else circular_states(self._planner.problem)
        return standard_deviation(state.belief, circular)

    def _estimate(self, state: PlanningState) -> FloatArray:
        return estimate(state.belief) if self._planner is None else self._planner.estimate(state)

    def _keeps(self, state: PlanningState) -> bool:
        return state.trial == self.trial and state.step < MAX_STEPS_KEPT

    def _keep(self, state: FloatArray | None) -> None:
        if state is not None:
            self.record.true_states.append(state)


def true_state(environment: Environment) -> FloatArray | None:
    """Return a copy of the world's own state, which only a simulated world knows."""
    state = getattr(environment, "state", None)
    return None if state is None else np.array(state, dtype=np.float64)


def _thinned(state: PlanningState) -> PlanningState:
    states, weights = state.belief
    every = -(-len(states) // MAX_PARTICLES_KEPT)
    some = np.array(weights[::every], dtype=np.float64)
    total = some.sum()
    # None of these few need have any weight.
    some = some / total if total > 0.0 else np.full(len(some), 1 / len(some))
    return state._replace(belief=Belief(np.array(states[::every], dtype=np.float64), some))
