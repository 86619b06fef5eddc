"""Problems from plain data; ``test_config_loader.py`` has those of files, with their lines."""

from typing import Any

import numpy as np
import pytest

from holdfast.config.problem_builder import build_problem, schemas_of
from holdfast.errors import ConfigurationError
from holdfast.problems.peg_in_hole_2d import PegInHole2D


def test_a_built_in_problem() -> None:
    problem = build_problem("peg_in_hole_2d", PegInHole2D, {"init_mean": [0.5, 0.0, 0.0]}, {})
    assert isinstance(problem, PegInHole2D)
    np.testing.assert_array_equal(problem.model.init_mean, [0.5, 0.0, 0.0])
    assert set(schemas_of(PegInHole2D)) == {"model", "state_space_planner"}


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ({"init_mean": [0.5]}, r"model\.init_mean is \[0\.5\] \(a list of 1\); expected"),
        ({"init_maen": 1}, r"model\.init_maen is not a known key; did you mean init_mean\?"),
        ({"launch": 1}, "launch is a key of recovery, not of model"),
    ],
)
def test_data_that_does_not_fit(model: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        build_problem("peg_in_hole_2d", PegInHole2D, model, {})


def test_a_class_that_is_no_problem() -> None:
    class Empty:
        pass

    with pytest.raises(ConfigurationError, match="empty is no problem: it lacks name, "):
        build_problem("empty", Empty, {}, {})
