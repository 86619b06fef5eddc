"""Pure functions are computed once.

A decision, and a state that follows from another, are the same in every run of a trial, so what was
computed in one run is taken over into the next. That they *are* pure is not taken on trust: of what
is taken over, a share is computed again, and must come to the same.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from holdfast.arrays import FloatArray
from holdfast.lab.errors import Violation
from holdfast.planning import Decision, ObservationInfo, Planner, PlanningState, digest
from holdfast.protocol.service_jobs import Job, JobResult

__all__ = ["JobCache", "MemoizingPlanner"]


_MOST = 20_000
"""Kept of each kind; then all is forgotten."""

_COMPUTED_AGAIN = 61
"""One of so many that are known is computed all the same."""


class RememberedDigests:
    """Digests of states, by the identity of the state, which is kept with its own."""

    def __init__(self) -> None:
        self._digests: dict[int, tuple[PlanningState, bytes]] = {}

    def of(self, state: PlanningState) -> bytes:
        """Return the digest of a state."""
        known = self._digests.get(id(state))
        if known is None:
            if len(self._digests) >= _MOST:
                self._digests.clear()
            known = self._digests[id(state)] = state, digest(state)
        return known[1]


class JobCache:
    """Outcomes of the services' jobs, by what the jobs were made with."""

    def __init__(self) -> None:
        self._outcomes: dict[tuple[object, ...], JobResult] = {}
        self._digests = RememberedDigests()
        self._taken_over = 0

    def outcome(self, job: Job) -> JobResult:
        """Return the outcome of a job; another one than the last time is a Violation."""
        state = job.state
        identity = job.identity, None if state is None else self._digests.of(state)
        known = self._outcomes.get(identity)
        if known is None:
            if len(self._outcomes) >= _MOST:
                self._outcomes.clear()
            outcome = self._outcomes[identity] = job.run()
            return outcome
        self._taken_over += 1
        if self._taken_over % _COMPUTED_AGAIN == 0 and _said(job.run()) != _said(known):
            raise Violation(f"a {job.kind} job came to another outcome than before")
        return known


def _said(outcome: JobResult) -> tuple[object, ...]:
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
        self._digests = RememberedDigests()
        self._initial: dict[tuple[int, int], PlanningState] = {}
        # By the identity of the state, which is kept with it and so cannot be another one's.
        self._observed: dict[
            tuple[int, int, bytes], tuple[PlanningState, PlanningState, ObservationInfo]
        ] = {}
        self._advanced: dict[tuple[int, bytes], tuple[PlanningState, PlanningState]] = {}
        self._decided: dict[int, tuple[PlanningState, Decision]] = {}
        self._taken_over = 0

    def init(self, seed: int, trial: int = 0) -> PlanningState:
        """Return the state before the first step."""
        state = self._initial.get((seed, trial))
        if state is None:
            state = self._initial[seed, trial] = self._planner.init(seed, trial)
        return state

    def observe(
        self, state: PlanningState, sensing_action: int, observation: npt.ArrayLike
    ) -> tuple[PlanningState, ObservationInfo]:
        """Fold an observation into the belief."""
        shown = np.asarray(observation, dtype=np.float64)
        key = id(state), sensing_action, shown.tobytes()
        known = self._observed.get(key)
        if known is None:
            self._make_room()
            after, info = self._planner.observe(state, sensing_action, shown)
            self._observed[key] = state, after, info
            return after, info
        if self._is_checked():
            self._compare(known[1], self._planner.observe(state, sensing_action, shown)[0])
        return known[1], known[2]

    def advance(self, state: PlanningState, task_action: FloatArray) -> PlanningState:
        """Predict the belief and go to the next step."""
        key = id(state), task_action.tobytes()
        known = self._advanced.get(key)
        if known is None:
            self._make_room()
            after = self._planner.advance(state, task_action)
            self._advanced[key] = state, after
            return after
        if self._is_checked():
            self._compare(known[1], self._planner.advance(state, task_action))
        return known[1]

    def decide(self, state: PlanningState, max_actions: int) -> Decision:
        """Decide all that can be decided before something is sensed again."""
        known = self._decided.get(id(state))
        if known is None:
            if len(self._decided) >= _MOST:
                self._decided.clear()
            known = self._decided[id(state)] = state, self._planner.decide(state, max_actions)
        return known[1]

    def digest(self, state: PlanningState) -> bytes:
        """Return 32 bytes that are equal for equal states only."""
        return self._digests.of(state)

    def _make_room(self) -> None:
        if len(self._advanced) + len(self._observed) >= _MOST:
            self._advanced.clear()
            self._observed.clear()

    def _is_checked(self) -> bool:
        self._taken_over += 1
        return self._taken_over % _COMPUTED_AGAIN == 0

    @staticmethod
    def _compare(before: PlanningState, now: PlanningState) -> None:
        if digest(before) != digest(now):
            raise Violation(f"the same events lead to another state of step {now.step} than before")
