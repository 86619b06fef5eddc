"""What is shown of a run: complete if there is time, and never waited for."""

import threading
from pathlib import Path

import numpy as np
import pytest

from holdfast.config.loader import Configuration, load
from holdfast.planning.planner import Planner, PlanningState
from holdfast.protocol.robot_events import Act, Sense, Timing
from holdfast.robot.links import RECOVERY_SERVICE
from holdfast_ros.ros2 import telemetry as module
from holdfast_ros.ros2.telemetry import PublishedDecision, Telemetry

CONFIGURATION = Path(__file__).parents[2] / "examples" / "peg_in_hole_2d.yaml"
LONG_S = 60.0


class Audience:
    """Keeps what it is shown; may be slow."""

    def __init__(self, configuration: Configuration, *, entropies: bool = True) -> None:
        self.orders: list[PublishedDecision] = []
        self.beliefs: list[PlanningState] = []
        self.errors: list[Exception] = []
        self.noticed = threading.Event()
        self.may_go_on = threading.Event()
        self.may_go_on.set()
        self.telemetry = Telemetry(
            configuration,
            self.order,
            self.beliefs.append,
            self.noticed.set,
            self.errors.append,
            belief_rate_hz=1e9,
            wants_entropies=lambda: entropies,
        )

    def order(self, shown: PublishedDecision) -> None:
        self.may_go_on.wait(LONG_S)
        if shown.decided_by == "nobody":
            raise ValueError("nobody")
        self.orders.append(shown)


def beginning() -> tuple[Configuration, PlanningState]:
    configuration = load(CONFIGURATION)
    state = Planner(configuration.problem, configuration.planning).init(0, 0)
    return configuration, state


def test_an_order_is_shown_with_entropies_and_belief() -> None:
    configuration, state = beginning()
    chosen, info = Planner(configuration.problem, configuration.planning).choose_sensing_action(
        state
    )
    audience = Audience(configuration)
    audience.telemetry.time(Timing(0, 0, "sensing", "cloud", "standard", 0.0, 0.0, 0.0))
    audience.telemetry.order(state, Sense(0, chosen), "standard")
    audience.telemetry.order(state, Act(0, np.ones(3)), "standard")
    audience.telemetry.close(LONG_S)
    sensing, acting = audience.orders
    np.testing.assert_array_equal(sensing.entropies, info.entropies)
    assert (sensing.sensing_action, sensing.decided_by) == (chosen, "cloud")
    assert (acting.sensing_action, acting.task_action.tolist()) == (None, [1.0, 1.0, 1.0])
    assert [belief is state for belief in audience.beliefs] == [True, True]


def test_who_decided_in_another_status_is_not_named() -> None:
    audience = Audience(beginning()[0])
    assert audience.telemetry.decided_in("standard") == ""
    audience.telemetry.time(Timing(0, 0, "task", "cloud", "standard", 0.0, 0.0, 0.0))
    assert audience.telemetry.decided_in("standard") == "cloud"
    assert audience.telemetry.decided_in("local_recovery") == ""
    # An answer of before, which is used only now.
    audience.telemetry.time(Timing(0, 1, "task", "cloud", "local_recovery", 0.0, 0.0, 0.0))
    assert audience.telemetry.decided_in("local_recovery") == ""
    audience.telemetry.time(Timing(0, 2, "task", RECOVERY_SERVICE, "local_recovery", 0, 0, 0))
    assert audience.telemetry.decided_in("local_recovery") == RECOVERY_SERVICE
    audience.telemetry.close(LONG_S)


def test_entropies_that_nobody_hears_are_not_computed() -> None:
    configuration, state = beginning()
    audience = Audience(configuration, entropies=False)
    audience.telemetry.order(state, Sense(0, 0), "standard")
    audience.telemetry.close(LONG_S)
    assert audience.orders[0].entropies.size == 0


def test_who_looks_on_slowly_misses_beliefs_first_and_holds_up_nobody(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "_MAX_STATE_BYTES", 0)
    monkeypatch.setattr(module, "_LATE_S", LONG_S)
    configuration, state = beginning()
    audience = Audience(configuration)
    audience.may_go_on.clear()
    count = module._MAX_NOTES + 50
    for step in range(count):
        audience.telemetry.order(state._replace(step=step), Act(step, np.ones(3)), "standard")
    audience.may_go_on.set()
    audience.telemetry.close(LONG_S)
    # The first one was being shown.
    assert audience.telemetry.dropped_decisions in (49, 50)
    assert len(audience.orders) == count - audience.telemetry.dropped_decisions
    assert audience.orders[-1].step == count - 1
    assert len(audience.beliefs) <= module._MIN_STATES + 1


def test_what_comes_too_late_has_no_belief(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_LATE_S", -1.0)
    configuration, state = beginning()
    audience = Audience(configuration)
    audience.telemetry.order(state, Sense(0, 0), "standard")
    audience.telemetry.close(LONG_S)
    assert audience.beliefs == []
    assert audience.orders[0].entropies.size == 0


def test_an_error_is_told_once_and_ends_nothing() -> None:
    configuration, state = beginning()
    audience = Audience(configuration)
    audience.telemetry.time(Timing(0, 0, "task", "nobody", "standard", 0.0, 0.0, 0.0))
    for step in range(2):
        audience.telemetry.order(state, Act(step, np.ones(3)), "standard")
    audience.telemetry.time(Timing(0, 0, "task", "cloud", "standard", 0.0, 0.0, 0.0))
    audience.telemetry.order(state, Act(2, np.ones(3)), "standard")
    audience.telemetry.notice()
    audience.telemetry.close(LONG_S)
    assert [str(error) for error in audience.errors] == ["nobody"]
    assert [shown.step for shown in audience.orders] == [0]
    assert audience.noticed.is_set()
