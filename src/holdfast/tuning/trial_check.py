"""What a few simulated trials show: endings, beliefs that are worn out, and truths that are lost.

The trials sense at random, which costs no time for choosing and favours no sensor. Their beliefs
just before a sensing step are kept for the checks of the sensors.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from holdfast.errors import HoldfastError
from holdfast.numerics.arrays import BoolArray, FloatArray
from holdfast.numerics.circular import differences
from holdfast.planning.belief import Belief
from holdfast.planning.outcome import TrialResult
from holdfast.planning.planner import Planner, PlanningState
from holdfast.problems.attributes import circular_states, sensing_labels
from holdfast.robot.environment import SimulatedEnvironment
from holdfast.robot.trial import SensingStep, TaskStep, TrialObserver, run_trial
from holdfast.tuning.contract_check import truths
from holdfast.tuning.findings import CONTRACT, Inspection, spread_out

__all__ = ["SensedBelief", "check_trials"]

_TRIALS = 8
_BELIEFS = 24
"""Beliefs before sensing that are kept."""

_MOST_STEPS = 1000

_FEW_LEFT = 3.0
"""Effective particles after an observation below which it leaves hardly any."""

_OFTEN = 0.2
"""Share of the observations from which on it is worth a warning."""

_PARTICLES_KEPT = 400


class SensedBelief(NamedTuple):
    """A belief just before sensing, and the stage of the task."""

    belief: Belief
    stage: int


class _Left(NamedTuple):
    """What an observation leaves of a belief, and in which coordinates it had lost the truth."""

    sensing_action: int
    size: float
    explained: bool
    outside: BoolArray


class _TimeOverError(HoldfastError):
    """The time for this check is over."""


class _Watcher(TrialObserver):
    """Keeps what the checks need of a trial, and ends it when time is over."""

    def __init__(self, inspection: Inspection, late: Callable[[], bool]) -> None:
        self.inspection, self.late = inspection, late
        self.before: list[PlanningState] = []
        self.left: list[_Left] = []

    def trial_began(self, environment: object, state: PlanningState) -> None:
        """Keep the world, to look at the true state."""
        del state
        self.environment = environment

    def sensed(self, step: SensingStep) -> None:
        """Note the belief, and what the observation left of it."""
        self.before.append(step.before)
        info = step.observation_info
        world = self.environment
        assert isinstance(world, SimulatedEnvironment)
        angles = circular_states(self.inspection.problem)
        apart = differences(step.before.belief.states, world.state, angles)
        # The true state beyond all particles in some coordinate.
        outside = (apart > 0.0).all(axis=0) | (apart < 0.0).all(axis=0)
        size = info.effective_sample_size
        self.left.append(_Left(step.sensing_action, size, info.explained, np.asarray(outside)))

    def acted(self, step: TaskStep) -> None:
        """End the trial if the time is over, or in a failure, which the world does not know."""
        if self.late():
            raise _TimeOverError
        if step.reward is not None:
            self.inspection.rewards.append(step.reward)
        world = self.environment
        assert isinstance(world, SimulatedEnvironment)
        if truths(self.inspection.problem, "is_failure", world.state):
            raise _TimeOverError("failed")


def check_trials(inspection: Inspection) -> list[SensedBelief]:
    """Run a few trials with random sensing; return beliefs from along the way."""
    problem, settings = inspection.problem, inspection.settings
    late = inspection.deadline(0.25)
    import msgspec

    selector = msgspec.structs.replace(
        settings.selector, method="random", sensing_is_optional=False
    )
    planner = Planner(problem, msgspec.structs.replace(settings, selector=selector))
    steps = min(inspection.max_steps, _MOST_STEPS)
    results: list[TrialResult] = []
    failed = 0
    states: list[PlanningState] = []
    left: list[_Left] = []
    shares: list[FloatArray] = []
    for trial in range(_TRIALS):
        if late():
            break
        watcher = _Watcher(inspection, late)

        def run(watcher: _Watcher = watcher, trial: int = trial) -> TrialResult | str:
            try:
                return run_trial(planner, inspection.seed, trial, max_steps=steps, observer=watcher)
            except _TimeOverError as error:
                return str(error)

        result = inspection.ask("a simulated trial", run, "trials")
        states += watcher.before
        left += watcher.left
        if watcher.left:
            shares.append(np.array([each.outside for each in watcher.left]))
        if isinstance(result, TrialResult):
            results.append(result)
        else:
            failed += result == "failed"
    ended = len(results) + failed
    if ended < _TRIALS:
        inspection.add(
            "information",
            "trials",
            f"{ended} of {_TRIALS} simulated trials came to their end in the time for this check",
            "Give it more (--budget).",
        )
    _report_endings(inspection, results, failed, steps)
    _report_depletion(inspection, left)
    _report_lost_truths(inspection, left, shares)
    kept = [states[index] for index in spread_out(_BELIEFS, len(states))]
    return [SensedBelief(_thinned(each.belief), each.stage) for each in kept]


def _thinned(belief: Belief) -> Belief:
    """Return a belief of at most so many particles, which is enough for the sensors' checks."""
    count = len(belief.weights)
    if count <= _PARTICLES_KEPT:
        return belief
    chosen = spread_out(_PARTICLES_KEPT, count)
    weights: FloatArray = belief.weights[chosen] / belief.weights[chosen].sum()
    return Belief(belief.states[chosen], weights)


def _report_endings(
    inspection: Inspection, results: list[TrialResult], failed: int, steps: int
) -> None:
    count = len(results) + failed
    if not count:
        return
    successes = [result.steps for result in results if result.success]
    seen = f"with random sensing, {len(successes)} of {count} trials reach the goal"
    if successes:
        seen += f", after {np.median(successes):.0f} steps (median)"
    if failed:
        seen += f", and {failed} fail"
    walk = inspection.walk
    possible = walk is not None and (walk.reached >= 0).mean() >= 0.5
    if not successes and possible:
        inspection.add(
            "warning",
            "trials",
            f"{seen}, within {steps} steps; with the state known most do",
            "Random sensing may be too poor, or the estimate (the mean) lies where the robot is "
            "not. Try particle_filter.estimate: heaviest_mode, sense more often "
            "(simulator.sensing_intervals), and look at the warnings here.",
            "docs/problems.md#your-own",
        )
    else:
        inspection.add("information", "trials", seen)


def _report_depletion(inspection: Inspection, left: list[_Left]) -> None:
    """Report what observations leave of the particles."""
    if not left:
        return
    particles = inspection.settings.particle_filter.num_particles
    few = []
    for action in range(len(sensing_labels(inspection.problem))):
        sizes = np.array([each.size for each in left if each.sensing_action == action])
        if len(sizes) >= 5 and (share := (sizes < _FEW_LEFT).mean()) > _OFTEN:
            few.append(f"{inspection.label(action)} in {share:.0%} of {len(sizes)} observations")
    if few:
        inspection.add(
            "warning",
            "depletion",
            f"sensors are too sharp for {particles} particles: often fewer than {_FEW_LEFT:.0f} "
            f"particles count afterwards (effective sample size), with {', '.join(few)}",
            "Take more particles (particle_filter.num_particles), sense more often, or declare the "
            "sensor a little less sharp than it is.",
            "docs/settings.md",
        )


def _report_lost_truths(
    inspection: Inspection, left: list[_Left], trials: list[FloatArray]
) -> None:
    """Report how often the true state lies beyond all particles; each trial counts the same."""
    if not trials:
        return
    unexplained = sum(not each.explained for each in left)
    particles = inspection.settings.particle_filter.num_particles
    shares = np.mean([outside.mean(axis=0) for outside in trials], axis=0)
    whole = float(np.mean([outside.any(axis=1).mean() for outside in trials]))
    # Beyond all of n particles of a right belief it is twice in n + 1.
    if whole < _OFTEN + 2.0 * shares.size / (particles + 1):
        return
    at = int(shares.argmax())
    inspection.add(
        "warning",
        "depletion",
        f"in {whole:.0%} of the beliefs before sensing, over {len(trials)} trials with random "
        f"sensing, the true state lies beyond all {particles} particles in some coordinate, most "
        f"often in {inspection.coordinate(at)} ({shares[at]:.0%}); {unexplained} of {len(left)} "
        "observations are further than any particle explains",
        "An observation of one coordinate leaves few particles for the others: take more of them, "
        "or sense more often. A coordinate that does not move needs a little noise in move.",
        CONTRACT,
    )
