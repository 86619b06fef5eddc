"""What a trial's beliefs tell: angles taken for numbers, several modes, and few particles left.

All make a robot slow or stop it, and none looks like an error. A heading of which half of the
particles say 3.1 and half -3.1 has a mean of 0; the mean of a belief with several modes is where
the robot is not; and of what does not move, resampling leaves copies of one particle, which are
certain and wrong.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.circular import unwrapped
from holdfast.numerics.floating_mode import in_own_mode
from holdfast.planning.modes import heaviest_mode
from holdfast.planning.settings import PlanningSettings
from holdfast.problems.attributes import circular_states, name_of, state_labels
from holdfast.reports.recorder import TrialRecord

_SHARE = 0.2
"""Share of the beliefs after an observation from which on a remark is made."""

_FEW = 0.03
"""Share of its first values that a depleted coordinate still has, at most."""


@in_own_mode
def belief_remarks(problem: Any, settings: PlanningSettings, record: TrialRecord) -> list[str]:
    """Return what a user should know of the beliefs after a trial's observations; mostly nothing.

    A coordinate counts as an angle that wraps if its label has the unit rad, and its particles
    span more than half a circle as numbers, but less than that on the circle. Several modes are
    reported where the trial failed: a sharp observation may leave particles in a few heaps, too,
    which does no harm. A coordinate that does not move is reported if hardly any of the values are
    left that its particles had at first, unless these were few, as those of a switch.
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
    for at, least, step in _depleted(record):
        label = problem.state_labels[at] if problem.state_labels else f"coordinate {at} of a state"
        remarks.append(
            f"{label} does not move, and by step {step} its particles had {least} different values "
            "left, of which the belief may be certain and wrong: if it is continuous, give "
            f"{name_of(problem)} static_parameters = ({at},), else take more particles "
            "(docs/problems.md, What does not move)"
        )
    failed = record.result is not None and not record.result.success
    if failed and not remarks and settings.particle_filter.estimate == "mean":
        several = sum(
            heaviest_mode(*step.after.belief, circular) is not step.after.belief.weights
            for step in record.sensing
        )
        if several > _SHARE * count:
            remarks.append(
                f"{several} of {count} beliefs had several modes, and the mean lies between them, "
                "where the robot is not: particle_filter.estimate: heaviest_mode takes one of them"
            )
    return remarks


def _depleted(record: TrialRecord) -> list[tuple[int, int, int]]:
    """Return the depleted coordinates, with the values left at the last observation, and its step.

    A coordinate does not move if all particles have the same values after each move as before it.
    """
    steps = record.sensing
    found = []
    befores = [step.before.belief.states for step in steps]
    afters = [step.after.belief.states for step in steps]
    for at in range(befores[0].shape[1] if len(steps) > 1 else 0):
        first, last = (len(set(states[:, at].tolist())) for states in (befores[0], befores[-1]))
        varied = 2 * first > len(befores[0])
        if varied and last <= max(1.0, _FEW * first):
            moves = zip(afters, befores[1:], strict=False)
            if all(np.array_equal(one[:, at], two[:, at]) for one, two in moves):
                found.append((at, last, steps[-1].before.step))
    return found


def _wraps(states: FloatArray, coordinate: int) -> bool:
    angles = states[:, [coordinate]]
    return bool(np.ptp(angles) > np.pi > np.ptp(unwrapped(angles, (0,))))
