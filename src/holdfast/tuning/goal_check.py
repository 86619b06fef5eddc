"""Whether the task can be done at all: its policy is followed with the state known.

What sensing can gain is bounded by what the policy does in a state that is known. So first some
trials are simulated all at once without any belief: if they do not come to the goal, no sensing
will. They also show where the robot goes, for the checks that need states from along the way.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from holdfast.numerics.arrays import FloatArray, IntArray
from holdfast.numerics.circular import differences
from holdfast.numerics.randomness import NoiseFreeStream
from holdfast.problems import checked
from holdfast.problems.attributes import circular_actions, circular_states
from holdfast.problems.problem import ProblemBase
from holdfast.tuning.contract_check import acted, truths
from holdfast.tuning.findings import Inspection, Severity, Walk, spread_out

__all__ = ["check_motion", "check_rewards", "follow_policy"]

_TRIALS = 64
_KEPT = 24
"""Steps of which the states are kept."""

_LONGER = 4
"""Times max_steps for which trials are followed, to tell a limit that is too low from a goal that
is never reached."""

_INITIAL, _WAY, _NOISE = 8, 9, 10
"""Trial numbers of the streams here."""

_ENOUGH = 0.5
"""Share of the trials that should reach the goal."""

_DRAWS, _STATES = 100, 12
"""Moves from each of some states, whose noise is compared."""


def follow_policy(inspection: Inspection) -> Walk:
    """Simulate trials in which the state is known, until all have ended or the steps are over."""
    problem, ask = inspection.problem, inspection.ask
    late = inspection.deadline(0.2, "goals")
    own = inspection.random(_INITIAL)
    states = ask("initial_states", checked.initial_states, problem, own, _TRIALS)
    stages = np.zeros(_TRIALS, dtype=np.int64)
    reached, failed = np.full((2, _TRIALS), -1)
    kept: list[tuple[FloatArray, IntArray]] = []
    jumps = np.zeros((2, states.shape[1]), dtype=np.int64)
    turns = np.zeros((2, problem.action_size), dtype=np.int64)
    step = still = 0
    stride = 1
    while True:
        done = ask("is_goal", truths, problem, "is_goal", states)
        lost = ask("is_failure", truths, problem, "is_failure", states)
        running = (reached < 0) & (failed < 0)
        reached[running & done] = step
        failed[running & lost & ~done] = step
        if step % stride == 0:
            kept.append((states, stages))
        if len(kept) > 2 * _KEPT:  # so that a long trial takes no more memory
            kept, stride = kept[::2], 2 * stride
        if step == _LONGER * inspection.max_steps or not (running & ~done & ~lost).any() or late():
            break
        stages = ask("next_stage", checked.next_stages, problem, states, stages)
        commanded = ask("policy", checked.policy, problem, states, stages)
        actions = ask("execute", checked.executed_action, problem, commanded)
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
        (jumps, "circular", circular_states(problem), "a state"),
        (turns, "circular_actions", circular_actions(problem), "the task action"),
    ):
        for at in np.flatnonzero((counts[1] >= 2) & (counts[1] == counts[0])).tolist():
            if at in declared:
                continue
            seen = f"coordinate {at} of {whose} jumps by a whole turn (2 pi) in one step, and is "
            seen += "not declared to be an angle: the mean of 3.1 and -3.1 is taken for 0"
            advice = f"Give the problem {attribute} = ({at},), and circular_observations for what "
            advice += "shows it; in a policy take numerics.wrapped(goal - heading)."
            inspection.add("warning", "units", seen, advice)


def _report_walk(
    inspection: Inspection, walk: Walk, failed: IntArray, steps: int, *, never_moves: bool
) -> None:
    limit, num_stages = inspection.max_steps, inspection.problem.num_stages
    reached, in_time = walk.reached >= 0, (walk.reached >= 0) & (walk.reached <= limit)
    if (walk.reached == 0).all():
        seen = f"all of {_TRIALS} initial states are goals: each trial ends before its first step"
        inspection.add("error", "goals", seen, "Look at is_goal and initial_states.")
        return
    if never_moves and not reached.all():
        seen = f"the policy never moves: its executed action is 0 in all of {_TRIALS} trials of "
        seen += f"{steps} steps, and {reached.sum()} of them reach the goal"
        inspection.add("error", "goals", seen, "Look at policy and execute.")
        return
    seen = f"with the state known, the policy comes to the goal in {reached.sum()} of {_TRIALS} "
    seen += "trials"
    if reached.any():
        seen += f", after {np.median(walk.reached[reached]):.0f} steps (median)"
    if lost := int((failed >= 0).sum()):
        seen += f", and {lost} fail"
    if running := _TRIALS - int(reached.sum()) - lost:
        seen += f"; {running} have not ended after {steps} steps"
    if (reached & ~in_time).any():
        seen += f"; within max_steps, {limit}, it is {in_time.sum()}"
    cut = running > 0 and steps < limit
    advice = (
        "What is lost here no sensing can win. Look at is_goal and at the policy near the goal."
    )
    if reached.mean() >= _ENOUGH:
        needed = int(np.quantile(walk.reached[reached], 0.9))
        advice = f"Set simulator.max_steps to {2 * needed} or more."
    if cut or in_time.mean() >= _ENOUGH:
        inspection.add("information", "goals", seen)
    else:
        inspection.add("warning" if in_time.any() else "error", "goals", seen, advice)
    if (greatest := int(walk.stages.max())) + 1 < num_stages and not cut:
        seen = f"num_stages is {num_stages}, but no trial comes beyond stage {greatest}"
        inspection.add("warning", "goals", seen, "Look at next_stage.")


def check_rewards(inspection: Inspection) -> None:
    """Look at the rewards of all simulated steps: whether they tell anything."""
    rewards, selector = np.array(inspection.rewards), inspection.settings.selector
    if not rewards.size or np.ptp(rewards) > 0.0 or rewards[0] < 0.0:
        return
    seen = f"the reward is {rewards[0]:g} in all of {len(rewards)} simulated steps: "
    severity: Severity = "information"
    if rewards[0] > 0.0:
        severity, why = "warning", "a trial that never reaches the goal has the greatest return"
    else:
        why = "expected_return has nothing to tell sensing actions by"
    if selector.method == "expected_return" and selector.rollout_reward == "problem":
        severity = "error"
    advice = "With selector.rollout_reward: steps the return counts steps instead; so it does "
    advice += "without a reward."
    inspection.add(severity, "goals", seen + why, advice)


def check_motion(inspection: Inspection) -> None:
    """Compare the noise of ``move`` with what the problem says of it."""
    problem, ask, walk = inspection.problem, inspection.ask, inspection.walk
    if walk is None:
        return
    declared = np.asarray(problem.motion_variance, dtype=np.float64)
    circular = circular_states(problem)
    ratios, offsets = [], []
    for number, at in enumerate(spread_out(_STATES, len(walk.states))):
        state, own = walk.states[at], inspection.random(_NOISE, number)
        action = ask("execute", acted, problem, state, int(walk.stages[at]))
        many = np.tile(state, (_DRAWS, 1))
        moved = ask("move", checked.move, problem, many, action, own)
        expected, slopes = ask("move", _expected, problem, state, action)
        change = differences(moved, expected, circular)
        spread, predicted = change.std(axis=0), (slopes**2 * declared).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios.append(np.where(predicted > 0.0, spread**2 / predicted, np.nan))
            offsets.append(np.abs(change.mean(axis=0)) / spread)
    for at in range(walk.states.shape[1]):
        ratio, offset = _typical(ratios, at, 1.0), _typical(offsets, at, 0.0)
        name = inspection.coordinate(at)
        if not 1.0 / 9.0 <= ratio <= 9.0:
            seen = f"motion_variance says that a step blurs {name} with a variance "
            seen += f"{'below' if ratio > 1.0 else 'above'} what move does: move's is {ratio:.2g} "
            seen += f"times as large (median of {len(ratios)} states)"
            advice = "motion_variance is the variance of the noise of one step, not its standard "
            advice += "deviation. The mixture estimators depend on it."
            inspection.add("warning", "motion", seen, advice)
        if offset > 1.5:
            seen = f"without noise a move leads {name} to a place that is {offset:.1f} standard "
            seen += f"deviations from the mean of {_DRAWS} moves with noise"
            advice = "path_entropy, the default, follows the policy without noise. Give the "
            advice += "problem an expected_move that leads to the mean."
            inspection.add("warning", "motion", seen, advice)


def _typical(rows: list[FloatArray], at: int, otherwise: float) -> float:
    """Return the median of a coordinate's numbers, if at least half of them are known."""
    values = np.array([row[at] for row in rows])
    known = values[np.isfinite(values)]
    return float(np.median(known)) if 2 * len(known) >= len(values) else otherwise


def _expected(problem: Any, state: FloatArray, action: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return where an action leads without noise, and its slopes, (state_size, action_size)."""

    def led(by: FloatArray) -> FloatArray:
        return checked.expected_move(problem, state, action + by, NoiseFreeStream(1000))

    slopes = np.empty((state.size, action.size))
    for at, step in enumerate(np.diag(1e-3 * np.maximum(1.0, np.abs(action)))):
        change = differences(led(step), led(-step), circular_states(problem))
        slopes[:, at] = change / (2.0 * step[at])
    return led(np.zeros(action.size)), slopes
