"""The inputs of a trial, and how a state follows from them.

A trial is (seed, number) and a list of inputs: what was sensed, what moves have shown, what came
late, a belief that was begun anew. An input is a record of the journal, and what is sent to a
service that lacks it; what replays a trial reads them, and what shows one. The records of a trial
are in the journal before they are used: an observation before an answer to it is, a task action
before it is performed. So after a crash the journal holds all that was done and used. It cannot
tell one thing, whether the last task action was still performed; only the environment can.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TypeAlias

import msgspec
import numpy as np
import numpy.typing as npt

from holdfast.errors import MessageError
from holdfast.numerics import reproducible as numerics
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.belief import ObservationInfo
from holdfast.planning.planner import Planner, PlanningState

MAX_INPUTS = 64
"""Bound on the inputs of one request; a service further behind is sent the state."""


class Sensed(msgspec.Struct, array_like=True, frozen=True, tag=1):
    """A sensing action and its observation (little-endian float64)."""

    step: int
    sensing_action: int
    # Empty if it comes later, or never, if the choice was not to sense, and in a :data:`Decision`.
    observation: bytes
    digest: bytes = b""  # 32 bytes, of the state that it led to; empty before it is folded in
    sensing_ms: float = 0.0  # how long the sensing action was computed; for the tables only

    def numbers(self) -> FloatArray | None:
        """Return the observation."""
        return numbers_of(self.observation)


class ActingRecord(msgspec.Struct, array_like=True, frozen=True, tag=2):
    """A task action (as executed, little-endian float64), written before it is performed."""

    step: int
    action: bytes

    @property
    def task_action(self) -> FloatArray:
        """The numbers, shape (action_size,)."""
        return decode_floats(self.action, None)


class Moved(msgspec.Struct, array_like=True, frozen=True, tag=3):
    """The task action was performed. Written before anything else is ordered.

    ``motion`` and ``observation`` (little-endian float64) are what the move has shown; empty for
    nothing.
    """

    step: int
    reward: float | None
    motion: bytes = b""
    observation: bytes = b""

    def numbers(self) -> tuple[FloatArray | None, FloatArray | None]:
        """Return the motion and the observation."""
        return numbers_of(self.motion), numbers_of(self.observation)


class PausedRecord(msgspec.Struct, array_like=True, frozen=True, tag=4):
    """The robot's process ended in order: nothing happened after the records before."""


class LocalTookOverRecord(msgspec.Struct, array_like=True, frozen=True, tag=5):
    """The cloud was lost so often since the last such record; for the tables only."""

    times: int


class Late(msgspec.Struct, array_like=True, frozen=True, tag=6):
    """An observation of an earlier step came."""

    step: int  # when it came
    taken: int  # the step at which it was taken
    observation: bytes
    digest: bytes = b""  # as that of :class:`Sensed`

    def numbers(self) -> FloatArray:
        """Return the observation."""
        return decode_floats(self.observation, None)


class Reinitialised(msgspec.Struct, array_like=True, frozen=True, tag=7):
    """The belief was begun anew."""

    step: int
    digest: bytes = b""  # as that of :class:`Sensed`


CatchUpInput: TypeAlias = Sensed | Moved
"""What a service can fold in. A late observation changes what is past, and a new belief forgets it:
after these a robot sends its state."""

Input: TypeAlias = CatchUpInput | Late | Reinitialised
"""What a belief rests on, besides the task actions, which follow from it."""

Record: TypeAlias = Input | ActingRecord | PausedRecord | LocalTookOverRecord

Decision: TypeAlias = Sensed | ActingRecord
"""What was decided, without what it has shown."""


def fold(
    planner: Planner, state: PlanningState, given: Input, action: FloatArray | None
) -> tuple[PlanningState, ObservationInfo | None]:
    """Return the state after an input of its step, and what its observation was found to be.

    ``action`` is the one that was performed, of a move. A late observation comes as the
    :class:`Sensed` that it completes.
    """
    if isinstance(given, Sensed):
        return planner.observe(state, given.sensing_action, given.numbers())
    if isinstance(given, Reinitialised):
        return planner.reinitialise(state), None
    assert isinstance(given, Moved)
    assert action is not None
    motion, shown = given.numbers()
    after = planner.advance(state, action, motion)
    return (after, None) if shown is None else planner.observe_move(after, action, shown)


def has_shown(record: Record) -> bool:
    """Return whether a record has what neither the decisions nor a simulated world can tell."""
    if isinstance(record, Moved):
        return bool(record.motion or record.observation)
    return isinstance(record, Late)


def decisions_of(records: Iterable[Record]) -> Iterator[Decision]:
    """Yield the decisions among records."""
    for record in records:
        if isinstance(record, Sensed):
            yield Sensed(record.step, record.sensing_action, b"", record.digest)
        elif isinstance(record, ActingRecord):
            yield record


def numbers_of(data: bytes) -> FloatArray | None:
    """Decode as many numbers as there are; None for none. Raise as :func:`decode_floats`."""
    return decode_floats(data, None) if data else None


def encode_floats(array: npt.ArrayLike | None) -> bytes:
    """Encode numbers as little-endian float64; None as nothing."""
    return b"" if array is None else np.ascontiguousarray(array, dtype="<f8").tobytes()


def decode_floats(data: bytes, size: int | None) -> FloatArray:
    """Decode ``size`` numbers, or as many as there are.

    Raises MessageError if their number differs, or one is not finite.
    """
    size = len(data) // 8 if size is None else size
    if len(data) != 8 * size:
        raise MessageError("malformed", f"{len(data)} bytes are not {size} numbers")
    numbers = np.frombuffer(data, dtype="<f8").astype(np.float64)
    if not numerics.all_finite(numbers):
        raise MessageError("malformed", f"{numbers} are not all finite")
    return numbers
