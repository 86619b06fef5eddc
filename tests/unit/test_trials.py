"""The loop of a trial, and many trials in one process and in several."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from holdfast.configuration import Configuration, load
from holdfast.errors import EnvironmentFailedError, InvalidValueError, ProblemError
from holdfast.outcome import Decisions, SensingDecision, TaskDecision, TrialResult
from holdfast.problems.problem import FloatArray
from holdfast.recording.recorder import Recorder
from holdfast.runtime import trials
from holdfast.runtime.environment import SimulatedEnvironment
from holdfast.runtime.trial import run_trial
from holdfast.runtime.trials import TrialCrashError, TrialError, run_trials

FAILING_PROBLEM = """
import numpy as np

from holdfast.errors import ProblemError
from holdfast.problems.peg_in_hole_2d import PegInHole2D


class Failing(PegInHole2D):
    \"\"\"Fails in every trial once its initial states are asked for.\"\"\"

    name = "failing"

    def initial_states(self, stream, count):
        raise {error}
"""


def configuration_of(tmp_path: Path, *, num_trials: int = 4, seed: int = 3) -> Configuration:
    path = tmp_path / "run.yaml"
    path.write_text(
        "problem: peg_in_hole_2d\n"
        "particle_filter: {num_particles: 40}\n"
        "active_sensing: {num_observation_samples: 3, num_cores: 1}\n"
        f"simulator: {{num_trials: {num_trials}, max_steps: 60, seed: {seed}}}\n"
    )
    return load(path)


def failing_configuration(tmp_path: Path, error: str) -> Configuration:
    # A name of its own for each error: Python imports a module of one name only once.
    name = f"failing_{''.join(filter(str.isalpha, error)).lower()}"
    (tmp_path / f"{name}.py").write_text(FAILING_PROBLEM.format(error=error))
    path = tmp_path / "failing.yaml"
    path.write_text(f"problem: {name}:Failing\nsimulator: {{num_trials: 4, seed: 3}}\n")
    return load(path)


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


def one(configuration: Configuration, trial: int = 0) -> TrialResult:
    return run_trial(configuration.problem, configuration.planning, configuration.simulator, trial)


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


class TestOneTrial:
    def test_same_trial_decides_the_same(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)
        first, second = one(configuration), one(configuration)
        assert first.decisions == second.decisions
        assert first.digest == second.digest

    def test_an_environment_may_say_that_the_task_failed(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)
        problem, simulator = configuration.problem, configuration.simulator

        class Failing(SimulatedEnvironment):
            says: Any = "failed"

            def is_done(self) -> Any:
                return self.says if self.step == 7 else super().is_done()

        world = Failing(problem, simulator.seed, 0)
        result = run_trial(problem, configuration.planning, simulator, 0, world)
        assert (result.outcome, result.success, result.failed) == ("failed", False, True)
        assert result.steps == 7
        for wrong, says in (("crashed", "'crashed'"), (1, "1"), (None, "None")):
            world = Failing(problem, simulator.seed, 0)
            world.says = wrong
            message = f'Failing: is_done returned {says}; it must return True, False or "failed"'
            with pytest.raises(EnvironmentFailedError, match=f"^{message}$"):
                run_trial(problem, configuration.planning, simulator, 0, world)

    def test_other_trials_and_seeds_decide_otherwise(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)
        digests = {
            one(configuration, 0).digest,
            one(configuration, 1).digest,
            one(configuration_of(tmp_path, seed=4), 0).digest,
        }
        assert len(digests) == 3

    def test_digest_is_the_hash_of_the_decisions(self, tmp_path: Path) -> None:
        result = one(configuration_of(tmp_path))
        assert result.decisions is not None
        expected = hashlib.blake2b(result.decisions.log, digest_size=32).hexdigest()
        assert result.digest == expected

    def test_decisions_come_in_the_order_of_the_loop(self, tmp_path: Path) -> None:
        result = one(configuration_of(tmp_path))
        assert result.decisions is not None
        decisions = list(result.decisions)
        task = [item for item in decisions if isinstance(item, TaskDecision)]
        sensing = [item for item in decisions if isinstance(item, SensingDecision)]
        assert [item.step for item in task] == list(range(result.steps))
        assert [item.step for item in sensing] == list(range(0, result.steps, 9))
        assert len(sensing) == result.sensing_decisions == len(result.sensing_ms)
        # At a step of both kinds, the robot senses first.
        steps = [(item.step, isinstance(item, TaskDecision)) for item in decisions]
        assert steps == sorted(steps)

    def test_decisions_hold_what_the_environment_was_told(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)

        class Noting(SimulatedEnvironment):
            sensed: list[int]
            performed: list[tuple[float, ...]]

            def perform_sensing(self, sensing_action: int) -> FloatArray:
                self.sensed.append(sensing_action)
                return super().perform_sensing(sensing_action)

            def perform(self, task_action: FloatArray) -> float | None:
                self.performed.append(tuple(task_action.tolist()))
                return super().perform(task_action)

        environment = Noting(configuration.problem, configuration.simulator.seed, 0)
        environment.sensed, environment.performed = [], []
        result = run_trial(
            configuration.problem, configuration.planning, configuration.simulator, 0, environment
        )
        assert result.decisions is not None
        decisions = list(result.decisions)
        assert environment.sensed == [
            item.sensing_action for item in decisions if isinstance(item, SensingDecision)
        ]
        assert environment.performed == [
            item.action for item in decisions if isinstance(item, TaskDecision)
        ]
        assert result.digest == one(configuration).digest

    def test_an_observer_changes_nothing(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)
        recorder = Recorder(trial=0)
        watched = run_trial(
            configuration.problem,
            configuration.planning,
            configuration.simulator,
            0,
            observer=recorder,
        )
        assert watched.digest == one(configuration).digest
        assert recorder.record.result is watched

    def test_it_stops_at_the_goal_or_at_max_steps(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)
        results = [one(configuration, trial) for trial in range(40)]
        for result in results:
            assert result.steps == 60 or (result.success and result.steps < 60)
        assert {result.success for result in results} == {True, False}

    @pytest.mark.parametrize("log", [b"X", b"A\0\0", b"S" + bytes(20), b"E", b"A" + bytes(9)])
    def test_a_damaged_log_is_refused(self, log: bytes) -> None:
        with pytest.raises(InvalidValueError, match="decision log"):
            list(Decisions(3, log))


class TestManyTrials:
    def test_each_trial_is_run_once(self, tmp_path: Path) -> None:
        results = run_all(configuration_of(tmp_path), jobs=1)
        assert [result.trial for result in results] == [0, 1, 2, 3]

    def test_finished_trials_are_left_out(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)
        every = run_all(configuration, jobs=1)
        rest = run_all(configuration, jobs=1, finished=(0, 2, 7))
        assert decided(rest) == [row for row in decided(every) if row[0] in (1, 3)]

    def test_nothing_is_run_when_all_are_finished(self, tmp_path: Path) -> None:
        assert run_all(configuration_of(tmp_path), jobs=4, finished=(0, 1, 2, 3)) == []

    def test_workers_change_no_result(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        configuration = configuration_of(tmp_path, num_trials=9)
        alone = run_all(configuration, jobs=1)
        # As if workers cost nothing to start: so even these short trials go to them.
        monkeypatch.setattr(trials, "_WORKER_START_S", 0.0)
        assert decided(run_all(configuration, jobs=2)) == decided(alone)

    def test_an_error_in_a_trial_names_it(self, tmp_path: Path) -> None:
        configuration = failing_configuration(tmp_path, 'ProblemError("too heavy")')
        with pytest.raises(TrialError, match=r"trial 2 \(seed 3\): too heavy"):
            run_all(configuration, jobs=1, finished=(0, 1))

    def test_what_a_problem_raises_comes_with_its_own_frames(self, tmp_path: Path) -> None:
        configuration = failing_configuration(tmp_path, 'KeyError("lamp")')
        with pytest.raises(TrialError) as caught:
            run_all(configuration, jobs=1)
        first, *frames = str(caught.value).splitlines()
        name = configuration.problem_name
        assert first == f"trial 0 (seed 3): {name} raised KeyError: 'lamp'"
        assert sum(line.startswith("  File ") for line in frames) == 1
        assert f"{tmp_path}" in frames[0]
        assert frames[1].strip() == 'raise KeyError("lamp")'

    def test_a_defect_without_a_frame_of_the_problem_is_raised_as_it_is(
        self, tmp_path: Path
    ) -> None:
        configuration = defective_configuration(tmp_path)
        with pytest.raises(TypeError, match="not callable") as caught:
            run_all(configuration, jobs=1)
        assert caught.value.__notes__ == ["in trial 0 (seed 3)"]

    def test_a_defect_in_a_worker_comes_back_with_its_traceback(self, tmp_path: Path) -> None:
        configuration = defective_configuration(tmp_path)
        with pytest.raises(TrialCrashError, match=r"(?s)Traceback.*not callable.*in trial [01]"):
            trials._run_in_workers(configuration, 2, iter(range(4)), 4, 1.0, lambda _: None)

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
            result = run_trial(problem, configuration.planning, simulator, 0, environment)
            assert result.reward == reward
            # It decides nothing.
            assert result.digest == one(configuration).digest
        # A trial without a step has earned nothing, which is a sum.
        begun_in_the_goal = Sparing(problem, simulator.seed, 0)
        begun_in_the_goal.state = np.zeros(3)
        result = run_trial(problem, configuration.planning, simulator, 0, begun_in_the_goal)
        assert (result.steps, result.reward) == (0, 0.0)

    def test_a_problem_without_rewards_has_none(self) -> None:
        room = load(Path(__file__).parents[2] / "examples" / "light_dark_room.yaml")
        assert one(room).reward is None

    @pytest.mark.parametrize("reward", [float("nan"), float("inf"), float("-inf")])
    def test_a_reward_that_is_not_finite_is_refused(self, tmp_path: Path, reward: float) -> None:
        configuration = configuration_of(tmp_path)

        class Rewarding(SimulatedEnvironment):
            def perform(self, task_action: FloatArray) -> float:
                super().perform(task_action)
                return reward if self.step == 3 else 0.0

        environment = Rewarding(configuration.problem, configuration.simulator.seed, 0)
        with pytest.raises(ProblemError, match=rf"the reward of step 2 is {reward}; it must be"):
            run_trial(
                configuration.problem,
                configuration.planning,
                configuration.simulator,
                0,
                environment,
            )

    @pytest.mark.parametrize(
        ("error", "expected", "text"),
        [
            ('ProblemError("too heavy")', TrialError, r"trial [01] \(seed 3\): too heavy"),
            (
                "ZeroDivisionError",
                TrialError,
                r"(?s)trial [01] \(seed 3\): failing_.* raised ZeroDivisionError\n  File ",
            ),
        ],
    )
    def test_errors_in_workers_come_back(
        self, tmp_path: Path, error: str, expected: type[Exception], text: str
    ) -> None:
        configuration = failing_configuration(tmp_path, error)
        with pytest.raises(expected, match=text):
            trials._run_in_workers(configuration, 2, iter(range(4)), 4, 1.0, lambda _: None)

    @pytest.mark.parametrize("jobs", [0, -1, 1025])
    def test_the_number_of_jobs_is_bounded(self, tmp_path: Path, jobs: int) -> None:
        with pytest.raises(InvalidValueError, match=f"jobs is {jobs}; it must be from 1 to 1024"):
            run_all(configuration_of(tmp_path), jobs=jobs)
