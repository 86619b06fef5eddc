"""The path entropy against its definition, written out particle by particle and step by step."""

import re
from collections.abc import Sequence
from typing import Any, Literal

import msgspec
import numpy as np
import pytest
from tests.oracles.test_sensing_reference import LightDark, Plane, compare, settings_of, some_belief

from holdfast.config import registry
from holdfast.errors import InvalidValueError, ProblemError
from holdfast.numerics.arrays import FloatArray, IntArray
from holdfast.numerics.randomness import NOISE_FREE, Purpose, Stream, stream
from holdfast.planning.belief import Belief
from holdfast.planning.policy_path import _followed, path_points
from holdfast.planning.sensing import SensingInfo, choose_sensing_action
from holdfast.planning.settings import PlanningSettings, SelectorSettings, check_settings
from holdfast.problems.attributes import check_problem, has_own
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.problems.problem import Problem
from studies.busy_room import BusyRoom

Actions = Literal["commanded", "executed"]


def path(
    offsets: Sequence[int] = (0, 2, 5),
    *,
    discount: float = 1.0,
    unit: Literal["steps", "sensing_intervals"] = "steps",
    estimator: str = "nearest_neighbor",
    actions: Actions = "commanded",
    interval: int = 8,
    cores: int = 1,
) -> PlanningSettings:
    selector = SelectorSettings(
        method="path_entropy",
        estimator=estimator,  # type: ignore[arg-type]
        actions=actions,
        path_offsets=tuple(offsets),
        path_discount=discount,
        path_unit=unit,
    )
    settings = settings_of(samples=4, selector=selector)
    return msgspec.structs.replace(
        settings,
        sensing_interval=interval,
        active_sensing=msgspec.structs.replace(settings.active_sensing, num_cores=cores),
    )


def choose(
    problem: Problem, settings: PlanningSettings, belief: Belief, stage: int = 0
) -> tuple[int, SensingInfo]:
    hypotheses = stream(41, 0, 0, Purpose.HYPOTHESES)
    return choose_sensing_action(problem, settings, belief, stage, hypotheses, hypotheses)


def bits(chosen: tuple[int, SensingInfo]) -> tuple[int, bytes, bytes]:
    index, info = chosen
    assert info.entropies is not None
    assert info.samples is not None
    return index, info.entropies.tobytes(), info.samples.tobytes()


@pytest.mark.parametrize("kind", ["uniform", "weighted", "zeros", "copies"])
@pytest.mark.parametrize("count", [8, 40, 200])
@pytest.mark.parametrize("problem", [Plane(), LightDark()], ids=lambda p: p.name)
def test_beliefs(problem: Problem, count: int, kind: str) -> None:
    """Stages change on the way; posteriors of all sizes, alone and in groups."""
    settings = path()
    belief = some_belief(problem, count, kind)
    compare(problem, settings, belief, stage=0)
    _, stages = ways(problem, belief.states, 5)
    assert len(np.unique(stages)) > 1


def ways(problem: Problem, states: FloatArray, steps: int) -> tuple[list[FloatArray], IntArray]:
    """Return the states and the stages of all steps."""
    stages = np.zeros(len(states), dtype=np.int64)
    found, passed = [states], [stages]
    for _ in range(steps):
        states = states + problem.limit_action(problem.policy(states, stages))
        stages = np.asarray(problem.next_stage(states, stages))
        found.append(states)
        passed.append(stages)
    return found, np.array(passed)


@pytest.mark.parametrize("actions", ["commanded", "executed"])
@pytest.mark.parametrize(
    "estimator", ["nearest_neighbor", "gaussian_mixture_upper", "gaussian_mixture_lower"]
)
@pytest.mark.parametrize("discount", [1.0, 0.9])
def test_settings(estimator: str, actions: Actions, discount: float) -> None:
    settings = path((1, 4), estimator=estimator, actions=actions, discount=discount)
    compare(LightDark(), settings, some_belief(LightDark(), 60, "weighted"))


def test_offsets_in_sensing_intervals() -> None:
    problem = Plane()
    belief = some_belief(problem, 60, "weighted")
    settings = path((0, 1, 2), unit="sensing_intervals", interval=2)
    assert bits(choose(problem, settings, belief)) == bits(choose(problem, path((0, 3, 6)), belief))


def test_the_discount_counts_in_the_unit_of_the_offsets() -> None:
    settings = path((0, 1, 2), unit="sensing_intervals", interval=2, discount=0.5)
    compare(Plane(), settings, some_belief(Plane(), 60, "weighted"))


@pytest.mark.parametrize("estimator", ["nearest_neighbor", "gaussian_mixture_lower"])
@pytest.mark.parametrize("actions", ["commanded", "executed"])
@pytest.mark.parametrize("name", registry.names())
def test_the_next_action_alone_is_action_entropy(
    name: str, actions: Actions, estimator: str
) -> None:
    problem = registry.problem_class(name).from_settings({}, {})
    alone = path((0,), estimator=estimator, actions=actions)
    selector = msgspec.structs.replace(alone.selector, method="action_entropy")
    usual = msgspec.structs.replace(alone, selector=selector)
    for count in (30, 300):
        belief = some_belief(problem, count, "zeros")
        assert bits(choose(problem, alone, belief)) == bits(choose(problem, usual, belief))


@pytest.mark.parametrize("count", [60, 600])
@pytest.mark.parametrize("estimator", ["nearest_neighbor", "gaussian_mixture_upper"])
def test_threads_change_nothing(count: int, estimator: str) -> None:
    problem = LightDark()
    belief = some_belief(problem, count, "weighted")
    found = {
        bits(choose(problem, path(estimator=estimator, cores=cores), belief))
        for cores in (1, 2, 4, 0)
    }
    assert len(found) == 1


@pytest.mark.parametrize("name", [*registry.names(), "busy_room"])
def test_the_kernel_follows_as_numpy_does(name: str) -> None:
    """Bit for bit, through contacts and stages, for one way of several hundred steps."""
    problem: Any = BusyRoom()
    if name != "busy_room":
        problem = registry.problem_class(name).from_settings({}, {})
    plain: Any = _Plain(problem)
    offsets = (0, 1, 9, 36, 300, 301)
    for stage in range(problem.num_stages):
        states = some_belief(problem, 150, "uniform").states
        states_at, stages_at = problem.expected_path(states, stage, offsets, 1)
        assert has_own(problem, "expected_path", ("policy", "limit_action", "next_stage"))
        expected_states, expected_stages = _followed(plain, states, stage, offsets, 1)
        np.testing.assert_array_equal(states_at, expected_states)
        commanded = path_points(problem, path(offsets), states, stage).points
        np.testing.assert_array_equal(commanded, problem.policy(states_at, stages_at))
        np.testing.assert_array_equal(stages_at, np.broadcast_to(expected_stages, (6, 150)))
    assert problem.num_stages == 1 or (stages_at[-1] == problem.num_stages - 1).any()


class _Plain:
    """A problem without a path of its own."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem

    def __getattr__(self, name: str) -> object:
        if name == "expected_path":
            raise AttributeError(name)
        return getattr(self._problem, name)


def test_an_inherited_path_is_none_of_a_new_policy() -> None:
    class Reversed(PegInHole2D):
        def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
            return -super().policy(states, stage)

    problem = Reversed()
    states = some_belief(problem, 40, "uniform").states
    points, _ = path_points(problem, path((0, 3)), states, 0)
    moved = states
    for _ in range(3):
        moved = problem.move(moved, problem.limit_action(problem.policy(moved, 0)), NOISE_FREE)
    np.testing.assert_array_equal(points[1], problem.policy(moved, 0))


class Drifting(Plane):
    """Has a way of its own to move without noise."""

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        raise AssertionError("expected_move is there to be asked")

    def expected_move(self, states: FloatArray, actions: FloatArray) -> FloatArray:
        return np.asarray(states + actions + 0.1)


def test_a_problem_may_say_where_its_actions_lead() -> None:
    problem = Drifting()
    states = np.array([[1.0, 2.0, 3.0], [0.1, 0.2, 0.3]])
    points, _ = path_points(problem, path((0, 1)), states, 0)
    moved = states + problem.limit_action(problem.policy(states, 0)) + 0.1
    stages = np.asarray(problem.next_stage(moved, np.zeros(2, dtype=np.int64)))
    np.testing.assert_array_equal(points[1], problem.policy(moved, stages))


def test_a_stream_without_noise() -> None:
    assert NOISE_FREE.normal((2, 3)).tolist() == np.zeros((2, 3)).tolist()
    assert NOISE_FREE.uniform(2).tolist() == [0.5, 0.5]
    assert NOISE_FREE.substream(7) is NOISE_FREE
    assert Stream((0, 0, 0, 0, 0)) != NOISE_FREE


class Redrawing(Plane):
    """Draws its noise again until nobody stays where he is, as he does without noise."""

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        noise = stream.normal(states.shape)
        while not noise.all():
            noise = stream.substream(1).normal(states.shape)
        return states + actions + 0.1 * noise


def test_a_move_that_waits_for_another_number_is_told_of() -> None:
    problem = Redrawing()
    with pytest.raises(ProblemError, match=r"give the problem an expected_move\(states, actions\)"):
        choose(problem, path(), some_belief(problem, 20, "weighted"))


class TestErrors:
    @pytest.mark.parametrize(
        ("settings", "message"),
        [
            (path((0, 3, 3)), "selector.path_offsets is [0, 3, 3]; the offsets must increase"),
            (
                path((0, 2000), unit="sensing_intervals"),
                "selector.path_offsets is [0, 2000], [0, 18000] steps with selector.path_unit "
                "sensing_intervals; allowed are 1 to 64 offsets from 0 to 10000 steps",
            ),
            (
                msgspec.structs.replace(
                    path(), active_sensing=settings_of(horizon=2).active_sensing
                ),
                "active_sensing.horizon is 2; with selector.method path_entropy it must be 1",
            ),
            (path(()), "selector.path_offsets"),
            (path((-1, 3)), "selector.path_offsets"),
            (path((3, 10_001)), "selector.path_offsets"),
            (path(range(65)), "selector.path_offsets"),
            (path(discount=0.0), "selector.path_discount"),
        ],
    )
    def test_settings(self, settings: PlanningSettings, message: str) -> None:
        with pytest.raises(InvalidValueError, match=re.escape(message)):
            check_settings(settings, PlanningSettings)

    def test_settings_of_a_single_decision(self) -> None:
        problem = Plane()
        with pytest.raises(InvalidValueError, match="must increase strictly"):
            choose(problem, path((3, 3)), some_belief(problem, 40, "uniform"))

    @pytest.mark.parametrize(
        ("base", "function", "wrong", "message"),
        [
            (
                Drifting,
                "expected_move",
                lambda _, states, __: states[:1],
                r"expected_move of plane.*\(40, 3\)",
            ),
            *(
                (
                    Plane,
                    "limit_action",
                    lambda *_, found=found: found,
                    r"limit_action of plane returned .*\(40, 3\)",
                )
                for found in (np.zeros((1, 3)), np.zeros(3), [[0.0] * 3])
            ),
            (
                Plane,
                "limit_action",
                lambda _, actions: -1e60 * actions,
                r"policy of plane.*in state .*, 3 steps on",
            ),
            *(
                (
                    Plane,
                    "next_stage",
                    lambda *_, stages=stages: stages,
                    f"next_stage of plane{says}",
                )
                for stages, says in (
                    (np.full(40, 3), " has the stage 3 for state"),
                    (np.full(40, -1), " has the stage -1 for state"),
                    (np.zeros(40), r" .*: need an array of integers of shape \(40,\)"),
                    (1, ""),
                )
            ),
            # A path into nowhere is not the policy's.
            (
                Drifting,
                "expected_move",
                lambda _, states, __: states + np.nan,
                r"led from the state .* in 3 steps to .*nan",
            ),
        ],
    )
    def test_what_the_path_meets_on_the_way(
        self, base: type[Plane], function: str, wrong: object, message: str
    ) -> None:
        problem: Any = type("Wrong", (base,), {function: wrong})()
        with pytest.raises(ProblemError, match=message):
            choose(problem, path((0, 3)), some_belief(Plane(), 40, "uniform"))

    def test_call_of_the_expected_move(self) -> None:
        problem: Any = type("Wrong", (Drifting,), {"expected_move": lambda _, states: states})()
        with pytest.raises(ProblemError, match=r"called as expected_move\(states, actions\)"):
            check_problem(problem)
