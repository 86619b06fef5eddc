"""Every number of the settings is a factor of the cost, or is listed as none."""

import math
from typing import Any, get_args

import pytest
from tests.fuzz.hostile_settings import hostile_settings, numeric_keys, with_key

from holdfast.config import registry
from holdfast.planning.settings import Method, PlanningSettings
from holdfast.problems.capsule_robot import CapsuleRobot
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.protocol.decision_cost import (
    ANY_MACHINE,
    COSTLY,
    FREE,
    TYPICAL_PROBLEM,
    CallCost,
    Cost,
    Pricing,
    describe_cost,
)
from holdfast.protocol.service_limits import ServiceLimits

METHODS = get_args(Method)
price_of = ANY_MACHINE.price_of
PEG = registry.problem_class("peg_in_hole_2d").from_settings({}, {})


def answer(settings: PlanningSettings, **changes: Any) -> Cost:
    asked: dict[str, Any] = {"steps": 9.0, "inputs": 1.0, "begins": True, "num_bytes": 100.0}
    return price_of(PEG, settings).reaching.cost(**{**asked, **changes})


def is_least(less: Cost, more: Cost) -> bool:
    return less.seconds <= more.seconds and less.num_bytes <= more.num_bytes


def test_each_numeric_setting_is_a_factor_or_listed_as_none() -> None:
    known = {*COSTLY, *FREE}
    assert set(numeric_keys()) == known, "list a new key in COSTLY and count it, or in FREE"
    assert not set(COSTLY) & set(FREE)


@pytest.mark.parametrize("key", [*COSTLY])
def test_a_costly_setting_never_lowers_the_cost_and_raises_it_somewhere(key: str) -> None:
    plain = PlanningSettings()
    if key == "selector.rollout_sensing_steps":
        plain = with_key(plain, "sensing_interval", 1)
    rises = False
    for method in METHODS:
        settings = with_key(plain, "selector.method", method)
        before: tuple[Cost, Cost] | None = None
        for factor in (1, 2, 10, 100):
            value: object = 40 * factor
            if key == "active_sensing.num_nearest_neighbors":
                settings = with_key(settings, "particle_filter.num_particles", 5000)
            if key == "selector.path_offsets":
                value = tuple(range(10 * factor))[:64]
            changed = with_key(settings, key, value)
            steps = float(changed.sensing_interval)
            found = price_of(PEG, changed).sensing, answer(changed, steps=steps)
            if key == "sensing_interval":
                # A robot that senses less often has fewer forks in its rollouts, not more.
                found = found[1], found[1]
            assert all(math.isfinite(each.seconds) for each in found)
            if before is not None:
                assert all(map(is_least, before, found)), (key, method, factor)
                rises |= any(
                    less.seconds < more.seconds for less, more in zip(before, found, strict=True)
                )
            before = found
    assert rises, key


@pytest.mark.parametrize("key", [*FREE])
def test_a_setting_that_is_no_factor_changes_nothing(key: str) -> None:
    for method in METHODS:
        settings = with_key(PlanningSettings(), "selector.method", method)
        changed = with_key(settings, key, 1 if numeric_keys()[key].is_whole else 0.5)
        assert price_of(PEG, settings).sensing == price_of(PEG, changed).sensing


def test_more_sensing_actions_cost_more() -> None:
    many_actions = CapsuleRobot()
    many_actions.sensing_actions = tuple(map(str, range(200)))
    for method in METHODS:
        settings = with_key(PlanningSettings(), "selector.method", method)
        few, many = (price_of(each, settings).sensing for each in (CapsuleRobot(), many_actions))
        assert is_least(few, many)
        if method not in ("random", "fixed"):
            assert many.seconds > 10.0 * few.seconds


def test_estimates_are_finite_whatever_is_set() -> None:
    limits = ServiceLimits()
    for hostile in hostile_settings():
        cost = price_of(PEG, hostile.settings).sensing
        assert all(map(math.isfinite, cost)), hostile
        method = hostile.settings.selector.method
        if hostile.key == "all" and method not in ("random", "fixed"):
            assert cost.seconds > limits.max_decision_s, hostile
        assert method in describe_cost(PEG, hostile.settings)


def test_the_defaults_are_brief_and_with_many_particles_small() -> None:
    limits = ServiceLimits()
    for name in ("peg_in_hole_2d", "multitier_peg_in_hole_2d", "capsule_robot", "peg_in_hole_3d"):
        problem = registry.problem_class(name).from_settings({}, {})
        price = price_of(problem, PlanningSettings())
        assert price.sensing.seconds < limits.max_brief_s
        failed_over = price.reaching.cost(steps=100, inputs=11, begins=True, num_bytes=500)
        assert failed_over.seconds < limits.max_medium_s
        many = with_key(PlanningSettings(), "particle_filter.num_particles", 100_000)
        assert price_of(problem, many).sensing.num_bytes < limits.max_decision_bytes


def test_the_words_name_the_keys_of_the_method() -> None:
    settings = with_key(PlanningSettings(), "selector.method", "expected_return")
    words = describe_cost(PEG, settings)
    for key in ("rollout_steps 200", "rollout_sensing_steps 4", "max_observation_samples 40"):
        assert f"selector.{key}" in words
    assert "3 sensing actions" in words
    assert "path_offsets" not in words


class Angular(PegInHole2D):
    """Whose rollouts and paths are Python's, and whose last coordinate is an angle."""

    own = TYPICAL_PROBLEM._replace(observation_size=3)
    circular = circular_actions = (2,)
    move = PegInHole2D.move


class General(Angular):
    """Which gives a likelihood, and returns from known states."""

    own = TYPICAL_PROBLEM._replace(known_return=CallCost(9e-6, 50e-9))
    rank_test = True

    def log_likelihood(self, states: Any, sensing_action: int, observation: Any) -> Any: ...


FINE = {"num_nearest_neighbors": 7, "num_particles": 2500, "estimate": "heaviest_mode"}
NESTED = {"horizon": 2, "sensing_interval": 4}
ROLLED = {"method": "expected_return", "max_observation_samples": 80}
KEYS = {each.rpartition(".")[2]: each for each in COSTLY} | {
    "estimate": "particle_filter.estimate",
    **{name: f"selector.{name}" for name in ("method", "estimator", "sensing_is_optional")},
}


@pytest.mark.parametrize(
    ("problem", "changes", "expected"),
    [
        (PegInHole2D, {}, (0.0081215, 523680, 0.003113944, 91500)),
        (PegInHole2D, {"method": "random"}, (0.00018, 9600, 0.003113944, 91500)),
        (
            PegInHole2D,
            {**FINE, **NESTED, "method": "action_entropy"},
            (0.73154934518, 19290480, 0.416612544, 760300),
        ),
        (
            PegInHole2D,
            {"estimator": "gaussian_mixture_upper", "path_offsets": (0, 3, 9)},
            (0.0089228, 769680, 0.003113944, 91500),
        ),
        (PegInHole2D, FINE, (0.072895320302, 4750480, 0.416612544, 760300)),
        (Angular, {"path_offsets": (0, 3, 9)}, (0.02152575, 730080, 0.005045344, 98700)),
        (
            General,
            {**NESTED, "method": "state_entropy"},
            (0.025456680751, 2416080, 0.005484344, 91500),
        ),
        (
            General,
            {"method": "action_covariance", "sensing_is_optional": True},
            (0.000822, 550240, 0.005484344, 91500),
        ),
        (PegInHole2D, ROLLED, (0.0323799, 1218240, 0.003113944, 91500)),
        (Angular, {**ROLLED, "sensing_interval": 70}, (0.583867, 1573920, 0.005045344, 98700)),
        (General, ROLLED, (0.34722016, 1447680, 0.005484344, 91500)),
        (
            Angular,
            {**ROLLED, "max_observation_samples": 20},
            (0.18424364, 497760, 0.005045344, 98700),
        ),
    ],
)
def test_the_model_in_numbers(
    problem: type[PegInHole2D], changes: dict[str, object], expected: tuple[float, ...]
) -> None:
    """Change them with benchmarks/decision_cost.py: lanes and limits of services follow."""
    settings = PlanningSettings()
    for name, value in changes.items():
        settings = with_key(settings, KEYS[name], value)
    own = getattr(problem, "own", TYPICAL_PROBLEM)
    price = Pricing(1.5).price_of(problem(), settings, own)
    asked: dict[str, Any] = {"steps": 9.0, "inputs": 2.0, "begins": True, "num_bytes": 100.0}
    reached = price.reaching.cost(**asked)
    assert (*price.sensing, *reached) == pytest.approx(expected, rel=1e-9)
