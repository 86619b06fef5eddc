"""Shapes for RViz and Foxglove: the scene, and the chosen sensing action."""

import numpy as np
import pytest

from holdfast.planning.belief import Belief
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.reports.markers import sensing_markers
from holdfast.reports.poses import PoseLayout, pose_layout


@pytest.fixture
def layout() -> PoseLayout:
    found = pose_layout(PegInHole2D())
    assert found is not None
    return found


@pytest.mark.parametrize(("action", "kind"), [(0, "ARROW"), (1, "ARROW"), (2, "LINE_STRIP")])
def test_a_sensed_coordinate_is_an_arrow_along_it_or_an_arc_about_it(
    layout: PoseLayout, action: int, kind: str
) -> None:
    problem = PegInHole2D()
    belief = Belief(np.array([[1.0, 2.0, 0.1], [3.0, 2.0, 0.1]]), np.array([0.5, 0.5]))
    shape, label = sensing_markers(problem, layout, "task", belief, action)
    assert shape.kind == kind
    assert label.text == f"sense {problem.sensing_actions[action]}"
    if kind == "ARROW":
        first, last = np.array(shape.points)
        assert np.allclose(0.5 * (first + last), [2.0, 2.0, 0.0])
        assert np.flatnonzero(last - first).tolist() == [action]
