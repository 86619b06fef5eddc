"""What every entry of the public interface takes for a number, and what it does not.

NumPy's integers and real numbers are numbers: they give what Python's give. A text, a truth value,
a date, an object or an entry that a mask hides is none: the error names it.
"""

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.line_problem import SETTINGS, Line

import holdfast as hf
from holdfast.numerics.randomness import Purpose, stream
from holdfast.planning.outcome import MoveResult, TrialResult

gymnasium = pytest.importorskip("gymnasium")

PEG = hf.make_problem("peg_in_hole_2d")
PLANNER = hf.Planner(PEG, particles=30)
STATE = PLANNER.init(1)
AFTER = PLANNER.advance(STATE, np.zeros(3))
CONFIGURATION = Path(__file__).parents[2] / "examples" / "peg_in_hole_2d.yaml"
INITIAL = stream(1, 0, 0, Purpose.INITIAL_BELIEF)
POINTS = np.linspace(0.0, 1.0, 20).reshape(10, 2)


class ShowsMoves(Line):
    """A line whose moves show their motion and an observation."""

    def move_by_measurement(self, states: Any, motion: Any, stream: Any) -> Any:
        return states + motion + 0.1 * stream.normal(states.shape)

    def move_log_likelihood(self, states: Any, action: Any, observation: Any) -> Any:
        return -0.5 * (states[..., 0] - observation[0] - 0.0 * action[0]) ** 2


LINE = hf.Planner(ShowsMoves(), SETTINGS)
LINE_STATE = LINE.init(1)


class World:
    """An environment of the user's that shows what a test wants."""

    def __init__(self, observation: Any = (0.5,), result: Any = None) -> None:
        self.observation, self.result = observation, result

    def perform_sensing(self, sensing_action: int) -> Any:
        return self.observation

    def perform(self, task_action: Any) -> Any:
        return self.result

    def is_done(self) -> bool:
        return False


def settings(**changes: Any) -> hf.PlanningSettings:
    return hf.PlanningSettings(particle_filter=hf.ParticleFilterSettings(**changes))


def encoded(planner: hf.Planner, *numbers: Any) -> bytes:
    return planner.encode(planner.init(*numbers))


def trial(planner: hf.Planner = LINE, *numbers: Any, world: Any = None, max_steps: Any = 3) -> str:
    ended: TrialResult = hf.run_trial(planner, *numbers, environment=world, max_steps=max_steps)
    return ended.digest


def world_after(seed: Any, number: Any, sensing_action: Any) -> Any:
    return hf.SimulatedEnvironment(PEG, seed, number).perform_sensing(sensing_action)


def gym_world(**arguments: Any) -> Any:
    world = hf.GymnasiumEnvironment("Pendulum-v1", [[0], [1]], **arguments)
    return np.concatenate([world.perform_sensing(0), world.perform_sensing(1)])


def problem_env(**arguments: Any) -> Any:
    from holdfast.robot.problem_env import ProblemEnv

    return ProblemEnv("peg_in_hole_2d", **{"particles": 30, "max_steps": 20, **arguments})


def reset(seed: Any, number: Any, action: Any) -> Any:
    env = problem_env()
    env.reset(seed=seed, options={"trial": number})
    return env.step(action)[0]


WHOLE: dict[str, tuple[Callable[[Any], Any], int]] = {
    "Planner(particles)": (lambda n: encoded(hf.Planner(PEG, particles=n), 1), 30),
    "settings": (lambda n: encoded(hf.Planner(PEG, settings(num_particles=n)), 1), 30),
    "init(seed)": (lambda n: encoded(PLANNER, n), 3),
    "init(trial)": (lambda n: encoded(PLANNER, 1, n), 3),
    "observe(sensing_action)": (lambda n: PLANNER.observe(STATE, n, [0.5]), 1),
    "plan_until_sensing": (lambda n: PLANNER.plan_until_sensing(AFTER, n), 2),
    "decide": (lambda n: PLANNER.decide(AFTER, n), 2),
    "make": (lambda n: hf.make_problem("peg_in_hole_2d", state_size=n).state_size, 3),
    "load(seed)": (lambda n: hf.load_configuration(CONFIGURATION, seed=n).to_yaml(), 3),
    "load(num_trials)": (lambda n: hf.load_configuration(CONFIGURATION, num_trials=n).to_yaml(), 3),
    "load(overrides)": (
        lambda n: hf.load_configuration(
            CONFIGURATION, overrides={"simulator.max_steps": n}
        ).to_yaml(),
        3,
    ),
    "run_trial(seed)": (lambda n: trial(LINE, n), 3),
    "run_trial(trial)": (lambda n: trial(LINE, 1, n), 3),
    "run_trial(max_steps)": (lambda n: trial(max_steps=n), 3),
    "SimulatedEnvironment(seed)": (lambda n: world_after(n, 0, 0), 3),
    "SimulatedEnvironment(trial)": (lambda n: world_after(0, n, 0), 3),
    "perform_sensing": (lambda n: world_after(0, 0, n), 1),
    "neighbors": (lambda n: hf.entropy(POINTS, None, hf.NearestNeighbor(n)), 3),
    "circular": (lambda n: hf.entropy(POINTS, circular=[n]), 1),
    "threads": (lambda n: hf.entropy(POINTS, threads=n), 1),
    "GymnasiumEnvironment(seed)": (lambda n: gym_world(seed=n), 3),
    "GymnasiumEnvironment(trial)": (lambda n: gym_world(trial=n), 3),
    "GymnasiumEnvironment.perform_sensing": (
        lambda n: hf.GymnasiumEnvironment("Pendulum-v1", [[0], [n]]).perform_sensing(n),
        1,
    ),
    "ProblemEnv(particles)": (lambda n: problem_env(particles=n).reset(seed=1)[0], 30),
    "ProblemEnv(max_steps)": (lambda n: problem_env(max_steps=n).reset(seed=1)[0], 20),
    "ProblemEnv.reset(seed)": (lambda n: reset(n, 0, 0), 3),
    "ProblemEnv.reset(trial)": (lambda n: reset(1, n, 0), 3),
    "ProblemEnv.step": (lambda n: reset(1, 0, n), 1),
}
"""A call of each entry that takes a whole number, and a number that it takes."""

NO_WHOLE = [True, 3.0, "3", np.ma.array(3, mask=True)]
"""One of each kind: unit/test_arrays.py has all, and here each entry has to look."""


def leaf(value: Any) -> Any:
    """Return what is compared: arrays as bytes."""
    if isinstance(value, np.ndarray):
        return value.tobytes()
    return tuple(map(leaf, value)) if isinstance(value, tuple | list) else value


@pytest.mark.parametrize("kind", [np.int64, np.array])
@pytest.mark.parametrize("name", WHOLE)
def test_a_whole_number_of_numpy_is_one(name: str, kind: Any) -> None:
    call, number = WHOLE[name]
    assert leaf(call(kind(number))) == leaf(call(number))


@pytest.mark.parametrize("wrong", NO_WHOLE, ids=repr)
@pytest.mark.parametrize("name", WHOLE)
def test_what_is_no_whole_number(name: str, wrong: Any) -> None:
    with pytest.raises(hf.HoldfastError):
        WHOLE[name][0](wrong)


REAL: dict[str, tuple[Callable[[Any], Any], Any]] = {
    "observe": (lambda x: PLANNER.observe(STATE, 0, x), [0.5]),
    "observe_move": (lambda x: LINE.observe_move(LINE_STATE, np.array([0.25]), x), [0.5]),
    "observe_move(task_action)": (lambda x: LINE.observe_move(LINE_STATE, x, [0.25]), [0.5]),
    "advance": (lambda x: PLANNER.advance(STATE, x), [0.5, 0.25, 0.0]),
    "advance(motion)": (lambda x: LINE.advance(LINE_STATE, np.array([0.5]), x), [0.5, 0.25]),
    "Belief.uniform": (lambda x: hf.Belief.uniform(x), [[0.5], [0.25]]),
    "Belief.weighted": (lambda x: hf.Belief.weighted([[0.5], [0.25]], x), [0.5, 0.25]),
    "SimulatedEnvironment.perform": (
        lambda x: hf.SimulatedEnvironment(PEG, 1).perform(x),
        [0.5, 0.25, 0.0],
    ),
    "entropy": (lambda x: hf.entropy(x, None, hf.NearestNeighbor(1)), [[0.5], [0.25], [4.0]]),
    "entropy(weights)": (
        lambda x: hf.entropy([[0.5], [0.25]], x, hf.NearestNeighbor(1)),
        [0.5, 0.25],
    ),
    "NearestNeighbor(resolution)": (
        lambda x: hf.entropy(POINTS, None, hf.NearestNeighbor(2, x)),
        [0.5, 0.25],
    ),
    "PriorNeighbors(prior)": (
        lambda x: hf.entropy([[0.5], [0.25], [4.0]], None, hf.PriorNeighbors(x, 1)),
        [0.5, 0.25, 0.25],
    ),
    "GaussianMixture(variance)": (
        lambda x: hf.entropy(POINTS, None, hf.GaussianMixture(x)),
        [0.5, 0.25],
    ),
    "make": (
        lambda x: hf.make_problem("peg_in_hole_2d", init_mean=x).initial_states(INITIAL.anew(), 3),
        [4.0, 2.0, 0.0],
    ),
    "load(overrides)": (
        lambda x: hf.load_configuration(CONFIGURATION, overrides={"model.init_mean": x}).to_yaml(),
        [4.0, 2.0, 0.0],
    ),
    "environment: sensing": (lambda x: trial(world=World(observation=x)), [0.5]),
    "environment: motion": (
        lambda x: trial(world=World(result=MoveResult(None, x, None))),
        [0.5, 0.25],
    ),
    "environment: observation": (
        lambda x: trial(world=World(result=MoveResult(None, None, x))),
        [0.5],
    ),
    "sensing_noise": (lambda x: gym_world(sensing_noise=x), [0.5, 0.25]),
    "GymnasiumEnvironment.perform": (
        lambda x: hf.GymnasiumEnvironment("Pendulum-v1", [[0]]).perform(x),
        [0.5],
    ),
}
"""A call of each entry that takes real numbers, and numbers that it takes."""


FORMS: dict[str, Callable[[Any], Any]] = {
    "tuple": lambda x: tuple(map(FORMS["tuple"], x)) if isinstance(x, list) else x,
    "float32": lambda x: np.array(x, np.float32),
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", REAL)
def test_real_numbers_of_numpy_are_numbers(name: str, form: str) -> None:
    call, numbers = REAL[name]
    assert leaf(call(FORMS[form](numbers))) == leaf(call(numbers))


WRONG: dict[str, Callable[[Any], Any]] = {
    "masked": lambda x: np.ma.array(x, mask=np.arange(np.size(x)).reshape(np.shape(x)) == 0),
    "texts": lambda x: np.array(x).astype(str),
    "list with a truth value": lambda x: [True, *x[1:]],
    "dates": lambda x: (4 * np.array(x)).astype("datetime64[s]"),
    "ragged": lambda x: [*x, [1.0, [2.0]]],
}


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("name", REAL)
def test_what_is_no_real_number(name: str, wrong: str) -> None:
    call, numbers = REAL[name]
    with pytest.raises(hf.HoldfastError):
        call(WRONG[wrong](numbers))


@pytest.mark.parametrize("number", [np.float32(0.01), np.float64(0.01), np.array(0.01)])
def test_one_real_number(number: Any) -> None:
    plain = float(number)
    for key in ("sensing_cov", "peg_width"):
        made = hf.make_problem("peg_in_hole_2d", **{key: number})
        assert leaf(made.observation_variance(np.zeros((1, 3)), 0)) == leaf(
            hf.make_problem("peg_in_hole_2d", **{key: plain}).observation_variance(
                np.zeros((1, 3)), 0
            )
        )
    found = hf.entropy(POINTS, None, hf.NearestNeighbor(2, number))
    assert found == hf.entropy(POINTS, None, hf.NearestNeighbor(2, plain))
    assert trial(world=World(result=number)) == trial(world=World(result=plain))


@pytest.mark.parametrize("wrong", ["0.5", True, np.ma.masked, Fraction(1, 2), [0.5], np.nan])
def test_a_reward_that_is_no_number(wrong: Any) -> None:
    with pytest.raises(
        hf.HoldfastError, match=r"perform returned .*; it must return a finite number, the reward"
    ):
        trial(world=World(result=wrong))


def test_the_error_names_value_and_limit() -> None:
    with pytest.raises(hf.HoldfastError, match=r"observation is '4\.0': must be real numbers"):
        PLANNER.observe(STATE, 0, "4.0")
    with pytest.raises(hf.HoldfastError, match="seed True: allowed are whole numbers from 0 to 92"):
        PLANNER.init(True)


@pytest.mark.parametrize(
    "function",
    [
        *("initial_states", "move", "observation_mean", "observation_variance", "policy"),
        *("limit_action", "reward", "sample_observation", "log_likelihood"),
    ],
)
def test_what_a_problem_returns_with_a_mask(function: str) -> None:
    """NumPy would go on with what the mask hides."""

    def masked(self: Any, *arguments: Any) -> Any:
        own = getattr(Sound, function)(self, *arguments)
        return np.ma.array(own, mask=np.arange(np.size(own)).reshape(np.shape(own)) == 0)

    general = function in ("sample_observation", "log_likelihood")
    kind = type("Masked", (Sound if general else Gaussian,), {function: masked})
    with pytest.raises(hf.HoldfastError, match=f"{function} "):
        trial(hf.Planner(kind(), SETTINGS))


def test_a_mask_that_hides_nothing_goes_no_further() -> None:
    drawn = np.ma.array(np.zeros((SETTINGS.particle_filter.num_particles, 2)))
    kind = type("Unmasked", (Gaussian,), {"initial_states": lambda *_: drawn})
    assert type(hf.Planner(kind(), SETTINGS).init(1).belief.states) is np.ndarray


class Gaussian(Line):
    """A line with a reward."""

    def limit_action(self, actions: Any) -> Any:
        return 1.0 * actions

    def reward(self, states: Any, actions: Any) -> Any:
        return 0.0 * states[..., 0] - 1.0


class Sound(Gaussian):
    """The same with a likelihood of its own."""

    def log_likelihood(self, states: Any, sensing_action: int, observation: Any) -> Any:
        return -0.5 * (states[..., sensing_action] - observation[0]) ** 2

    def sample_observation(self, state: Any, sensing_action: int, stream: Any) -> Any:
        return state[sensing_action : sensing_action + 1] + stream.normal((1,))
