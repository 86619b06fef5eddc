"""A cache of computed states, shared by a robot and the planner in its process.

Both follow the same belief, so each state would be computed twice: when the planner looks ahead,
and when the robot gets there. The functions that lead from state to state are pure, so the second
caller gets the first one's result. Both then hold the same objects, and identity is the key.

Large states are not cached: keeping hundreds of them costs more memory than the time is worth.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable
from typing import Any

import numpy as np
import numpy.typing as npt

from holdfast.arrays import FloatArray
from holdfast.config.settings import PlanningSettings
from holdfast.planning import ObservationInfo, Planner, PlanningState
from holdfast.problems.problem import Problem

__all__ = ["MemoCache", "MemoizingPlanner"]

_MAX_RESULTS = 512
"""A few turns of the longest interval between two sensing steps."""

_LARGE_BYTES = 64 << 10


class MemoCache:
    """Results by key, the latest 512; several threads may use it."""

    def __init__(self) -> None:
        self._results: dict[Hashable, tuple[object, Any]] = {}
        self._keys: deque[Hashable] = deque()

    def get(self, key: Hashable) -> Any:
        """Return the cached result, or None."""
        known = self._results.get(key)
        return None if known is None else known[1]

    def keep(self, key: Hashable, state: PlanningState, result: object) -> None:
        """Cache a result unless ``state`` is large.

        The state is kept alive, because its identity is part of the key.
        """
        if state.belief.states.nbytes > _LARGE_BYTES:
            return
        self._results[key] = state, result
        self._keys.append(key)
        if len(self._keys) > _MAX_RESULTS:
            self._results.pop(self._keys.popleft(), None)


class MemoizingPlanner(Planner):
    """A planner that shares its results with others through a cache."""

    def __init__(self, problem: Problem, settings: PlanningSettings, cache: MemoCache) -> None:
        super().__init__(problem, settings)
        self._cache = cache

    def init(self, seed: int, trial: int = 0) -> PlanningState:
        """Return the state before the first step."""
        key = "initial", seed, trial
        state: PlanningState | None = self._cache.get(key)
        if state is None:
            state = super().init(seed, trial)
            self._cache.keep(key, state, state)
        return state

    def observe(
        self, state: PlanningState, sensing_action: int, observation: npt.ArrayLike
    ) -> tuple[PlanningState, ObservationInfo]:
        """Fold an observation into the belief."""
        shown = np.asarray(observation, dtype=np.float64)
        key = id(state), sensing_action, shown.tobytes()
        known: tuple[PlanningState, ObservationInfo] | None = self._cache.get(key)
        if known is None:
            known = super().observe(state, sensing_action, shown)
            self._cache.keep(key, state, known)
        return known

    def advance(self, state: PlanningState, task_action: FloatArray) -> PlanningState:
        """Predict the belief and go to the next step."""
        key = id(state), task_action.tobytes()
        after: PlanningState | None = self._cache.get(key)
        if after is None:
            after = super().advance(state, task_action)
            self._cache.keep(key, state, after)
        return after

    def digest(self, state: PlanningState) -> bytes:
        """Return 32 bytes that are equal for equal states only."""
        key = id(state)
        found: bytes | None = self._cache.get(key)
        if found is None:
            found = super().digest(state)
            self._cache.keep(key, state, found)
        return found
