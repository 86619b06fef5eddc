"""The loop of one trial."""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.line_problem import SETTINGS, Line

from holdfast.config.loader import Configuration, load
from holdfast.errors import EnvironmentFailedError, InvalidValueError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.inputs import ActingRecord, Sensed, encode_floats
from holdfast.planning.outcome import DONE_VALUES, Decisions, MoveResult, TrialResult
from holdfast.planning.planner import Planner
from holdfast.planning.settings import LostSettings
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.reports.recorder import Recorder
from holdfast.robot.environment import Environment, SimulatedEnvironment
from holdfast.robot.gymnasium_environment import GymnasiumEnvironment
from holdfast.robot.trial import run_trial

FAILING_PROBLEM = """
from holdfast.errors import ProblemError
from holdfast.problems.peg_in_hole_2d import PegInHole2D

class Failing(PegInHole2D):
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


def one(configuration: Configuration, trial: int = 0, **watched: Any) -> TrialResult:
    return run_trial(
        Planner(configuration.problem, configuration.planning),
        configuration.simulator.seed,
        trial,
        max_steps=configuration.simulator.max_steps,
        **watched,
    )


class TestOneTrial:
    def test_an_environment_may_say_that_the_task_failed(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)

        class Failing(SimulatedEnvironment):
            says: Any = "failed"

            def is_done(self) -> Any:
                return self.says if self.step == 7 else super().is_done()

        result = one(configuration, environment=Failing(configuration.problem, 3, 0))
        assert (result.outcome, result.success, result.failed) == ("failed", False, True)
        assert result.steps == 7
        for wrong, says in (("crashed", "'crashed'"), (1, "1")):
            world = Failing(configuration.problem, 3, 0)
            world.says = wrong
            message = f"Failing: is_done returned {says}; it must return {DONE_VALUES}"
            with pytest.raises(EnvironmentFailedError, match=f"^{message}$"):
                one(configuration, environment=world)

    def test_a_simulated_world_may_fail(self) -> None:
        class Cliff(Line):
            def is_failure(self, states: Any) -> Any:
                return states[..., 0] > -1.0  # and so at the goal

        results = [run_trial(Planner(Cliff(), SETTINGS), 2, trial) for trial in range(20)]
        assert {result.outcome for result in results} == {"failed"}
        # Of 20 trials, 0.84 each begin there: all of them do with a probability of 0.03.
        assert 0 < sum(result.steps == 0 for result in results) < 20

    @pytest.mark.parametrize("nothing", [None, np.array([np.nan])])
    def test_without_a_reading_the_belief_stays(self, nothing: Any, tmp_path: Path) -> None:
        """And the trial is the one of a planner that is told None there."""
        configuration = configuration_of(tmp_path)
        problem, planning = configuration.problem, configuration.planning

        class Blinks(SimulatedEnvironment):
            def perform_sensing(self, sensing_action: int) -> Any:
                return nothing if self.step % 2 else super().perform_sensing(sensing_action)

        planner = Planner(problem, planning)
        world = Blinks(problem, 3, 0)
        result = run_trial(planner, 3, max_steps=40, environment=world)
        state, world = planner.init(3), Blinks(problem, 3, 0)
        missing = 0
        while not world.is_done() and state.step < 40:
            if planner.needs_sensing(state):
                chosen, _ = planner.choose_sensing_action(state)
                shown = world.perform_sensing(chosen)
                missing += shown is nothing
                state, _ = planner.observe(state, chosen, None if shown is nothing else shown)
            action, _ = planner.choose_task_action(state)
            world.perform(action)
            state = planner.advance(state, action)
        assert result.decisions is not None
        assert result.decisions.log.endswith(planner.digest(state))
        assert result.missing_observations == missing > 0
        assert result.sensing_decisions > missing

    def test_a_robot_without_any_reading_is_stopped(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)

        class Blind(SimulatedEnvironment):
            def perform_sensing(self, sensing_action: int) -> Any:
                return None

        world = Blind(configuration.problem, 3, 0)
        with pytest.raises(
            EnvironmentFailedError,
            match=r"Blind: perform_sensing gave no reading 3 times in a row; "
            r"environment\.max_missing_in_a_row allows 2",
        ):
            one(configuration, environment=world, max_missing_in_a_row=2)

    def test_decisions_come_in_the_order_of_the_loop(self, tmp_path: Path) -> None:
        result = one(configuration_of(tmp_path))
        assert result.decisions is not None
        log = result.decisions.log
        assert result.digest == hashlib.blake2b(log, digest_size=32).hexdigest()
        decisions = list(result.decisions)
        task = [item for item in decisions if isinstance(item, ActingRecord)]
        sensing = [item for item in decisions if isinstance(item, Sensed)]
        assert [item.step for item in task] == list(range(result.steps))
        assert [item.step for item in sensing] == list(range(0, result.steps, 9))
        assert len(sensing) == result.sensing_decisions == len(result.sensing_ms)
        # At a step of both kinds, the robot senses first.
        steps = [(item.step, isinstance(item, ActingRecord)) for item in decisions]
        assert steps == sorted(steps)

    def test_decisions_hold_what_the_environment_was_told(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)

        class Noting(SimulatedEnvironment):
            sensed: list[int]
            performed: list[bytes]

            def perform_sensing(self, sensing_action: int) -> FloatArray:
                self.sensed.append(sensing_action)
                return super().perform_sensing(sensing_action)

            def perform(self, task_action: FloatArray) -> float | MoveResult | None:
                self.performed.append(encode_floats(task_action))
                return super().perform(task_action)

        environment = Noting(configuration.problem, 3, 0)
        environment.sensed, environment.performed = [], []
        result = one(configuration, environment=environment)
        assert result.decisions is not None
        decisions = list(result.decisions)
        assert environment.sensed == [
            item.sensing_action for item in decisions if isinstance(item, Sensed)
        ]
        assert environment.performed == [
            item.action for item in decisions if isinstance(item, ActingRecord)
        ]
        assert result.digest == one(configuration).digest

    def test_an_observer_changes_nothing(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)
        recorder = Recorder(trial=0)
        watched = one(configuration, observer=recorder)
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


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"lost": LostSettings(on_lost="reinitialize")},  # type: ignore[arg-type]
            r"lost: on_lost is \"reinitialize\"; expected one of .*did you mean reinitialise\?",
        ),
        (
            {"lost": LostSettings(false_alarm_rate=5)},
            r"lost: false_alarm_rate is 5; expected a number >= 1e-12 and <= 0\.1",
        ),
        ({"lost": "hold"}, "lost is of type str; it must be a LostSettings"),
        ({"lost": None}, "lost is of type NoneType; it must be a LostSettings"),
        ({"lost": {"on_lost": "hold"}}, "lost is of type dict; it must be a LostSettings"),
        (
            {"max_missing_in_a_row": "x"},
            r"environment: max_missing_in_a_row is \"x\"; expected a whole number >= 0",
        ),
        ({"max_missing_in_a_row": -1}, "max_missing_in_a_row is -1; expected a whole number >= 0"),
    ],
)
def test_what_is_out_of_bounds_is_named(given: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidValueError, match=message):
        run_trial(Planner(PegInHole2D(), method="random"), max_steps=1, **given)


@pytest.mark.parametrize(
    "make",
    [
        lambda problem: SimulatedEnvironment(problem, 0),
        lambda _problem: GymnasiumEnvironment(
            "MountainCarContinuous-v0",
            [[0], [1]],
            lambda _environment, action: action[:1].astype(np.float32),
        ),
    ],
)
def test_a_world_is_for_one_trial(make: Callable[[PegInHole2D], Environment]) -> None:
    problem = PegInHole2D()
    planner = Planner(problem, method="fixed")
    environment = make(problem)
    environment.perform(np.zeros(3))
    with pytest.raises(
        InvalidValueError, match=r"performed 1 task .*make a new one for each trial"
    ):
        run_trial(planner, max_steps=3, environment=environment)
