"""What the robot acts on: a world that goes on when the robot's process does not.

Each trial is run once by the plain closed loop, with no service, no message and no journal in it.
What was sensed and done there is kept: it is what every other run of that trial must do, and, as
long as it does, what the world shows to it. To sense or do something else, again, too early or too
late raises a :class:`Violation` at once.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np

from holdfast.arrays import FloatArray
from holdfast.config.settings import PlanningSettings, SimulatorSettings
from holdfast.lab.errors import Violation
from holdfast.lab.simulation.memo_cache import Memo
from holdfast.outcome import MoveResult, TrialResult
from holdfast.planning import Planner
from holdfast.problems.problem import Problem
from holdfast.robot.environment import SimulatedEnvironment
from holdfast.robot.trial import run_trial

__all__ = ["EnvironmentModel", "ReferenceRun", "ReferenceRuns", "ReferenceStep", "Repeats"]

Repeats: TypeAlias = tuple[tuple[int, int], ...]
"""Steps, and how often something was sensed in them before."""

_MOST = 2_000


class ReferenceStep(NamedTuple):
    """One step of the undisturbed run.

    Attributes
    ----------
    sensing_action : int or None
        What was sensed before the task action, if anything.
    observation : array or None
        What it showed.
    action : bytes
        The task action, little-endian float64.
    done : bool
        Whether the task is done after it.
    """

    sensing_action: int | None
    observation: FloatArray | None
    action: bytes
    reward: float | None
    done: bool


class ReferenceRun(NamedTuple):
    """A trial as it goes when nothing disturbs it."""

    steps: tuple[ReferenceStep, ...]
    done_at_start: bool
    digest: str


class _Recorder:
    """The world, and what is done in it."""

    def __init__(self, problem: Problem, seed: int, trial: int, repeats: Repeats) -> None:
        self._problem = problem
        self._seed = seed
        self._trial = trial
        self._environment = SimulatedEnvironment(problem, seed, trial)
        self._repeats = dict(repeats)
        self._sensed: tuple[int, FloatArray] | None = None
        self.steps: list[ReferenceStep] = []

    def perform_sensing(self, sensing_action: int) -> FloatArray:
        times = self._repeats.get(len(self.steps), 0)
        environment = self._again(times) if times else self._environment
        shown = np.array(environment.perform_sensing(sensing_action), dtype=np.float64)
        shown.setflags(write=False)
        self._sensed = sensing_action, shown
        return shown

    def _again(self, times: int) -> SimulatedEnvironment:
        """Return the same world with noise of its own for what is sensed again."""
        world = self._environment
        again = SimulatedEnvironment(self._problem, self._seed + times, self._trial)
        again.state, again.step = world.state, world.step
        return again

    def perform(self, task_action: FloatArray) -> float | None:
        reward = self._environment.perform(task_action)
        assert not isinstance(reward, MoveResult)
        sensing_action, shown = self._sensed or (None, None)
        written = np.asarray(task_action, dtype="<f8").tobytes()
        done = self._environment.is_done()
        self.steps.append(ReferenceStep(sensing_action, shown, written, reward, done))
        self._sensed = None
        return reward

    def is_done(self) -> bool:
        return self._environment.is_done()


class ReferenceRuns:
    """The undisturbed trials, each run when it is first asked for."""

    def __init__(self, problem: Problem, planning: PlanningSettings, seed: int) -> None:
        self._problem = problem
        self._planning = planning
        self._seed = seed
        self._runs: Memo[tuple[int, int, Repeats], ReferenceRun] = Memo(_MOST)

    def get(self, trial: int, max_steps: int, repeats: Repeats = ()) -> ReferenceRun:
        """Return a trial of at most so many steps.

        Parameters
        ----------
        repeats : tuple of (int, int)
            Steps in which something had been sensed before, and how often, without anybody knowing
            it now. What is sensed there then shows something else: the trial as it goes from there.
        """
        key = trial, max_steps, repeats
        return self._runs.get(key, lambda: self._run(trial, max_steps, repeats))

    def _run(self, trial: int, max_steps: int, repeats: Repeats) -> ReferenceRun:
        simulator = SimulatorSettings(num_trials=trial + 1, max_steps=max_steps, seed=self._seed)
        recorder = _Recorder(self._problem, self._seed, trial, repeats)
        done_at_start = recorder.is_done()
        result = run_trial(
            Planner(self._problem, self._planning),
            simulator.seed,
            trial,
            max_steps=simulator.max_steps,
            environment=recorder,
        )
        return ReferenceRun(tuple(recorder.steps), done_at_start, result.digest)


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
        self.trial = trial
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
        where = f"trial {self.trial}: sensing action {sensing_action} of step {step}"
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
            self._reference = self._references.get(self.trial, self._max_steps, repeats)
        shown = self._reference.steps[step].observation
        assert shown is not None
        return shown

    def act(self, step: int, action: FloatArray) -> tuple[float | None, bool]:
        """Perform a task action; return its reward and whether the task is done."""
        where = f"trial {self.trial}: task action of step {step}"
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
                f"trial {self.trial} ended after {result.steps} steps, {self.performed} of which "
                f"were performed: the undisturbed run has {len(reference.steps)}"
            )
        if result.digest != reference.digest:
            raise Violation(
                f"trial {self.trial}: digest of the decisions {result.digest[:16]}, the "
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
                    f"trial {self.trial}: {name} {said}, the undisturbed run has {true}"
                )
