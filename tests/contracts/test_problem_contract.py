"""What every registered problem promises, checked for each of them.

A problem of your own can be put through the same checks: register it, and it is.
"""

from functools import partial
from typing import Any

import numpy as np
import pytest

from holdfast.config import registry
from holdfast.numerics.arrays import FloatArray, IntArray
from holdfast.numerics.randomness import Purpose, stream
from holdfast.problems.problem import Problem

SEED = 11
LEADING_SHAPES = [(), (1,), (13,), (3, 5), (2, 3, 4), (0,)]
MOVED: dict[tuple[Any, tuple[int, ...]], FloatArray] = {}
initial = partial(stream, SEED, 0, 0, Purpose.INITIAL_BELIEF)  # anew at each call
OF_EXPERIMENTS = [
    "studies.light_dark:LightDark",
    "studies.busy_room:BusyRoom",
    "studies.vdp_tag:VdpTag",
]
BATCHED = ["studies.two_ends:TwoCues", "studies.two_ends:TMaze", "studies.two_ends:Sorting"]
motion = partial(stream, SEED, 0, 0, Purpose.PREDICTION)  # anew at each call


@pytest.fixture(scope="module", params=[*registry.names(), *OF_EXPERIMENTS])
def problem(request: pytest.FixtureRequest) -> Problem:
    built = registry.problem_class(request.param).from_settings({}, {})
    assert isinstance(built, Problem)
    return built


def some_states(problem: Problem, leading: tuple[int, ...]) -> FloatArray:
    """Return states from all along the way."""
    if (problem, leading) not in MOVED:
        MOVED[problem, leading] = moved_states(problem, leading)
    return MOVED[problem, leading].copy()


def moved_states(problem: Problem, leading: tuple[int, ...]) -> FloatArray:
    """Return states that have started, and then were moved by the policy for a while."""
    count = int(np.prod(leading, dtype=int))
    states = problem.initial_states(initial(), count)
    for step in range(30):
        actions = problem.limit_action(problem.policy(states, 0))
        states = problem.move(states, actions, motion().substream(step))
    return states.reshape(*leading, problem.state_size)


def some_stages(problem: Problem, leading: tuple[int, ...]) -> IntArray:
    count = int(np.prod(leading, dtype=int))
    return (np.arange(count, dtype=np.int64) % problem.num_stages).reshape(leading)


def test_attributes(problem: Problem) -> None:
    if problem.name in registry.names():
        assert type(problem) is registry.problem_class(problem.name)
    assert problem.state_size >= 1
    assert problem.action_size >= 1
    assert problem.num_stages >= 1
    assert len(problem.sensing_actions) >= 1
    assert all(isinstance(label, str) and label for label in problem.sensing_actions)
    assert len(set(problem.sensing_actions)) == len(problem.sensing_actions)
    assert len(problem.state_labels) == problem.state_size
    assert np.shape(problem.resolution) in {(), (problem.action_size,)}
    assert np.all(np.asarray(problem.resolution) > 0.0)
    assert np.isfinite(problem.resolution).all()
    assert problem.motion_variance.shape == (problem.action_size,)
    assert (problem.motion_variance >= 0.0).all()


def test_initial_states(problem: Problem) -> None:
    states = problem.initial_states(initial(), 50)
    assert states.shape == (50, problem.state_size)
    assert states.dtype == np.float64
    assert np.isfinite(states).all()
    assert len(np.unique(states, axis=0)) == 50
    assert problem.initial_states(initial(), 50).tobytes() == states.tobytes()
    assert problem.initial_states(initial(), 20).tobytes() == states[:20].tobytes()
    assert problem.initial_states(initial().substream(1), 50).tobytes() != states.tobytes()


@pytest.mark.parametrize("leading", LEADING_SHAPES)
def test_shapes_and_kinds(problem: Problem, leading: tuple[int, ...]) -> None:
    states = some_states(problem, leading)
    stages = some_stages(problem, leading)
    actions = problem.policy(states, stages)
    executed = problem.limit_action(actions)
    moved = problem.move(states, executed, motion())
    for array, size in (
        (actions, problem.action_size),
        (executed, problem.action_size),
        (moved, problem.state_size),
    ):
        assert array.shape == (*leading, size)
        assert array.dtype == np.float64
        assert np.isfinite(array).all()
    reward = np.asarray(problem.reward(moved, executed))
    assert reward.shape == leading
    assert reward.dtype == np.float64
    goal = np.asarray(problem.is_goal(states))
    assert goal.shape == leading
    assert goal.dtype == np.bool_
    following = np.asarray(problem.next_stage(states, stages))
    assert following.shape == leading
    assert np.issubdtype(following.dtype, np.integer)


@pytest.mark.parametrize("leading", LEADING_SHAPES)
def test_observations(problem: Problem, leading: tuple[int, ...]) -> None:
    states = some_states(problem, leading)
    for sensing_action in range(len(problem.sensing_actions)):
        mean = problem.observation_mean(states, sensing_action)
        variance = problem.observation_variance(states, sensing_action)
        assert mean.shape[:-1] == leading
        assert mean.shape[-1] >= 1
        assert variance.shape in {mean.shape, mean.shape[-1:]}
        assert np.isfinite(mean).all()
        assert (variance > 0.0).all()
        assert np.isfinite(variance).all()


@pytest.mark.parametrize("place", BATCHED)
def test_likelihoods_of_several_observations_are_those_of_each(place: str) -> None:
    several: Any = registry.problem_class(place).from_settings({}, {})
    states = some_states(several, (50,))
    for sensing_action in range(len(several.sensing_actions)):
        observations = np.array(
            [
                several.sample_observation(state, sensing_action, motion().substream(number))
                for number, state in enumerate(states[:7])
            ]
        )
        together = several.log_likelihoods(states, sensing_action, observations)
        for own, observation in zip(together, observations, strict=True):
            alone = several.log_likelihood(states, sensing_action, observation)
            assert own.tobytes() == alone.tobytes()


def test_a_batch_is_its_elements(problem: Problem) -> None:
    states = some_states(problem, (40,))
    stages = some_stages(problem, (40,))
    actions = problem.policy(states, stages)
    executed = problem.limit_action(actions)
    rewards = problem.reward(states, executed)
    goals = problem.is_goal(states)
    following = np.asarray(problem.next_stage(states, stages))
    sensing_actions = range(len(problem.sensing_actions))
    means = [problem.observation_mean(states, each) for each in sensing_actions]
    for n, state in enumerate(states):
        stage = int(stages[n])
        assert problem.policy(state, stage).tobytes() == actions[n].tobytes()
        assert problem.limit_action(actions[n]).tobytes() == executed[n].tobytes()
        assert problem.reward(state, executed[n]) == rewards[n]
        assert problem.is_goal(state) == goals[n]
        assert problem.next_stage(state, stage) == following[n]
        for each in sensing_actions:
            assert problem.observation_mean(state, each).tobytes() == means[each][n].tobytes()


def test_one_stage_for_a_belief_each(problem: Problem) -> None:
    states = some_states(problem, (4, 6))
    stages = some_stages(problem, (4,))
    together = problem.policy(states, stages[:, np.newaxis])
    for trial in range(4):
        alone = problem.policy(states[trial], int(stages[trial]))
        assert alone.tobytes() == together[trial].tobytes()


def test_motion_is_a_function_of_state_action_and_stream(problem: Problem) -> None:
    states = some_states(problem, (64,))
    actions = problem.limit_action(problem.policy(states, 0))
    moved = problem.move(states, actions, motion())
    assert problem.move(states, actions, motion()).tobytes() == moved.tobytes()
    assert problem.move(states, actions, motion().substream(7)).tobytes() != moved.tobytes()
    # The first particles move as they would without the others.
    assert problem.move(states[:9], actions[:9], motion()).tobytes() == moved[:9].tobytes()
    # One action for all is that action for each.
    shared = problem.move(states, actions[0], motion())
    repeated = problem.move(states, np.tile(actions[0], (64, 1)), motion())
    assert shared.tobytes() == repeated.tobytes()


def test_the_noise_has_the_stated_variance(problem: Problem) -> None:
    # Of particles that start in one place, many are free to move: their spread is the noise's.
    count = 4000
    start = problem.initial_states(initial(), 1)
    spread = problem.move(
        np.repeat(start, count, axis=0), np.zeros(problem.action_size), motion()
    ).var(axis=0)
    # Walls can only cut the noise off. Five standard errors above is one false alarm in 10^6.
    spread = spread[: problem.action_size]  # of what is acted on
    assert (spread <= problem.motion_variance * (1.0 + 5.0 * np.sqrt(2.0 / count))).all()
    assert (spread >= 0.1 * problem.motion_variance).all()


def test_limits_are_limits(problem: Problem) -> None:
    commanded = initial().normal((200, problem.action_size))
    executed = problem.limit_action(commanded)
    np.testing.assert_allclose(problem.limit_action(executed), executed, rtol=1e-15)
    larger = np.abs(problem.limit_action(1e6 * commanded))
    assert (np.abs(executed) <= larger.max(axis=0) * (1.0 + 1e-15)).all()
    assert (executed * commanded >= 0.0).all()


def test_stages_advance_one_by_one_to_the_last(problem: Problem) -> None:
    states = some_states(problem, (200,))
    for stage in range(problem.num_stages):
        stages = np.full(200, stage, dtype=np.int64)
        following = np.asarray(problem.next_stage(states, stages))
        assert (following >= stage).all()
        assert (following <= min(stage + 1, problem.num_stages - 1)).all()
    single = problem.next_stage(states[0], 0)
    assert isinstance(single, int)


def test_nothing_changes_its_arguments(problem: Problem) -> None:
    states = some_states(problem, (20,))
    stages = some_stages(problem, (20,))
    actions = problem.limit_action(problem.policy(states, stages))
    for array in (states, stages, actions):
        array.setflags(write=False)
    problem.policy(states, stages)
    problem.limit_action(actions)
    problem.next_stage(states, stages)
    problem.reward(states, actions)
    problem.is_goal(states)
    moved = problem.move(states, actions, motion())
    assert not np.shares_memory(moved, states)


def test_the_task_can_be_done(problem: Problem) -> None:
    """With the state known, the policy reaches the goal in most trials."""
    trials = 20
    states = problem.initial_states(initial(), trials)
    stages: int | IntArray = np.zeros(trials, dtype=np.int64)
    done = np.zeros(trials, dtype=bool)
    assert not problem.is_goal(states).any()
    for step in range(1500):
        stages = problem.next_stage(states, stages)
        actions = problem.limit_action(problem.policy(states, stages))
        states = problem.move(states, actions, motion().substream(step))
        done |= problem.is_goal(states)
        if done.all():
            break
    assert done.mean() >= 0.9


def test_scene(problem: Problem) -> None:
    scene = problem.scene()
    if scene is None:
        return
    assert len(set(scene.axes)) == 2
    assert all(0 <= axis < problem.state_size for axis in scene.axes)
    x_min, y_min, x_max, y_max = scene.limits
    assert x_min < x_max
    assert y_min < y_max
    assert (scene.obstacles[:, :2] < scene.obstacles[:, 2:]).all()
    assert scene.angle is None or 0 <= scene.angle < problem.state_size


def test_the_defaults_can_be_written_out_and_read_in(problem: Problem) -> None:
    if not hasattr(problem, "model"):
        pytest.skip("takes plain keyword arguments")
    built = registry.problem_class(problem.name)
    import msgspec

    again = built.from_settings(
        msgspec.to_builtins(problem.model),
        msgspec.to_builtins(problem.state_space_planner),  # type: ignore[attr-defined]
    )
    states = some_states(problem, (10,))
    assert again.policy(states, 0).tobytes() == problem.policy(states, 0).tobytes()
    assert again.initial_states(initial(), 10).tobytes() == (
        problem.initial_states(initial(), 10).tobytes()
    )
