"""Which runs are a robot's, and why services were given up."""

from __future__ import annotations

from pathlib import Path

import pytest

from holdfast.cli.robot_run import RobotFindings, is_robot_run
from holdfast.config.loader import load


@pytest.mark.parametrize(
    ("overrides", "rate_hz", "expected"),
    [
        ({}, None, False),
        ({}, 10.0, True),
        ({"offload.services": ["tcp/127.0.0.1:7447"]}, None, True),
        ({"environment.object": "somebodys_robot"}, None, True),
    ],
)
def test_a_robots_run(
    overrides: dict[str, object], rate_hz: float | None, expected: bool, tmp_path: Path
) -> None:
    (tmp_path / "run.yaml").write_text("problem: peg_in_hole_2d")
    assert is_robot_run(load(tmp_path / "run.yaml", overrides=overrides), rate_hz) is expected


def test_reasons_are_the_last_ones() -> None:
    held: list[str] = []
    reasons = RobotFindings(lambda: held.append("once"))
    reasons.event("holding", step=0, reason="a: has not appeared")
    reasons.event("holding", step=1, reason="a: has not appeared")
    assert held == ["once"]
    reasons.event("refused", service="a", final=False, code="busy", reason="later")
    reasons.event("unreachable", service="b", reason="no route")
    reasons.event("unreachable", service="b", reason="no answer")
    reasons.event("refused", service="a", final=True, code="other_code", reason="other digest")
    assert reasons.refusals == {"a": "other_code: other digest"}
    assert reasons.unreachable == {"b": "no answer"}
