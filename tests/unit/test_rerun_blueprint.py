"""Which coordinates are drawn in space: the problem's pose, else its drawing."""

from pathlib import Path

import pytest

from holdfast.config.loader import load
from holdfast.reports.rerun_blueprint import drawn_layout, is_flat

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.mark.parametrize(
    ("example", "indices", "flat"),
    [
        ("peg_in_hole_2d", (0, 1, None, None, None, 2), True),
        ("peg_in_hole_3d", (0, 1, 2, 5, 4, 3), False),
        ("light_dark_room", (0, 1, None, None, None, None), True),
    ],
)
def test_what_is_drawn(example: str, indices: tuple[int | None, ...], flat: bool) -> None:
    layout = drawn_layout(load(EXAMPLES / f"{example}.yaml").problem)
    assert layout is not None
    assert layout.indices == indices
    assert is_flat(layout) == flat


def test_a_problem_that_says_nothing() -> None:
    assert drawn_layout(load(EXAMPLES / "corridor_doors.yaml").problem) is None
    assert not is_flat(None)
