"""Public objects can be pickled and copied, and what comes back is what went in.

A pool of processes pickles what it sends, a tree search copies the world at each of its nodes.
"""

import copy
import dataclasses
import functools
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.command_line import run_here

import holdfast as hf
from holdfast import errors
from holdfast.config.registry import BUILT_IN
from holdfast.numerics.randomness import NOISE_FREE, Purpose, stream
from holdfast.robot.problem_env import ProblemEnv

EXAMPLES = Path(__file__).parents[2] / "examples"
SMALL = {"particle_filter.num_particles": 30, "simulator.max_steps": 40}


def pickled(protocol: int, value: Any) -> Any:
    return pickle.loads(pickle.dumps(value, protocol))


COPIES: dict[str, Callable[[Any], Any]] = {
    **{
        f"protocol {number}": functools.partial(pickled, number)
        for number in (0, 2, pickle.HIGHEST_PROTOCOL)
    },
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
}


def planner_of(name: str) -> hf.Planner:
    return hf.Planner(hf.make_problem(name), particles=30)


def advanced(planner: hf.Planner) -> hf.PlanningState:
    """Return a state after some steps."""
    state = planner.init(3)
    world = hf.SimulatedEnvironment(planner.problem, 3)
    while state.step < 5:
        if planner.needs_sensing(state):
            action, _ = planner.choose_sensing_action(state)
            state, _ = planner.observe(state, action, world.perform_sensing(action))
        task_action, _ = planner.choose_task_action(state)
        world.perform(task_action)
        state = planner.advance(state, task_action)
    return state


def ended(planner: hf.Planner) -> str:
    return hf.run_trial(planner, 3, max_steps=40).digest


def after(world: Any) -> bytes:
    """Return what a world shows after two moves of the policy."""
    planner = planner_of("peg_in_hole_2d")
    action, _ = planner.choose_task_action(planner.init(3))
    moved = [world.perform(action) for _ in range(2)]
    return repr((moved, world.perform_sensing(1), world.is_done())).encode()


def env() -> ProblemEnv:
    made = ProblemEnv("peg_in_hole_2d", particles=30, max_steps=40)
    made.reset(seed=3)
    made.step(1)
    return made


def moved_world() -> hf.SimulatedEnvironment:
    world = hf.SimulatedEnvironment(hf.make_problem("peg_in_hole_2d"), 3)
    world.perform(np.array([-0.1, 0.0, 0.0]))
    return world


def gymnasium_world() -> hf.GymnasiumEnvironment:
    world = hf.GymnasiumEnvironment("Pendulum-v1", [[0], [1]], sensing_noise=0.1)
    world.perform(np.array([0.5]))
    return world


@dataclasses.dataclass
class Kept:
    """Objects whose arrays, and whether these are read-only, are all there is."""

    make: Callable[[], Any]
    shows: Callable[[Any], Any]


STATE = advanced(planner_of("peg_in_hole_2d"))
POINTS = np.linspace(0.0, 1.0, 20).reshape(10, 2)

OBJECTS: dict[str, Kept] = {
    **{
        f"problem {name}": Kept(
            lambda name=name: hf.make_problem(name),  # type: ignore[misc]
            lambda problem: ended(hf.Planner(problem, particles=30)),
        )
        for name in BUILT_IN
    },
    "planner": Kept(lambda: planner_of("peg_in_hole_2d"), ended),
    "state": Kept(lambda: STATE, planner_of("peg_in_hole_2d").digest),
    "belief": Kept(lambda: STATE.belief, lambda belief: [each.tobytes() for each in belief]),
    "weighted belief": Kept(
        lambda: hf.Belief.weighted([[1.0], [2.0]], [1, 2]),
        lambda belief: [each.tobytes() for each in belief],
    ),
    "configuration": Kept(
        lambda: hf.load_configuration(EXAMPLES / "peg_in_hole_2d.yaml", overrides=SMALL),
        lambda read: (read.to_yaml(), read.path, ended(hf.Planner(read.problem, read.planning))),
    ),
    "world": Kept(moved_world, after),
    "world of another": Kept(
        lambda: hf.SenseInBackground(moved_world()),
        lambda world: (world.perform_sensing(0), world.perform(np.zeros(3)), world.step),
    ),
    "gymnasium's world": Kept(
        gymnasium_world, lambda world: repr((world.perform(np.array([0.1])), world.is_done()))
    ),
    "gymnasium environment": Kept(env, lambda each: repr(each.step(2))),
    "stream": Kept(
        lambda: stream(1, 2, 3, Purpose.PREDICTION), lambda each: each.normal((3,)).tobytes()
    ),
    "stream without noise": Kept(lambda: NOISE_FREE, lambda each: each.normal((3,)).tobytes()),
    "result": Kept(
        lambda: hf.run_trial(planner_of("peg_in_hole_2d"), 3, max_steps=9),
        lambda each: msgspec.to_builtins(
            msgspec.structs.replace(each, sensing_ms=(), mean_sensing_ms=0.0)
        ),
    ),
    "ending": Kept(lambda: hf.Ending("failed", "fell"), repr),
    "move result": Kept(lambda: hf.MoveResult(1.0, np.ones(2), None), repr),
    "later": Kept(lambda: hf.LATER, lambda later: later is hf.LATER),
    "settings": Kept(hf.PlanningSettings, repr),
    "nearest neighbour": Kept(
        lambda: hf.NearestNeighbor(2, np.array([0.1, 0.2])),
        lambda each: hf.entropy(POINTS, None, each),
    ),
    "prior neighbours": Kept(
        lambda: hf.PriorNeighbors(np.full(10, 0.1), 2), lambda each: hf.entropy(POINTS, None, each)
    ),
    "mixture": Kept(
        lambda: hf.GaussianMixture(np.array([0.1, 0.2])),
        lambda each: hf.entropy(POINTS, None, each),
    ),
    "scene": Kept(lambda: hf.make_problem("peg_in_hole_2d").scene(), lambda each: repr(vars(each))),
}


@pytest.mark.parametrize("how", COPIES)
@pytest.mark.parametrize("name", OBJECTS)
def test_a_copy_does_what_the_original_does(name: str, how: str) -> None:
    if name.startswith("stream") and how == "protocol 0":
        pytest.skip("classes with slots have no such protocol")
    kept = OBJECTS[name]
    copied = COPIES[how](kept.make())
    assert kept.shows(copied) == kept.shows(kept.make())


def arrays_in(value: Any, path: str = "", seen: set[int] | None = None) -> dict[str, bool]:
    """Return whether each array in an object is writable, by where it is."""
    seen = set() if seen is None else seen
    if isinstance(value, np.ndarray):
        return {path: value.flags.writeable}
    if id(value) in seen or isinstance(value, type):
        return {}
    seen.add(id(value))
    parts: dict[str, Any] = {}
    if isinstance(value, tuple | list):
        parts = {str(index): each for index, each in enumerate(value)}
    elif isinstance(value, dict):
        parts = {str(key): each for key, each in value.items()}
    elif type(value).__module__.startswith("holdfast"):
        parts = getattr(value, "__dict__", {})
    found: dict[str, bool] = {}
    for key, each in parts.items():
        if key != "_made_of":  # what the kernel has taken over
            found |= arrays_in(each, f"{path}.{key}", seen)
    return found


@pytest.mark.parametrize("how", COPIES)
@pytest.mark.parametrize("name", [name for name in OBJECTS if arrays_in(OBJECTS[name].make())])
def test_what_is_read_only_stays_so(name: str, how: str) -> None:
    original = OBJECTS[name].make()
    own = {path for path, writable in arrays_in(original).items() if not writable}
    copied = {path for path, writable in arrays_in(COPIES[how](original)).items() if not writable}
    assert copied >= own


def test_a_recorded_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    configuration = EXAMPLES / "peg_in_hole_2d.yaml"
    sets = [f"--set={key}={value}" for key, value in SMALL.items()]
    run_here(capsys, tmp_path, "run", str(configuration), "--trials=1", "--out=run", *sets)
    run = hf.open_run(tmp_path / "run")
    for copies in COPIES.values():
        again = copies(run)
        assert again.trials == run.trials
        read = again.trial(run.trials[0])
        kept = copies(read)
        assert kept.result == read.result
        assert not kept.beliefs[0].states.flags.writeable


@pytest.mark.parametrize(
    "error",
    [
        errors.MessageError("refused", "too long"),
        errors.DecidedOtherwiseError(1, 2, "task"),
        errors.RunError(errors.TrialError("trial 1"), "holdfast run"),
        errors.InvalidValueError("seed -1"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_errors(error: Exception) -> None:
    """A pool of processes sends them home."""
    for copies in COPIES.values():
        again = copies(error)
        assert type(again) is type(error)
        assert str(again) == str(error)
        assert vars(again) == vars(error)
