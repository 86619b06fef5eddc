"""What a few simulated trials show: endings, beliefs that are worn out, truths that are lost.

The trials sense at random, which costs no time for choosing and favours no sensor. Their beliefs
just before a sensing step are kept for the checks of the sensors and of the time of a decision.
"""

from __future__ import annotations

import contextlib
import cProfile
from collections.abc import Callable
from time import thread_time

import msgspec
import numpy as np

from holdfast.errors import HoldfastError
from holdfast.numerics.arrays import BoolArray, FloatArray
from holdfast.numerics.circular import differences
from holdfast.planning.belief import Belief
from holdfast.planning.planner import Planner, PlanningState
from holdfast.problems.attributes import PARAMETERS, circular_states, sensing_labels
from holdfast.robot.environment import SimulatedEnvironment
from holdfast.robot.trial import SensingStep, TaskStep, TrialObserver, run_trial
from holdfast.tuning.contract_check import truths
from holdfast.tuning.findings import Inspection, spread_out

__all__ = ["check_decision_time", "check_trials"]

_TRIALS, _MOST_STEPS = 8, 1000
_BELIEFS, _PARTICLES = 24, 400
"""Beliefs before sensing that are kept, and particles of each."""

_FEW_LEFT = 3.0
"""Effective particles after an observation below which it leaves hardly any."""

_OFTEN = 0.2
"""Share of the observations from which on it is worth a warning."""

_DECISIONS = 5


_Left = tuple[int, float, BoolArray]
"""What an observation leaves of a belief: the sensing action, effective particles, and whether the
true state lay beyond all particles in each coordinate."""


class _EndedError(HoldfastError):
    """The time for this check is over, or the trial has failed."""


class _Watcher(TrialObserver):
    """Keeps what the checks need of a trial, and ends it when time is over."""

    def __init__(self, inspection: Inspection, late: Callable[[], bool]) -> None:
        self.inspection, self.late = inspection, late
        self.before: list[PlanningState] = []
        self.left: list[_Left] = []

    def trial_began(self, environment: object, state: PlanningState) -> None:
        """Keep the world, to look at the true state."""
        del state
        assert isinstance(environment, SimulatedEnvironment)
        self.world = environment

    def sensed(self, step: SensingStep) -> None:
        """Note the belief, and what the observation left of it."""
        self.before.append(step.before)
        angles = circular_states(self.inspection.problem)
        apart = differences(step.before.belief.states, self.world.state, angles)
        # The true state beyond all particles in some coordinate.
        outside = (apart > 0.0).all(axis=0) | (apart < 0.0).all(axis=0)
        size = step.observation_info.effective_sample_size
        self.left.append((step.sensing_action, size, np.asarray(outside)))

    def acted(self, step: TaskStep) -> None:
        """End the trial if the time is over, or in a failure, which the world does not know."""
        if self.late():
            raise _EndedError("late")
        if step.reward is not None:
            self.inspection.rewards.append(step.reward)
        if truths(self.inspection.problem, "is_failure", self.world.state):
            raise _EndedError("failed")


def check_trials(inspection: Inspection) -> list[PlanningState]:
    """Run a few trials with random sensing; return states from along the way, before sensing."""
    settings, late = inspection.settings, inspection.deadline(0.25, "trials")
    selector = msgspec.structs.replace(
        settings.selector, method="random", sensing_is_optional=False
    )
    planner = Planner(inspection.problem, msgspec.structs.replace(settings, selector=selector))
    steps = min(inspection.max_steps, _MOST_STEPS)
    reached: list[int] = []
    endings: list[str] = []
    watchers: list[_Watcher] = []

    def run(trial: int, watcher: _Watcher) -> str:
        try:
            result = run_trial(planner, inspection.seed, trial, max_steps=steps, observer=watcher)
        except _EndedError as error:
            return str(error)
        reached.extend([result.steps] if result.success else [])
        return "ended"

    while len(watchers) < _TRIALS and not late():
        watchers.append(_Watcher(inspection, late))
        endings.append(inspection.ask("a simulated trial", run, len(endings), watchers[-1]))
    count, failed = len(endings) - endings.count("late"), endings.count("failed")
    if count:
        _report_endings(inspection, reached, count, failed, steps)
    _report_depletion(inspection, [watcher.left for watcher in watchers if watcher.left])
    states = [state for watcher in watchers for state in watcher.before]
    kept = [states[index] for index in spread_out(_BELIEFS, len(states))]
    return [state._replace(belief=_thinned(state.belief)) for state in kept]


def _thinned(belief: Belief) -> Belief:
    """Return a belief of fewer particles, which is enough for the sensors' checks."""
    chosen = spread_out(_PARTICLES, len(belief.weights))
    weights: FloatArray = belief.weights[chosen] / belief.weights[chosen].sum()
    return Belief(belief.states[chosen], weights)


def _report_endings(
    inspection: Inspection, reached: list[int], count: int, failed: int, steps: int
) -> None:
    seen = f"with random sensing, {len(reached)} of {count} trials reach the goal"
    seen += f", after {np.median(reached):.0f} steps (median)" if reached else ""
    seen += f", and {failed} fail" if failed else ""
    walk = inspection.walk
    if reached or walk is None or (walk.reached >= 0).mean() < 0.5:
        inspection.add("information", "trials", seen)
        return
    seen += f", within {steps} steps; with the state known most do"
    advice = "The estimate (the mean) may lie where the robot is not, or random sensing is too "
    advice += "poor. Try particle_filter.estimate: heaviest_mode, and sense more often "
    advice += "(simulator.sensing_intervals)."
    inspection.add("warning", "trials", seen, advice)


def _report_depletion(inspection: Inspection, trials: list[list[_Left]]) -> None:
    """Report what observations leave of the particles, and how often the truth is beyond them."""
    if not trials:
        return
    left = [each for trial in trials for each in trial]
    particles = inspection.settings.particle_filter.num_particles
    few = []
    for action in range(len(sensing_labels(inspection.problem))):
        sizes = np.array([size for own, size, _ in left if own == action])
        if len(sizes) >= 5 and (share := (sizes < _FEW_LEFT).mean()) > _OFTEN:
            few.append(f"{inspection.label(action)} in {share:.0%} of {len(sizes)} observations")
    if few:
        seen = f"sensors are too sharp for {particles} particles: often fewer than {_FEW_LEFT:.0f} "
        seen += f"count afterwards (effective sample size), with {', '.join(few)}"
        advice = "Take more particles (particle_filter.num_particles), sense more often, or "
        advice += "declare the sensor a little less sharp than it is."
        inspection.add("warning", "depletion", seen, advice)
    # Each trial counts the same.
    outside = [np.array([each for _, _, each in trial]) for trial in trials]
    shares = np.mean([each.mean(axis=0) for each in outside], axis=0)
    whole = float(np.mean([each.any(axis=1).mean() for each in outside]))
    # Beyond all of n particles of a right belief it is twice in n + 1.
    if whole > _OFTEN + 2.0 * shares.size / (particles + 1):
        at = int(shares.argmax())
        seen = f"in {whole:.0%} of the beliefs before sensing, over {len(trials)} trials with "
        seen += f"random sensing, the true state lies beyond all {particles} particles in some "
        seen += f"coordinate, most often in {inspection.coordinate(at)} ({shares[at]:.0%})"
        advice = "An observation of one coordinate leaves few particles for the others: take more, "
        advice += "or sense more often. What does not move needs a little noise in move."
        inspection.add("warning", "depletion", seen, advice)


def check_decision_time(inspection: Inspection, states: list[PlanningState]) -> None:
    """Say how many milliseconds of one thread a choice of what to sense takes, and in what."""
    problem, settings = inspection.problem, inspection.settings
    late = inspection.deadline(0.15, "time")
    active = msgspec.structs.replace(settings.active_sensing, num_cores=1)
    planner = Planner(problem, msgspec.structs.replace(settings, active_sensing=active))
    initial = inspection.ask("a decision", planner.init, inspection.seed, 0, check="time")
    taken: list[float] = []
    profile = cProfile.Profile(thread_time)

    def decide(state: PlanningState) -> None:
        # The first one, which may load something, does not count.
        planner.choose_sensing_action(state)
        began = thread_time()
        planner.choose_sensing_action(state)
        taken.append(thread_time() - began)
        with contextlib.suppress(ValueError):  # if a profiler runs already
            profile.runcall(planner.choose_sensing_action, state)

    for state in [initial, *(states[index] for index in spread_out(_DECISIONS, len(states)))]:
        if not (taken and late()):
            inspection.ask("a decision", decide, state, check="time")
    codes = {getattr(getattr(problem, each, None), "__code__", None): each for each in PARAMETERS}
    entries = sorted(profile.getstats(), key=lambda entry: -entry.totaltime)
    parts = [
        f"{entry.totaltime / entries[0].totaltime:.0%} in {codes[entry.code]} "
        f"({entry.callcount} calls)"
        for entry in entries
        if entry.code in codes and entry.totaltime > 0.02 * entries[0].totaltime
    ]
    seen = f"a choice of what to sense takes {np.median(taken) * 1e3:.2g} ms of processor time "
    seen += f"({settings.selector.method}, {settings.particle_filter.num_particles} particles)"
    seen += f": {', '.join(parts)}" if parts else ""
    advice = "Use whole arrays in what takes most, no loop over states, and look whether fewer "
    advice += "active_sensing.num_observation_samples choose as well."
    inspection.add("information", "time", seen, advice if np.median(taken) > 5e-3 else "")
