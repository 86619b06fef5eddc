"""The journal of an unfinished trial: its records, and the state that they fold to.

An observation is in the journal before it is used, and a task action before it is performed. After
a crash the journal therefore holds all that was done and seen. It cannot tell one thing, whether
the last task action was still performed; only the environment can.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TypeAlias

import msgspec

from holdfast.errors import InvalidValueError, MessageError, RecordError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.outcome import SensingDecision, TaskDecision
from holdfast.planning.planner import ObservationInfo, Planner
from holdfast.planning.settings import LostSettings
from holdfast.planning.tracking import LateObservation, Trial
from holdfast.protocol.messages import (
    MAX_INPUTS,
    Input,
    Moved,
    Observed,
    decode_floats,
    encode_floats,
    numbers_of,
)


class ObservedRecord(msgspec.Struct, array_like=True, frozen=True, tag=1):
    """An observation (little-endian float64), written before it is used."""

    step: int
    sensing_action: int
    observation: bytes  # empty if it comes later, or if the choice was not to sense
    digest: bytes  # 32 bytes, of the state that it led to; checked by :func:`replay`
    sensing_ms: float  # how long the sensing action was computed; for the tables only


class ActingRecord(msgspec.Struct, array_like=True, frozen=True, tag=2):
    """A task action (as executed, little-endian float64), written before it is performed."""

    step: int
    action: bytes


class PerformedRecord(msgspec.Struct, array_like=True, frozen=True, tag=3):
    """The task action was performed. Written before anything else is ordered.

    ``motion`` and ``observation`` (little-endian float64) are what the move has shown; empty for
    nothing.
    """

    step: int
    reward: float | None
    motion: bytes = b""
    observation: bytes = b""


class PausedRecord(msgspec.Struct, array_like=True, frozen=True, tag=4):
    """The robot's process ended in order: nothing happened after the records before."""


class LocalTookOverRecord(msgspec.Struct, array_like=True, frozen=True, tag=5):
    """The cloud was lost so often since the last such record; for the tables only."""

    times: int


class LateRecord(msgspec.Struct, array_like=True, frozen=True, tag=6):
    """An observation of an earlier step came."""

    step: int
    taken: int  # the step at which it was taken
    observation: bytes
    digest: bytes  # 32 bytes, of the state that it led to

    def late(self) -> LateObservation:
        """Return the observation and its step."""
        shown = decode_floats(self.observation, len(self.observation) // 8)
        return LateObservation(self.taken, shown)


class ReinitialisedRecord(msgspec.Struct, array_like=True, frozen=True, tag=7):
    """The belief was begun anew; ``digest`` is that of the state that this led to."""

    step: int
    digest: bytes


Record: TypeAlias = (
    ObservedRecord
    | ActingRecord
    | PerformedRecord
    | PausedRecord
    | LocalTookOverRecord
    | LateRecord
    | ReinitialisedRecord
)

_ENCODER = msgspec.msgpack.Encoder()
_DECODER: msgspec.msgpack.Decoder[Record] = msgspec.msgpack.Decoder(Record)


def encode_record(record: Record) -> bytes:
    """Encode a record."""
    return _ENCODER.encode(record)


def decode_record(data: bytes) -> Record:
    """Decode a record; raise RecordError if the bytes are not a record."""
    try:
        return _DECODER.decode(data)
    except Exception as error:  # decoding may raise anything
        raise RecordError(f"{len(data)} bytes are no record of a journal: {error}") from error


class TrialHistory(Trial):
    """An unfinished trial: what its records fold to."""

    def __init__(
        self,
        planner: Planner,
        seed: int,
        trial: int,
        false_alarm_rate: float = LostSettings().false_alarm_rate,
    ) -> None:
        super().__init__(planner, seed, trial, false_alarm_rate)
        # The latest from which a service can fold the state, as many as fit into a request.
        self.inputs: tuple[Input, ...] = ()
        self.actions: list[FloatArray] = []  # replayed task actions in order
        # A task action in the journal that is not known to be performed.
        self.pending: FloatArray | None = None
        self.paused = False  # whether the previous process ended in order
        # Whether the robot was found lost by the last observation or move, or by what came late
        # since then.
        self.is_lost = False

    @property
    def begun(self) -> bool:
        """Whether anything has happened."""
        return self.num_inputs > 0 or self.state.step > 0 or self.pending is not None

    def fold_observation(
        self, sensing_action: int, observation: FloatArray | None, sensing_ms: float
    ) -> tuple[ObservationInfo, ObservedRecord]:
        """Fold in a sensing action; return what was found, and its record."""
        step = self.state.step
        info, reached = self.observe(sensing_action, observation, sensing_ms)
        self.is_lost = self._raised_lost()
        shown = b"" if observation is None else encode_floats(observation)
        self._add(Observed(step, sensing_action, shown))
        return info, ObservedRecord(step, sensing_action, shown, reached, sensing_ms)

    def fold_move(self, record: PerformedRecord) -> ObservationInfo | None:
        """Fold in that the pending task action was performed; return what was found, if any was."""
        assert self.pending is not None
        action, motion, observation = self.pending, record.motion, record.observation
        info = self.move(action, record.reward, numbers_of(motion), numbers_of(observation))
        self.is_lost = self._raised_lost()
        if motion or observation:
            self._add(Moved(record.step, motion, observation))
        self.pending = None
        return info

    def fold_late_observation(
        self, late: LateObservation
    ) -> tuple[ObservationInfo, LateRecord] | None:
        """Fold in a late observation; return what was found, and its record.

        None if none of its step is awaited.
        """
        found = self.observe_late(late)
        if found is None:
            return None
        info, reached = found
        self.is_lost = self.is_lost or self._raised_lost()
        self._add(None)
        shown = encode_floats(late.observation)
        return info, LateRecord(self.state.step, late.step, shown, reached)

    def fold_reinitialisation(self) -> ReinitialisedRecord:
        """Begin the belief anew; return the record."""
        reached = self.reinitialise()
        self.is_lost = False
        self._add(None)
        return ReinitialisedRecord(self.state.step, reached)

    def _raised_lost(self) -> bool:
        return self.alarm is not None and self.alarm.kind == "lost"

    def _add(self, given: Input | None) -> None:
        """Keep an input; None is one that no service can fold in: it needs the state after it."""
        self.inputs = () if given is None else (*self.inputs, given)[-MAX_INPUTS:]


def replay(
    planner: Planner,
    seed: int,
    trial: int,
    records: Sequence[Record],
    false_alarm_rate: float = LostSettings().false_alarm_rate,
) -> TrialHistory:
    """Fold the records of an unfinished trial, in the order in which they were written.

    Raises RecordError if a record does not follow from those before it, or leads to another state
    than before.
    """
    history = TrialHistory(planner, seed, trial, false_alarm_rate)
    for position, record in enumerate(records):
        history.paused = isinstance(record, PausedRecord)
        try:
            _replay_record(planner, history, record)
        except (RecordError, MessageError, InvalidValueError) as error:
            raise RecordError(f"trial {trial}: record {position} of its journal {error}") from error
    return history


def has_shown(record: Record) -> bool:
    """Return whether a record has what neither the decisions nor a simulated world can tell."""
    if isinstance(record, PerformedRecord):
        return bool(record.motion or record.observation)
    return isinstance(record, LateRecord)


def decisions_of(records: Sequence[Record]) -> Iterator[SensingDecision | TaskDecision]:
    """Yield the decisions among records."""
    for record in records:
        if isinstance(record, ObservedRecord):
            yield SensingDecision(record.step, record.sensing_action, record.digest)
        elif isinstance(record, ActingRecord):
            action = decode_floats(record.action, len(record.action) // 8)
            yield TaskDecision(record.step, tuple(action.tolist()))


def _replay_record(planner: Planner, history: TrialHistory, record: Record) -> None:
    if isinstance(record, PausedRecord):
        return
    if isinstance(record, LocalTookOverRecord):
        history.recoveries += record.times
        return
    state = history.state
    if isinstance(record, ObservedRecord | ActingRecord) and history.pending is not None:
        raise RecordError("comes before the action of that step is known to be performed")
    if record.step != state.step:
        raise RecordError(f"is of step {record.step}, where step {state.step} is due")
    if isinstance(record, ObservedRecord):
        if not planner.needs_sensing(state):
            raise RecordError("is an observation where a task action is due")
        observation = numbers_of(record.observation)
        _, again = history.fold_observation(record.sensing_action, observation, record.sensing_ms)
        _require_same_state(record.digest, again.digest)
    elif isinstance(record, LateRecord):
        found = history.fold_late_observation(record.late())
        if found is None:
            raise RecordError(f"is an observation of step {record.taken}, where none is awaited")
        _require_same_state(record.digest, found[1].digest)
    elif isinstance(record, ReinitialisedRecord):
        _require_same_state(record.digest, history.fold_reinitialisation().digest)
    elif isinstance(record, ActingRecord):
        if planner.needs_sensing(state):
            raise RecordError("is a task action where an observation is due")
        history.pending = decode_floats(record.action, planner.problem.action_size)
    elif history.pending is None:
        raise RecordError("is of a performance of which no action was written down")
    else:
        history.actions.append(history.pending)
        history.fold_move(record)


def _require_same_state(recorded: bytes, reached: bytes) -> None:
    if reached != recorded:
        raise RecordError(
            "leads to another state than it did when it was written: the problem is not "
            "deterministic, its code has changed, or the journal is damaged"
        )
