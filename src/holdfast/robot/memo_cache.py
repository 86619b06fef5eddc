"""A cache of computed states, shared by a robot and the planner in its process.

Both follow the same belief, so each state would be computed twice: when the planner looks ahead,
and when the robot gets there. The functions that lead from state to state are pure, so the second
caller gets the first one's result. Both then hold the same objects, and identity is the key.

Large states are not cached: keeping hundreds of them costs more memory than the time is worth.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable
from functools import partial
from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt

from holdfast.numerics.arrays import FloatArray
from holdfast.planning.planner import ObservationInfo, Planner, PlanningState
from holdfast.planning.settings import PlanningSettings
from holdfast.problems.problem import Problem

_Result = TypeVar("_Result")

_MAX_RESULTS = 512
"""A few turns of the longest interval between two sensing steps."""

_LARGE_BYTES = 64 << 10


class MemoCache:
    """Results by key, the latest 512; several threads may use it."""

    def __init__(self) -> None:
        self._results: dict[Hashable, tuple[PlanningState, Any]] = {}
        self._keys: deque[Hashable] = deque()

    def once(
        self, key: Hashable, state: PlanningState | None, compute: Callable[[], _Result]
    ) -> _Result:
        """Return the result for a key, computed unless it is cached.

        The state is kept alive, because its identity is part of the key. Without one the result is
        a state itself.
        """
        if (known := self._results.get(key)) is not None:
            cached: _Result = known[1]
            return cached
        result = compute()
        kept = cast("PlanningState", result) if state is None else state
        if kept.belief.states.nbytes <= _LARGE_BYTES:
            self._results[key] = kept, result
            self._keys.append(key)
            if len(self._keys) > _MAX_RESULTS:
                self._results.pop(self._keys.popleft(), None)
        return result


class MemoizingPlanner(Planner):
    """A planner that shares its results with others through a cache."""

    def __init__(self, problem: Problem, settings: PlanningSettings, cache: MemoCache) -> None:
        super().__init__(problem, settings)
        self._once = cache.once

    def init(self, seed: int, trial: int = 0) -> PlanningState:
        """Return the state before the first step."""
        return self._once(("initial", seed, trial), None, partial(super().init, seed, trial))

    def observe(
        self, state: PlanningState, sensing_action: int, observation: npt.ArrayLike | None
    ) -> tuple[PlanningState, ObservationInfo]:
        """Fold an observation into the belief."""
        key = id(state), sensing_action, _bytes_of(observation)
        return self._once(key, state, partial(super().observe, state, sensing_action, observation))

    def advance(
        self,
        state: PlanningState,
        task_action: FloatArray,
        motion: npt.ArrayLike | None = None,
    ) -> PlanningState:
        """Predict the belief and go to the next step."""
        key = id(state), task_action.tobytes(), _bytes_of(motion)
        return self._once(key, state, partial(super().advance, state, task_action, motion))

    def observe_move(
        self, state: PlanningState, task_action: FloatArray, observation: npt.ArrayLike
    ) -> tuple[PlanningState, ObservationInfo]:
        """Fold what came with a move into the belief."""
        key = "move", id(state), task_action.tobytes(), _bytes_of(observation)
        compute = partial(super().observe_move, state, task_action, observation)
        return self._once(key, state, compute)

    def reinitialise(self, state: PlanningState) -> PlanningState:
        """Begin the belief anew."""
        key = "reinitialised", id(state)
        return self._once(key, state, partial(super().reinitialise, state))

    def digest(self, state: PlanningState) -> bytes:
        """Return 32 bytes that are equal for equal states only."""
        return self._once(id(state), state, partial(super().digest, state))


def _bytes_of(shown: npt.ArrayLike | None) -> bytes:
    """Return the bits of what was shown; empty for nothing."""
    return b"" if shown is None else np.asarray(shown, dtype=np.float64).tobytes()
