"""A trial as it goes: the state that follows from what was done and shown, and its account.

Sensing may take time. The robot goes on meanwhile, and the observation that comes later still
belongs to the step at which it was taken: the state before it is kept, the observation is folded in
there, and what followed is folded again. So the state is a function of the record alone: the one of
a trial in which each observation was there at its step and the same actions were performed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import msgspec

from holdfast.errors import InvalidValueError, MessageError, RecordError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.belief import ObservationInfo
from holdfast.planning.inputs import (
    MAX_INPUTS,
    ActingRecord,
    CatchUpInput,
    Input,
    Late,
    LocalTookOverRecord,
    Moved,
    PausedRecord,
    Record,
    Reinitialised,
    Sensed,
    decode_floats,
    fold,
    has_shown,
)
from holdfast.planning.lost import MOVE, LostTest, Verdict
from holdfast.planning.outcome import DecisionLog, Ending, RewardAccount, TrialResult
from holdfast.planning.planner import Planner, PlanningState
from holdfast.planning.settings import LostSettings

_GivenT = TypeVar("_GivenT", bound=Record)

MAX_AWAITED = 16
"""Bound on the observations that are awaited at once; of more, the oldest is given up."""

MAX_INPUTS_SINCE = 2000
"""Bound on what happened since the oldest awaited observation, which is then given up: all of that
is kept in memory, and folded again when it comes."""


class Trial:
    """A trial so far.

    ``false_alarm_rate`` is the one of :class:`~holdfast.planning.lost.LostTest`.
    """

    def __init__(
        self,
        planner: Planner,
        seed: int,
        trial: int,
        false_alarm_rate: float = LostSettings().false_alarm_rate,
    ) -> None:
        self.planner = planner
        self.state = planner.init(seed, trial)  # after everything that is known to be performed
        self.log = DecisionLog(planner.problem.action_size)
        self.rewards = RewardAccount(planner.problem)
        self.num_sensed = 0  # sensing actions that were performed
        # What led to the state besides task actions: observations and choices not to sense, moves
        # that have shown something, late observations, reinitialisations.
        self.num_inputs = 0
        self.num_missing = 0  # performed, and without an observation so far
        self.num_unexplained = 0  # observations that no particle explains
        self.fewest_distinct: int | None = None  # particles that an observation weighed
        self.lost_test = LostTest(false_alarm_rate)
        self.alarm: Verdict | None = None  # of the last input or move
        self.found: ObservationInfo | None = None  # what its observation was found to be
        self.sensing_ms: list[float] = []  # of each choice of a sensing action
        self.recoveries = 0  # times that the cloud was lost
        # The latest inputs from which a service can fold the state, as many as fit into a request.
        self.inputs: tuple[CatchUpInput, ...] = ()
        self.pending: FloatArray | None = None  # in the journal, and not known to be performed
        self.paused = False  # whether the last record says that the process ended in order
        self.is_lost = False  # by the last observation or move, or by what came late since then
        # From the oldest awaited observation on: each input, the action of a move and, of an
        # awaited one, the state before it.
        self._inputs: list[tuple[Input, FloatArray | None]] = []
        self._before: dict[int, PlanningState] = {}

    @property
    def awaited(self) -> tuple[int, ...]:
        """Steps whose observation is still to come, oldest first."""
        return tuple(state.step for state in self._before.values())

    @property
    def begun(self) -> bool:
        """Whether anything has happened."""
        return self.num_inputs > 0  # a trial begins with the choice of what to sense

    @property
    def actions(self) -> list[FloatArray]:
        """The task actions that were performed, in order."""
        decided = self.log.decisions()
        return [each.task_action for each in decided if isinstance(each, ActingRecord)]

    def take(self, given: _GivenT) -> _GivenT:
        """Fold in a record; return it with the digest of the state that it leads to.

        Raises RecordError if it does not follow from those before it, and HoldfastError if the
        problem cannot fold it in. Nothing is changed by a record that raises.
        """
        digest = self._take(given)
        self.paused = isinstance(given, PausedRecord)
        return given if digest is None else msgspec.structs.replace(given, digest=digest)

    def _take(self, given: Record) -> bytes | None:
        if isinstance(given, PausedRecord):
            return None
        if isinstance(given, LocalTookOverRecord):
            self.recoveries += given.times
            return None
        state, pending = self.state, self.pending
        if isinstance(given, Sensed | ActingRecord) and pending is not None:
            raise RecordError("comes before the action of that step is known to be performed")
        if given.step != state.step:
            raise RecordError(f"is of step {given.step}, where step {state.step} is due")
        if isinstance(given, Sensed):
            if not self.planner.needs_sensing(state):
                raise RecordError("is an observation where a task action is due")
            return self._sense(given)
        if isinstance(given, Late):
            return self._take_late(given)
        if isinstance(given, Reinitialised):
            return self._reinitialise(given)
        if isinstance(given, ActingRecord):
            if self.planner.needs_sensing(state):
                raise RecordError("is a task action where an observation is due")
            self.pending = decode_floats(given.action, self.planner.problem.action_size)
        elif pending is None:
            raise RecordError("is of a performance of which no action was written down")
        else:
            self._move(given, pending)
        return None

    def _sense(self, given: Sensed) -> bytes:
        before = self.state
        after, info = fold(self.planner, before, given, None)
        performed = given.sensing_action != self.planner.no_sensing
        awaited = performed and not given.observation
        if awaited and len(self._before) == MAX_AWAITED:
            self._give_up_oldest()
        self._keep(given, None, before if awaited else None)
        self.state = after
        self.num_sensed += performed
        self.num_missing += awaited
        self._note_input(given)
        self._judge(given.sensing_action, info if given.observation else None)
        self.found = info
        self.is_lost = self._is_alarmed()
        self.sensing_ms.append(given.sensing_ms)
        reached = self.planner.digest(after)
        self.log.sensed(before.step, given.sensing_action, reached)
        self.rewards.sensed(given.sensing_action)
        return reached

    def _move(self, given: Moved, action: FloatArray) -> None:
        state, info = fold(self.planner, self.state, given, action)
        self._keep(given, action)
        self.log.acted(given.step, action)
        self.state, self.pending = state, None
        if has_shown(given):
            self._note_input(given)
            self.log.moved(given.step, self.planner.digest(state))
        self._judge(MOVE, info)
        self.is_lost = self._is_alarmed()
        self.rewards.acted(given.reward)

    def _take_late(self, late: Late) -> bytes:
        """Fold in an observation at its step, and what followed again."""
        position = next((at for at, each in self._before.items() if each.step == late.taken), None)
        if position is None:
            raise RecordError(f"is an observation of step {late.taken}, where none is awaited")
        sensed = self._inputs[position][0]
        assert isinstance(sensed, Sensed)
        sensed = msgspec.structs.replace(sensed, observation=late.observation)
        state, info = fold(self.planner, self._before[position], sensed, None)
        again = {}
        for at in range(position + 1, len(self._inputs)):
            if at in self._before:
                again[at] = state
            state = fold(self.planner, state, *self._inputs[at])[0]
        # Then it says nothing of the belief that is.
        of_old_belief = any(isinstance(each, Reinitialised) for each, _ in self._inputs[position:])
        self._inputs[position] = sensed, None
        del self._before[position]
        self._before |= again
        self._drop_settled()
        self.state = state
        self.num_missing -= 1
        self._note_input(late)
        self._judge(sensed.sensing_action, info, of_old_belief=of_old_belief)
        self.is_lost = self.is_lost or self._is_alarmed()
        reached = self.planner.digest(state)
        self.log.observed_late(late.taken, state.step, reached)
        return reached

    def _reinitialise(self, given: Reinitialised) -> bytes:
        self.state = fold(self.planner, self.state, given, None)[0]
        self._keep(given, None)
        self._note_input(given)
        self.lost_test.restart()
        self.alarm = self.found = None
        self.is_lost = False
        reached = self.planner.digest(self.state)
        self.log.reinitialised(self.state.step, reached)
        return reached

    def result(self, ending: Ending | None) -> TrialResult:
        """End the trial and return its result; it is out of steps if its task has not ended."""
        state = self.state
        self.log.ended(state.step, self.planner.digest(state))
        decisions = self.log.decisions()
        sensing_ms = tuple(self.sensing_ms)
        outcome, reason = ending or ("truncated", "")
        return TrialResult(
            trial=state.trial,
            seed=state.seed,
            success=outcome == "succeeded",
            failed=outcome == "failed",
            reason=reason,
            steps=state.step,
            reward=self.rewards.total if state.step else 0.0,
            sensing_decisions=self.num_sensed,
            mean_sensing_ms=sum(sensing_ms) / len(sensing_ms) if sensing_ms else 0.0,
            recoveries=self.recoveries,
            missing_observations=self.num_missing,
            unexplained_observations=self.num_unexplained,
            lost=self.lost_test.num_lost,
            suspect_sensors=self.lost_test.num_suspect,
            fewest_distinct_particles=self.fewest_distinct,
            digest=decisions.digest(),
            sensing_ms=sensing_ms,
            decisions=decisions,
        )

    def _judge(
        self, sensing_action: int, info: ObservationInfo | None, *, of_old_belief: bool = False
    ) -> None:
        """Count an observation; None is none."""
        self.alarm, self.found = None, info
        if info is None:
            return
        self.num_unexplained += not info.explained
        distinct = info.distinct_particles
        self.fewest_distinct = min(distinct, self.fewest_distinct or distinct)
        if not of_old_belief:
            self.alarm = self.lost_test.observed(sensing_action, info.within_gate)

    def _is_alarmed(self) -> bool:
        return self.alarm is not None and self.alarm.kind == "lost"

    def _note_input(self, given: Input) -> None:
        self.num_inputs += 1
        told = (*self.inputs, given)[-MAX_INPUTS:] if isinstance(given, Sensed | Moved) else ()
        self.inputs = told

    def _keep(
        self, given: Input, action: FloatArray | None, before: PlanningState | None = None
    ) -> None:
        """Keep an input while an observation is awaited that belongs before it."""
        if before is not None:
            self._before[len(self._inputs)] = before
        elif not self._before:
            return
        self._inputs.append((given, action))
        if len(self._inputs) > MAX_INPUTS_SINCE:
            self._give_up_oldest()

    def _give_up_oldest(self) -> None:
        del self._before[next(iter(self._before))]
        self._drop_settled()

    def _drop_settled(self) -> None:
        """Forget the inputs before the oldest observation that is still awaited."""
        first = min(self._before, default=len(self._inputs))
        del self._inputs[:first]
        self._before = {at - first: state for at, state in sorted(self._before.items())}


def replay(
    planner: Planner,
    seed: int,
    trial: int,
    records: Sequence[Record],
    false_alarm_rate: float = LostSettings().false_alarm_rate,
) -> Trial:
    """Fold the records of a trial, in the order in which they were written.

    Raises RecordError if a record does not follow from those before it, or leads to another state
    than before.
    """
    track = Trial(planner, seed, trial, false_alarm_rate)
    for position, record in enumerate(records):
        try:
            _require_same(track.take(record), record)
        except (RecordError, MessageError, InvalidValueError) as error:
            raise RecordError(f"trial {trial}: record {position} of its journal {error}") from error
    return track


def _require_same(taken: Record, recorded: Record) -> None:
    if taken != recorded:
        raise RecordError(
            "leads to another state than it did when it was written: the problem is not "
            "deterministic, its code has changed, or the journal is damaged"
        )
