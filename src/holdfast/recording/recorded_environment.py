"""The world of a recorded trial: it answers what its records say.

A robot's own world cannot be run again. But all that the planner had of it is in the journal: the
same observations, given to the same planner, lead to the same beliefs.

A late observation comes with a task action, or when a robot that was killed goes on: then it may
come before the task action that is next, chosen or not.
"""

from __future__ import annotations

from collections.abc import Sequence

from holdfast.errors import DecidedOtherwiseError, EndOfRecordsError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.outcome import Done, Ending, MoveResult, TrialResult
from holdfast.planning.tracking import LateObservation
from holdfast.protocol.messages import encode_floats, numbers_of
from holdfast.protocol.records import (
    ActingRecord,
    LateRecord,
    ObservedRecord,
    PerformedRecord,
    Record,
)
from holdfast.robot.environment import LATER, Later, SimulatedEnvironment

__all__ = ["RecordedEnvironment"]


class RecordedEnvironment:
    """The world of a recorded trial.

    Parameters
    ----------
    records : sequence of Record
        In the order in which they were written; the one of the last performance may be missing.
    result : TrialResult or None
        None if the trial is not finished: then EndOfRecordsError is raised after the last record.
    simulated : SimulatedEnvironment or None
        Performs the same task actions, so that the true state is known.
    """

    def __init__(
        self,
        trial: int,
        records: Sequence[Record],
        result: TrialResult | None = None,
        simulated: SimulatedEnvironment | None = None,
    ) -> None:
        self._result = result
        self._trial = trial
        self._simulated = simulated
        kinds = ObservedRecord | ActingRecord | PerformedRecord | LateRecord
        self._records: list[Record] = []
        # Those that came when a task action was written down and not performed, by its step.
        self._before_moving: dict[int, list[LateRecord]] = {}
        pending = False
        for record in records:
            if pending and isinstance(record, LateRecord):
                self._before_moving.setdefault(record.step, []).append(record)
            elif isinstance(record, kinds):
                self._records.append(record)
                pending = isinstance(record, ActingRecord)
        self._next = 0
        self._step = 0

    @property
    def state(self) -> FloatArray | None:
        """The true state, where the world is simulated."""
        return None if self._simulated is None else self._simulated.state

    def perform_sensing(self, sensing_action: int) -> FloatArray | Later:
        """Return the recorded observation; DecidedOtherwiseError if it is of another action."""
        record = self._take()
        if not isinstance(record, ObservedRecord) or record.sensing_action != sensing_action:
            raise self._otherwise(record)
        observation = numbers_of(record.observation)
        return LATER if observation is None else observation

    def perform(self, task_action: FloatArray) -> MoveResult:
        """Return what the record has shown; DecidedOtherwiseError if it is of another action."""
        record = self._take()
        if not isinstance(record, ActingRecord) or record.action != encode_floats(task_action):
            raise self._otherwise(record)
        self._step += 1
        if self._simulated is not None:
            self._simulated.perform(task_action)
        if self._next < len(self._records):
            performed = self._records[self._next]
            if isinstance(performed, PerformedRecord):
                self._next += 1
                shown = numbers_of(performed.motion), numbers_of(performed.observation)
                return MoveResult(performed.reward, *shown)
        return MoveResult()

    def late_before_choosing(self) -> list[LateObservation]:
        """Return the observations of earlier steps that came before a task action was chosen."""
        if self._next < len(self._records):
            record = self._records[self._next]
            if isinstance(record, ObservedRecord) and not record.observation:
                self._next += 1  # the choice was not to sense
        return self.late_observations()

    def late_before_moving(self) -> list[LateObservation]:
        """Return those that came between the choice of a task action and its performance."""
        return [record.late() for record in self._before_moving.pop(self._step, ())]

    def late_observations(self) -> list[LateObservation]:
        """Return the observations of earlier steps that came next."""
        late = []
        while self._next < len(self._records):
            record = self._records[self._next]
            if not isinstance(record, LateRecord):
                break
            late.append(record.late())
            self._next += 1
        return late

    def is_done(self) -> Done:
        """Return how the task had ended, or False."""
        if self._result is None:
            if self._next == len(self._records) and self._step:
                raise EndOfRecordsError(self._trial)
            return False
        if self._step < self._result.steps:
            return False
        return Ending(self._result.outcome, self._result.reason)

    def _take(self) -> Record | None:
        if self._next == len(self._records):
            if self._result is None:
                raise EndOfRecordsError(self._trial)
            return None
        self._next += 1
        return self._records[self._next - 1]

    def _otherwise(self, record: Record | None) -> DecidedOtherwiseError:
        kinds = {ObservedRecord: "sensing", ActingRecord: "task"}
        kind = None if record is None else kinds.get(type(record))
        return DecidedOtherwiseError(self._trial, self._step, kind)
