"""A peg and a hole in space."""

import pytest

from holdfast.errors import InvalidValueError
from holdfast.problems.peg_in_hole_3d import PegInHole3D, PegInHole3DModel


class TestPegInHole3D:
    problem = PegInHole3D()

    def test_a_map_without_room_for_the_hole_is_refused(self) -> None:
        with pytest.raises(InvalidValueError, match=r"model\.map_dim"):
            PegInHole3D(PegInHole3DModel(map_dim=(0.5, 6.0, 6.0)))
