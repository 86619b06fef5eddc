"""A peg and the holes of several plates."""

import pytest

from holdfast.errors import InvalidValueError
from holdfast.problems.multitier_peg_in_hole_2d import (
    Hole,
    MultitierPegInHole2D,
    MultitierPegInHole2DModel,
)


class TestMultitierPegInHole2D:
    problem = MultitierPegInHole2D()

    def test_a_hole_outside_of_the_map_is_refused(self) -> None:
        model = MultitierPegInHole2DModel(holes=(Hole(center=(0, 0)), Hole(center=(11.8, 6))))
        with pytest.raises(InvalidValueError, match=r"model\.holes\[1\].*map_dim"):
            MultitierPegInHole2D(model)

    def test_an_empty_map_is_refused(self) -> None:
        model = MultitierPegInHole2DModel(map_dim=(12, -12, -12, 12))
        with pytest.raises(InvalidValueError, match=r"model\.map_dim"):
            MultitierPegInHole2D(model)
