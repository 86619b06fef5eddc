"""How often a late question is asked twice."""

from __future__ import annotations

import pytest

from holdfast.config.settings import OffloadSettings, PlanningSettings
from holdfast.planning import Planner
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.protocol.hedging import HedgingBudget
from holdfast.protocol.question import Question


def awaited_since(needed_at: float | None) -> Question:
    planner = Planner(PegInHole2D(), PlanningSettings())
    state = planner.init(1)
    question = Question(planner.settings, state, planner.digest(state), (), 0)
    if needed_at is not None:
        question.wait(needed_at)
    return question


def test_a_question_is_late_after_the_deadline_if_the_robot_waits_for_it() -> None:
    budget = HedgingBudget(OffloadSettings(decision_deadline_ms=20.0))
    assert budget.due_at(awaited_since(1.0)) == pytest.approx(1.02)
    assert budget.due_at(awaited_since(None)) is None
    assert HedgingBudget(OffloadSettings()).due_at(awaited_since(1.0)) is None


def test_in_the_long_run_the_share_of_hedges_is_bounded() -> None:
    budget = HedgingBudget(OffloadSettings(decision_deadline_ms=20.0, max_hedged_share=0.25))
    asked = awaited_since(1.0)
    hedges = 0
    for _ in range(400):
        budget.earn()
        if budget.due_at(asked) is not None:
            budget.spend()
            hedges += 1
    assert 100 <= hedges <= 103
