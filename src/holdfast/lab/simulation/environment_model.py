"""What the robot acts on: a world that goes on when the robot's process does not.

It knows how the undisturbed run went, and lets nothing else happen in it: to sense or do something
else, again, too early or too late raises a :class:`Violation` at once.
"""

from __future__ import annotations

import numpy as np

from holdfast.arrays import FloatArray
from holdfast.lab.errors import Violation
from holdfast.lab.simulation.reference_runs import ReferenceRuns
from holdfast.outcome import TrialResult

__all__ = ["EnvironmentModel"]


class EnvironmentModel:
    """The world of one trial.

    Parameters
    ----------
    shows_the_same : bool
        Whether what is sensed again shows the same again. In a world outside of the simulation it
        does not: a robot that has forgotten what it sensed will know something else.
    """

    def __init__(
        self, trial: int, max_steps: int, references: ReferenceRuns, *, shows_the_same: bool
    ) -> None:
        self._trial = trial
        self._max_steps = max_steps
        self._references = references
        self._reference = references.get(trial, max_steps)
        self._shows_the_same = shows_the_same
        self._times: dict[int, int] = {}
        self.performed = 0

    @property
    def done(self) -> bool:
        """Whether the task is done."""
        if self.performed == 0:
            return self._reference.done_at_start
        return self._reference.steps[self.performed - 1].done

    def begin_again(self, actions: list[FloatArray]) -> None:
        """Perform these from the beginning: this world does not outlive the robot's process."""
        self.performed = 0
        for step, action in enumerate(actions):
            self.act(step, action)

    def sense(self, step: int, sensing_action: int) -> FloatArray:
        """Perform a sensing action and return what it shows."""
        where = f"trial {self._trial}: sensing action {sensing_action} of step {step}"
        if step != self.performed:
            raise Violation(f"{where}, where {self.performed} task actions have been performed")
        steps = self._reference.steps
        expected = steps[step].sensing_action if step < len(steps) else None
        if sensing_action != expected:
            raise Violation(f"{where}: the undisturbed run has {expected}")
        times = self._times.get(step, 0)
        self._times[step] = times + 1
        if times and not self._shows_the_same:
            repeats = tuple((at, count - 1) for at, count in self._times.items() if count > 1)
            self._reference = self._references.get(self._trial, self._max_steps, repeats)
        shown = self._reference.steps[step].observation
        assert shown is not None
        return shown

    def act(self, step: int, action: FloatArray) -> tuple[float | None, bool]:
        """Perform a task action; return its reward and whether the task is done."""
        where = f"trial {self._trial}: task action of step {step}"
        if step != self.performed:
            again = " again" if step < self.performed else ""
            raise Violation(f"{where} performed{again}, where {self.performed} have been performed")
        if step >= len(self._reference.steps):
            raise Violation(f"{where}: the undisturbed run has ended before")
        due = self._reference.steps[step]
        written = np.asarray(action, dtype="<f8").tobytes()
        if written != due.action:
            expected = np.frombuffer(due.action, dtype="<f8")
            raise Violation(f"{where}: {action}, the undisturbed run has {expected}")
        self.performed += 1
        return due.reward, due.done

    def check_end(self, result: TrialResult, *, rewards_are_known: bool) -> None:
        """Compare the robot's result; its reward only if it has heard of that of each action."""
        reference = self._reference
        if not result.steps == self.performed == len(reference.steps):
            raise Violation(
                f"trial {self._trial} ended after {result.steps} steps, {self.performed} of which "
                f"were performed: the undisturbed run has {len(reference.steps)}"
            )
        if result.digest != reference.digest:
            raise Violation(
                f"trial {self._trial}: digest of the decisions {result.digest[:16]}, the "
                f"undisturbed run has {reference.digest[:16]}"
            )
        reward = None if reference.steps else 0.0
        for step in reference.steps:
            if step.reward is not None:
                reward = (reward or 0.0) + step.reward
        sensed = sum(step.sensing_action is not None for step in reference.steps)
        for name, said, true in (
            ("success", result.success, self.done),
            ("sensing decisions", result.sensing_decisions, sensed),
            ("reward", result.reward if rewards_are_known else reward, reward),
        ):
            if said != true:
                raise Violation(
                    f"trial {self._trial}: {name} {said}, the undisturbed run has {true}"
                )
