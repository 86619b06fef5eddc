"""Many trials, in one process and in several."""

from pathlib import Path

import numpy as np
import pytest
from tests.unit.test_trial import configuration_of, failing_configuration, one

from holdfast.config.loader import Configuration, load
from holdfast.errors import InvalidValueError, TrialCrashError, TrialError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.outcome import TrialResult
from holdfast.robot import trial_pool
from holdfast.robot.environment import SimulatedEnvironment
from holdfast.robot.trial_pool import Arm, TrialPool
from holdfast.robot.trials import run_trials


def defective_configuration(tmp_path: Path) -> Configuration:
    """A problem that makes holdfast fail with no function of the problem on the stack."""
    (tmp_path / "defective.py").write_text(
        "from holdfast.problems.peg_in_hole_2d import PegInHole2D\n"
        "class Defective(PegInHole2D):\n"
        "    initial_states = 3\n"
    )
    path = tmp_path / "defective.yaml"
    path.write_text("problem: defective:Defective\nsimulator: {num_trials: 4, seed: 3}\n")
    return load(path)


def decided(results: list[TrialResult]) -> list[tuple[int, str, float | None, int]]:
    """Everything of a result but its times."""
    ordered = sorted(results, key=lambda result: result.trial)
    return [(result.trial, result.digest, result.reward, result.steps) for result in ordered]


def run_all(
    configuration: Configuration, jobs: int, finished: tuple[int, ...] = ()
) -> list[TrialResult]:
    results: list[TrialResult] = []
    run_trials(configuration, jobs, finished, results.append)
    return results


def in_workers(configuration: Configuration) -> list[TrialResult]:
    """Run four trials in two workers, from the first one on."""
    arm = Arm.of(configuration)
    with TrialPool(2) as pool:
        return [done.result for done in pool.run((arm, trial) for trial in range(4))]


class TestManyTrials:
    def test_each_trial_is_run_once_and_finished_ones_are_left_out(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)
        every = run_all(configuration, jobs=1)
        assert [result.trial for result in every] == [0, 1, 2, 3]
        rest = run_all(configuration, jobs=1, finished=(0, 2, 7))
        assert decided(rest) == [row for row in decided(every) if row[0] in (1, 3)]
        assert run_all(configuration, jobs=4, finished=(0, 1, 2, 3)) == []

    def test_workers_change_no_result(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        configuration = configuration_of(tmp_path, num_trials=9)
        alone = run_all(configuration, jobs=1)
        # As if workers cost nothing to start: so even these short trials go to them.
        monkeypatch.setattr(trial_pool, "_WORKER_START_S", 0.0)
        assert decided(run_all(configuration, jobs=2)) == decided(alone)

    def test_an_error_in_a_trial_names_it(self, tmp_path: Path) -> None:
        configuration = failing_configuration(tmp_path, 'ProblemError("too heavy")')
        with pytest.raises(TrialError, match=r"trial 2 \(seed 3\): too heavy"):
            run_all(configuration, jobs=1, finished=(0, 1))

    def test_a_defect_without_a_frame_of_the_problem_is_raised_as_it_is(
        self, tmp_path: Path
    ) -> None:
        configuration = defective_configuration(tmp_path)
        with pytest.raises(TypeError, match="not callable") as caught:
            run_all(configuration, jobs=1)
        assert caught.value.__notes__ == ["in trial 0 (seed 3)"]
        # From a worker it comes back with its traceback.
        with pytest.raises(TrialCrashError, match=r"(?s)Traceback.*not callable.*in trial [01]"):
            in_workers(configuration)

    def test_a_reward_that_nobody_defines_is_none(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)
        problem, simulator = configuration.problem, configuration.simulator

        class Sparing(SimulatedEnvironment):
            """Reports the rewards of some steps."""

            rewarded: tuple[int, ...] = ()

            def perform(self, task_action: FloatArray) -> float | None:
                super().perform(task_action)
                return -2.0 if self.step in self.rewarded else None

        for rewarded, reward in (((), None), ((2, 5), -4.0)):
            environment = Sparing(problem, simulator.seed, 0)
            environment.rewarded = rewarded
            result = one(configuration, environment=environment)
            assert result.reward == reward
            # It decides nothing.
            assert result.digest == one(configuration).digest
        # A trial without a step has earned nothing, which is a sum.
        begun_in_the_goal = Sparing(problem, simulator.seed, 0)
        begun_in_the_goal.state = np.zeros(3)
        result = one(configuration, environment=begun_in_the_goal)
        assert (result.steps, result.reward) == (0, 0.0)

    def test_a_problem_without_rewards_has_none(self) -> None:
        room = load(Path(__file__).parents[2] / "examples" / "light_dark_room.yaml")
        assert one(room).reward is None

    @pytest.mark.parametrize(
        ("error", "text"),
        [
            ('ProblemError("too heavy")', "too heavy"),
            ("ZeroDivisionError", "failing_.* raised ZeroDivisionError\n  File "),
        ],
    )
    def test_errors_in_workers_come_back(self, tmp_path: Path, error: str, text: str) -> None:
        with pytest.raises(TrialError, match=rf"(?s)trial [01] \(seed 3\): {text}"):
            in_workers(failing_configuration(tmp_path, error))

    @pytest.mark.parametrize("jobs", [0, -1, 1025])
    def test_the_number_of_jobs_is_bounded(self, tmp_path: Path, jobs: int) -> None:
        with pytest.raises(InvalidValueError, match=f"jobs is {jobs}; it must be from 1 to 1024"):
            run_all(configuration_of(tmp_path), jobs=jobs)
