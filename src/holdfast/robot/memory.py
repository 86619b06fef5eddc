"""States that are computed once, although a robot and its own planner both come to them.

A robot without services asks its own planner. Both follow the same belief, so each state would be
computed twice: when the planner looks ahead, and when the robot gets there. The functions that lead
from state to state are pure, so the second one is handed what the first one has come to, and from
then on both hold the very same objects, which are therefore found by identity.

Of large states nothing is remembered: to compute them takes long, but to keep some hundred of them
takes more memory than that is worth.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable
from typing import Any

import numpy as np
import numpy.typing as npt

from holdfast.planning import ObservationInfo, Planner, PlanningState
from holdfast.problems.problem import Problem
from holdfast.settings import PlanningSettings

__all__ = ["RememberingPlanner", "StateMemory"]

FloatArray = npt.NDArray[np.float64]

_MOST = 512
"""Results that are kept: a few turns of the longest interval between two sensing steps."""

_LARGE_BYTES = 64 << 10


class StateMemory:
    """What states were found to lead to; several threads may use it."""

    def __init__(self) -> None:
        self._results: dict[Hashable, tuple[object, Any]] = {}
        self._keys: deque[Hashable] = deque()

    def get(self, key: Hashable) -> Any:
        """Return the result that is kept under a key; None if there is none."""
        known = self._results.get(key)
        return None if known is None else known[1]

    def keep(self, key: Hashable, state: PlanningState, result: object) -> None:
        """Keep a result, and the state whose identity is in its key, unless that is large."""
        if state.belief.states.nbytes > _LARGE_BYTES:
            return
        self._results[key] = state, result
        self._keys.append(key)
        if len(self._keys) > _MOST:
            self._results.pop(self._keys.popleft(), None)


class RememberingPlanner(Planner):
    """A planner that takes from a memory what another one has come to.

    Parameters
    ----------
    problem : Problem
    settings : PlanningSettings
    memory : StateMemory
        Of one problem with these settings.
    """

    def __init__(self, problem: Problem, settings: PlanningSettings, memory: StateMemory) -> None:
        super().__init__(problem, settings)
        self._memory = memory

    def initial_state(self, seed: int, trial: int) -> PlanningState:
        """Return the state before the first step."""
        key = "initial", seed, trial
        state: PlanningState | None = self._memory.get(key)
        if state is None:
            state = super().initial_state(seed, trial)
            self._memory.keep(key, state, state)
        return state

    def observe(
        self, state: PlanningState, sensing_action: int, observation: npt.ArrayLike
    ) -> tuple[PlanningState, ObservationInfo]:
        """Fold an observation into the belief."""
        shown = np.asarray(observation, dtype=np.float64)
        key = id(state), sensing_action, shown.tobytes()
        known: tuple[PlanningState, ObservationInfo] | None = self._memory.get(key)
        if known is None:
            known = super().observe(state, sensing_action, shown)
            self._memory.keep(key, state, known)
        return known

    def advance(self, state: PlanningState, task_action: FloatArray) -> PlanningState:
        """Predict the belief and go to the next step."""
        key = id(state), task_action.tobytes()
        after: PlanningState | None = self._memory.get(key)
        if after is None:
            after = super().advance(state, task_action)
            self._memory.keep(key, state, after)
        return after

    def digest(self, state: PlanningState) -> bytes:
        """Return 32 bytes that are equal for equal states only."""
        key = id(state)
        found: bytes | None = self._memory.get(key)
        if found is None:
            found = super().digest(state)
            self._memory.keep(key, state, found)
        return found
