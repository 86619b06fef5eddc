"""Whether the task can be done, and what a few simulated trials show of the beliefs.

Sensing cannot gain more than a known state. So first some trials are simulated all at once without
any belief: if these do not come to the goal, no sensing will. They also show where the robot goes.

Then a few trials sense at random, which favours no sensor; their beliefs are kept for other checks.
At last the method that is to be used runs beside random sensing.
"""

from __future__ import annotations

import contextlib
import cProfile
from collections.abc import Callable
from time import thread_time
from typing import Any

import msgspec
import numpy as np

from holdfast.numerics.arrays import BoolArray, FloatArray, IntArray
from holdfast.numerics.circular import differences
from holdfast.numerics.randomness import NoiseFreeStream
from holdfast.planning.belief import Belief
from holdfast.planning.outcome import TrialResult
from holdfast.planning.planner import Planner, PlanningState
from holdfast.problems import attributes, checked
from holdfast.problems.problem import ProblemBase
from holdfast.robot.lost_values import ADVICE, FEW_LEFT, REMEDY, LostValues, remark_on_lost_values
from holdfast.robot.trial import SensingStep, TaskStep, TrialObserver, run_trial
from holdfast.tuning.contract_check import acted, check_contract
from holdfast.tuning.findings import CheckEndedError, Inspection, Severity, Walk, spread_out
from holdfast.tuning.verdict import mean_difference

_WALKS = 64
_KEPT, _CHOSEN = 24, 48  # steps whose states are kept, and states whose contract is checked
_LONGER = 4  # times max_steps, to tell a limit that is too low from a trial that is lost
_INITIAL, _WAY, _NOISE = 8, 9, 10  # trial numbers of the streams here
_DRAWS, _STATES = 100, 12  # moves from each of some states, whose noise is compared
_TRIALS, _MOST_STEPS, _DECISIONS = 8, 1000, 5
_BELIEFS, _PARTICLES = 24, 400  # beliefs before sensing that are kept, and particles of each
_FEWEST_PAIRS = 10  # of trials from which an interval is made
_ENOUGH = 0.5  # share of the trials that should reach the goal
_OFTEN = 0.2  # share of the observations from which on it is worth a warning


def check_goals(inspection: Inspection) -> None:
    """Follow the policy with the state known, and check the contract again along the way."""
    walk = _follow_policy(inspection)
    chosen = spread_out(_CHOSEN, len(walk.states))
    if len(chosen) == _CHOSEN:
        check_contract(inspection, walk.states[chosen], walk.stages[chosen])
    if all(each.check != "purity" for each in inspection.findings):
        _check_motion(inspection, walk)


def _follow_policy(inspection: Inspection) -> Walk:
    """Simulate trials in which the state is known, until all have ended or the steps are over."""
    problem, ask = inspection.problem, inspection.ask
    late = inspection.deadline(0.2, "goals")
    own = inspection.random(_INITIAL)
    states = ask("initial_states", checked.initial_states, problem, own, _WALKS)
    stages = np.zeros(_WALKS, dtype=np.int64)
    reached, failed = np.full(_WALKS, -1), np.zeros(_WALKS, dtype=np.int64)
    kept: list[tuple[FloatArray, IntArray]] = []
    jumps = np.zeros((2, states.shape[1]), dtype=np.int64)
    turns = np.zeros((2, problem.action_size), dtype=np.int64)
    step = still = 0
    stride = 1
    while True:
        done = ask("is_goal", checked.truths, problem, "is_goal", states)
        lost = ask("is_failure", checked.truths, problem, "is_failure", states)
        running = (reached < 0) & (failed == 0)
        reached[running & done & ~lost] = step
        failed[running & lost] = 1 + done[running & lost]  # 2: although it is at a goal
        if step % stride == 0:
            kept.append((states, stages))
        if len(kept) > 2 * _KEPT:  # so that a long trial takes no more memory
            kept, stride = kept[::2], 2 * stride
        if step == _LONGER * inspection.max_steps or not (running & ~done & ~lost).any() or late():
            break
        stages = ask("next_stage", checked.next_stages, problem, states, stages)
        commanded = ask("policy", checked.policy, problem, states, stages)
        actions = ask("limit_action", checked.executed_action, problem, commanded)
        still += bool((actions == 0.0).all())
        own = inspection.random(_WAY, step)
        moved = ask("move", checked.move, problem, states, actions, own)
        jumps += _large_changes(moved - states)
        turns += _large_changes(ask("policy", checked.policy, problem, moved, stages) - commanded)
        states = moved
        step += 1
    some = [kept[index] for index in spread_out(_KEPT, len(kept))]
    at, their = (np.concatenate([each[part] for each in some]) for part in (0, 1))
    inspection.walk = walk = Walk(at, np.asarray(their, dtype=np.int64), reached)
    _report_angles(inspection, jumps, turns)
    _report_walk(inspection, walk, failed, step, never_moves=0 < step == still)
    if getattr(type(problem), "reward", None) not in (None, ProblemBase.reward):
        actions = ask("policy", acted, problem, walk.states, walk.stages)
        rewards = ask("reward", checked.rewards, problem, walk.states, actions)
        inspection.rewards.extend(rewards.tolist())
    return walk


def _large_changes(change: FloatArray) -> IntArray:
    """Count the large changes of each coordinate in a step, and those of about a whole turn."""
    size = np.abs(change)
    return np.array([(size > 0.5 * np.pi).sum(0), (np.abs(size - 2.0 * np.pi) < 0.5).sum(0)])


def _report_angles(inspection: Inspection, jumps: IntArray, turns: IntArray) -> None:
    """Warn of coordinates whose large changes are all whole turns, as if they were angles."""
    problem = inspection.problem
    for counts, attribute, declared, whose in (
        (jumps, "circular", attributes.circular_states(problem), "a state"),
        (turns, "circular_actions", attributes.circular_actions(problem), "the task action"),
    ):
        for at in np.flatnonzero((counts[1] >= 2) & (counts[1] == counts[0])).tolist():
            seen = f"coordinate {at} of {whose} jumps by a whole turn (2 pi) in one step, and is "
            seen += "not declared to be an angle: the mean of 3.1 and -3.1 is taken for 0"
            advice = f"Give the problem {attribute} = ({at},), and circular_observations to a "
            advice += "Gaussian sensor; elsewhere take numerics.wrapped(goal - heading)."
            if at not in declared:
                inspection.add("warning", "units", seen, advice)


def _report_walk(
    inspection: Inspection, walk: Walk, failed: IntArray, steps: int, *, never_moves: bool
) -> None:
    limit, num_stages = inspection.max_steps, inspection.problem.num_stages
    reached, in_time = walk.reached >= 0, (walk.reached >= 0) & (walk.reached <= limit)
    if (walk.reached == 0).all():
        seen = f"all of {_WALKS} initial states are goals: each trial ends before its first step"
        inspection.add("error", "goals", seen, "Look at is_goal and initial_states.")
        return
    if never_moves and not reached.all():
        seen = f"the policy never moves: its executed action is 0 in all of {_WALKS} trials of "
        seen += f"{steps} steps, and {reached.sum()} of them reach the goal"
        inspection.add("error", "goals", seen, "Look at policy and limit_action.")
        return
    seen = f"with the state known, the policy comes to the goal in {reached.sum()} of {_WALKS} "
    seen += "trials"
    if reached.any():
        seen += f", after {np.median(walk.reached[reached]):.0f} steps (median)"
    if lost := int((failed > 0).sum()):
        seen += f", and {lost} fail"
    if running := _WALKS - int(reached.sum()) - lost:
        seen += f"; {running} have not ended after {steps} steps"
    if (reached & ~in_time).any():
        seen += f"; within max_steps, {limit}, it is {in_time.sum()}"
    cut = running > 0 and steps < limit
    advice = "No sensing wins what is lost here. Look at is_goal and at the policy near the goal."
    if reached.mean() >= _ENOUGH:
        needed = int(np.quantile(walk.reached[reached], 0.9))
        advice = f"Set simulator.max_steps to {2 * needed} or more."
    if missed := int((failed == 2).sum()):
        seen += f"; {missed} of the failures are at a goal"
        advice = "A trial fails even at a goal: let is_failure be false where is_goal is true."
    if not missed and (cut or in_time.mean() >= _ENOUGH):
        inspection.add("information", "goals", seen)
    else:
        inspection.add("warning" if in_time.any() else "error", "goals", seen, advice)
    if (greatest := int(walk.stages.max())) + 1 < num_stages and not cut:
        seen = f"num_stages is {num_stages}, but no trial comes beyond stage {greatest}"
        inspection.add("warning", "goals", seen, "Look at next_stage.")


def _check_rewards(inspection: Inspection) -> None:
    """Look at the rewards of all simulated steps: whether they tell anything."""
    rewards, selector = np.array(inspection.rewards), inspection.settings.selector
    if not rewards.size or np.ptp(rewards) > 0.0 or rewards[0] < 0.0:
        return
    severity: Severity = "information"
    tells = "expected_return has nothing to tell sensing actions by"
    if rewards[0] > 0.0:
        severity, tells = "warning", "a trial that never reaches the goal has the greatest return"
    seen = f"the reward is {rewards[0]:g} in all of {len(rewards)} simulated steps: {tells}"
    if selector.method == "expected_return" and selector.rollout_reward == "problem":
        severity = "error"
    advice = "selector.rollout_reward: steps counts steps instead, as without a reward."
    inspection.add(severity, "goals", seen, advice)


def _check_motion(inspection: Inspection, walk: Walk) -> None:
    """Compare the noise of ``move`` with what the problem says of it."""
    problem, ask = inspection.problem, inspection.ask
    ratios = []
    for number, at in enumerate(spread_out(_STATES, len(walk.states))):
        state, own = walk.states[at], inspection.random(_NOISE, number)
        action = ask("limit_action", acted, problem, state, int(walk.stages[at]))
        moved = ask("move", checked.move, problem, np.tile(state, (_DRAWS, 1)), action, own)
        slopes = ask("move", _slopes, problem, state, action)
        variance = differences(moved, moved[0], attributes.circular_states(problem)).var(axis=0)
        predicted = (slopes**2 * np.asarray(problem.motion_variance)).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios.append(np.where(predicted > 0.0, variance / predicted, np.nan))
    for at, values in enumerate(np.transpose(ratios)):
        known = values[np.isfinite(values)]
        ratio = float(np.median(known)) if 2 * len(known) >= len(values) else 1.0
        if not 1.0 / 9.0 <= ratio <= 9.0:
            seen = f"motion_variance says that a step blurs {inspection.coordinate(at)} with a "
            seen += f"variance {'below' if ratio > 1.0 else 'above'} what move does: move's is "
            seen += f"{ratio:.2g} times as large (median of {len(ratios)} states)"
            advice = "motion_variance is the variance of the noise of one step, not its standard "
            advice += "deviation. The mixture estimators depend on it."
            inspection.add("warning", "motion", seen, advice)


def _slopes(problem: Any, state: FloatArray, action: FloatArray) -> FloatArray:
    """Return how a state after a move changes with the action, (state_size, action_size)."""

    def led(by: FloatArray) -> FloatArray:
        return checked.expected_move(problem, state, action + by, NoiseFreeStream(1000))

    slopes = np.empty((state.size, action.size))
    for at, step in enumerate(np.diag(1e-3 * np.maximum(1.0, np.abs(action)))):
        change = differences(led(step), led(-step), attributes.circular_states(problem))
        slopes[:, at] = change / (2.0 * step[at])
    return slopes


class _Watcher(LostValues):
    """Keeps what the checks need of a trial, and ends it when time is over."""

    def __init__(self, inspection: Inspection, late: Callable[[], bool], keep: bool = True) -> None:
        self.inspection, self.late, self.keep = inspection, late, keep
        self.steps: list[SensingStep] = []
        self.outside: list[BoolArray] = []

    def sensed(self, step: SensingStep) -> None:
        """Note the step, and in which coordinates the true state was beyond all particles."""
        if not self.keep:
            return
        assert self.world is not None
        self.steps.append(step)
        angles = attributes.circular_states(self.inspection.problem)
        apart = differences(step.before.belief.states, self.world.state, angles)
        self.outside.append(np.asarray((apart > 0.0).all(axis=0) | (apart < 0.0).all(axis=0)))

    def acted(self, step: TaskStep) -> None:
        """Keep the reward."""
        if self.late():
            raise CheckEndedError
        if step.reward is not None and self.keep:
            self.inspection.rewards.append(step.reward)


def check_trials(inspection: Inspection) -> None:
    """Run a few trials with random sensing, and keep beliefs from before sensing."""
    late = inspection.deadline(0.25, "trials")
    steps = min(inspection.max_steps, _MOST_STEPS)
    watchers = [_Watcher(inspection, late) for _ in range(_TRIALS)]
    results = []
    with contextlib.suppress(CheckEndedError):
        planner = _sensing_at_random(inspection)
        for trial, watcher in enumerate(watchers):
            results.append(_simulated(inspection, planner, trial, steps, watcher))
    if results:
        _report_endings(inspection, results, steps)
    reached = [result.success for result in results]
    if remark := remark_on_lost_values([each.lost for each in watchers[: len(results)]], reached):
        inspection.add("warning", "depletion", f"with random sensing, {remark}", f"{REMEDY}.")
    _report_depletion(inspection, [each for each in watchers if each.steps], remark)
    states = [step.before for watcher in watchers for step in watcher.steps]
    kept = [states[index] for index in spread_out(_BELIEFS, len(states))]
    for state in kept:
        (points, weights), chosen = state.belief, spread_out(_PARTICLES, len(state.belief.weights))
        thinned = Belief(points[chosen], weights[chosen] / weights[chosen].sum())
        inspection.beliefs.append(state._replace(belief=thinned))
    _check_rewards(inspection)


def _sensing_at_random(inspection: Inspection) -> Planner:
    selector = msgspec.structs.replace(
        inspection.settings.selector, method="random", sensing_is_optional=False
    )
    settings = msgspec.structs.replace(inspection.settings, selector=selector)
    return Planner(inspection.problem, settings)


def _simulated(
    inspection: Inspection, planner: Planner, trial: int, steps: int, observer: TrialObserver
) -> TrialResult:
    def run() -> TrialResult:
        return run_trial(planner, inspection.seed, trial, max_steps=steps, observer=observer)

    return inspection.ask("a simulated trial", run, check="trials")


def check_method(inspection: Inspection) -> None:
    """Compare the method with random sensing in trials of the same worlds."""
    problem, settings = inspection.problem, inspection.settings
    method = settings.selector.method
    wrong = any(each.severity == "error" for each in inspection.findings)
    if method == "random" or wrong or not inspection.trials:
        return
    late = inspection.deadline(0.6)
    planners = [Planner(problem, settings), _sensing_at_random(inspection)]
    priced, limit = getattr(problem, "sensing_costs", None) is not None, inspection.max_steps
    more: list[float] = []
    with contextlib.suppress(CheckEndedError):
        for trial in range(_TRIALS, _TRIALS + inspection.trials):
            clock = _Watcher(inspection, late, keep=False)
            pair = [_simulated(inspection, each, trial, limit, clock) for each in planners]
            own, other = (
                -(each.reward or 0.0) if priced else each.steps if each.success else limit
                for each in pair
            )
            more.append(float(own - other))
    count = len(more)
    if count < min(_FEWEST_PAIRS, inspection.trials):
        inspection.add_over("method")
        return
    difference, (low, high) = mean_difference(np.array(more))
    words, shown = "takes {} steps (a failure: the limit)", (difference, low, high)
    if priced:
        words, shown = "earns {} of reward", (-difference, -high, -low)
    effect = words.format("{:+.3g} [{:+.3g}, {:+.3g}]".format(*shown))
    seen = f"{method} {effect} beside random sensing in {count} paired trials: "
    if low > 0.0:
        advice = "Run holdfast tune, which finds what suits this problem. Of methods that are as "
        advice += "good as random sensing, one in thirty is called worse by chance."
        inspection.add("warning", "method", seen + "here it is worse", advice)
    elif high < 0.0:
        inspection.add("information", "method", seen + "here it is better")
    else:
        seen += f"{count} trials cannot tell which is better"
        advice = "More can: --trials and --budget, or holdfast tune."
        inspection.add("information", "method", seen, advice)


def _report_endings(inspection: Inspection, results: list[TrialResult], steps: int) -> None:
    reached = [result.steps for result in results if result.success]
    failed = sum(result.failed for result in results)
    seen = f"with random sensing, {len(reached)} of {len(results)} trials reach the goal"
    seen += f", after {np.median(reached):.0f} steps (median)" if reached else ""
    seen += f", and {failed} fail" if failed else ""
    walk = inspection.walk
    if reached or walk is None or (walk.reached >= 0).mean() < 0.5:
        inspection.add("information", "trials", seen)
        return
    seen += f", within {steps} steps; with the state known most do"
    advice = "The estimate (the mean) may lie where the robot is not, or random sensing is poor: "
    advice += "try particle_filter.estimate: heaviest_mode, or shorter simulator.sensing_intervals."
    inspection.add("warning", "trials", seen, advice)


def _report_depletion(inspection: Inspection, trials: list[_Watcher], lost: str) -> None:
    """Report what observations leave of the particles, and how often the truth is beyond them."""
    if not trials:
        return
    left = [(step.sensing_action, step.observation_info) for own in trials for step in own.steps]
    particles = inspection.settings.particle_filter.num_particles
    few = []
    for action in range(len(attributes.sensing_labels(inspection.problem))):
        sizes = np.array([info.effective_sample_size for own, info in left if own == action])
        if len(sizes) >= 5 and (share := (sizes < FEW_LEFT).mean()) > _OFTEN:
            few.append(f"{inspection.label(action)} in {share:.0%} of {len(sizes)} observations")
    if few:
        seen = f"sensors are too sharp for {particles} particles: often fewer than {FEW_LEFT:.0f} "
        seen += f"count afterwards (effective sample size), with {', '.join(few)}"
        inspection.add("warning", "depletion", seen, f"{ADVICE[0].upper()}{ADVICE[1:]}.")
    # Each trial counts the same.
    outside = [np.array(trial.outside) for trial in trials]
    shares = np.mean([each.mean(axis=0) for each in outside], axis=0)
    whole = float(np.mean([each.any(axis=1).mean() for each in outside]))
    # Beyond all of n particles of a right belief it is twice in n + 1.
    if whole > _OFTEN + 2.0 * shares.size / (particles + 1):
        at = int(shares.argmax())
        seen = f"in {whole:.0%} of the beliefs before sensing, over {len(trials)} trials with "
        seen += f"random sensing, the true state lies beyond all {particles} particles in some "
        seen += f"coordinate, most often in {inspection.coordinate(at)} ({shares[at]:.0%})"
        advice = f"An observation leaves few for other coordinates: {ADVICE}."
        if not lost and not attributes.static_parameters(inspection.problem):
            advice += " Name continuous values that never change in static_parameters."
        inspection.add("warning", "depletion", seen, advice)


def check_decision_time(inspection: Inspection) -> None:
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

    some = spread_out(_DECISIONS, len(inspection.beliefs))
    for state in [initial, *(inspection.beliefs[index] for index in some)]:
        if not (taken and late()):
            inspection.ask("a decision", decide, state, check="time")
    codes = {
        getattr(getattr(problem, each, None), "__code__", None): each
        for each in attributes.PARAMETERS
    }
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
