"""Settings that are made in Python."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from holdfast.errors import InvalidValueError, ProblemError
from holdfast.planning.planner import Planner
from holdfast.planning.settings import (
    ActiveSensingSettings,
    PlanningSettings,
    SelectorSettings,
    check_settings,
    estimator_of,
    path_steps,
)
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.robot.environment import SimulatedEnvironment


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (PlanningSettings(selector=SelectorSettings(method="entropy")), r"selector\.method"),  # type: ignore[arg-type]
        (PlanningSettings(selector=SelectorSettings(estimator="knn")), r"selector\.estimator"),  # type: ignore[arg-type]
        (PlanningSettings(active_sensing=ActiveSensingSettings(horizon=0)), "horizon"),
        (PlanningSettings(active_sensing=ActiveSensingSettings(discount=5.0)), "discount"),
        (PlanningSettings(sensing_interval=-1), "sensing_interval"),
        (
            PlanningSettings(
                active_sensing=ActiveSensingSettings(num_observation_samples=41),
                selector=SelectorSettings(method="expected_return"),
            ),
            r"max_observation_samples is 40; .*num_observation_samples, which is 41",
        ),
        (PlanningSettings(selector=SelectorSettings(sensing_action=-1)), "sensing_action"),
        (
            PlanningSettings(selector={"metod": "random"}),  # type: ignore[arg-type]
            r"selector\.metod is not a known key; did you mean method\?; allowed: method, ",
        ),
        (
            PlanningSettings(active_sensing=ActiveSensingSettings(horizon=np.int64(0))),  # type: ignore[arg-type]
            r"active_sensing\.horizon is 0; expected a whole number >= 1",
        ),
        (
            SelectorSettings(method="random"),
            r"settings is of type SelectorSettings; it must be a PlanningSettings, as in "
            r"PlanningSettings\(selector=SelectorSettings\(\.\.\.\)\)",
        ),
        ({"selector": {}}, "settings is of type dict; it must be a PlanningSettings$"),
        (300, "settings is of type int; it must be a PlanningSettings$"),
        (PlanningSettings, "settings is the class PlanningSettings; it must be a Planning"),
        (
            SimpleNamespace(planning=PlanningSettings()),
            "must be a PlanningSettings, as its attribute planning is",
        ),
    ],
)
def test_settings_made_in_python_are_checked(settings: Any, message: str) -> None:
    with pytest.raises(InvalidValueError, match=message):
        check_settings(settings, PlanningSettings)
    with pytest.raises(InvalidValueError, match=message):
        Planner(PegInHole2D(), settings)


def test_a_method_may_be_a_text_of_numpys() -> None:
    planner = Planner(PegInHole2D(), method=np.str_("random"))  # type: ignore[arg-type]
    assert type(planner.settings.selector.method) is str


@pytest.mark.parametrize("use", [Planner, lambda problem: SimulatedEnvironment(problem, 0)])
def test_a_class_is_no_problem(use: Callable[[Any], object]) -> None:
    message = r"PegInHole2D is a class; make one: PegInHole2D\(\)"
    with pytest.raises(ProblemError, match=message):
        use(PegInHole2D)


@pytest.mark.parametrize(
    ("selector", "particles", "estimator"),
    [
        ({}, 500, "prior_neighbors"),
        ({}, 501, "nearest_neighbor"),
        ({"method": "action_entropy"}, 500, "nearest_neighbor"),
        ({"estimator": "gaussian_mixture_lower"}, 500, "gaussian_mixture_lower"),
    ],
)
def test_the_estimator_that_is_left_open(
    selector: dict[str, Any], particles: int, estimator: str
) -> None:
    assert estimator_of(SelectorSettings(**selector), particles) == estimator


def test_offsets_in_steps() -> None:
    offsets = SelectorSettings(path_offsets=(0, 1, 3))
    assert path_steps(PlanningSettings(selector=offsets, sensing_interval=8)) == (0, 9, 27)
    in_steps = SelectorSettings(path_offsets=(0, 1, 3), path_unit="steps")
    assert path_steps(PlanningSettings(selector=in_steps, sensing_interval=8)) == (0, 1, 3)
