"""A recorded run as arrays: what is read is what was run."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tests.command_line import Workplace
from tests.recordings import Steps, decided, forget_steps, rewrite

import holdfast as hf
from holdfast.errors import OutputError
from holdfast.reports.reading import RunArrays

Recorded = Callable[..., RunArrays]

CONFIGURATION = """\
problem: peg_in_hole_2d
particle_filter: {num_particles: 40}
simulator: {num_trials: 3, max_steps: 20, seed: 5}
"""

ENCODERS = "encoders:PegWithEncoders"
"""Its moves have a measured motion, and show something."""

OWN_ROBOT = """
import numpy as np

class Robot:
    def perform_sensing(self, sensing_action):
        return np.array([1.0])

    def perform(self, task_action):
        return None

    def is_done(self):
        return False
"""


@pytest.fixture
def recorded(workplace: Workplace) -> Recorded:
    def run(text: str = CONFIGURATION) -> RunArrays:
        workplace.write("run.yaml", text)
        module = "from holdfast_lab.simulation.peg_with_encoders import PegWithEncoders\n"
        workplace.write("encoders.py", module)
        assert workplace.run("run", "run.yaml", "--out", "run", "-q").code in (0, 1)
        directory = workplace.directory
        return hf.open_run(directory / "run", problem_directory=directory)

    return run


@pytest.mark.parametrize("problem", ["peg_in_hole_2d", ENCODERS])
def test_the_arrays_are_what_was_run(recorded: Recorded, problem: str) -> None:
    run = recorded(CONFIGURATION.replace("peg_in_hole_2d", problem))
    configuration = run.configuration
    assert run.trials == (0, 1, 2)
    for number, trial in enumerate(run.read()):
        seen = Steps()
        result = decided(configuration, number, observer=seen)
        assert trial.result is not None
        assert trial.result.digest == result.digest == run.results["digest"][number]
        assert run.results["steps"][number] == result.steps == len(trial.task_actions)
        np.testing.assert_array_equal(trial.task_actions, [step.executed for step in seen.tasks])
        moved = [step.moved for step in seen.tasks]
        assert [motion.tobytes() for motion in trial.motions] == [each.motion for each in moved]
        shown = [observation.tobytes() for observation in trial.move_observations]
        assert shown == [each.observation for each in moved]
        assert all(map(bool, shown)) is (problem == ENCODERS)
        assert trial.sensing_steps.tolist() == [step.before.step for step in seen.sensing]
        assert trial.sensing_actions.tolist() == [step.sensing_action for step in seen.sensing]
        np.testing.assert_array_equal(
            trial.observations, [step.observation for step in seen.sensing]
        )
        np.testing.assert_array_equal(
            trial.entropies, [step.sensing_info.entropies for step in seen.sensing]
        )
        assert len(trial.beliefs) == result.steps + 1
        for belief, step in zip(trial.beliefs, seen.tasks, strict=False):
            np.testing.assert_array_equal(belief.states, step.state.belief.states)
        for belief, sensing in zip(trial.priors, seen.sensing, strict=True):
            np.testing.assert_array_equal(belief.states, sensing.before.belief.states)
        np.testing.assert_array_equal(
            trial.estimates[:-1], [step.task_info.estimate for step in seen.tasks]
        )
        assert trial.stages.tolist() == [0] * result.steps
        assert trial.rewards.sum() == pytest.approx(result.reward)
        assert trial.true_states is not None
        assert trial.true_states.shape == (result.steps + 1, 3)


def test_one_trial_is_read_alone(recorded: Recorded) -> None:
    run = recorded()
    assert run.trial(1).trial == 1
    assert [trial.trial for trial in run.read([2, 0])] == [0, 2]
    with pytest.raises(OutputError, match="has no trial 7"):
        run.trial(7)


def test_a_method_without_entropies(recorded: Recorded) -> None:
    run = recorded(CONFIGURATION + "selector: {method: random}\n")
    trial = run.trial(0)
    assert trial.entropies.shape == (len(trial.sensing_steps), 3)
    assert np.isnan(trial.entropies).all()


def test_a_world_of_ones_own(recorded: Recorded, tmp_path: Path) -> None:
    """What it showed is kept; its true state is not known, and it gives no reward."""
    (tmp_path / "numb_robot.py").write_text(OWN_ROBOT)
    run = recorded(CONFIGURATION + "environment: {object: 'numb_robot:Robot'}\n")
    assert np.isnan(run.results["reward"]).all()
    for trial in run.read():
        assert trial.task_actions.shape == (20, 3)
        assert trial.sensing_steps.tolist() == [0, 9, 18]
        assert np.concatenate(trial.observations).tolist() == [1.0, 1.0, 1.0]
        assert len(trial.beliefs) == 21
        assert trial.true_states is None


def test_a_world_of_ones_own_that_was_forgotten(recorded: Recorded, tmp_path: Path) -> None:
    (tmp_path / "numb_robot.py").write_text(OWN_ROBOT)
    run = recorded(CONFIGURATION + "environment: {object: 'numb_robot:Robot'}\n")
    rewrite(tmp_path / "run" / "journal.bin", forget_steps)
    with pytest.raises(OutputError, match="trial 1 cannot be computed again: this run is older"):
        run.trial(1)


def test_no_run(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="no run"):
        hf.open_run(tmp_path)
