"""The caller's floating-point mode changes no decision, stops nothing, and stays the caller's."""

import ctypes
import ctypes.util
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.line_problem import Line

import holdfast as hf
from holdfast.config.loader import load
from holdfast.journal.tables import SummaryBuilder
from holdfast.numerics.arrays import FloatArray, IntArray
from holdfast.numerics.floating_mode import as_caller, in_own_mode
from holdfast.planning.belief import standard_deviation
from holdfast.planning.planner import decode_checkpoint, encode_checkpoint
from holdfast.planning.settings import ActiveSensingSettings, PlanningSettings, SelectorSettings
from holdfast.reports.belief_remarks import belief_remarks
from holdfast.reports.figure import trial_figure
from holdfast.reports.recorder import Recorder
from holdfast.robot.trial import run_trial

EXAMPLES = Path(__file__).parents[2] / "examples"
USUAL = dict(np.geterr())

TINY = 1e-200
"""Its square is 0."""


def trial_of(problem: Any, method: Any, **sensing: int) -> str:
    settings = PlanningSettings(
        active_sensing=ActiveSensingSettings(num_cores=1, **sensing),
        selector=SelectorSettings(method=method, rollout_steps=30),
    )
    planner = hf.Planner(problem, settings, particles=100)
    return run_trial(planner, seed=3, max_steps=40).digest


METHODS = [
    "path_entropy",
    "action_entropy",
    "state_entropy",
    "action_covariance",
    "expected_return",
]


class TestNumPy:
    @pytest.mark.parametrize("method", METHODS)
    @pytest.mark.parametrize("name", ["capsule_robot", "peg_in_hole_3d"])
    def test_no_mode_stops_a_built_in_problem(self, name: str, method: str) -> None:
        usual = trial_of(hf.make_problem(name), method)
        with np.errstate(all="raise"):
            assert trial_of(hf.make_problem(name), method) == usual
            assert set(np.geterr().values()) == {"raise"}

    def test_nor_a_horizon(self) -> None:
        usual = trial_of(hf.make_problem("peg_in_hole_2d"), "action_entropy", horizon=2)
        with np.errstate(all="raise"):
            found = trial_of(hf.make_problem("peg_in_hole_2d"), "action_entropy", horizon=2)
        assert found == usual

    def test_what_a_user_calls_by_itself(self) -> None:
        weights = np.append(np.full(9, TINY), 1.0)[::-1]
        planner = hf.Planner(hf.make_problem("peg_in_hole_2d"), particles=10)
        state = planner.init(1)
        sharp = state._replace(belief=hf.Belief.weighted(state.belief.states, weights))
        with np.errstate(all="raise"):
            hf.Belief.weighted(np.zeros((2, 1)), [1e-300, 1e300])
            assert np.isfinite(hf.entropy(np.append(np.zeros(9), [TINY, 1.0]).reshape(-1, 1)))
            standard_deviation(hf.Belief.uniform([[0.0], [TINY]]))
            assert planner.observe(sharp, 0, None)[1].effective_sample_size == 1.0
            assert decode_checkpoint(encode_checkpoint(sharp)).belief.weights[1] > 0.0

    def test_what_is_recorded_of_a_run(self) -> None:
        configuration = load(EXAMPLES / "peg_in_hole_2d.yaml")
        planner = hf.Planner(configuration.problem, configuration.planning)
        recorder = Recorder(0, planner)
        with np.errstate(all="raise"):
            result = run_trial(planner, max_steps=60, observer=recorder)
            summary = SummaryBuilder()
            summary.add(result)
            summary.build(problem="peg", seed=0, version="", trials=1, wall_time_s=1.0)
            belief_remarks(configuration.problem, configuration.planning, recorder.record)
            assert len(trial_figure(configuration, recorder.record)) > 10_000


class Noting(Line):
    """A user's problem that notes the mode in which it is called, and keeps one of its own."""

    def __init__(self) -> None:
        self.modes: list[dict[str, Any]] = []

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        self.modes.append(dict(np.geterr()))
        return super().policy(states, stage)


class Strict(Line):
    """A user's problem in whose code a number becomes 0."""

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        return np.asarray(super().policy(states, stage) + np.square(np.full(1, TINY)))


class TestUserCode:
    def test_it_has_the_callers_mode(self) -> None:
        problem = Noting()
        planner = hf.Planner(problem, particles=20)
        state = planner.init(1)
        for mode in ("raise", "ignore"):
            problem.modes.clear()
            with np.errstate(all=mode):
                planner.choose_sensing_action(state)
                planner.choose_task_action(state)
            assert {each for found in problem.modes for each in found.values()} == {mode}
        problem.modes.clear()
        planner.choose_task_action(state)
        assert problem.modes == [USUAL]

    def test_what_it_asked_for_is_raised(self) -> None:
        planner = hf.Planner(Strict(), particles=20)
        state = planner.init(1)
        planner.choose_task_action(state)
        with np.errstate(all="raise"), pytest.raises(FloatingPointError):
            planner.choose_task_action(state)
        assert dict(np.geterr()) == USUAL

    def test_within_it_our_functions_run_in_our_mode_again(self) -> None:
        modes: list[str] = []

        @in_own_mode
        def ours(depth: int) -> None:
            modes.append(np.geterr()["under"])
            if depth:
                as_caller(theirs, depth)

        def theirs(depth: int) -> None:
            modes.append(np.geterr()["under"])
            ours(depth - 1)
            with np.errstate(under="warn"):
                ours(depth - 1)

        with np.errstate(under="raise"):
            ours(1)
            assert np.geterr()["under"] == "raise"
        assert modes == ["ignore", "raise", "ignore", "ignore"]
        modes.clear()
        ours(1)
        assert modes == ["ignore"] * 4


@contextmanager
def rounding(mode: int) -> Iterator[Any]:
    library = ctypes.CDLL(ctypes.util.find_library("m"))
    assert library.fesetround(mode) == 0
    try:
        yield library
    finally:
        library.fesetround(0)


@pytest.mark.skipif(platform.machine() != "x86_64", reason="numbers of x86's modes")
class TestProcessor:
    @pytest.mark.parametrize(
        ("mode", "method"), [(0x400, "path_entropy"), (0x800, "expected_return")]
    )
    def test_rounding_changes_no_decision(self, mode: int, method: str) -> None:
        usual = trial_of(hf.make_problem("peg_in_hole_2d"), method)
        with rounding(mode) as library:
            found = trial_of(hf.make_problem("peg_in_hole_2d"), method)
            kept = library.fegetround()
        assert found == usual
        assert kept == mode

    def test_the_functions_of_a_problem_round_as_everywhere(self) -> None:
        thirds: list[float] = []

        class Thirds(Line):
            def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
                thirds.append(float((np.ones(1) / np.full(1, 3.0))[0]))
                return super().policy(states, stage)

        planner = hf.Planner(Thirds(), particles=20)
        state = planner.init(1)
        planner.choose_task_action(state)
        with rounding(0x800):
            planner.choose_task_action(state)
        assert thirds[0] == thirds[1] == 1.0 / 3.0
