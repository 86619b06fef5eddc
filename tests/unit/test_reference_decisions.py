"""The robot's own first decisions, and answers that agree with them or differ."""

from __future__ import annotations

from pathlib import Path

import pytest

from holdfast.config.loader import load
from holdfast.errors import HoldfastError
from holdfast.planning import digest
from holdfast.protocol.messages import DIGEST_SIZE, Reply, SensingAnswer, TaskAnswer, encode_floats
from holdfast.robot.reference_decisions import ReferenceDecisions

EXAMPLE = Path(__file__).parents[2] / "examples" / "peg_in_hole_2d.yaml"


def test_an_answer_agrees_only_if_every_bit_does() -> None:
    configuration = load(EXAMPLE, overrides={"particle_filter.num_particles": 50})
    decisions = ReferenceDecisions.of(configuration)
    assert decisions.session_configuration.problem == "peg_in_hole_2d"
    first, second = decisions.turns
    assert (first.observations, len(second.observations)) == ((), 1)
    actions, sensing_action, ahead = second.decision
    assert sensing_action is not None
    replies: list[Reply] = [
        TaskAnswer(1, len(actions), b"".join(map(encode_floats, actions)), 0),
        SensingAnswer(1, ahead.step, sensing_action, digest(ahead)[:DIGEST_SIZE], 0),
    ]
    assert second.agrees_with(replies)
    assert not second.agrees_with(replies[:1])
    assert not first.agrees_with(replies)


def test_a_problem_that_fails_is_named(tmp_path: Path) -> None:
    (tmp_path / "reference_failing.py").write_text(
        "from holdfast.problems.peg_in_hole_2d import PegInHole2D\n"
        "class Failing(PegInHole2D):\n"
        "    def policy(self, *arguments):\n"
        "        raise ZeroDivisionError('a defect')\n"
    )
    path = tmp_path / "failing.yaml"
    path.write_text("problem: reference_failing:Failing\n")
    with pytest.raises(HoldfastError, match="ZeroDivisionError: a defect"):
        ReferenceDecisions.of(load(path))
