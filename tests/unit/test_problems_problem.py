"""The defaults of a problem."""

from __future__ import annotations

import numpy as np
import pytest

from holdfast.errors import ProblemError
from holdfast.problems.problem import ProblemBase


class Minimal(ProblemBase):
    def __init__(self, size: float = 1.0) -> None:
        self.size = size


class TestProblemBase:
    def test_settings_become_keyword_arguments(self) -> None:
        assert Minimal.from_settings({"size": 3.0}, {}).size == 3.0
        assert Minimal.from_settings({}, {"size": 4.0}).size == 4.0

    def test_unknown_and_double_keys(self) -> None:
        with pytest.raises(ProblemError, match="colour"):
            Minimal.from_settings({"colour": 1}, {})
        with pytest.raises(ProblemError, match="size: given in both"):
            Minimal.from_settings({"size": 1.0}, {"size": 2.0})

    def test_defaults(self) -> None:
        problem = Minimal()
        assert problem.next_stage(np.zeros(3), 0) == 0
        assert problem.reward(np.zeros((4, 3)), np.zeros((4, 2))).shape == (4,)
        assert problem.scene() is None
        actions = np.ones(2)
        np.testing.assert_array_equal(problem.execute(actions), actions)
