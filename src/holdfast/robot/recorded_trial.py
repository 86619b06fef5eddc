"""A recorded trial, run again from its records: the planner must come to each decision again.

A robot's own world cannot be run again. But all that the planner had of it is in the journal: the
same observations, given to the same planner in the same order, lead to the same beliefs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

from holdfast.errors import DecidedOtherwiseError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.outcome import Ending, MoveResult, TrialResult
from holdfast.planning.planner import Planner, PlanningState, TaskInfo
from holdfast.planning.tracking import Trial
from holdfast.protocol.messages import encode_floats, numbers_of
from holdfast.protocol.records import (
    ActingRecord,
    LateRecord,
    ObservedRecord,
    PerformedRecord,
    Record,
    ReinitialisedRecord,
)
from holdfast.robot.environment import Environment, SimulatedEnvironment
from holdfast.robot.trial import LateStep, SensingStep, TaskStep, TrialObserver


def run_recorded_trial(
    planner: Planner,
    seed: int,
    trial: int,
    # In the order in which they were written; the one of the last performance may be missing.
    records: Sequence[Record],
    observer: TrialObserver,
    # None if the trial is not finished: then it does not end, and None is returned.
    result: TrialResult | None = None,
    # Performs the same task actions, so that the true state is known.
    simulated: SimulatedEnvironment | None = None,
) -> TrialResult | None:
    """Run a trial again, as far as its records go.

    Raises DecidedOtherwiseError if a decision is another one than the recorded.
    """
    again = _Again(Trial(planner, seed, trial), observer, simulated)
    for record in records:
        again.take(record)
    again.perform()
    if result is None:
        return None
    if again.track.state.step != result.steps:
        raise DecidedOtherwiseError(trial, again.track.state.step, None)
    ended = again.track.result(Ending(result.outcome, result.reason))
    observer.trial_ended(again.track.state, ended)
    return ended


class _Again:
    """A trial that is run again, and the task action that is chosen and not performed yet."""

    def __init__(
        self, track: Trial, observer: TrialObserver, simulated: SimulatedEnvironment | None
    ) -> None:
        self.track = track
        self._observer = observer
        self._simulated = simulated
        # For the observer, which asks it for the true state alone.
        self._environment = cast("Environment", simulated)
        self._chosen: tuple[PlanningState, FloatArray, TaskInfo] | None = None
        observer.trial_began(self._environment, track.state)

    def take(self, record: Record) -> None:
        if isinstance(record, ObservedRecord):
            self.perform()
            self._sense(record)
        elif isinstance(record, ActingRecord):
            self.perform()
            self._choose(record)
        elif isinstance(record, PerformedRecord):
            shown = numbers_of(record.motion), numbers_of(record.observation)
            self.perform(record.reward, *shown)
        elif isinstance(record, LateRecord):
            late = record.late()
            found = self.track.observe_late(late)
            if found is not None:
                self._observer.observed_late(LateStep(late, self.track.state, found[0]))
        elif isinstance(record, ReinitialisedRecord):
            self.track.reinitialise()
            self._observer.reinitialised(self.track.state)

    def _sense(self, record: ObservedRecord) -> None:
        track, before = self.track, self.track.state
        otherwise = DecidedOtherwiseError(before.trial, before.step, "sensing")
        if not track.planner.needs_sensing(before):
            raise otherwise
        chosen, sensing_info = track.planner.choose_sensing_action(before)
        if chosen != record.sensing_action:
            raise otherwise
        observation = numbers_of(record.observation)
        info, _ = track.observe(chosen, observation, record.sensing_ms)
        self._observer.sensed(
            SensingStep(before, chosen, sensing_info, observation, track.state, info)
        )

    def _choose(self, record: ActingRecord) -> None:
        planner, state = self.track.planner, self.track.state
        executed, info = planner.choose_task_action(state)
        if planner.needs_sensing(state) or encode_floats(executed) != record.action:
            raise DecidedOtherwiseError(state.trial, state.step, "task")
        self._chosen = state, executed, info

    def perform(
        self,
        reward: float | None = None,
        motion: FloatArray | None = None,
        observation: FloatArray | None = None,
    ) -> None:
        """Perform what was chosen, unless a record has said so already."""
        if self._chosen is None:
            return
        (before, executed, task_info), self._chosen = self._chosen, None
        if self._simulated is not None:
            self._simulated.perform(executed)
        info = self.track.move(executed, reward, motion, observation)
        shown = MoveResult(reward, motion, observation)
        self._observer.acted(
            TaskStep(self._environment, before, task_info, executed, reward, shown, info)
        )
