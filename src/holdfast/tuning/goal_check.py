"""Whether the task can be done at all: its policy is followed with the state known.

What sensing can gain is bounded by what the policy does in a state that is known. So first some
trials are simulated all at once without any belief: if they do not come to the goal, no sensing
will. They also show where the robot goes, for the checks that need states from along the way.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from holdfast.numerics.arrays import FloatArray, IntArray
from holdfast.numerics.randomness import NoiseFreeStream
from holdfast.problems import checked
from holdfast.problems.attributes import circular_actions, circular_states, has_own
from holdfast.problems.problem import ProblemBase
from holdfast.tuning.contract_check import truths
from holdfast.tuning.findings import CONTRACT, Inspection, Severity, Walk, spread_out

__all__ = ["check_motion", "check_rewards", "follow_policy"]

_TRIALS = 64
_KEPT = 24
"""Steps of which the states are kept."""

_LONGER = 4
"""Times max_steps for which trials are followed, to tell a limit that is too low from a goal that
is never reached."""

_STREAM, _NOISE = 8, 9

_FEW = 0.5
"""Share of the trials that should reach the goal."""

_TURN = 2.0 * np.pi
_NEARLY = 0.5
"""A coordinate that jumps by a whole turn, give or take this, is an angle (rad)."""


def follow_policy(inspection: Inspection, num_trials: int = _TRIALS) -> Walk:
    """Simulate trials in which the state is known, until all have ended or the steps are over."""
    problem, ask = inspection.problem, inspection.ask
    late = inspection.deadline(0.2)
    own = inspection.random(_STREAM)
    states = ask("initial_states", lambda: checked.initial_states(problem, own, num_trials))
    stages = np.zeros(num_trials, dtype=np.int64)
    reached, failed = np.full(num_trials, -1), np.full(num_trials, -1)
    kept: list[tuple[FloatArray, Any]] = []
    jumps = np.zeros((2, states.shape[1]), dtype=np.int64)
    turns = np.zeros((2, problem.action_size), dtype=np.int64)
    step = still = 0
    stride = 1
    limit = _LONGER * inspection.max_steps
    for step in range(limit + 1):
        done = ask("is_goal", lambda states=states: truths(problem, "is_goal", states))  # type: ignore[misc]
        lost = ask("is_failure", lambda states=states: truths(problem, "is_failure", states))  # type: ignore[misc]
        open_ones = (reached < 0) & (failed < 0)
        reached[open_ones & done] = step
        failed[open_ones & lost & ~done] = step
        if step % stride == 0:
            kept.append((states, stages))
        if len(kept) > 2 * _KEPT:  # so that a long trial takes no more memory
            kept, stride = kept[::2], 2 * stride
        if step == limit or not ((reached < 0) & (failed < 0)).any() or late():
            break
        stages = ask(
            "next_stage",
            lambda states=states, stages=stages: checked.next_stages(problem, states, stages),  # type: ignore[misc]
        )
        commanded = ask(
            "policy",
            lambda states=states, stages=stages: checked.policy(problem, states, stages),  # type: ignore[misc]
        )
        actions = ask(
            "execute",
            lambda commanded=commanded: checked.executed_action(problem, commanded),  # type: ignore[misc]
        )
        still += bool((actions == 0.0).all())
        noise = inspection.random(_NOISE, step)
        moved = ask(
            "move",
            lambda states=states, actions=actions, noise=noise: checked.move(  # type: ignore[misc]
                problem, states, actions, noise
            ),
        )
        jumps += _large_changes(moved - states)
        following = ask(
            "policy",
            lambda states=moved, stages=stages: checked.policy(problem, states, stages),  # type: ignore[misc]
        )
        turns += _large_changes(following - commanded)
        states = moved
    some = spread_out(_KEPT, len(kept))
    walk = Walk(
        np.stack([kept[index][0] for index in some]),
        np.stack([kept[index][1] for index in some]),
        reached,
        failed,
        step,
    )
    inspection.walk = walk
    _report_angles(inspection, jumps, turns)
    _report_walk(inspection, walk, still)
    return walk


def _large_changes(change: FloatArray) -> IntArray:
    """Count the large changes of each coordinate in a step, and those of about a whole turn."""
    size = np.abs(change)
    counts = [(size > 0.5 * np.pi).sum(axis=0), (np.abs(size - _TURN) < _NEARLY).sum(axis=0)]
    return np.array(counts)


def _are_turns(counts: IntArray) -> IntArray:
    """Return the coordinates whose large changes are whole turns, as if they were angles."""
    return np.flatnonzero((counts[1] >= 2) & (counts[1] == counts[0]))


def _report_angles(inspection: Inspection, jumps: IntArray, turns: IntArray) -> None:
    problem = inspection.problem
    declared = set(circular_states(problem))
    for at in _are_turns(jumps):
        if int(at) not in declared:
            inspection.add(
                "warning",
                "units",
                f"{inspection.coordinate(int(at))} jumps by a whole turn (2 pi) in one step, and "
                "is not declared to be an angle: the mean of 3.1 and -3.1 is taken for 0",
                f"Give the problem circular = ({int(at)},), and circular_observations for what "
                "shows it.",
                "docs/problems.md#your-own",
            )
    declared = set(circular_actions(problem))
    for at in _are_turns(turns):
        if int(at) not in declared:
            inspection.add(
                "warning",
                "units",
                f"coordinate {int(at)} of the task action jumps by a whole turn (2 pi) between two "
                "steps, and is not declared to be an angle",
                "Take numerics.wrapped(goal - heading) for a difference of angles in the policy, "
                f"or give the problem circular_actions = ({int(at)},).",
                "docs/problems.md#your-own",
            )


def _report_walk(inspection: Inspection, walk: Walk, still: int) -> None:
    count, steps = len(walk.reached), walk.steps
    reached, failed = walk.reached >= 0, walk.failed >= 0
    first = walk.reached == 0
    if first.all():
        inspection.add(
            "error",
            "goals",
            f"all of {count} initial states are goals: each trial ends before its first step",
            "Look at is_goal and initial_states.",
            CONTRACT,
        )
        return
    if first.any():
        inspection.add(
            "information",
            "goals",
            f"{first.sum()} of {count} initial states are goals already: such trials take 0 steps",
        )
    if steps and still == steps and not reached.all():
        inspection.add(
            "error",
            "goals",
            f"the policy never moves: its executed action is 0 in all of {count} trials of "
            f"{steps} steps, and {reached.sum()} of them reach the goal",
            "Look at policy and execute.",
            CONTRACT,
        )
        return
    times = ""
    if reached.any():
        times = f", after {np.median(walk.reached[reached]):.0f} steps (median)"
    seen = (
        f"with the state known, the policy comes to the goal in {reached.sum()} of {count} trials"
        f"{times}"
    )
    if failed.any():
        seen += f", and {failed.sum()} fail"
    open_ones = count - int(reached.sum()) - int(failed.sum())
    if open_ones:
        seen += f"; {open_ones} have not ended after {steps} steps"
    limit = inspection.max_steps
    in_time = (walk.reached >= 0) & (walk.reached <= limit)
    if (reached & ~in_time).any():
        seen += f"; within max_steps, {limit}, it is {in_time.sum()}"
    cut = bool(open_ones) and steps < limit
    if cut:
        seen += f" of {limit}, when the time for this check was over"
    advice = (
        "What is lost here no sensing can win. Look at is_goal and at the policy near the goal, or "
        "expect that much less."
    )
    if reached.mean() >= _FEW:
        needed = int(np.quantile(walk.reached[reached], 0.9))
        advice = f"Set simulator.max_steps to {2 * needed} or more."
    if cut or in_time.mean() >= _FEW:
        inspection.add("information", "goals", seen)
    else:
        severity: Severity = "warning" if in_time.any() else "error"
        inspection.add(severity, "goals", seen, advice, CONTRACT)
    num_stages = inspection.problem.num_stages
    greatest = int(walk.stages.max())
    if greatest + 1 < num_stages and not cut:
        inspection.add(
            "warning",
            "goals",
            f"num_stages is {num_stages}, but no trial comes beyond stage {greatest}",
            "Look at next_stage.",
            CONTRACT,
        )
    _note_rewards(inspection, walk)


def _note_rewards(inspection: Inspection, walk: Walk) -> None:
    problem = inspection.problem
    if not _has_reward(problem):
        return
    states = walk.states.reshape(-1, walk.states.shape[-1])
    stages = walk.stages.reshape(-1)

    def found() -> FloatArray:
        actions = checked.executed_action(problem, checked.policy(problem, states, stages))
        return checked.rewards(problem, states, actions)

    inspection.rewards.extend(inspection.ask("reward", found).tolist())


def _has_reward(problem: Any) -> bool:
    return getattr(type(problem), "reward", None) not in (None, ProblemBase.reward)


def check_rewards(inspection: Inspection) -> None:
    """Look at the rewards of all simulated steps: whether they tell anything."""
    rewards, selector = np.array(inspection.rewards), inspection.settings.selector
    if not rewards.size or np.ptp(rewards) > 0.0 or rewards[0] < 0.0:
        return
    value = float(rewards[0])
    asked = selector.method == "expected_return" and selector.rollout_reward == "problem"
    seen = f"the reward is {value:g} in all of {len(rewards)} simulated steps: "
    seen += (
        "a trial that never reaches the goal has the greatest return"
        if value > 0.0
        else "expected_return has nothing to tell sensing actions by"
    )
    inspection.add(
        "error" if asked else "warning" if value > 0.0 else "information",
        "goals",
        seen,
        "With selector.rollout_reward: steps the return counts steps instead. Or leave reward out, "
        "which does the same.",
        "docs/problems.md#when-to-sense",
    )


def check_motion(inspection: Inspection) -> None:
    """Compare the noise of ``move`` with what the problem says of it."""
    problem, ask, walk = inspection.problem, inspection.ask, inspection.walk
    if walk is None:
        return
    draws = 100
    rows = walk.states.reshape(-1, walk.states.shape[-1])
    stages = walk.stages.reshape(-1)
    declared = np.asarray(problem.motion_variance, dtype=np.float64)
    circular = circular_states(problem)
    ratios, offsets = [], []
    for number, at in enumerate(spread_out(12, len(rows))):
        state = np.repeat(rows[at : at + 1], draws, axis=0)
        action = ask(
            "execute",
            lambda at=at: checked.executed_action(  # type: ignore[misc]
                problem, checked.policy(problem, rows[at], int(stages[at]))
            ),
        )
        own = inspection.random(_NOISE + 1, number)
        moved = ask("move", lambda: checked.move(problem, state, action, own))  # noqa: B023
        expected, slopes = ask("move", lambda: _expected(problem, rows[at], action))  # noqa: B023
        change = _shorter(moved - expected, circular)
        spread = change.std(axis=0)
        predicted = (slopes**2 * declared).sum(axis=1)
        moves = (predicted > 0.0) & (spread > 0.0)
        ratios.append(np.where(moves, spread**2 / np.where(moves, predicted, 1.0), np.nan))
        with np.errstate(divide="ignore", invalid="ignore"):
            offsets.append(np.where(spread > 0.0, np.abs(change.mean(axis=0)) / spread, np.nan))
    for at in range(rows.shape[1]):
        ratio, offset = _median(ratios, at), _median(offsets, at)
        if ratio is not None and not 1.0 / 9.0 <= ratio <= 9.0:
            inspection.add(
                "warning",
                "motion",
                f"motion_variance says that a step blurs {inspection.coordinate(at)} with a "
                f"variance {'below' if ratio > 1.0 else 'above'} what move does: move's is "
                f"{ratio:.2g} times as large (median of {len(ratios)} states)",
                "motion_variance is the variance of the noise of one step, not its standard "
                "deviation. The mixture estimators and the advice about resolution depend on it.",
                CONTRACT,
            )
        if offset is not None and offset > 1.5:
            function = "expected_move" if has_own(problem, "expected_move", ("move",)) else "move"
            inspection.add(
                "warning",
                "motion",
                f"{function} without noise leads {inspection.coordinate(at)} to a place that is "
                f"{offset:.1f} standard deviations from the mean of {draws} moves with noise",
                "path_entropy, the default, follows the policy without noise. Give the problem an "
                "expected_move that leads to the mean.",
                CONTRACT,
            )


def _median(rows: list[FloatArray], at: int) -> float | None:
    values = np.array([row[at] for row in rows])
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) >= len(rows) / 2 else None


def _shorter(change: FloatArray, circular: Any) -> FloatArray:
    for at in circular:
        change[..., at] = (change[..., at] + np.pi) % _TURN - np.pi
    return change


def _expected(problem: Any, state: FloatArray, action: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return where an action leads without noise, and its slopes, (state_size, action_size)."""

    def led(action: FloatArray) -> FloatArray:
        return checked.expected_move(problem, state, action, NoiseFreeStream(1000))

    middle = led(action)
    slopes = np.empty((state.size, action.size))
    circular = circular_states(problem)
    for at in range(action.size):
        step = np.zeros(action.size)
        step[at] = 1e-3 * max(1.0, float(np.abs(action[at])))
        change = _shorter(led(action + step) - led(action - step), circular)
        slopes[:, at] = change / (2.0 * step[at])
    return middle, slopes
