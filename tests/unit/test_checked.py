"""What a problem's functions return is checked where it is used."""

import copy
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.line_problem import SETTINGS, Line

from holdfast.errors import ProblemError
from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.randomness import Stream
from holdfast.planning.planner import Planner
from holdfast.planning.settings import SelectorSettings
from holdfast.problems import checked
from holdfast.robot.environment import SimulatedEnvironment


def run_a_step(problem: Any) -> None:
    environment = SimulatedEnvironment(problem, 0, 0)
    planner = Planner(problem, SETTINGS)
    state = planner.init(0, 0)
    action, _ = planner.choose_sensing_action(state)
    state, _ = planner.observe(state, action, environment.perform_sensing(action))
    task_action, _ = planner.choose_task_action(state)
    environment.perform(task_action)
    environment.is_done()
    planner.advance(state, task_action)


@pytest.mark.parametrize(
    ("found", "need"),
    [
        ([np.zeros((1, 4, 2)), np.zeros((1, 4), np.int64)], "need a tuple of two arrays$"),
        ((np.zeros((1, 4)), None), r"need a float64 array of shape \(1, 4, 2\)$"),
        ((np.zeros((1, 4, 2)), np.zeros((1, 4))), r"need an array of integers of shape \(1, 4\)$"),
    ],
)
def test_what_a_path_must_be(found: object, need: str) -> None:
    problem: Any = type("Wrong", (Line,), {"expected_path": lambda *_: found})()
    with pytest.raises(ProblemError, match=f"^expected_path of line returned .*: {need}"):
        checked.expected_path(problem, np.zeros((4, 2)), 0, (3,), 1)


@pytest.mark.parametrize(
    ("found", "observations", "message"),
    [
        (np.zeros(4), [[1.0], [2.0]], r"returned float64 of shape \(4,\): need .* \(2, 4\)$"),
        (
            np.array([[0.0] * 4, [0.0, -np.inf, np.nan, 0.0]]),
            [[1.0], [2.0]],
            r"log_likelihoods of line, observation \[2\.\] under sensing action 1, is NaN",
        ),
        (np.zeros((2, 4)), [[1.0], [2.0, 3.0]], "of 1 and of 2 coordinates under sensing action 1"),
    ],
)
def test_what_likelihoods_at_once_must_be(found: Any, observations: Any, message: str) -> None:
    problem: Any = type("Wrong", (Line,), {"log_likelihoods": lambda *_: found})()
    with pytest.raises(ProblemError, match=message):
        checked.log_likelihoods(problem, np.zeros((4, 2)), 1, [np.array(o) for o in observations])


@pytest.mark.parametrize("function", ["policy", "move", "observation_mean"])
def test_a_function_cannot_change_the_belief(function: str) -> None:
    def in_place(_self: Line, states: FloatArray, *_: object) -> FloatArray:
        states += 1.0
        return states

    broken: Any = type("InPlace", (Line,), {function: in_place})()
    with pytest.raises(ValueError, match="read-only"):
        run_a_step(broken)


def huge(value: float) -> np.ndarray:
    return np.full(4000, value)


@pytest.mark.parametrize(
    ("attribute", "value", "message"),
    [
        ("observation_mean", lambda s, action: s[..., action], r"float64 of shape \(.*\): need"),
        ("observation_mean", lambda *_: np.zeros(1), "of sensing action 0 .* float64 of shape"),
        ("observation_variance", lambda *_: 0.01, r"action 0 of line .* float \(0.01\): need"),
        ("observation_variance", lambda *_: np.ones(2), r"float64 of shape \(2,\)"),
        ("observation_variance", lambda *_: np.ones(1, complex), r"complex128 of shape \(1,\)"),
        ("policy", lambda s, _: -s, r"float64 of shape \(30, 2\): need .* \(30, 1\)"),
        ("policy", lambda s, _: [[0.0]] * len(s), "policy of line returned list"),
        ("move", lambda *_: None, "move of line returned NoneType"),
        ("next_stage", lambda *_: 7, "next_stage of line is 7: allowed are 0 to 0"),
        ("reward", lambda *_: np.zeros(3), r"float64 of shape \(3,\): need one number"),
        ("is_goal", lambda *_: np.array([True]), "is_goal of line returned bool"),
        ("is_goal", lambda *_: np.float64(5.3), r"is .*5\.3.*: must be True or False"),
        ("is_failure", lambda *_: "wall", "is_failure of line returned str .*: need one number"),
        ("initial_states", lambda _, n: np.zeros((n, 2), np.int64), "of line returned int64"),
        ("motion_variance", huge(-1.0), r"is \[(-1\. ){4}\.\.\.( -1\.){4}\]: must"),
        ("motion_variance", ["a", "b"], r"is \['a' 'b'\]: must be 1 numbers >= 0"),
        ("sensing_actions", "x" * 4000, "is 'xxx.*: must be a sequence of labels"),
        ("sensing_actions", [1, 2], "has 1: labels must be text"),
        ("next_stage", lambda *_: 1e300, r"next_stage of .* is 1e\+300: allowed are 0 to 0"),
        ("next_stage", lambda *_: float("nan"), "next_stage of .* is nan: allowed are 0 to 0"),
        ("reward", lambda *_: object(), "reward of .* returned object .*: need one number"),
        ("is_goal", lambda *_: huge(1.0), r"is_goal of .* shape \(4000,\): need one number"),
        ("policy", lambda s, _: np.full((*s.shape[:-1], 1), np.nan), r"of line .*\[nan"),
        ("observation_mean", lambda s, _: np.full((*s.shape[:-1], 900), np.nan), r"is nan at \(0"),
        ("observation_variance", lambda *_: -np.ones(1), r"is -1\.0 at \(0,\) of shape \(1,\)"),
        ("sample_observation", lambda *_: "no", r"returned str \('no'\): need a float64 array"),
        ("sample_observation", lambda *_: huge(0.0), "returned .* of 4000 coordinates: need 1 to"),
        ("sample_observation", lambda *_: np.full(900, np.nan), r"\[nan nan nan nan \.\.\. nan"),
        ("log_likelihood", lambda s, *_: np.full(len(s), np.nan), "is NaN or plus infinity for a"),
    ],
)
def test_what_does_not_fit_is_named(attribute: str, value: object, message: str) -> None:
    """The function, the value and where it stands, on one short line, however large all is."""
    own = staticmethod(value) if callable(value) else value
    problem: Any = type("Wrong", (Line,), {attribute: own})()
    if attribute == "log_likelihood":
        problem.sample_observation = lambda *_: np.zeros(900)
    if attribute == "sample_observation":
        problem.log_likelihood = lambda states, *_: np.zeros(len(states))
    if attribute == "observation_mean":
        problem.observation_variance = lambda *_: np.ones(900)
    with pytest.raises(ProblemError, match=message) as refused:
        run_a_step(problem)
    assert f"{attribute} of " in str(refused.value)
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 300


class Rough(Line):
    """A problem whose functions draw several times, as a user of NumPy writes it."""

    def __init__(self) -> None:
        self.drawn: dict[str, list[Any]] = {}

    def note(self, function: str, *draws: FloatArray) -> None:
        self.drawn.setdefault(function, []).append([draw.tobytes() for draw in draws])

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        first, second = stream.normal(size=count), stream.normal(size=count)
        self.note("initial_states", first, second)
        return np.asarray(np.stack([first, second], axis=-1))

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        draws = [0.1 * stream.normal(size=states.shape) for _ in range(3)]
        self.note("move", *draws)
        return states + actions + draws[0] + draws[1] + draws[2]

    def expected_move(self, states: FloatArray, actions: FloatArray) -> FloatArray:
        return states + actions

    def log_likelihood(
        self, states: FloatArray, sensing_action: int, observation: FloatArray
    ) -> FloatArray:
        away = states[:, sensing_action] - observation[0]
        return np.asarray(-50.0 * away * away)

    def sample_observation(
        self, state: FloatArray, sensing_action: int, stream: Stream
    ) -> FloatArray:
        wrong, noise = stream.random(1), stream.normal(size=1)
        self.note("sample_observation", wrong, noise)
        return np.where(wrong < 0.1, 0.0, state[[sensing_action]] + 0.1 * noise)


class TestStreams:
    def test_each_call_has_a_stream_that_begins_anew_and_goes_on(self) -> None:
        once, again = Rough(), Rough()
        for problem in (once, again):
            run_a_step(problem)
            run_a_step(problem)
        assert set(once.drawn) == {"initial_states", "move", "sample_observation"}
        for function, calls in once.drawn.items():
            assert all(len(set(draws)) == len(draws) for draws in calls), function
            # The second run of the step drew what the first one did, and so did another problem.
            half = len(calls) // 2
            assert calls[:half] == calls[half:]
        assert again.drawn == once.drawn

    def test_noise_is_the_same_after_every_sensing_action(self) -> None:
        problem = Rough()
        selector = SelectorSettings(
            method="expected_return", rollout_steps=2, rollout_sensing_steps=1
        )
        planner = Planner(problem, msgspec.structs.replace(SETTINGS, selector=selector))
        planner.choose_sensing_action(planner.init(4))
        moves = problem.drawn["move"]
        assert moves
        assert moves[0::2] == moves[1::2]

    @pytest.mark.parametrize(
        "derive", [lambda own: own, lambda own: own.substream(1), Stream.anew, copy.copy]
    )
    def test_one_that_is_kept_is_refused(self, derive: Callable[[Stream], Stream]) -> None:
        class Keeping(Line):
            def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
                self.kept = getattr(self, "kept", derive(stream))
                return states + actions + self.kept.normal(size=states.shape)

        environment = SimulatedEnvironment(Keeping(), 0, 0)
        environment.perform(np.zeros(1))
        with pytest.raises(ProblemError, match="kept from an earlier call cannot be drawn from"):
            environment.perform(np.zeros(1))


class TestPredictions:
    @pytest.mark.parametrize("sizes", [(1, 1, 1), (1, 3, 2), (3, 1, 1), (2, 1, 4)])
    @pytest.mark.parametrize("varying", [(), (0,), (1,), (2,), (0, 1, 2)])
    def test_they_stand_one_below_the_other(
        self, sizes: tuple[int, ...], varying: tuple[int, ...]
    ) -> None:
        class Mixed(Line):
            sensing_actions = ("a", "b", "c")

            def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
                columns = np.arange(sizes[sensing_action])
                return np.asarray(states[..., :1] + 10.0 * sensing_action + columns)

            def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
                own = 0.1 * (1.0 + sensing_action) + np.arange(sizes[sensing_action])
                return np.asarray(own + states[..., :1] ** 2 if sensing_action in varying else own)

        states = np.random.default_rng(2).normal(size=(7, 2))
        found, means, variances = checked.predictions(Mixed(), states, range(3))
        assert found == list(sizes)
        assert variances.shape == (sum(sizes), 7 if varying else 1)
        each = [checked.prediction(Mixed(), states, action) for action in range(3)]
        assert means.tobytes() == np.vstack([mean.T for mean, _ in each]).tobytes()
        wide = [np.broadcast_to(variance, mean.shape).T for mean, variance in each]
        assert np.broadcast_to(variances, means.shape).tobytes() == np.vstack(wide).tobytes()
