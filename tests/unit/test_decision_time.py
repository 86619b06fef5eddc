"""Where the time of a decision goes: functions are counted once, and nothing else changes."""

from __future__ import annotations

from typing import Any

import numpy as np
from tests.unit.test_problem_check import Rover

import holdfast as hf
from holdfast.planning.settings import PlanningSettings
from holdfast.tuning.decision_time import FunctionTimes, check_decision_time
from holdfast.tuning.findings import Inspection


class OtherMove(hf.make("peg_in_hole_2d").__class__):  # type: ignore[misc]
    """Inherits a path that does not agree with its own move."""

    def move(self, states: Any, actions: Any, stream: Any) -> Any:
        return super().move(states, 0.5 * actions, stream)


def test_decisions_are_the_same_and_calls_are_counted() -> None:
    problems: list[Any] = [Rover(), hf.make("peg_in_hole_2d"), OtherMove.from_settings({}, {})]
    for problem in problems:
        times = FunctionTimes(problem)
        plain, timed = hf.Planner(problem), hf.Planner(times.problem)
        state = plain.init(1)
        first, info = plain.choose_sensing_action(state)
        again, timed_info = timed.choose_sensing_action(state)
        assert first == again
        assert np.array_equal(info.entropies, timed_info.entropies)  # type: ignore[arg-type]
        assert times.calls["policy"] >= 1
        assert set(times.seconds) == set(times.calls)
        assert ("expected_path" in times.calls) == (type(problem).__name__ == "PegInHole2D")
        assert not hasattr(problem, "calls")


def test_a_function_that_calls_another_counts_for_both() -> None:
    class Nested(Rover):
        def policy(self, states: Any, stage: Any) -> Any:
            return self.execute(-states)

    times = FunctionTimes(Nested())
    times.problem.policy(np.zeros((3, 2)), 0)
    assert times.calls == {"policy": 1}


def test_it_is_information() -> None:
    inspection = Inspection(Rover(), PlanningSettings(), 100, 0, 1e6)
    check_decision_time(inspection, [])
    (found,) = inspection.findings
    assert (found.severity, found.check) == ("information", "time")
    assert "ms of processor time (path_entropy, 300 particles)" in found.seen
    assert "the kernel" in found.seen
