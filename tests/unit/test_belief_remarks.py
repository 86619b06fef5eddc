"""What a trial's beliefs tell: of the two examples that need a setting, and of nothing else."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from tests.recordings import record_trial

from holdfast.config.loader import Configuration, load
from holdfast.recording.belief_remarks import belief_remarks

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


@pytest.mark.parametrize("name", ["peg_in_hole_2d", "light_dark_room", "corridor_doors"])
def test_others_are_told_nothing(name: str) -> None:
    assert not remarks_of(name, 0)
