"""One trial: a robot senses, acts and predicts until it is at the goal or out of steps.

The loop owns no decision and no random number: it hands the planner's decisions to the environment
and the environment's observations to the planner. It notes each decision as bytes, in order, and
the hash of these bytes is the trial's digest: two runs decided the same exactly if their digests
are equal, on whatever machine, with however many processes they were made.

An observer sees every step (to draw a figure, say). The default one does nothing.
"""

from __future__ import annotations

from time import perf_counter
from typing import NamedTuple

import numpy as np

from holdfast.arrays import FloatArray
from holdfast.config.settings import SimulatorSettings
from holdfast.errors import EnvironmentFailedError, InvalidValueError, ProblemError
from holdfast.outcome import DecisionLog, Done, RewardAccount, TrialResult
from holdfast.planning import (
    ObservationInfo,
    Planner,
    PlanningState,
    SensingInfo,
    TaskInfo,
    digest,
)
from holdfast.robot.environment import (
    DONE_VALUES,
    Environment,
    SimulatedEnvironment,
    as_done,
)

__all__ = [
    "NULL_OBSERVER",
    "SensingStep",
    "TaskStep",
    "TrialObserver",
    "run_trial",
]


class SensingStep(NamedTuple):
    """A sensing action, its observation, and the states before and after it."""

    before: PlanningState
    sensing_action: int
    sensing_info: SensingInfo
    observation: FloatArray
    after: PlanningState
    observation_info: ObservationInfo


class TaskStep(NamedTuple):
    """A task action that was performed, and the state in which it was chosen."""

    environment: Environment
    state: PlanningState
    task_info: TaskInfo
    executed: FloatArray
    reward: float | None


class TrialObserver:
    """Observes a trial: derive from it, and define what is of interest; the rest does nothing.

    It must change nothing, and copy what it keeps.
    """

    def trial_began(self, environment: Environment, state: PlanningState) -> None:
        """Take note of the first state."""

    def sensed(self, step: SensingStep) -> None:
        """Take note of a sensing action."""

    def acted(self, step: TaskStep) -> None:
        """Take note of a task action."""

    def trial_ended(self, state: PlanningState, result: TrialResult) -> None:
        """Take note of the last state and of the outcome."""


NULL_OBSERVER = TrialObserver()


def run_trial(
    planner: Planner,
    seed: int = 0,
    trial: int = 0,
    *,
    max_steps: int = SimulatorSettings().max_steps,
    environment: Environment | None = None,
    observer: TrialObserver = NULL_OBSERVER,
) -> TrialResult:
    """Run one trial until it is done, has failed, or has had ``max_steps``.

    How often the robot senses is a setting of the planner, ``sensing_interval``.

    Parameters
    ----------
    seed, trial : int
        Together they name every random draw.
    max_steps : int
        Task actions, at least 1.
    environment : Environment, optional
        By default simulated from the problem.

    Raises
    ------
    HoldfastError
        If holdfast refuses what the problem or the environment returned; :class:`ProblemError` for
        a reward that is not finite, :class:`EnvironmentFailedError` for anything else than what
        ``is_done`` may return.
    """
    if not (isinstance(max_steps, int) and max_steps >= 1):
        raise InvalidValueError(f"max_steps is {max_steps!r}; allowed are integers from 1")
    problem = planner.problem
    if environment is None:
        environment = SimulatedEnvironment(problem, seed, trial)
    state = planner.init(seed, trial)
    observer.trial_began(environment, state)

    log = DecisionLog(problem.action_size)
    sensing_ms: list[float] = []
    rewards = RewardAccount(problem)
    unexplained = 0
    steps = 0
    done = _ask_done(environment)
    while not done and steps < max_steps:
        if planner.needs_sensing(state):
            started = perf_counter()
            sensing_action, sensing_info = planner.choose_sensing_action(state)
            sensing_ms.append((perf_counter() - started) * 1e3)
            observation = environment.perform_sensing(sensing_action)
            before = state
            state, observation_info = planner.observe(state, sensing_action, observation)
            if not observation_info.explained:
                unexplained += 1
            log.sensed(steps, sensing_action, digest(state))
            rewards.sensed(sensing_action)
            observer.sensed(
                SensingStep(
                    before, sensing_action, sensing_info, observation, state, observation_info
                )
            )
        executed, task_info = planner.choose_task_action(state)
        reward = environment.perform(executed)
        if reward is not None:
            if not np.isfinite(reward):
                raise ProblemError(
                    f"the reward of step {steps} is {float(reward)}; it must be a finite number"
                )
            rewards.acted(float(reward))
        log.acted(steps, executed)
        observer.acted(TaskStep(environment, state, task_info, executed, reward))
        state = planner.advance(state, executed)
        steps += 1
        done = _ask_done(environment)
    log.ended(steps, digest(state))

    decisions = log.decisions()
    result = TrialResult(
        trial=trial,
        seed=seed,
        success=done is True,
        failed=done == "failed",
        steps=steps,
        reward=rewards.total if steps else 0.0,
        sensing_decisions=len(sensing_ms),
        mean_sensing_ms=sum(sensing_ms) / len(sensing_ms) if sensing_ms else 0.0,
        recoveries=0,
        unexplained_observations=unexplained,
        digest=decisions.digest(),
        sensing_ms=tuple(sensing_ms),
        decisions=decisions,
    )
    observer.trial_ended(state, result)
    return result


def _ask_done(environment: Environment) -> Done:
    value = environment.is_done()
    done = as_done(value)
    if done is None:
        raise EnvironmentFailedError(
            f"{type(environment).__name__}: is_done returned {value!r:.80}; it must return "
            f"{DONE_VALUES}"
        )
    return done
