"""How a message shows an array."""

from __future__ import annotations

import numpy as np
import pytest

from holdfast.arrays import in_brief


@pytest.mark.parametrize(
    ("values", "text"),
    [
        (np.array([1.0, 2.5]), "[1.  2.5]"),
        (np.arange(100), "[ 0  1  2  3 ... 96 97 98 99]"),
        ([[1, 2], [3, 4]], "[[1 2]\n [3 4]]"),
        ([[1, 2], [3]], "[[1, 2], [3]]"),
        (3.0, "3."),
        ("abc", "'abc'"),
    ],
)
def test_in_brief(values: object, text: str) -> None:
    assert in_brief(values) == text


def test_a_ragged_list_is_cut() -> None:
    assert len(in_brief([[0], list(range(1000))])) == 80
