"""What a trial's beliefs tell: angles taken for numbers, several modes, and few particles left.

All make a robot slow or stop it, and none looks like an error. A heading of which half of the
particles say 3.1 and half -3.1 has a mean of 0; the mean of a belief with several modes is where
the robot is not; and of what does not move, resampling leaves copies of one particle, which are
certain and often wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.circular import unwrapped
from holdfast.numerics.floating_mode import in_own_mode
from holdfast.planning.belief import Belief
from holdfast.planning.modes import heaviest_mode
from holdfast.planning.settings import PlanningSettings
from holdfast.problems import attributes
from holdfast.problems.attributes import circular_states, coordinate_name, name_of, state_labels
from holdfast.reports.recorder import TrialRecord
from holdfast.robot.lost_values import ADVICE, FEW_LEFT, REMEDY
from holdfast.robot.trial import SensingStep

_SHARE = 0.2
"""Share of the beliefs after an observation from which on a remark is made."""

_FEW = 0.03
"""Share of its first values that a depleted coordinate still has, at most."""


@in_own_mode
def belief_remarks(
    problem: Any, settings: PlanningSettings, record: TrialRecord, *, lost_are_told: bool = False
) -> list[str]:
    """Return what a user should know of the beliefs after a trial's observations; mostly nothing.

    A coordinate counts as an angle that wraps if its label has the unit rad, and its particles
    span more than half a circle as numbers, but less than that on the circle. Several modes are
    reported where the trial failed: a sharp observation may leave particles in a few heaps, too,
    which does no harm; coordinates of zeros and ones do not count, whose mean is a probability. A
    coordinate that does not move is reported if hardly any of the values are left that its
    particles had at first. If these were few, as those of a switch, certainty may be right: what is
    reported is the loss of the true value, unless ``lost_are_told``; and where that is not known, a
    single value that is left by an observation that left few effective particles.
    """
    count = len(record.sensing)
    remarks: list[str] = []
    circular = circular_states(problem)
    for coordinate, label in enumerate(state_labels(problem)):
        if coordinate in circular or "rad" not in label:
            continue
        wraps = sum(_wraps(step.after.belief.states, coordinate) for step in record.sensing)
        if wraps > _SHARE * count:
            remarks.append(
                f"{label} lay on both sides of a whole turn in {wraps} of {count} beliefs, and was "
                f"averaged as a number: give {name_of(problem)} circular = ({coordinate},), so "
                "that pi is -pi"
            )
    if record.lost_values and not lost_are_told:
        names = ", ".join(record.lost_values)
        remarks.append(f"no particle had the true value of {names} at the end. {REMEDY}")
    for at, least, settled in _depleted(record):
        advice = f"if it is continuous, give {name_of(problem)} static_parameters = ({at},), "
        advice += "else take more particles"
        if at in attributes.static_parameters(problem):
            sensor = attributes.sensing_labels(problem)[settled.sensing_action]
            advice = f"an observation of {sensor} left about one particle at step "
            advice += f"{settled.before.step}, and static_parameters cannot spread one: {ADVICE}"
        remarks.append(
            f"{coordinate_name(problem, at)} does not move, and by step "
            f"{record.sensing[-1].before.step} its particles had {least} different "
            f"value{'s' * (least != 1)} left, of which the belief may be certain and wrong: "
            f"{advice} (docs/problems.md, Parameters that never change)"
        )
    failed = record.result is not None and not (record.result.success or record.lost_values)
    if failed and not remarks and settings.particle_filter.estimate == "mean":
        several = sum(_has_modes(step.after.belief, circular) for step in record.sensing)
        if several > _SHARE * count:
            remarks.append(
                f"{several} of {count} beliefs had several modes, and the mean lies between them, "
                "where the robot is not: particle_filter.estimate: heaviest_mode takes one of them"
            )
    return remarks


def _has_modes(belief: Belief, circular: Sequence[int]) -> bool:
    """Return whether a belief has several modes, but for coordinates of zeros and ones."""
    states, weights = belief
    kept = np.flatnonzero(~np.isin(states, (0.0, 1.0)).all(axis=0)).tolist()
    own = np.ascontiguousarray(states[:, kept])
    angles = [kept.index(at) for at in circular if at in kept]
    return bool(kept) and heaviest_mode(own, weights, angles) is not weights


def _depleted(record: TrialRecord) -> list[tuple[int, int, SensingStep]]:
    """Return the depleted coordinates, how many values are left, and the step that left so few.

    A coordinate does not move if all particles have the same values after each move as before it.
    """
    steps = record.sensing
    found = []
    befores = [step.before.belief.states for step in steps]
    afters = [step.after.belief.states for step in steps]
    for at in range(befores[0].shape[1] if len(steps) > 1 else 0):
        first, last = (len(set(states[:, at].tolist())) for states in (befores[0], befores[-1]))
        moves = zip(afters, befores[1:], strict=False)
        if last > max(1.0, _FEW * first) or not all(
            np.array_equal(one[:, at], two[:, at]) for one, two in moves
        ):
            continue
        values = (len(set(states[:, at].tolist())) for states in afters)
        settled = next(step for step, left in zip(steps, values, strict=True) if left <= last)
        by_chance = settled.observation_info.effective_sample_size < FEW_LEFT
        varied, hidden = 2 * first > len(befores[0]), not record.true_states
        if varied or (hidden and first > 1 and by_chance):
            found.append((at, last, settled))
    return found


def _wraps(states: FloatArray, coordinate: int) -> bool:
    angles = states[:, [coordinate]]
    return bool(np.ptp(angles) > np.pi > np.ptp(unwrapped(angles, (0,))))
