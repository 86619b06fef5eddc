"""The outcome of a trial and of a move, and decisions as bytes, by which runs are compared.

Every decision is noted in order, in a few bytes, and the hash of these bytes is the trial's digest.
Two runs decided the same exactly if their digests are equal, on whatever machine they were made,
with however many processes, and however often the service that decided had died in between.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterator
from typing import Annotated, Any, Literal, NamedTuple, TypeAlias

import msgspec
import numpy as np
import numpy.typing as npt

from holdfast.errors import InvalidValueError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.inputs import ActingRecord, Decision, Sensed
from holdfast.printable import brief, one_line
from holdfast.problems.attributes import sensing_costs

Outcome: TypeAlias = Literal["succeeded", "failed", "truncated"]
"""How a trial ended: the environment terminated it, or it was cut off, by a limit (truncated)."""

MAX_REASON = 200
"""Bound on the characters of a reason."""


class Ending(NamedTuple):
    """How an environment's task has ended.

    Attributes
    ----------
    outcome : {"succeeded", "failed", "truncated"}
        ``truncated``: cut off by a limit of the environment's own, neither success nor failure.
    reason : str
        One line for people, at most 200 characters of it are kept: "hit the wall at 2 m/s".
    """

    outcome: Outcome
    reason: str = ""


Done: TypeAlias = bool | Literal["failed"] | Ending | None
"""What ``is_done`` of an environment returns: False or None while the task goes on."""

DONE_VALUES = 'True, False, None, "failed" or an Ending'
"""The same in words, for messages."""


def ending_of(done: object) -> Ending | None:
    """Return how the task has ended, from what ``is_done`` has returned; None while it goes on.

    Raises
    ------
    InvalidValueError
        If it must not return that.
    """
    if done is None or isinstance(done, bool | np.bool_):
        return Ending("succeeded") if done else None
    if isinstance(done, str) and done == "failed":
        return Ending("failed")
    if isinstance(done, Ending) and isinstance(done.reason, str) and done.outcome in _OUTCOMES:
        reason = one_line(done.reason)
        return Ending(done.outcome, reason[:MAX_REASON])
    raise InvalidValueError(f"returned {brief(done)}; it must return {DONE_VALUES}")


_OUTCOMES = ("succeeded", "failed", "truncated")


class MoveResult(NamedTuple):
    """What the performance of a task action has shown.

    Attributes
    ----------
    reward : float or None
        None where there is none.
    motion : array or None
        The measured motion (of encoders, say), as the problem's ``move_by_measurement`` takes it.
    observation : array or None
        What came with the move (a contact force, say), for the problem's ``move_log_likelihood``.
    """

    reward: float | None = None
    motion: npt.ArrayLike | None = None
    observation: npt.ArrayLike | None = None


_DIGEST_SIZE = 32
_SENSING = struct.Struct(f"<cQI{_DIGEST_SIZE}s")
_TASK = struct.Struct("<cQ")
_LATE = struct.Struct(f"<cQQ{_DIGEST_SIZE}s")
_END = struct.Struct(f"<cQ{_DIGEST_SIZE}s")
_OTHERS = {b"M": _END, b"L": _LATE, b"R": _END, b"E": _END}
"""Records that are no decision, but lead to the states in which later ones are taken."""


class Decisions(msgspec.Struct, frozen=True):
    """All decisions of a trial in order, in a few bytes each.

    Iterating yields them as records of a journal, :class:`~holdfast.planning.inputs.Sensed`
    (without an observation) and :class:`~holdfast.planning.inputs.ActingRecord`.

    Attributes
    ----------
    action_size : int
        Coordinates of a task action.
    log : bytes
        The records: ``S`` step, sensing action, state digest; ``A`` step, executed action;
        ``E`` steps, digest of the last state. Where there is something of the kind: ``M`` step of a
        move that has shown something, state digest; ``L`` step at which a late observation was
        taken, step at which it came, state digest; ``R`` step of a reinitialisation, state digest.
        Numbers are little-endian; steps have 8 bytes, sensing actions 4, coordinates are float64.
        The trial's digest is the hash of these bytes.
    """

    action_size: Annotated[int, msgspec.Meta(ge=0)]
    log: bytes

    def __repr__(self) -> str:
        """Return something short: the log has kilobytes."""
        return f"Decisions(action_size={self.action_size}, log of {len(self.log)} bytes)"

    def digest(self) -> str:
        """Return the BLAKE2b-256 of the log in hexadecimal."""
        return hashlib.blake2b(self.log, digest_size=_DIGEST_SIZE).hexdigest()

    def reinitialised_after(self) -> frozenset[int]:
        """Return after how many inputs (of a trial, as tracked) the belief was begun anew."""
        inputs = 0
        found = set()
        for kind, _ in self._records():
            if kind == b"R":
                found.add(inputs)
            inputs += kind in (b"S", b"M", b"L", b"R")
        return frozenset(found)

    def __iter__(self) -> Iterator[Decision]:
        for kind, position in self._records():
            if kind == b"S":
                _, step, sensing_action, state_digest = _SENSING.unpack_from(self.log, position)
                yield Sensed(step, sensing_action, b"", state_digest)
            elif kind == b"A":
                _, step = _TASK.unpack_from(self.log, position)
                at = position + _TASK.size
                yield ActingRecord(step, self.log[at : at + 8 * self.action_size])

    def _records(self) -> Iterator[tuple[bytes, int]]:
        """Yield the kind of each record and where it begins; it lies in the log as a whole."""
        sizes = {
            b"S": _SENSING.size,
            b"A": _TASK.size + 8 * self.action_size,
            **{kind: record.size for kind, record in _OTHERS.items()},
        }
        position = 0
        while position < len(self.log):
            kind = self.log[position : position + 1]
            size = sizes.get(kind)
            if size is None:
                raise InvalidValueError(
                    f"decision log: byte {position} is {kind!r}, which begins no record"
                )
            if position + size > len(self.log):
                raise InvalidValueError(
                    f"decision log: the record at byte {position} of {len(self.log)} is cut short"
                )
            yield kind, position
            position += size


class DecisionLog:
    """Notes the decisions of a trial while it runs."""

    def __init__(self, action_size: int) -> None:
        self._action_size = action_size
        self._log = bytearray()

    def sensed(self, step: int, sensing_action: int, state_digest: bytes) -> None:
        """Note a sensing action and the digest of the state that its observation led to."""
        self._log += _SENSING.pack(b"S", step, sensing_action, state_digest)

    def acted(self, step: int, action: FloatArray) -> None:
        """Note a task action as it is executed."""
        self._log += _TASK.pack(b"A", step)
        self._log += np.asarray(action, dtype="<f8").tobytes()

    def moved(self, step: int, state_digest: bytes) -> None:
        """Note that a move has shown something, and the digest of the state that it led to."""
        self._log += _END.pack(b"M", step, state_digest)

    def observed_late(self, taken: int, step: int, state_digest: bytes) -> None:
        """Note an observation of an earlier step, and the digest of the state that it led to."""
        self._log += _LATE.pack(b"L", taken, step, state_digest)

    def reinitialised(self, step: int, state_digest: bytes) -> None:
        """Note that the belief was begun anew."""
        self._log += _END.pack(b"R", step, state_digest)

    def ended(self, steps: int, state_digest: bytes) -> None:
        """Note the number of steps and the digest of the last state."""
        self._log += _END.pack(b"E", steps, state_digest)

    def decisions(self) -> Decisions:
        """Return what was noted so far."""
        return Decisions(self._action_size, bytes(self._log))


class RewardAccount:
    """A trial's rewards less the costs of its sensing actions.

    ``total`` is None as long as there is neither a reward nor a problem with sensing costs.
    """

    def __init__(self, problem: Any) -> None:
        self._costs = sensing_costs(problem)
        has_costs = getattr(problem, "sensing_costs", None) is not None
        self.total: float | None = 0.0 if has_costs else None

    def sensed(self, sensing_action: int) -> None:
        """Subtract the cost of a sensing action; not to sense costs nothing."""
        if sensing_action == len(self._costs):
            return
        cost = float(self._costs[sensing_action])
        if cost > 0.0:
            self.acted(-cost)

    def acted(self, reward: float | None) -> None:
        """Add a reward; None is none."""
        if reward is not None:
            self.total = (self.total or 0.0) + reward


class TrialResult(msgspec.Struct, frozen=True, kw_only=True):
    """The result of a trial. Its scalar fields are the columns of ``trials.csv``.

    A field that is added here, with a default for older journals, is a column
    (:data:`TRIAL_COLUMNS`); :meth:`holdfast.planning.tracking.Trial.result` fills it in.

    Attributes
    ----------
    trial, seed : int
        Number of the trial, from 0, and seed of the run: the random streams follow from both.
    success, failed : bool
        Whether the goal was reached, and whether the task ended in failure. If neither, the trial
        ran out of steps.
    reason : str
        Why it ended, in the environment's words; empty where it said nothing.
    steps, sensing_decisions : int
        Task actions performed, and sensing actions chosen.
    reward : float or None
        Sum of the rewards of the steps. A step without one adds nothing; None if there were steps
        and none of them had one, unless sensing has prices, which are rewards.
    mean_sensing_ms : float
        Mean wall time of choosing a sensing action, 0 if none was chosen.
    recoveries : int
        Times that the local service took over, in all processes that had a part in the trial; 0
        with the planner in process.
    missing_observations : int
        Sensing actions without an observation: there was no reading, or it had not come yet.
    unexplained_observations : int
        Observations that no particle of the belief explained.
    lost, suspect_sensors : int
        Times that the robot was found lost, and a sensing action suspect
        (:mod:`holdfast.planning.lost`).
    fewest_distinct_particles : int or None
        The least number of different particles that an observation weighed; None without one.
    digest : str
        BLAKE2b-256 of the decisions, in hexadecimal.
    sensing_ms : tuple of float
        Wall time of choosing each sensing action, in order.
    decisions : Decisions or None
        What was decided; None in a result that was read back without them.
    """

    trial: int
    seed: int
    success: bool
    # Journals that do not have it are of trials that could not fail.
    failed: bool = False
    reason: str = ""
    steps: int
    reward: float | None
    sensing_decisions: int
    mean_sensing_ms: float
    recoveries: int
    unexplained_observations: int
    digest: str
    lost: int = 0
    suspect_sensors: int = 0
    missing_observations: int = 0
    fewest_distinct_particles: int | None = None
    sensing_ms: tuple[float, ...]
    decisions: Decisions | None = None

    @property
    def outcome(self) -> Outcome:
        """How the trial ended: in its environment's words, or out of steps."""
        if self.success:
            return "succeeded"
        return "failed" if self.failed else "truncated"

    def in_words(self) -> str:
        """Return what the trial came to, on one line."""
        text = (
            f"{self.outcome} after {self.steps:,} steps, "
            f"{self.sensing_decisions:,} sensing actions{self.reason and f': {self.reason}'}"
        )
        return text if self.reward is None else f"{text}; reward {self.reward:.6g}"


TRIAL_COLUMNS = (
    *(
        name
        for name in TrialResult.__struct_fields__
        if name not in ("failed", "reason", "sensing_ms", "decisions")
    ),
    "outcome",  # instead of "failed"
    "reason",
)
"""The columns of ``trials.csv``."""

COUNTS = {
    "sensing_decisions": "sensing actions",
    "missing_observations": "missing observations",
    "unexplained_observations": "observations that no particle explains",
    "lost": "times that the robot was found lost",
    "suspect_sensors": "sensors found suspect",
    "recoveries": "times that the local service took over",
}
"""The columns that a summary adds up, in words."""
