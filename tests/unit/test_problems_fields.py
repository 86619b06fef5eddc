"""The bounds of the problems' settings, declared in holdfast.problems.rigid_body."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import yaml

from holdfast.config import registry
from holdfast.errors import InvalidValueError
from holdfast.problems.peg_in_hole_2d import PegInHole2D, PegInHole2DModel

EARLIER_WORK = yaml.safe_load((Path(__file__).parent / "data" / "earlier_work.yaml").read_text())


@pytest.mark.parametrize("name", EARLIER_WORK)
def test_the_earlier_works_settings_are_the_defaults(name: str) -> None:
    kind: Any = registry.problem_class(name)
    loaded, default = kind.from_settings(*EARLIER_WORK[name].values()), kind()
    for section in ("model", "state_space_planner"):
        given = msgspec.to_builtins(getattr(loaded, section))
        expected = msgspec.to_builtins(getattr(default, section))
        assert {key: value for key, value in given.items() if not key.startswith("num_")} == {
            key: value for key, value in expected.items() if not key.startswith("num_")
        }
    np.testing.assert_array_equal(loaded.world.obstacles, default.world.obstacles)


@pytest.mark.parametrize(
    ("model", "path"),
    [
        ({"peg_width": 0.0}, r"\$\.peg_width"),
        ({"motion_cov": [0.01, -0.01, 0.01]}, r"\$\.motion_cov\[1\]"),
        ({"init_cov": [1.0, 1.0]}, r"\$\.init_cov"),
        ({"init_mean": [0.0, float("nan"), 0.0]}, r"\$\.init_mean\[1\]"),
        ({"sensing_cov": 0.0}, r"\$\.sensing_cov"),
        ({"sensing_cov": float("inf")}, r"\$\.sensing_cov"),
        ({"collision_tol": 1.0}, r"\$\.collision_tol"),
        ({"collision_tol": 1e-13}, r">= 1e-12 .*\$\.collision_tol"),
        ({"state_size": 4}, r"\$\.state_size"),
        ({"peg_with": 1.0}, "peg_with"),
    ],
)
def test_settings_out_of_bounds(model: dict[str, Any], path: str) -> None:
    with pytest.raises(msgspec.ValidationError, match=path):
        PegInHole2D.from_settings(model, {})


def test_the_constructor_checks_too() -> None:
    with pytest.raises(InvalidValueError, match=r"model.*\$\.peg_height"):
        PegInHole2D(PegInHole2DModel(peg_height=-2.0))
