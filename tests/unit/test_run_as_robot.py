"""Which runs are a robot's, and why services were given up."""

from pathlib import Path

import pytest

from holdfast.cli.run import RobotFindings, is_robot_run
from holdfast.cli.run_options import RunOptions
from holdfast.config.loader import load


@pytest.mark.parametrize(
    ("words", "overrides", "expected"),
    [
        ([], {}, False),
        (["--rate", "10"], {}, True),
        (["--view", "rerun=10.0.0.7"], {}, True),
        (["--view-file", "run.rrd"], {}, True),
        ([], {"offload.services": ["tcp/127.0.0.1:7447"]}, True),
        ([], {"environment.object": "somebodys_robot"}, True),
    ],
)
def test_a_robots_run(
    words: list[str], overrides: dict[str, object], expected: bool, tmp_path: Path
) -> None:
    (tmp_path / "run.yaml").write_text("problem: peg_in_hole_2d")
    options = RunOptions.parse("run", ["run.yaml", *words])
    configuration = load(tmp_path / "run.yaml", overrides=overrides)
    assert is_robot_run(options, configuration) is expected


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
