"""One trial: a robot senses, acts and predicts until it is at the goal or out of steps.

The loop owns no decision and no random number: it hands the planner's decisions to the environment
and the environment's observations to the planner. It notes each decision as bytes, in order, and
the hash of these bytes is the trial's digest: two runs decided the same exactly if their digests
are equal, on whatever machine, with however many processes they were made.

An observer sees every step (to draw a figure, say). The default one does nothing.
"""

from __future__ import annotations

from collections.abc import Collection
from time import perf_counter
from typing import NamedTuple

from holdfast.errors import HeldError, InvalidValueError
from holdfast.numerics.arrays import FloatArray, whole
from holdfast.planning import settings
from holdfast.planning.belief import ObservationInfo
from holdfast.planning.inputs import Late, Moved, Reinitialised, Sensed
from holdfast.planning.outcome import TrialResult
from holdfast.planning.planner import Planner, PlanningState, TaskInfo
from holdfast.planning.sensing import SensingInfo
from holdfast.planning.tracking import Trial
from holdfast.robot.environment import (
    CheckedEnvironment,
    Environment,
    SimulatedEnvironment,
    require_methods,
)


class SensingStep(NamedTuple):
    """A sensing action, its observation, and the states before and after it."""

    before: PlanningState
    sensed: Sensed
    sensing_info: SensingInfo
    after: PlanningState
    observation_info: ObservationInfo

    @property
    def sensing_action(self) -> int:
        """What was chosen; the choice may be not to sense (``planner.no_sensing``)."""
        return self.sensed.sensing_action

    @property
    def observation(self) -> FloatArray | None:
        """What was observed; None if it comes later, never, or if nothing was sensed."""
        return self.sensed.numbers()


class TaskStep(NamedTuple):
    """A task action that was performed, and the state in which it was chosen.

    ``moved`` is what the environment returned, ``observation_info`` what its observation led to.
    """

    environment: Environment
    state: PlanningState
    task_info: TaskInfo
    executed: FloatArray
    moved: Moved
    observation_info: ObservationInfo | None = None

    @property
    def reward(self) -> float | None:
        """None if the environment gave none."""
        return self.moved.reward


class LateStep(NamedTuple):
    """A late observation, and the state after it was folded in at its step."""

    late: Late
    after: PlanningState
    observation_info: ObservationInfo


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

    def observed_late(self, step: LateStep) -> None:
        """Take note of an observation that came late."""

    def reinitialised(self, state: PlanningState) -> None:
        """Take note of the state with a belief that was begun anew."""

    def trial_ended(self, state: PlanningState, result: TrialResult) -> None:
        """Take note of the last state and of the outcome."""


NULL_OBSERVER = TrialObserver()

_LOST_BY_DEFAULT = settings.LostSettings()


def run_trial(
    planner: Planner,
    seed: int = 0,
    trial: int = 0,
    *,
    max_steps: int = settings.SimulatorSettings().max_steps,
    environment: Environment | None = None,
    observer: TrialObserver = NULL_OBSERVER,
    lost: settings.LostSettings = _LOST_BY_DEFAULT,
    max_missing_in_a_row: int = settings.EnvironmentSettings().max_missing_in_a_row,
    reinitialised_after: Collection[int] | None = None,
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
    lost : LostSettings
        When the robot counts as lost, and what it does then.
    max_missing_in_a_row : int
        How often in a row sensing may give no reading; once more is an EnvironmentFailedError.
    reinitialised_after : collection of int, optional
        Of a simulated trial that is run again: after how many inputs the belief was begun anew;
        instead of ``lost``.

    Raises
    ------
    HeldError
        If the robot is lost and ``lost.on_lost`` is ``hold``.
    HoldfastError
        If holdfast refuses what the problem or the environment returned.
    """
    if not isinstance(planner, Planner):
        raise InvalidValueError(
            f"planner is a {type(planner).__name__}: run_trial takes a planner, as in "
            "run_trial(Planner(problem))"
        )
    max_steps = whole("max_steps", max_steps, 1)
    if environment is None:
        environment = SimulatedEnvironment(planner.problem, seed, trial)
    else:
        _require_new(environment)
    require_methods(environment, type(environment).__name__)
    lost = settings.check_settings(lost, settings.LostSettings, "lost")
    missed = settings.EnvironmentSettings(max_missing_in_a_row=max_missing_in_a_row)
    missed = settings.check_settings(missed, settings.EnvironmentSettings, "environment")
    track = Trial(planner, seed, trial, lost.false_alarm_rate)
    name, most = type(environment).__name__, missed.max_missing_in_a_row
    world = CheckedEnvironment(planner.problem, name, most, environment)
    observer.trial_began(environment, track.state)
    ending = world.ready(resumed=False).ending
    while ending is None and track.state.step < max_steps:
        if planner.needs_sensing(track.state):
            _sense(track, world, observer)
            _act_if_lost(track, lost.on_lost, reinitialised_after, observer)
        executed, task_info = planner.choose_task_action(track.state)
        acted = world.perform(track.state.step, executed)
        track.pending = executed
        take_move(track, acted.moved, task_info, observer, environment)
        if track.found is not None:
            _act_if_lost(track, lost.on_lost, reinitialised_after, observer)
        for late in acted.late:
            if late.taken in track.awaited:
                take_late(track, late, observer)
                _act_if_lost(track, lost.on_lost, reinitialised_after, observer)
        ending = acted.ending
    ended = track.result(ending)
    observer.trial_ended(track.state, ended)
    return ended


def take_sensing(
    track: Trial, sensed: Sensed, sensing_info: SensingInfo, observer: TrialObserver
) -> None:
    """Fold in a sensing action, and tell the observer."""
    before, sensed = track.state, track.take(sensed)
    assert track.found is not None
    observer.sensed(SensingStep(before, sensed, sensing_info, track.state, track.found))


def take_move(
    track: Trial,
    moved: Moved,
    task_info: TaskInfo,
    observer: TrialObserver,
    environment: Environment,
) -> None:
    """Fold in the pending task action, and tell the observer."""
    before, action = track.state, track.pending
    assert action is not None
    moved = track.take(moved)
    observer.acted(TaskStep(environment, before, task_info, action, moved, track.found))


def take_late(track: Trial, late: Late, observer: TrialObserver) -> None:
    """Fold in a late observation that is awaited, and tell the observer."""
    late = track.take(late)
    assert track.found is not None
    observer.observed_late(LateStep(late, track.state, track.found))


def take_reinitialisation(track: Trial, observer: TrialObserver) -> None:
    """Begin the belief anew, and tell the observer."""
    track.take(Reinitialised(track.state.step))
    observer.reinitialised(track.state)


def _require_new(environment: Environment) -> None:
    """Refuse a world that begins with an earlier trial's end."""
    from holdfast.robot.gymnasium_environment import GymnasiumEnvironment

    if isinstance(environment, SimulatedEnvironment | GymnasiumEnvironment):
        count = environment.steps_performed()
        if count:
            raise InvalidValueError(
                f"environment is a {type(environment).__name__} that has performed {count} task "
                "actions already: make a new one for each trial"
            )


def _sense(track: Trial, world: CheckedEnvironment, observer: TrialObserver) -> None:
    planner, before = track.planner, track.state
    started = perf_counter()
    sensing_action, sensing_info = planner.choose_sensing_action(before)
    sensing_ms = (perf_counter() - started) * 1e3
    shown = b""
    if sensing_action != planner.no_sensing:
        came = world.sense(before.step, sensing_action)
        shown = came.observation if isinstance(came, Sensed) else b""
    sensed = Sensed(before.step, sensing_action, shown, sensing_ms=sensing_ms)
    take_sensing(track, sensed, sensing_info, observer)


def _act_if_lost(
    track: Trial,
    on_lost: settings.OnLost,
    recorded: Collection[int] | None,
    observer: TrialObserver,
) -> None:
    """Do what is to be done after an input."""
    alarm = track.alarm
    is_lost = alarm is not None and alarm.kind == "lost"
    if recorded is not None:
        again = track.num_inputs in recorded
    elif is_lost and on_lost == "hold":
        raise HeldError(
            f"the robot is lost in trial {track.state.trial}, step {track.state.step}, and holds "
            "still, as lost.on_lost says"
        )
    else:
        again = is_lost and on_lost == "reinitialise"
    if again:
        take_reinitialisation(track, observer)
