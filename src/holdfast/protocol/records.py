"""The journal of an unfinished trial: its records, and the state that they fold to.

An observation is in the journal before it is used, and a task action before it is performed. After
a crash the journal therefore holds all that was done and seen. It cannot tell one thing, whether
the last task action was still performed; only the environment can.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import msgspec

from holdfast.arrays import FloatArray
from holdfast.errors import InvalidValueError, MessageError, RecordError
from holdfast.outcome import DecisionLog, Done, RewardAccount, TrialResult
from holdfast.planning import Planner, PlanningState
from holdfast.protocol.messages import MAX_OBSERVATIONS, Observed, decode_floats

__all__ = [
    "DIVERGENCE_RUN",
    "ActingRecord",
    "LocalTookOverRecord",
    "ObservedRecord",
    "PausedRecord",
    "PerformedRecord",
    "Record",
    "TrialHistory",
    "decode_record",
    "encode_record",
    "replay",
]


class ObservedRecord(msgspec.Struct, array_like=True, frozen=True, tag=1):
    """An observation (little-endian float64), written before it is used.

    Attributes
    ----------
    digest : bytes
        32 bytes, of the state that it led to; checked by :func:`replay`.
    sensing_ms : float
        How long the sensing action was computed; for the tables only.
    """

    step: int
    sensing_action: int
    observation: bytes
    digest: bytes
    sensing_ms: float


class ActingRecord(msgspec.Struct, array_like=True, frozen=True, tag=2):
    """A task action (as executed, little-endian float64), written before it is performed."""

    step: int
    action: bytes


class PerformedRecord(msgspec.Struct, array_like=True, frozen=True, tag=3):
    """The task action was performed. Written before anything else is ordered."""

    step: int
    reward: float | None


class PausedRecord(msgspec.Struct, array_like=True, frozen=True, tag=4):
    """The robot's process ended in order: nothing happened after the records before."""


class LocalTookOverRecord(msgspec.Struct, array_like=True, frozen=True, tag=5):
    """The cloud was lost so often since the last such record; for the tables only."""

    times: int


Record: TypeAlias = (
    ObservedRecord | ActingRecord | PerformedRecord | PausedRecord | LocalTookOverRecord
)

_ENCODER = msgspec.msgpack.Encoder()
_DECODER: msgspec.msgpack.Decoder[Record] = msgspec.msgpack.Decoder(Record)


def encode_record(record: Record) -> bytes:
    """Encode a record."""
    return _ENCODER.encode(record)


def decode_record(data: bytes) -> Record:
    """Decode a record.

    Raises
    ------
    RecordError
        If the bytes are not a record.
    """
    try:
        return _DECODER.decode(data)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise RecordError(f"{len(data)} bytes are no record of a journal: {error}") from error


DIVERGENCE_RUN = 5
"""So many observations outside the validation gate in a row are no outliers: the filter has
diverged. (A sensor with 1 % outliers shows five in a row once in 10^10 observations.)"""


class TrialHistory:
    """An unfinished trial: what its records fold to.

    Attributes
    ----------
    state : PlanningState
        After everything that is known to be performed.
    observations : tuple of Observed
        The latest, as many as fit into a request.
    actions : list of array
        Replayed task actions in order.
    pending : array or None
        A task action in the journal that is not known to be performed.
    paused : bool
        Whether the previous process ended in order.
    num_unexplained : int
        Observations outside the validation gate of every particle.
    unexplained_in_a_row : int
        Length of the current run of these.
    num_divergences : int
        Times that such a run reached :data:`DIVERGENCE_RUN`.
    recoveries : int
        Times that the cloud was lost.
    """

    def __init__(self, planner: Planner, seed: int, trial: int) -> None:
        self.state = planner.init(seed, trial)
        self.observations: tuple[Observed, ...] = ()
        self.num_observations = 0
        self.log = DecisionLog(planner.problem.action_size)
        self.actions: list[FloatArray] = []
        self.rewards = RewardAccount(planner.problem)
        self.pending: FloatArray | None = None
        self.paused = False
        self.num_unexplained = 0
        self.unexplained_in_a_row = 0
        self.num_divergences = 0
        self.sensing_ms: list[float] = []
        self.recoveries = 0

    @property
    def begun(self) -> bool:
        """Whether anything has happened."""
        return self.num_observations > 0 or self.state.step > 0 or self.pending is not None

    def observed(self, record: ObservedRecord, after: PlanningState, *, explained: bool) -> None:
        """Fold in an observation that led to the state ``after``."""
        kept = Observed(record.step, record.sensing_action, record.observation)
        self.observations = (*self.observations, kept)[-MAX_OBSERVATIONS:]
        self.num_observations += 1
        self.num_unexplained += not explained
        self.unexplained_in_a_row = 0 if explained else self.unexplained_in_a_row + 1
        self.num_divergences += self.unexplained_in_a_row == DIVERGENCE_RUN
        self.sensing_ms.append(record.sensing_ms)
        self.log.sensed(record.step, record.sensing_action, record.digest)
        self.rewards.sensed(record.sensing_action)
        self.state = after

    def result(self, planner: Planner, done: Done) -> TrialResult:
        """End the trial and return its result."""
        state = self.state
        self.log.ended(state.step, planner.digest(state))
        decisions = self.log.decisions()
        sensing_ms = tuple(self.sensing_ms)
        return TrialResult(
            trial=state.trial,
            seed=state.seed,
            success=done is True,
            failed=done == "failed",
            steps=state.step,
            reward=self.rewards.total if state.step else 0.0,
            sensing_decisions=self.num_observations,
            mean_sensing_ms=sum(sensing_ms) / len(sensing_ms) if sensing_ms else 0.0,
            recoveries=self.recoveries,
            unexplained_observations=self.num_unexplained,
            digest=decisions.digest(),
            sensing_ms=sensing_ms,
            decisions=decisions,
        )

    def performed(self, planner: Planner, reward: float | None) -> None:
        """Fold in that the pending task action was performed."""
        assert self.pending is not None
        self.log.acted(self.state.step, self.pending)
        self.state = planner.advance(self.state, self.pending)
        self.rewards.acted(reward)
        self.pending = None


def replay(planner: Planner, seed: int, trial: int, records: Sequence[Record]) -> TrialHistory:
    """Fold the records of an unfinished trial, in the order in which they were written.

    Raises
    ------
    RecordError
        If a record does not follow from those before it, or leads to another state than before.
    """
    history = TrialHistory(planner, seed, trial)
    for position, record in enumerate(records):
        history.paused = isinstance(record, PausedRecord)
        try:
            _replay_record(planner, history, record)
        except (RecordError, MessageError, InvalidValueError) as error:
            raise RecordError(f"trial {trial}: record {position} of its journal {error}") from error
    return history


def _replay_record(planner: Planner, history: TrialHistory, record: Record) -> None:
    if isinstance(record, PausedRecord):
        return
    if isinstance(record, LocalTookOverRecord):
        history.recoveries += record.times
        return
    state = history.state
    if not isinstance(record, PerformedRecord) and history.pending is not None:
        raise RecordError("comes before the action of that step is known to be performed")
    if record.step != state.step:
        raise RecordError(f"is of step {record.step}, where step {state.step} is due")
    if isinstance(record, ObservedRecord):
        _replay_observation(planner, history, record)
    elif isinstance(record, ActingRecord):
        if planner.needs_sensing(state):
            raise RecordError("is a task action where an observation is due")
        history.pending = decode_floats(record.action, planner.problem.action_size)
    elif history.pending is None:
        raise RecordError("is of a performance of which no action was written down")
    else:
        history.actions.append(history.pending)
        history.performed(planner, record.reward)


def _replay_observation(planner: Planner, history: TrialHistory, record: ObservedRecord) -> None:
    state = history.state
    if not planner.needs_sensing(state):
        raise RecordError("is an observation where a task action is due")
    observation = decode_floats(record.observation, len(record.observation) // 8)
    after, info = planner.observe(state, record.sensing_action, observation)
    reached = planner.digest(after)
    if reached != record.digest:
        raise RecordError(
            "leads to another state than it did when it was written: the problem is not "
            "deterministic, its code has changed, or the journal is damaged"
        )
    history.observed(record, after, explained=info.explained)
