"""Planning: pure functions of a state, which any process goes on from."""

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.line_problem import Beacon
from tests.planning_settings import SEED, TRIAL, planning_settings

from holdfast.config import registry
from holdfast.errors import InvalidValueError, ProblemError
from holdfast.planning import planner as planning
from holdfast.planning.belief import Belief
from holdfast.planning.planner import Planner, decode_checkpoint, digest, encode_checkpoint
from holdfast.planning.settings import (
    ActiveSensingSettings,
    ParticleFilterSettings,
    PlanningSettings,
    SelectorSettings,
)
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.problems.problem import Problem


@pytest.fixture(scope="module", params=registry.names())
def problem(request: pytest.FixtureRequest) -> Problem:
    built = registry.problem_class(request.param).from_settings({}, {})
    assert isinstance(built, Problem)
    return built


@pytest.fixture(scope="module")
def peg() -> Problem:
    return PegInHole2D()


def test_static_parameters_are_drawn_anew() -> None:
    """And the same again, from a checkpoint: so says every service."""

    class Named(Beacon):
        static_parameters = (1,)

    distinct, ends = [], []
    for problem, at in ((Beacon(), 30), (Named(), 30), (Named(), 4)):
        planner = Planner(problem, planning_settings())
        state = planner.init(SEED, TRIAL)
        for step in range(10):
            if step == at:
                state = decode_checkpoint(encode_checkpoint(state))
            state, _ = planner.observe(state, 1, np.array([0.5]))
            state = planner.advance(state, np.array([0.1]))
        values = state.belief.states[:, 1]
        distinct.append((len(np.unique(values)), len(values)))
        ends.append(planner.digest(state))
    assert distinct[0][0] < 0.2 * distinct[0][1]
    assert distinct[1][0] == distinct[1][1]
    assert ends[0] != ends[1] == ends[2]


class TestPurity:
    def test_nothing_is_changed_and_nothing_is_shared(self, problem: Problem) -> None:
        configured = planning_settings()
        planner = Planner(problem, configured)
        state = planner.init(SEED, TRIAL)
        size = problem.observation_mean(state.belief.states, 0).shape[-1]
        observation = np.full(size, 0.5)
        for array in (*state.belief, observation):
            array.setflags(write=False)
        before = digest(state)

        sensing_action, _ = planner.choose_sensing_action(state)
        assert 0 <= sensing_action < len(problem.sensing_actions)
        after, _ = planner.observe(state, 0, observation)
        action, info = planner.choose_task_action(after)
        action.setflags(write=False)
        following = planner.advance(after, action)
        encode_checkpoint(state)

        assert digest(state) == before
        assert len({before, digest(after), digest(following)}) == 3
        # What a caller does to what it got must not reach what it handed in.
        for old in state.belief:
            for new in (*following.belief, after.belief.states, info.estimate, info.commanded):
                assert not np.shares_memory(old, new)
        for old in after.belief:
            assert not np.shares_memory(old, following.belief.states)
            assert not np.shares_memory(old, action)

    def test_read_checkpoints_are_their_own(self, peg: Problem) -> None:
        state = Planner(peg, planning_settings()).init(SEED, TRIAL)
        data = encode_checkpoint(state)
        decoded = decode_checkpoint(data)
        with pytest.raises(ValueError, match="read-only"):
            decoded.belief.states[:] = 0.0
        assert decoded.belief.states.tobytes() == state.belief.states.tobytes()


class TestFunctions:
    @pytest.mark.parametrize(
        ("interval", "expected"), [(0, [0, 1, 2, 3, 4, 5, 6]), (1, [0, 2, 4, 6]), (4, [0, 5])]
    )
    def test_needs_sensing(self, peg: Problem, interval: int, expected: list[int]) -> None:
        """At steps t with t % (interval + 1) == 0, once."""
        configured = planning_settings(sensing_interval=interval)
        state = Planner(peg, configured).init(SEED, TRIAL)
        senses = [
            step
            for step in range(7)
            if planning.needs_sensing(configured, state._replace(step=step))
        ]
        assert senses == expected
        for step in range(7):
            assert not planning.needs_sensing(configured, state._replace(step=step, sensed=True))

    def test_observe_at_threshold_one_always_resamples(self, peg: Problem) -> None:
        """Even where rounding puts the effective size of equal weights above their number."""
        planner = Planner(peg, planning_settings(49))
        state = planner.init(SEED, TRIAL)
        same = state._replace(belief=Belief.uniform(np.repeat(state.belief.states[:1], 49, axis=0)))
        _, info = planner.observe(same, 0, [4.0])
        assert info.resampled

    def test_task_action_of_the_most_likely_particle(self, problem: Problem) -> None:
        configured = msgspec.structs.replace(
            planning_settings(),
            particle_filter=ParticleFilterSettings(num_particles=40, estimate="most_likely"),
        )
        planner = Planner(problem, configured)
        state = planner.init(SEED, TRIAL)
        weights = np.ones(40)
        weights[[7, 9]] = 3.0
        weighted = state._replace(belief=Belief.weighted(state.belief.states, weights))
        action, info = planner.choose_task_action(weighted)
        likely = state.belief.states[7]
        assert info.estimate.tolist() == likely.tolist()
        assert not np.shares_memory(info.estimate, state.belief.states)
        stage = int(problem.next_stage(likely, state.stage))
        assert action.tolist() == problem.limit_action(problem.policy(likely, stage)).tolist()
        assert planner.advance(weighted, action).stage == stage
        # Of equals the first.
        _, info = planner.choose_task_action(state)
        assert info.estimate.tolist() == state.belief.states[0].tolist()


class TestBadInput:
    @pytest.mark.parametrize("count", [0, -3, 10_000_001])
    def test_number_of_particles(self, peg: Problem, count: int) -> None:
        """Settings made by hand are not validated: the first function that uses them is."""
        with pytest.raises(
            InvalidValueError, match=rf"particle_filter\.num_particles is {count}; .* <= 10000000"
        ):
            Planner(peg, planning_settings(count)).init(SEED, TRIAL)

    def test_too_many_particles_for_neighbours_of_the_prior(self, peg: Problem) -> None:
        selector = SelectorSettings(method="action_entropy", estimator="prior_neighbors")
        settings = msgspec.structs.replace(planning_settings(4097), selector=selector)
        expected = r"particle_filter\.num_particles is 4097; .*prior_neighbors .*allows 4096"
        with pytest.raises(InvalidValueError, match=expected):
            Planner(peg, settings).init(SEED, TRIAL)

    @pytest.mark.parametrize("neighbors", [60, 61, 1000])
    def test_as_many_neighbours_as_particles(self, peg: Problem, neighbors: int) -> None:
        sensing = ActiveSensingSettings(num_nearest_neighbors=neighbors)
        settings = msgspec.structs.replace(planning_settings(60), active_sensing=sensing)
        expected = rf"num_nearest_neighbors is {neighbors}; .* below .*num_particles, which is 60"
        with pytest.raises(InvalidValueError, match=expected):
            Planner(peg, settings).init(SEED, TRIAL)

    @pytest.mark.parametrize(
        ("seed", "trial", "text"),
        [
            (-1, 0, "seed -1: allowed are whole numbers from 0 to 9223372036854775807"),
            (2**63, 0, f"seed {2**63}: allowed are whole numbers from 0"),
            (0, -1, "trial -1"),
            (0, 2**32, f"trial {2**32}"),
            (1.5, 0, r"seed 1\.5: allowed are whole numbers from 0 to 9223372036854775807"),
            (0, "1", "trial '1': allowed are whole numbers from 0 to 4294967295"),
        ],
    )
    def test_seed_and_trial(self, peg: Problem, seed: Any, trial: Any, text: str) -> None:
        with pytest.raises(InvalidValueError, match=text):
            Planner(peg, planning_settings()).init(seed, trial)

    def test_state_of_another_problem(self, peg: Problem) -> None:
        capsule = registry.problem_class("capsule_robot").from_settings({}, {})
        state = Planner(capsule, planning_settings()).init(SEED, TRIAL)
        planner = Planner(peg, planning_settings())
        calls: tuple[Callable[[], object], ...] = (
            lambda: planner.choose_sensing_action(state),
            lambda: planner.observe(state, 0, [1.0]),
            lambda: planner.choose_task_action(state),
            lambda: planner.advance(state, np.zeros(3)),
        )
        for call in calls:
            with pytest.raises(
                InvalidValueError, match="state of 2 coordinates: peg_in_hole_2d has 3"
            ):
                call()

    @pytest.mark.parametrize("sensing_action", [-1, 3, 100, 1.5])
    def test_sensing_action(self, peg: Problem, sensing_action: Any) -> None:
        planner = Planner(peg, planning_settings())
        state = planner.init(SEED, TRIAL)
        with pytest.raises(
            InvalidValueError, match=rf"sensing action {sensing_action}: peg_in_hole_2d has 0 to 2"
        ):
            planner.observe(state, sensing_action, [1.0])

    @pytest.mark.parametrize(
        "action", [[np.nan, 0.0, 0.0], [0.0, np.inf, 0.0], [0.0, 0.0], [0.0] * 4, 0.0, [[0.0] * 3]]
    )
    def test_task_action(self, peg: Problem, action: object) -> None:
        planner = Planner(peg, planning_settings())
        state = planner.init(SEED, TRIAL)
        with pytest.raises(InvalidValueError, match=r"task action .* needs 3 finite coordinates"):
            planner.advance(state, action)  # type: ignore[arg-type]

    @pytest.mark.parametrize("bad", [np.nan, np.inf])
    @pytest.mark.parametrize("function", ["initial_states", "move", "policy"])
    def test_what_a_problem_returns_is_finite(self, function: str, bad: float) -> None:
        planner = Planner(PegInHole2D(), planning_settings())
        state = planner.init(SEED, TRIAL)
        states = state.belief.states.copy()
        states[7, 1] = bad
        returned = np.array([0.0, np.nan, bad]) if function == "policy" else states
        setattr(planner.problem, function, lambda *_: returned)
        calls: dict[str, Callable[[], object]] = {
            "initial_states": lambda: planner.init(SEED, TRIAL),
            "move": lambda: planner.advance(state, np.zeros(3)),
            "policy": lambda: planner.choose_task_action(state),
        }
        says = "gives" if function == "policy" else "put particle 7 at .*: every"
        with pytest.raises(ProblemError, match=f"{function} of peg_in_hole_2d {says}"):
            calls[function]()

    def test_the_last_step_of_all(self, peg: Problem) -> None:
        """Steps are words of 32 bits; the stream of the one after the last is refused."""
        configured = planning_settings()
        planner = Planner(peg, configured)
        state = planner.init(SEED, TRIAL)
        last = planner.advance(state._replace(step=2**32 - 1), np.zeros(3))
        with pytest.raises(InvalidValueError, match=rf"step {2**32}: allowed are 0 to {2**32 - 1}"):
            planner.advance(last, np.zeros(3))


def test_settings_that_change_are_checked_again() -> None:
    offsets = [0, 1]
    selector = SelectorSettings(path_offsets=offsets)  # type: ignore[arg-type]
    settings = PlanningSettings(selector=selector)
    assert Planner(PegInHole2D(), settings).settings.selector.path_offsets == (0, 1)
    offsets.append(2)
    assert Planner(PegInHole2D(), settings).settings.selector.path_offsets == (0, 1, 2)
    plain = PlanningSettings()
    assert Planner(PegInHole2D(), plain).settings is Planner(PegInHole2D(), plain).settings
