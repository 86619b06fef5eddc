"""The example of gymnasium's LunarLander: what its model says, and how its trials end."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import holdfast as hf
from holdfast.config.loader import Configuration, load
from holdfast.numerics.randomness import NOISE_FREE, Purpose, stream
from holdfast.planning.outcome import TrialResult
from holdfast.planning.planner import Planner
from holdfast.robot.environment_maker import load_environment
from holdfast.robot.gymnasium_environment import GymnasiumEnvironment
from holdfast.robot.trial import run_trial

pytest.importorskip("Box2D", reason="there is no wheel of Box2D for this Python")

EXAMPLE = Path(__file__).parents[2] / "examples" / "lunar_lander.yaml"


@pytest.fixture(scope="module")
def example() -> Configuration:
    return load(EXAMPLE)


def world(example: Configuration, trial: int = 0) -> GymnasiumEnvironment:
    environment = load_environment(example)(trial)
    assert isinstance(environment, GymnasiumEnvironment)
    return environment


def in_the_air(environment: GymnasiumEnvironment) -> bool:
    return not environment.is_done() and not environment._seen[6:].any()


def test_its_model_is_what_gymnasium_does(example: Configuration) -> None:
    """In the air, the prediction of one step is off by no more than the noise that it has."""
    problem = example.problem
    errors: list[Any] = []
    spreads: list[Any] = []
    noise = stream(1, 0, 0, Purpose.WORLD_MOTION)
    for trial in range(8):
        environment = world(example, trial)
        while in_the_air(environment):
            before = environment._seen[:6].astype(np.float64)
            # The example's controller, disturbed.
            action = problem.limit_action(problem.policy(before, 0)) + 0.3 * noise.normal(2)
            action = np.clip(action, -1.0, 1.0)
            noise = noise.substream(0)
            environment.perform(action)
            if not in_the_air(environment):
                break
            predicted = problem.move(before, action, NOISE_FREE)
            errors.append(environment._seen[:6] - predicted)
            many = problem.move(np.tile(before, (200, 1)), action, noise)
            spreads.append(many.std(axis=0))
    error, spread = np.array(errors), np.array(spreads)
    assert len(error) > 500
    for index in (2, 3, 5):  # the speeds, which have all of the noise
        measured, said = (np.sqrt(np.mean(each[:, index] ** 2)) for each in (error, spread))
        assert measured < 1.5 * said + 1e-3, problem.state_labels[index]
        assert abs(np.mean(error[:, index])) < 2e-3


def test_the_belief_begins_around_the_truth(example: Configuration) -> None:
    states = example.problem.initial_states(stream(1, 0, 0, Purpose.INITIAL_BELIEF), 1000)
    truth = np.array([world(example, trial)._seen[:6] for trial in range(40)])
    assert np.all(states.min(axis=0) - 0.02 < truth.min(axis=0))
    assert np.all(states.max(axis=0) + 0.02 > truth.max(axis=0))


def test_broken_engines_crash(example: Configuration) -> None:
    """gymnasium says ``terminated``, as of a landing; it is a failure, and has a reason."""
    environment = world(example)
    while not environment.is_done():
        environment.perform(np.array([-1.0, 0.0]))
    done = environment.is_done()
    assert isinstance(done, hf.Ending)
    assert done.outcome == "failed"
    assert done.reason.startswith("crashed at vx ")


def test_one_that_flies_away_has_failed(example: Configuration) -> None:
    environment = world(example)
    while not environment.is_done():
        tilt = environment._seen[4] + 1.0 * environment._seen[5]
        environment.perform(np.array([1.0, 1.0 if tilt > -0.4 else 0.0]))
    assert environment.is_done() == hf.Ending("failed", "left the picture")


def test_how_trials_end(example: Configuration) -> None:
    """Of 50, 36 landed. With that share, fewer than 2 of 8 do once in 1,200 such tests."""
    planner = Planner(example.problem, example.planning)

    def outcome(trial: int) -> TrialResult:
        limit = example.simulator.max_steps
        return run_trial(planner, 2, trial, max_steps=limit, environment=world(example, trial))

    results = [outcome(trial) for trial in range(8)]
    assert sum(result.success for result in results) >= 2
    for result in results:
        assert (result.outcome == "failed") == bool(result.reason)
        assert result.outcome != "truncated"
        assert (result.reward or 0.0) < 100.0 or result.success
    assert outcome(3).digest == results[3].digest
