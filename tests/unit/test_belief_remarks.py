"""What a trial's beliefs tell: of what needs a setting or some noise, and of nothing else."""

import dataclasses
import re
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.line_problem import SETTINGS, Beacon
from tests.recordings import record_trial
from tests.unit.test_lost_values import RANDOM, Bit

from holdfast.config.loader import Configuration, load
from holdfast.planning.outcome import TrialResult
from holdfast.planning.planner import Planner
from holdfast.reports.belief_remarks import belief_remarks
from holdfast.reports.recorder import Recorder
from holdfast.robot.trial import SensingStep, run_trial

EXAMPLES = Path(__file__).parents[2] / "examples"


def remarks_of(name: str, trial: int, overrides: dict[str, Any] | None = None) -> list[str]:
    configuration = load(EXAMPLES / f"{name}.yaml", overrides=overrides or {})
    return remarks_on(configuration, configuration.problem, trial)


def remarks_on(configuration: Configuration, problem: Any, trial: int) -> list[str]:
    record = record_trial(dataclasses.replace(configuration, problem=problem), trial).record
    return belief_remarks(problem, configuration.planning, record)


MEAN = {"particle_filter.estimate": "mean"}


class TestSeveralModes:
    def failing_trial(self) -> int:
        configuration = load(EXAMPLES / "corridor_anywhere.yaml", overrides=MEAN)
        for trial in range(20):
            result = record_trial(configuration, trial).record.result
            if result is not None and not result.success:
                return trial
        pytest.fail("the mean never fails in the corridor")

    def test_a_robot_that_stays_between_them_is_told(self) -> None:
        trial = self.failing_trial()
        (remark,) = remarks_of("corridor_anywhere", trial, MEAN)
        assert "had several modes, and the mean lies between them" in remark
        assert "particle_filter.estimate: heaviest_mode" in remark
        assert not remarks_of("corridor_anywhere", trial)

    def test_the_mean_of_zeros_and_ones_is_a_probability(self) -> None:
        assert not any(bits_of((4.0, 1e6), hidden=False))


def bits_of(variances: tuple[float, float], *, hidden: bool) -> list[str]:
    """Return the remarks on twelve trials with a bit, of a robot whose world is ``hidden``."""
    problem, found = Bit(), []
    problem.variances = variances
    planner = Planner(problem, RANDOM)
    for trial in range(12):
        recorder = Recorder(trial, planner)
        run_trial(planner, 3, trial, max_steps=20, observer=recorder)
        if hidden:
            recorder.record.true_states.clear()
            recorder.record.lost_values = ()
        found.append(" ".join(belief_remarks(problem, RANDOM, recorder.record)))
        assert hidden or bool(found[-1]) == bool(recorder.lost)
        assert hidden or not belief_remarks(problem, RANDOM, recorder.record, lost_are_told=True)
    return found


@pytest.mark.parametrize(
    ("hidden", "least", "says"),
    [(False, 2, "no particle had the true value of bit"), (True, 9, "bit does not move, and by")],
)
def test_a_bit_is_certain_by_chance_or_by_evidence(hidden: bool, least: int, says: str) -> None:
    told = [each.startswith(says) for each in bits_of((1e-8, 4.0), hidden=hidden) if each]
    assert least <= len(told) == sum(told)
    assert not any(bits_of((4.0, 1e-4), hidden=hidden))


class TestAngles:
    def test_a_heading_that_is_averaged_as_a_number_is_told(self) -> None:
        configuration = load(EXAMPLES / "wrapping_heading.yaml")
        kind: Any = type(configuration.problem)

        class Numbers(kind):  # type: ignore[misc]
            circular = circular_observations = ()

        (remark,) = remarks_on(configuration, Numbers(), 0)
        assert remark.startswith("heading (rad) lay on both sides of a whole turn in ")
        assert "give wrapping_heading circular = (2,)" in remark
        assert not remarks_on(configuration, configuration.problem, 0)


class TestDepletion:
    def recorded(self, problem: Any) -> tuple[list[str], TrialResult, list[int]]:
        settings = msgspec.structs.replace(SETTINGS, sensing_interval=1)
        planner = Planner(problem, settings)
        distinct: list[int] = []

        class Both(Recorder):
            def sensed(self, step: SensingStep) -> None:
                super().sensed(step)
                distinct.append(step.observation_info.distinct_particles)

        recorder = Both(0, planner)
        result = run_trial(planner, seed=5, max_steps=60, observer=recorder)
        return belief_remarks(problem, settings, recorder.record), result, distinct

    def test_what_does_not_move_is_told(self) -> None:
        (remark,), result, _ = self.recorded(Beacon())
        assert remark.startswith("beacon (m) does not move, and by step 58 its particles had 1 ")
        assert "docs/problems.md, Parameters that never change" in remark
        # The robot's own coordinate is another one in each particle.
        assert result.fewest_distinct_particles == 30

    def test_what_static_parameters_cannot_redraw_is_told(self) -> None:
        class Sharp(Beacon):
            static_parameters = (1,)

            def observation_variance(self, states: Any, sensing_action: int) -> Any:
                return np.array([1e-12])

        (remark,), _, _ = self.recorded(Sharp())
        assert "had 1 different value left" in remark
        assert re.search(r": an observation of (first|second) left about one particle at", remark)
        assert "give line static_parameters" not in remark

    def test_nothing_is_told_of_what_moves_a_little(self) -> None:
        class Drifting(Beacon):
            noise = np.array([0.1, 0.03])

        remarks, _, _ = self.recorded(Drifting())
        assert not remarks

    def test_info_and_result_count_what_is_left(self) -> None:
        class Still(Beacon):
            noise = np.zeros(2)

        remarks, result, distinct = self.recorded(Still())
        assert distinct[0] == 30
        assert distinct == sorted(distinct, reverse=True)
        assert result.fewest_distinct_particles == distinct[-1] == 1
        assert len(remarks) == 1  # the robot moves


@pytest.mark.parametrize("name", ["peg_in_hole_2d", "light_dark_room", "corridor_doors"])
def test_others_are_told_nothing(name: str) -> None:
    assert not remarks_of(name, 0)
