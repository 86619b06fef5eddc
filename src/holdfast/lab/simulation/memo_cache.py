"""Pure functions are computed once.

A decision, and a state that follows from another, are the same in every run of a trial, so what was
computed in one run is taken over into the next. That they *are* pure is not taken on trust: of what
is taken over, a share is computed again, and must come to the same.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

import numpy.typing as npt

from holdfast.arrays import FloatArray
from holdfast.lab.errors import Violation
from holdfast.planning import Decision, ObservationInfo, Planner, PlanningState, digest
from holdfast.protocol.service_jobs import Job, JobResult
from holdfast.robot.memo_cache import bytes_of

__all__ = ["JobCache", "Memo", "MemoizingPlanner"]

_MOST = 20_000
_COMPUTED_AGAIN = 61
"""One of so many that are known is computed all the same."""

Key = TypeVar("Key")
Value = TypeVar("Value")


class Memo(Generic[Key, Value]):
    """Results by key. Once there are ``most`` of them, all are forgotten.

    ``check`` gets a result that is taken over and, now and then, the same computed again.
    """

    def __init__(
        self, most: int = _MOST, check: Callable[[Value, Value], None] | None = None
    ) -> None:
        self._most = most
        self._check = check
        self._known: dict[Key, Value] = {}
        self._taken_over = 0

    def get(self, key: Key, compute: Callable[[], Value]) -> Value:
        """Return the result of a key, computed if it is not known."""
        known = self._known.get(key)
        if known is None:
            if len(self._known) >= self._most:
                self._known.clear()
            result = self._known[key] = compute()
            return result
        if self._check is not None:
            self._taken_over += 1
            if self._taken_over % _COMPUTED_AGAIN == 0:
                self._check(known, compute())
        return known


class JobCache:
    """Outcomes of the services' jobs, by what the jobs were made with."""

    def __init__(self) -> None:
        self._outcomes: Memo[tuple[object, ...], tuple[str, JobResult]]
        self._outcomes = Memo(check=_check_outcomes)
        self._digests: Memo[int, tuple[PlanningState, bytes]] = Memo()

    def outcome(self, job: Job) -> JobResult:
        """Return the outcome of a job; another one than the last time is a Violation."""
        if job.is_cancelled:
            return job.run()  # its outcome follows from that, and not from what it was made with
        state = job.state
        known = None
        if state is not None:
            known = self._digests.get(id(state), lambda: (state, digest(state)))[1]
        return self._outcomes.get((job.identity, known), lambda: (job.kind, job.run()))[1]


def _check_outcomes(known: tuple[str, JobResult], now: tuple[str, JobResult]) -> None:
    if _comparable(now[1]) != _comparable(known[1]):
        raise Violation(f"a {now[0]} job came to another outcome than before")


def _comparable(outcome: JobResult) -> tuple[object, ...]:
    states = (outcome.state, outcome.ahead)
    return (
        *(None if state is None else digest(state) for state in states),
        *outcome._replace(problem=None, state=None, ahead=None),
    )


class MemoizingPlanner(Planner):
    """The robot's planner, which knows the states that it has come to before."""

    def __init__(self, planner: Planner) -> None:
        super().__init__(planner.problem, planner.settings)
        self._planner = planner
        self._initial: Memo[tuple[int, int], PlanningState] = Memo()
        # By the identity of the state, which is kept with the result and so stays the state's own.
        self._digests: Memo[int, tuple[PlanningState, bytes]] = Memo()
        self._observed: Memo[
            tuple[int, int, bytes], tuple[PlanningState, PlanningState, ObservationInfo]
        ] = Memo(check=lambda known, now: _check_states(known[1], now[1]))
        self._advanced: Memo[tuple[int, bytes, bytes], tuple[PlanningState, PlanningState]] = Memo(
            check=lambda known, now: _check_states(known[1], now[1])
        )
        self._moves_observed: Memo[
            tuple[int, bytes, bytes], tuple[PlanningState, PlanningState, ObservationInfo]
        ] = Memo(check=lambda known, now: _check_states(known[1], now[1]))
        self._reinitialised: Memo[int, tuple[PlanningState, PlanningState]] = Memo()
        self._decided: Memo[int, tuple[PlanningState, Decision]] = Memo()

    def init(self, seed: int, trial: int = 0) -> PlanningState:
        """Return the state before the first step."""
        return self._initial.get((seed, trial), lambda: self._planner.init(seed, trial))

    def observe(
        self, state: PlanningState, sensing_action: int, observation: npt.ArrayLike | None
    ) -> tuple[PlanningState, ObservationInfo]:
        """Fold an observation into the belief."""
        _, after, info = self._observed.get(
            (id(state), sensing_action, bytes_of(observation)),
            lambda: (state, *self._planner.observe(state, sensing_action, observation)),
        )
        return after, info

    def advance(
        self,
        state: PlanningState,
        task_action: FloatArray,
        motion: npt.ArrayLike | None = None,
    ) -> PlanningState:
        """Predict the belief and go to the next step."""
        return self._advanced.get(
            (id(state), task_action.tobytes(), bytes_of(motion)),
            lambda: (state, self._planner.advance(state, task_action, motion)),
        )[1]

    def observe_move(
        self, state: PlanningState, task_action: FloatArray, observation: npt.ArrayLike
    ) -> tuple[PlanningState, ObservationInfo]:
        """Fold what came with a move into the belief."""
        _, after, info = self._moves_observed.get(
            (id(state), task_action.tobytes(), bytes_of(observation)),
            lambda: (state, *self._planner.observe_move(state, task_action, observation)),
        )
        return after, info

    def reinitialise(self, state: PlanningState) -> PlanningState:
        """Begin the belief anew."""
        return self._reinitialised.get(
            id(state), lambda: (state, self._planner.reinitialise(state))
        )[1]

    def decide(self, state: PlanningState, max_actions: int) -> Decision:
        """Decide all that can be decided before something is sensed again."""
        return self._decided.get(
            id(state), lambda: (state, self._planner.decide(state, max_actions))
        )[1]

    def digest(self, state: PlanningState) -> bytes:
        """Return 32 bytes that are equal for equal states only."""
        return self._digests.get(id(state), lambda: (state, digest(state)))[1]


def _check_states(known: PlanningState, now: PlanningState) -> None:
    if digest(known) != digest(now):
        raise Violation(f"the same events lead to another state of step {now.step} than before")
