"""Planning as a state machine: pure, repeatable from any point, and safe to write down and read."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from typing import NamedTuple

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some

from holdfast import planning
from holdfast.belief import Belief, estimate, resample, update
from holdfast.errors import CheckpointError, InvalidValueError, ProblemError
from holdfast.planning import PlanningState, decode_checkpoint, digest, encode_checkpoint
from holdfast.problems import registry
from holdfast.problems.capsule_robot import CapsuleRobot
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.problems.problem import FloatArray, IntArray, Problem
from holdfast.randomness import Purpose, Stream, stream
from holdfast.runtime.environment import SimulatedEnvironment
from holdfast.sensing import choose_sensing_action
from holdfast.settings import (
    ActiveSensingSettings,
    ParticleFilterSettings,
    PlanningSettings,
    SelectorSettings,
)

SEED, TRIAL, STEPS = 2**40 + 3, 6, 14

GOLDEN_DIGEST = "187f6a5a76a77f1a6f9557467062aeef0de3bd61a29ae3f838adc04014ef9c6c"


def planning_settings(
    num_particles: int = 40, sensing_interval: int = 3, resampling_threshold: float = 1.0
) -> PlanningSettings:
    return PlanningSettings(
        particle_filter=ParticleFilterSettings(
            num_particles=num_particles, resampling_threshold=resampling_threshold
        ),
        active_sensing=ActiveSensingSettings(num_observation_samples=3, num_cores=1),
        sensing_interval=sensing_interval,
    )


@pytest.fixture(scope="module", params=registry.names())
def problem(request: pytest.FixtureRequest) -> Problem:
    built = registry.problem_class(request.param).from_settings({}, {})
    assert isinstance(built, Problem)
    return built


@pytest.fixture(scope="module")
def peg() -> Problem:
    return PegInHole2D()


class Decision(NamedTuple):
    """The state before a call, and what the call was given from outside and returned."""

    state: PlanningState
    kind: str
    outside: bytes
    returned: bytes


def go_on(
    problem: Problem,
    configured: PlanningSettings,
    state: PlanningState,
    observations: dict[int, FloatArray],
    until: int,
) -> Iterator[Decision]:
    """Yield decisions from a state on; what the world shows is given by step."""
    while state.step < until:
        if planning.needs_sensing(configured, state):
            index, info = planning.choose_sensing_action(problem, configured, state)
            assert info.samples is not None
            yield Decision(state, "sense", b"", bytes([index]) + info.samples.tobytes())
            observation = observations[state.step]
            before = state
            state, _ = planning.observe(problem, configured, state, index, observation)
            yield Decision(before, "observe", observation.tobytes(), digest(state))
        action, task_info = planning.choose_task_action(problem, configured, state)
        told = action.tobytes() + task_info.estimate.tobytes() + task_info.commanded.tobytes()
        yield Decision(state, "act", b"", told + bytes([task_info.stage]))
        before = state
        state = planning.advance(problem, configured, state, action)
        yield Decision(before, "advance", action.tobytes(), digest(state))


def observations_of(problem: Problem, configured: PlanningSettings) -> dict[int, FloatArray]:
    """Return what a simulated world shows at each sensing step."""
    environment = SimulatedEnvironment(problem, SEED, TRIAL)
    state = planning.initial_state(problem, configured, SEED, TRIAL)
    observations = {}
    while state.step < STEPS:
        if planning.needs_sensing(configured, state):
            index, _ = planning.choose_sensing_action(problem, configured, state)
            observations[state.step] = environment.perform_sensing(index)
            state, _ = planning.observe(problem, configured, state, index, observations[state.step])
        action, _ = planning.choose_task_action(problem, configured, state)
        environment.perform(action)
        state = planning.advance(problem, configured, state, action)
    return observations


class TestReplay:
    @pytest.mark.parametrize("resampling_threshold", [1.0, 0.4])
    def test_from_every_point_the_rest_is_the_same(
        self, problem: Problem, resampling_threshold: float
    ) -> None:
        """After a crash at any point: read the checkpoint, see what was seen, decide the same."""
        configured = planning_settings(resampling_threshold=resampling_threshold)
        observations = observations_of(problem, configured)
        start = planning.initial_state(problem, configured, SEED, TRIAL)
        whole = list(go_on(problem, configured, start, observations, STEPS))
        assert {decision.kind for decision in whole} == {"sense", "observe", "act", "advance"}
        for at in range(len(whole)):
            state = whole[at].state
            # The state in which a step senses, or acts: only there does the loop begin.
            if whole[at].kind in {"observe", "advance"}:
                continue
            resumed = decode_checkpoint(encode_checkpoint(state))
            fresh = type(problem).from_settings({}, {})  # type: ignore[attr-defined]
            rest = list(go_on(fresh, configured, resumed, observations, STEPS))
            assert [again[1:] for again in rest] == [first[1:] for first in whole[at:]]

    def test_trials_and_seeds_differ(self, problem: Problem) -> None:
        configured = planning_settings()
        digests = set()
        for seed, trial in ((SEED, TRIAL), (SEED, TRIAL + 1), (SEED + 1, TRIAL)):
            state = planning.initial_state(problem, configured, seed, trial)
            action, _ = planning.choose_task_action(problem, configured, state)
            after = planning.advance(problem, configured, state, action)
            digests |= {state.belief.states.tobytes(), after.belief.states.tobytes()}
        assert len(digests) == 6

    def test_observations_draw_nothing(self, peg: Problem) -> None:
        """How often a robot has sensed changes none of the random numbers to come."""
        configured = planning_settings(resampling_threshold=0.0)
        state = planning.initial_state(peg, configured, SEED, TRIAL)
        sensed, _ = planning.observe(peg, configured, state, 0, [4.0])
        action = np.array([0.1, 0.0, 0.0])
        moved = [
            planning.advance(peg, configured, either, action).belief.states.tobytes()
            for either in (state, sensed)
        ]
        assert moved[0] == moved[1]


class TestPurity:
    def test_nothing_is_changed_and_nothing_is_shared(self, problem: Problem) -> None:
        configured = planning_settings()
        state = planning.initial_state(problem, configured, SEED, TRIAL)
        size = problem.observation_mean(state.belief.states, 0).shape[-1]
        observation = np.full(size, 0.5)
        for array in (*state.belief, observation):
            array.setflags(write=False)
        before = digest(state)

        planning.choose_sensing_action(problem, configured, state)
        after, _ = planning.observe(problem, configured, state, 0, observation)
        action, info = planning.choose_task_action(problem, configured, after)
        action.setflags(write=False)
        following = planning.advance(problem, configured, after, action)
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
        state = planning.initial_state(peg, planning_settings(), SEED, TRIAL)
        data = encode_checkpoint(state)
        decoded = decode_checkpoint(data)
        with pytest.raises(ValueError, match="read-only"):
            decoded.belief.states[:] = 0.0
        assert decoded.belief.states.tobytes() == state.belief.states.tobytes()


class TestFunctions:
    def test_initial_state(self, problem: Problem) -> None:
        configured = planning_settings()
        state = planning.initial_state(problem, configured, SEED, TRIAL)
        assert state[:5] == (SEED, TRIAL, 0, 0, False)
        assert state.belief.states.shape == (40, problem.state_size)
        assert state.belief.weights.tolist() == [1.0 / 40.0] * 40
        draws = stream(SEED, TRIAL, 0, Purpose.INITIAL_BELIEF)
        assert state.belief.states.tobytes() == problem.initial_states(draws, 40).tobytes()

    @pytest.mark.parametrize(
        ("interval", "expected"), [(0, [0, 1, 2, 3, 4, 5, 6]), (1, [0, 2, 4, 6]), (4, [0, 5])]
    )
    def test_needs_sensing(self, peg: Problem, interval: int, expected: list[int]) -> None:
        """At steps t with t % (interval + 1) == 0, once."""
        configured = planning_settings(sensing_interval=interval)
        state = planning.initial_state(peg, configured, SEED, TRIAL)
        senses = [
            step
            for step in range(7)
            if planning.needs_sensing(configured, state._replace(step=step))
        ]
        assert senses == expected
        for step in range(7):
            assert not planning.needs_sensing(configured, state._replace(step=step, sensed=True))

    def test_observe(self, peg: Problem) -> None:
        state = planning.initial_state(peg, planning_settings(), SEED, TRIAL)
        for threshold in (0.0, 0.3, 1.0):
            configured = planning_settings(resampling_threshold=threshold)
            after, info = planning.observe(peg, configured, state, 1, [2.5])
            assert after[:4] == state[:4]
            assert after.sensed
            assert info.explained
            assert 1.0 <= info.effective_sample_size <= 40.0
            assert info.resampled == (info.effective_sample_size <= threshold * 40)
            equal = after.belief.weights.tolist() == [1.0 / 40.0] * 40
            assert equal == info.resampled
            if not info.resampled:
                assert after.belief.states.tobytes() == state.belief.states.tobytes()
            # The belief about the height is now near what was seen.
            assert abs(estimate(after.belief)[1] - 2.5) < 0.3

    def test_observe_at_threshold_one_always_resamples(self, peg: Problem) -> None:
        """Even where rounding puts the effective size of equal weights above their number."""
        state = planning.initial_state(peg, planning_settings(49), SEED, TRIAL)
        same = state._replace(belief=Belief.uniform(np.repeat(state.belief.states[:1], 49, axis=0)))
        _, info = planning.observe(peg, planning_settings(49), same, 0, [4.0])
        assert info.resampled

    def test_unexplained_observation(self, problem: Problem) -> None:
        """A million metres away: the belief stays valid, and the robot is told."""
        configured = planning_settings()
        state = planning.initial_state(problem, configured, SEED, TRIAL)
        for sensing_action in range(len(problem.sensing_actions)):
            size = problem.observation_mean(state.belief.states, sensing_action).shape[-1]
            for sign in (1.0, -1.0):
                after, info = planning.observe(
                    problem, configured, state, sensing_action, np.full(size, sign * 1e6)
                )
                assert not info.explained
                assert 1.0 <= info.effective_sample_size <= 40.0 + 1e-9
                again = decode_checkpoint(encode_checkpoint(after))
                assert digest(again) == digest(after)
                action, _ = planning.choose_task_action(problem, configured, after)
                assert np.isfinite(action).all()

    def test_task_action(self, problem: Problem) -> None:
        configured = planning_settings()
        state = planning.initial_state(problem, configured, SEED, TRIAL)
        action, info = planning.choose_task_action(problem, configured, state)
        mean = estimate(state.belief)
        assert info.estimate.tolist() == mean.tolist()
        assert info.stage == int(problem.next_stage(mean, state.stage))
        assert info.commanded.tolist() == problem.policy(mean, info.stage).tolist()
        assert action.tolist() == problem.execute(info.commanded).tolist()

    def test_task_action_of_the_most_likely_particle(self, problem: Problem) -> None:
        configured = msgspec.structs.replace(
            planning_settings(),
            particle_filter=ParticleFilterSettings(num_particles=40, estimate="most_likely"),
        )
        state = planning.initial_state(problem, configured, SEED, TRIAL)
        weights = np.ones(40)
        weights[[7, 9]] = 3.0
        weighted = state._replace(belief=Belief.weighted(state.belief.states, weights))
        action, info = planning.choose_task_action(problem, configured, weighted)
        likely = state.belief.states[7]
        assert info.estimate.tolist() == likely.tolist()
        assert not np.shares_memory(info.estimate, state.belief.states)
        stage = int(problem.next_stage(likely, state.stage))
        assert action.tolist() == problem.execute(problem.policy(likely, stage)).tolist()
        assert planning.advance(problem, configured, weighted, action).stage == stage
        # Of equals the first.
        _, info = planning.choose_task_action(problem, configured, state)
        assert info.estimate.tolist() == state.belief.states[0].tolist()

    def test_advance(self, problem: Problem) -> None:
        configured = planning_settings()
        state = planning.initial_state(problem, configured, SEED, TRIAL)
        weighted = state._replace(
            sensed=True, belief=Belief.weighted(state.belief.states, np.arange(1.0, 41.0))
        )
        action, info = planning.choose_task_action(problem, configured, weighted)
        after = planning.advance(problem, configured, weighted, action)
        assert after[:5] == (SEED, TRIAL, 1, info.stage, False)
        assert after.belief.weights.tolist() == weighted.belief.weights.tolist()
        draws = stream(SEED, TRIAL, 0, Purpose.PREDICTION)
        moved = problem.move(weighted.belief.states, action, draws)
        assert after.belief.states.tobytes() == moved.tobytes()

    def test_random_numbers_are_named_by_the_state(self, problem: Problem) -> None:
        """Seed, trial, step and purpose, and nothing else."""
        configured = planning_settings()
        start = planning.initial_state(problem, configured, SEED, TRIAL)
        state = start._replace(step=8)

        def named(purpose: Purpose) -> Stream:
            return stream(SEED, TRIAL, 8, purpose)

        index, info = planning.choose_sensing_action(problem, configured, state)
        hypotheses, selection = named(Purpose.HYPOTHESES), named(Purpose.SELECTION)
        expected_index, expected = choose_sensing_action(
            problem, configured, state.belief, 0, hypotheses, selection
        )
        assert info.samples is not None
        assert expected.samples is not None
        assert (index, info.samples.tobytes()) == (expected_index, expected.samples.tobytes())

        observation = problem.observation_mean(state.belief.states, index)[0]
        after, _ = planning.observe(problem, configured, state, index, observation)
        updated, _ = update(problem, state.belief, index, observation)
        resampled = resample(updated, named(Purpose.RESAMPLING))
        assert after.belief.states.tobytes() == resampled.states.tobytes()

        action = problem.execute(np.full(problem.action_size, 0.02))
        moved = problem.move(state.belief.states, action, named(Purpose.PREDICTION))
        advanced = planning.advance(problem, configured, state, action)
        assert advanced.belief.states.tobytes() == moved.tobytes()

        random = msgspec.structs.replace(configured, selector=SelectorSettings(method="random"))
        chosen, _ = planning.choose_sensing_action(problem, random, state)
        count = len(problem.sensing_actions)
        assert chosen == int(float(selection.uniform()) * count)

    def test_stages_advance_once_a_step(self) -> None:
        """By the estimate, and one at a time, however far it is already."""
        problem = registry.problem_class("capsule_robot").from_settings({}, {})
        configured = planning_settings()
        state = planning.initial_state(problem, configured, SEED, TRIAL)
        via_point = Belief.uniform(np.repeat([[4.5, 2.5]], 40, axis=0))
        there = state._replace(belief=via_point)
        action, info = planning.choose_task_action(problem, configured, there)
        assert info.stage == 1
        assert planning.advance(problem, configured, there, action).stage == 1


class TestDigest:
    def test_every_field_counts(self, peg: Problem) -> None:
        state = planning.initial_state(peg, planning_settings(), SEED, TRIAL)
        states, weights = state.belief

        def changed(array: FloatArray, *at: int) -> FloatArray:
            other = array.copy()
            other[at] = np.nextafter(other[at], np.inf)
            return other

        others = [
            state._replace(seed=SEED + 1),
            state._replace(trial=TRIAL + 1),
            state._replace(step=1),
            state._replace(stage=1),
            state._replace(sensed=True),
            *(
                state._replace(belief=Belief(changed(states, n, c), weights))
                for n in (0, 17, 39)
                for c in range(3)
            ),
            *(state._replace(belief=Belief(states, changed(weights, n))) for n in (0, 17, 39)),
            state._replace(belief=Belief(states[::-1].copy(), weights)),
            state._replace(belief=Belief(states.reshape(60, 2), np.full(60, 1.0 / 60.0))),
            state._replace(belief=Belief(states[:-1].copy(), weights[:-1].copy())),
        ]
        digests = {digest(state), *map(digest, others)}
        assert len(digests) == 1 + len(others)
        assert all(len(found) == 32 for found in digests)

    def test_it_is_about_values_and_not_about_memory(self, peg: Problem) -> None:
        state = planning.initial_state(peg, planning_settings(), SEED, TRIAL)
        states, weights = state.belief
        for same in (
            Belief(states.copy(), weights.copy()),
            Belief(np.asfortranarray(states), weights),
            Belief(np.repeat(states, 2, axis=0)[::2], np.repeat(weights, 2)[::2]),
            Belief(states.astype(">f8"), weights.astype(">f8")),
        ):
            assert digest(state._replace(belief=same)) == digest(state)

    def test_golden(self) -> None:
        """A change here makes every digest ever written worthless."""
        belief = Belief(np.array([[1.0, -2.5], [0.0, 1e-300]]), np.array([0.25, 0.75]))
        state = PlanningState(seed=1, trial=2, step=3, stage=4, sensed=True, belief=belief)
        assert digest(state).hex() == GOLDEN_DIGEST


class TestCheckpoint:
    def test_its_arrays_are_copied_once(self) -> None:
        """And that by NumPy, which lets other threads go on meanwhile."""
        count = 100_000
        belief = Belief(np.zeros((count, 3)), np.full(count, 1.0 / count))
        data = encode_checkpoint(PlanningState(0, 0, 0, 0, False, belief))
        tracemalloc.start()
        try:
            decode_checkpoint(data)
            _, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert peak < 1.5 * len(data)

    def test_round_trip(self, problem: Problem) -> None:
        configured = planning_settings(resampling_threshold=0.0)
        state = planning.initial_state(problem, configured, SEED, TRIAL)
        size = problem.observation_mean(state.belief.states, 0).shape[-1]
        sensed, _ = planning.observe(problem, configured, state, 0, np.full(size, 1.0))
        largest = state._replace(seed=2**63 - 1, trial=2**32 - 1, step=2**32 - 1, stage=2**32 - 1)
        for original in (state, sensed, largest):
            data = encode_checkpoint(original)
            again = decode_checkpoint(data)
            assert again[:5] == original[:5]
            assert type(again.sensed) is bool
            assert digest(again) == digest(original)
            assert again.belief.states.dtype == np.float64
            assert again.belief.states.flags.c_contiguous
            assert encode_checkpoint(again) == data

    def test_every_truncation_is_refused(self, peg: Problem) -> None:
        data = encode_checkpoint(planning.initial_state(peg, planning_settings(10), SEED, TRIAL))
        for length in range(len(data)):
            with pytest.raises(CheckpointError):
                decode_checkpoint(data[:length])
        for more in (b"\0", b"\xc0", data):
            with pytest.raises(CheckpointError):
                decode_checkpoint(data + more)

    @settings(max_examples=300, deadline=None, derandomize=True)
    @given(
        places=some.lists(some.integers(0, 10**6), min_size=1, max_size=4),
        values=some.lists(some.integers(0, 255), min_size=4, max_size=4),
        head=some.booleans(),
    )
    def test_corruption_is_refused_or_gives_a_valid_state(
        self, places: list[int], values: list[int], head: bool
    ) -> None:
        """Some bytes changed, in the head (of 40 bytes) or anywhere."""
        state = planning.initial_state(PegInHole2D(), planning_settings(6), SEED, TRIAL)
        data = bytearray(encode_checkpoint(state))
        for place, value in zip(places, values, strict=False):
            data[place % (40 if head else len(data))] = value
        self.assert_refused_or_valid(bytes(data))

    @settings(max_examples=200, deadline=None, derandomize=True)
    @given(data=some.binary(max_size=300))
    def test_noise_is_refused_or_gives_a_valid_state(self, data: bytes) -> None:
        self.assert_refused_or_valid(data)

    @settings(max_examples=200, deadline=None, derandomize=True)
    @given(
        fields=some.lists(
            some.one_of(
                some.none(),
                some.booleans(),
                some.integers(-(2**63), 2**64 - 1),
                some.floats(),
                some.binary(max_size=48),
                some.text(max_size=5),
                some.lists(some.integers(0, 9), max_size=3),
            ),
            max_size=12,
        )
    )
    def test_other_messages_are_refused(self, fields: list[object]) -> None:
        self.assert_refused_or_valid(msgspec.msgpack.encode(fields))
        self.assert_refused_or_valid(msgspec.msgpack.encode([1, *fields]))

    def assert_refused_or_valid(self, data: bytes) -> None:
        try:
            state = decode_checkpoint(data)
        except CheckpointError:
            return
        states, weights = state.belief
        assert states.ndim == 2
        assert states.size > 0
        assert weights.shape == states.shape[:1]
        assert np.isfinite(states).all()
        assert (weights >= 0.0).all()
        assert abs(weights.sum() - 1.0) < 1e-6
        assert digest(decode_checkpoint(encode_checkpoint(state))) == digest(state)

    @pytest.mark.parametrize(
        ("field", "value", "text"),
        [
            (0, 2, "checkpoint version 2: this holdfast reads 1"),
            (0, 0, "checkpoint version 0"),
            (1, -1, r"no checkpoint.*>= 0.*\[1\]"),
            (1, 2**63, r"no checkpoint"),
            (2, 2**32, rf"<= {2**32 - 1}.*\[2\]"),
            (3, -1, r">= 0.*\[3\]"),
            (4, 2**32, rf"<= {2**32 - 1}.*\[4\]"),
            (5, 1, r"bool.*\[5\]"),
            (6, 0, r">= 1.*\[6\]"),
            (6, 10_000_001, r"<= 10000000.*\[6\]"),
            (6, 9, "9 particles of 3 coordinates has 240 and 80 bytes: need 216 and 72"),
            (7, 0, r">= 1.*\[7\]"),
            (7, 2, "10 particles of 2 coordinates has 240 and 80 bytes: need 160 and 80"),
            (8, np.full(30, np.nan).tobytes(), "a state that is not finite"),
            (8, np.full(30, -np.inf).tobytes(), "a state that is not finite"),
            (9, np.full(10, -0.1).tobytes(), "weights that are negative or sum to -1"),
            (9, np.full(10, 0.2).tobytes(), "weights .* sum to 2"),
            (9, np.zeros(10).tobytes(), "weights .* sum to 0"),
            (9, np.array([np.nan] + [0.1] * 9).tobytes(), "weights .* sum to nan"),
            (9, np.array([np.inf] + [0.0] * 9).tobytes(), "weights .* sum to inf"),
            (9, np.array([1e308] * 10).tobytes(), "weights .* sum to inf"),
            (9, np.array([np.inf, -np.inf] * 5).tobytes(), "weights .* sum to nan"),
        ],
    )
    def test_bounds(self, peg: Problem, field: int, value: object, text: str) -> None:
        state = planning.initial_state(peg, planning_settings(10), SEED, TRIAL)
        fields = msgspec.msgpack.decode(encode_checkpoint(state))
        fields[field] = value
        with pytest.raises(CheckpointError, match=text):
            decode_checkpoint(msgspec.msgpack.encode(fields))

    @pytest.mark.parametrize("count", [0, 1, 9, 11])
    def test_other_numbers_of_fields(self, peg: Problem, count: int) -> None:
        state = planning.initial_state(peg, planning_settings(10), SEED, TRIAL)
        fields = msgspec.msgpack.decode(encode_checkpoint(state))
        with pytest.raises(CheckpointError, match="no checkpoint"):
            decode_checkpoint(msgspec.msgpack.encode([*fields, 0, 0][:count]))


class Broken(PegInHole2D):
    """A peg whose functions return what they are told to."""

    def __init__(self, **returned: FloatArray) -> None:
        super().__init__()
        self.returned = returned

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        return self.returned.get("initial_states", super().initial_states(stream, count))

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        return self.returned.get("move", super().move(states, actions, stream))

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        return self.returned.get("policy", super().policy(states, stage))


class TestBadInput:
    @pytest.mark.parametrize("count", [0, -3, 10_000_001])
    def test_number_of_particles(self, peg: Problem, count: int) -> None:
        """Settings made by hand are not validated: the first function that uses them is."""
        with pytest.raises(
            InvalidValueError, match=rf"particle_filter\.num_particles {count}: allowed are 1 to 1"
        ):
            planning.initial_state(peg, planning_settings(count), SEED, TRIAL)

    @pytest.mark.parametrize(
        ("seed", "trial", "text"),
        [
            (-1, 0, "seed -1: allowed are 0"),
            (2**63, 0, f"seed {2**63}: allowed are 0"),
            (0, -1, "trial -1"),
            (0, 2**32, f"trial {2**32}"),
        ],
    )
    def test_seed_and_trial(self, peg: Problem, seed: int, trial: int, text: str) -> None:
        with pytest.raises(InvalidValueError, match=text):
            planning.initial_state(peg, planning_settings(), seed, trial)

    @pytest.mark.parametrize("sensing_action", [-1, 3, 100])
    def test_sensing_action(self, peg: Problem, sensing_action: int) -> None:
        state = planning.initial_state(peg, planning_settings(), SEED, TRIAL)
        with pytest.raises(
            InvalidValueError, match=rf"sensing action {sensing_action}: peg_in_hole_2d has 0 to 2"
        ):
            planning.observe(peg, planning_settings(), state, sensing_action, [1.0])

    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
    def test_observation(self, peg: Problem, bad: float) -> None:
        state = planning.initial_state(peg, planning_settings(), SEED, TRIAL)
        before = digest(state)
        with pytest.raises(InvalidValueError, match=rf"observation \[ *{bad}\]: every coordinate"):
            planning.observe(peg, planning_settings(), state, 0, [bad])
        with pytest.raises(InvalidValueError, match=r"observation of 2 coordinates.* gives 1"):
            planning.observe(peg, planning_settings(), state, 0, [1.0, 2.0])
        assert digest(state) == before

    @pytest.mark.parametrize(
        "action", [[np.nan, 0.0, 0.0], [0.0, np.inf, 0.0], [0.0, 0.0], [0.0] * 4, 0.0, [[0.0] * 3]]
    )
    def test_task_action(self, peg: Problem, action: object) -> None:
        state = planning.initial_state(peg, planning_settings(), SEED, TRIAL)
        with pytest.raises(InvalidValueError, match=r"task action .* needs 3 finite coordinates"):
            planning.advance(peg, planning_settings(), state, action)  # type: ignore[arg-type]

    @pytest.mark.parametrize("bad", [np.nan, np.inf])
    @pytest.mark.parametrize("function", ["initial_states", "move"])
    def test_states_not_finite(self, peg: Problem, function: str, bad: float) -> None:
        configured = planning_settings()
        state = planning.initial_state(peg, configured, SEED, TRIAL)
        states = state.belief.states.copy()
        states[7, 1] = bad
        broken = Broken(**{function: states})
        with pytest.raises(ProblemError, match=rf"{function} of peg_in_hole_2d put particle 7 at"):
            if function == "move":
                planning.advance(broken, configured, state, np.zeros(3))
            else:
                planning.initial_state(broken, configured, SEED, TRIAL)

    @pytest.mark.parametrize(
        "states", [np.zeros((39, 3)), np.zeros((40, 2)), np.zeros(40), np.zeros((40, 3), np.int64)]
    )
    @pytest.mark.parametrize("function", ["initial_states", "move"])
    def test_states_of_another_form(self, peg: Problem, function: str, states: FloatArray) -> None:
        configured = planning_settings()
        state = planning.initial_state(peg, configured, SEED, TRIAL)
        broken = Broken(**{function: states})
        with pytest.raises(ProblemError, match=rf"{function} of .* returned .* need a float64 arr"):
            if function == "move":
                planning.advance(broken, configured, state, np.zeros(3))
            else:
                planning.initial_state(broken, configured, SEED, TRIAL)

    @pytest.mark.parametrize("bad", [np.nan, np.inf])
    def test_policy_not_finite(self, peg: Problem, bad: float) -> None:
        state = planning.initial_state(peg, planning_settings(), SEED, TRIAL)
        broken = Broken(policy=np.array([0.0, np.nan, bad]))
        with pytest.raises(ProblemError, match="policy of peg_in_hole_2d gives"):
            planning.choose_task_action(broken, planning_settings(), state)

    def test_the_last_step_of_all(self, peg: Problem) -> None:
        """Steps are words of 32 bits; the stream of the one after the last is refused."""
        configured = planning_settings()
        state = planning.initial_state(peg, configured, SEED, TRIAL)
        last = planning.advance(peg, configured, state._replace(step=2**32 - 1), np.zeros(3))
        with pytest.raises(InvalidValueError, match=rf"step {2**32}: allowed are 0 to {2**32 - 1}"):
            planning.advance(peg, configured, last, np.zeros(3))


class TestCheckState:
    def test_a_state_of_its_own_problem_passes(self) -> None:
        problem, settings = PegInHole2D(), PlanningSettings()
        planning.check_state(problem, settings, planning.initial_state(problem, settings, 1, 2))

    def test_what_does_not_fit_is_named(self) -> None:
        problem, settings = PegInHole2D(), PlanningSettings()
        state = planning.initial_state(problem, settings, 1, 2)
        with pytest.raises(InvalidValueError, match=r"stage 1: peg_in_hole_2d has 0 to 0"):
            planning.check_state(problem, settings, state._replace(stage=1))
        with pytest.raises(InvalidValueError, match=r"of 3 coordinates: capsule_robot has 2"):
            planning.check_state(CapsuleRobot(), settings, state)
        other = PlanningSettings(particle_filter=ParticleFilterSettings(num_particles=7))
        with pytest.raises(InvalidValueError, match=r"of 300 particles.*num_particles is 7"):
            planning.check_state(problem, other, state)
