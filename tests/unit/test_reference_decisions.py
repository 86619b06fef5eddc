"""The robot's own first decisions, and answers that agree with them or differ."""

from pathlib import Path

import pytest

from holdfast.config.loader import load
from holdfast.errors import HoldfastError
from holdfast.protocol.messages import Progress, Reply, SensingAnswer, TaskAnswer
from holdfast.robot.reference_decisions import answer_in, reference_decisions

EXAMPLE = Path(__file__).parents[2] / "examples" / "peg_in_hole_2d.yaml"


def test_an_answer_agrees_only_if_every_bit_does() -> None:
    configuration = load(EXAMPLE, overrides={"particle_filter.num_particles": 50})
    first, second = reference_decisions(configuration)
    assert first.request.session_configuration is not None
    assert first.request.session_configuration.problem == "peg_in_hole_2d"
    assert (first.request.inputs, len(second.request.inputs)) == ((), 1)
    actions = next(each for each in second.answer if isinstance(each, bytes))
    sensing_action, arrives = next(each for each in second.answer if isinstance(each, tuple))
    replies: list[Reply] = [
        Progress(1, True),
        TaskAnswer(1, 1, actions, 0),
        SensingAnswer(1, 9, sensing_action, arrives, 0),
    ]
    assert answer_in(replies) == second.answer != first.answer
    assert answer_in(replies[:2]) != second.answer
    other = bytes([actions[0] ^ 1, *actions[1:]])
    assert answer_in([TaskAnswer(1, 1, other, 0), replies[2]]) != second.answer


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
        reference_decisions(load(path))
