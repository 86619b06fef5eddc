"""The run that nothing disturbs, and the world as it goes there.

Each trial is run once by the plain closed loop, with no service, no message and no journal in it.
What was sensed and done there is kept: it is what every other run of that trial must do, and, as
long as it does, what the world shows to it. So the world of a disturbed run need not be computed
again, and whatever differs is seen at once.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np

from holdfast.arrays import FloatArray
from holdfast.config.settings import PlanningSettings, SimulatorSettings
from holdfast.lab.simulation.memo_cache import Memo
from holdfast.planning import Planner
from holdfast.problems.problem import Problem
from holdfast.robot.environment import SimulatedEnvironment
from holdfast.robot.trial import run_trial

__all__ = ["ReferenceRun", "ReferenceRuns", "ReferenceStep", "Repeats"]


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
