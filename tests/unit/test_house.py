"""The picture of the rooms in ARCHITECTURE.md is that of the imports."""

import runpy
from pathlib import Path

import pytest

DRAWING = Path(__file__).parents[2] / "docs" / "images" / "draw_house.py"


def test_it_is_current() -> None:
    pytest.importorskip("grimp")  # with import-linter
    drawn = runpy.run_path(str(DRAWING))
    again = "python docs/images/draw_house.py draws it again"
    assert drawn["PICTURE"].read_text() == drawn["house"](), again
