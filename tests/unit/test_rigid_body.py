"""What the pegs have in common."""

from typing import Any

import numpy as np
import pytest

from holdfast.problems.multitier_peg_in_hole_2d import MultitierPegInHole2D
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.problems.peg_in_hole_3d import PegInHole3D

PEGS: list[tuple[type[Any], int]] = [(PegInHole2D, 2), (MultitierPegInHole2D, 2), (PegInHole3D, 3)]
"""With the number of coordinates of a translation; those after it are angles."""


@pytest.mark.parametrize(("peg", "positions"), PEGS)
@pytest.mark.parametrize("turned", [3.0, 3.2, -4.0, 6.3, -7.0])
def test_a_peg_is_turned_back_all_the_way(peg: type[Any], positions: int, turned: float) -> None:
    """Angles are not wrapped: after more than half a turn a peg goes back the way it came.

    A wrapped action would jump by a whole turn where the belief has particles on both sides of half
    a turn, and its entropy would be that of a choice that nobody has.
    """
    problem = peg()
    state = np.zeros(problem.state_size)
    if peg is MultitierPegInHole2D:
        state[0] = 4.0  # in the axis of the first hole, as the others' is at zero
    state[positions:] = turned
    commanded = problem.policy(state, 0)
    assert commanded[positions:].tolist() == [-turned] * (problem.state_size - positions)


@pytest.mark.parametrize(("peg", "positions"), PEGS)
def test_translations_and_rotations_have_limits_of_their_own(
    peg: type[Any], positions: int
) -> None:
    problem = peg.from_settings({}, {"translation_step_size": 0.3, "rotation_step_size": 0.02})
    angles = problem.action_size - positions
    limits = np.array([0.3] * positions + [0.02] * angles)
    np.testing.assert_array_equal(problem.limit_action(np.full(problem.action_size, 5.0)), limits)
    np.testing.assert_array_equal(problem.limit_action(np.full(problem.action_size, -5.0)), -limits)
    # What is within its own limit is left alone, also where the other one is smaller.
    np.testing.assert_array_equal(problem.limit_action(0.9 * limits), 0.9 * limits)
