"""A simulated world that shows each observation some moves after it was taken."""

from __future__ import annotations

from holdfast.numerics.arrays import FloatArray
from holdfast.problems.problem import Problem
from holdfast.robot.environment import LATER, Later, SimulatedEnvironment

__all__ = ["LateWorld"]


class LateWorld(SimulatedEnvironment):
    """A simulated world whose observations come ``moves`` task actions later; 0 is at once."""

    def __init__(self, problem: Problem, seed: int, trial: int, moves: int) -> None:
        super().__init__(problem, seed, trial)
        self._moves = moves
        self._due: dict[int, tuple[int, FloatArray]] = {}

    def perform_sensing(self, sensing_action: int) -> FloatArray | Later:  # type: ignore[override]
        """Sense, and keep the observation until it is due."""
        shown = super().perform_sensing(sensing_action)
        if not self._moves:
            return shown
        self._due[self.step + self._moves] = self.step, shown
        return LATER

    def late_observations(self) -> list[tuple[int, FloatArray]]:
        """Return what is due after this move."""
        due = self._due.pop(self.step, None)
        return [] if due is None else [due]
