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
from typing import Any, ClassVar

import numpy as np

from holdfast.planning.planner import Planner, PlanningState
from holdfast.planning.settings import PlanningSettings
from holdfast.problems.problem import Problem

_MAX_RESULTS = 512
"""A few turns of the longest interval between two sensing steps."""

_LARGE_BYTES = 64 << 10


class MemoCache:
    """Results by function and arguments, the latest 512; several threads may use it."""

    def __init__(self) -> None:
        self._results: dict[Hashable, tuple[PlanningState, Any]] = {}
        self._keys: deque[Hashable] = deque()

    def once(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return what the function returns, computed unless it is cached."""
        key = key_of(function, arguments)
        if (known := self._results.get(key)) is not None:
            return known[1]
        result = function(*arguments)
        # Kept alive, because its identity is part of the key.
        kept = arguments[0] if isinstance(arguments[0], PlanningState) else result
        if kept.belief.states.nbytes <= _LARGE_BYTES:
            self._results[key] = kept, result
            self._keys.append(key)
            if len(self._keys) > _MAX_RESULTS:
                self._results.pop(self._keys.popleft(), None)
        return result


class MemoizingPlanner(Planner):
    """A planner that shares its results with others through a cache."""

    shared: ClassVar[tuple[str, ...]] = (
        "init",
        "observe",
        "advance",
        "observe_move",
        "reinitialise",
        "digest",
    )

    def __init__(self, problem: Problem, settings: PlanningSettings, cache: MemoCache) -> None:
        super().__init__(problem, settings)
        for name in self.shared:
            setattr(self, name, partial(cache.once, getattr(self, name)))


def key_of(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Hashable:
    """Return what identifies a call."""
    return (function.__name__, *[_part_of(each) for each in arguments if each is not None])


def _part_of(argument: Any) -> Hashable:
    """Return a state's identity, a whole number, or the bits of what was done or shown."""
    if isinstance(argument, PlanningState):
        return id(argument)
    return argument if isinstance(argument, int) else np.asarray(argument, np.float64).tobytes()
