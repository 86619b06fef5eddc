"""What /diagnostics says of a run: how bad it is, and what is known last."""

from types import SimpleNamespace
from typing import Any

import pytest

from holdfast.planning.settings import RecoverySettings
from holdfast.robot.health import Condition
from holdfast_ros.ros2.diagnostics import Diagnostics, Level, RobotDiagnosis
from holdfast_ros.ros2.run_segment import Ending, SegmentResult


def running(word: str, status: str, num_finished: int = 0) -> Any:
    """Return a part of a run, as far as the diagnostics look at it."""
    return SimpleNamespace(
        status=status,
        num_finished=num_finished,
        unexplained_observations=0,
        condition=lambda: Condition(word, True, 1) if word else None,
    )


DECIDERS: Any = SimpleNamespace(
    dropped_decisions=0, decided_in=lambda status: "cloud" if status == "standard" else ""
)
"""Who decided last."""


class Said:
    """Diagnostics with a clock of the test's."""

    def __init__(self, **settings: Any) -> None:
        self.now = 100.0
        self.diagnostics = Diagnostics(RecoverySettings(**settings), lambda: self.now)

    def tell(self, part: Any, last: SegmentResult | None = None) -> RobotDiagnosis:
        return self.diagnostics.tell(part, last, DECIDERS)


def part(ending: Ending, **fields: Any) -> SegmentResult:
    return SegmentResult(ending, "why", (), **fields)


def test_to_hold_while_the_local_service_starts_is_a_warning() -> None:
    said = Said(launch_timeout_ms=3000.0)
    holding = running("holding still", "local_recovery")
    said.diagnostics.event("holding")
    assert said.tell(holding)[:2] == (Level.WARN, "holding still")
    said.now += 3.0
    assert said.tell(holding).level == Level.WARN
    said.now += 0.1
    assert said.tell(holding).level == Level.ERROR
    said.diagnostics.event("resumed")
    assert said.tell(running("local_recovery", "local_recovery")).level == Level.WARN
    said.diagnostics.event("holding")
    assert said.tell(holding).level == Level.WARN
    assert said.tell(holding).facts["holding"] == "true"


@pytest.mark.parametrize("event", ["launch_failed", "recovery_exited"])
def test_to_hold_is_an_error_when_the_local_service_does_not_start(event: str) -> None:
    said = Said()
    holding = running("holding still", "local_recovery")
    said.diagnostics.event("holding")
    said.diagnostics.event(event)
    assert said.tell(holding).level == Level.ERROR
    said.diagnostics.event("resumed")
    said.diagnostics.event("holding")
    assert said.tell(holding).level == Level.WARN


def test_to_hold_is_an_error_at_once_where_nothing_is_started() -> None:
    said = Said(launch="never")
    said.diagnostics.event("holding")
    assert said.tell(running("holding still", "standard")).level == Level.ERROR


def test_an_alarm_is_a_warning_until_the_belief_is_a_new_one() -> None:
    said, usual = Said(), running("standard", "standard")
    assert said.tell(usual).level == Level.OK
    for event, later in (("lost", "reinitialised"), ("sensor_suspect", "trial")):
        said.diagnostics.event(event)
        assert (said.tell(usual).level, said.tell(usual).facts[event]) == (Level.WARN, "true")
        said.diagnostics.event(later)
        assert said.tell(usual).level == Level.OK
    said.diagnostics.event("wrong_answer")
    said.diagnostics.event("trial")
    assert said.tell(usual).facts["wrong_answer"] == "true"
    assert said.tell(usual).level == Level.WARN


def test_what_was_known_last_is_still_said_after_the_end() -> None:
    said = Said()
    said.tell(running("standard", "standard", 1))
    told = said.tell(None, part(Ending.FINISHED, status="local_recovery", num_finished=2))
    assert told[:2] == (Level.OK, "finished")
    assert told.facts["status"] == "local_recovery"
    assert told.facts["finished_trials"] == "2"
    # The next part has no status before it runs.
    told = said.tell(running("", "", 2), part(Ending.FINISHED))
    assert (told.word, told.facts["status"]) == ("starting", "local_recovery")


def test_nobody_decides_in_a_new_status_before_the_first_decision() -> None:
    said = Said()
    assert said.tell(running("standard", "standard")).facts["decided_by"] == "cloud"
    assert said.tell(running("local_recovery", "local_recovery")).facts["decided_by"] == ""


def test_a_run_that_is_held_is_an_error_with_its_reason() -> None:
    told = Said().tell(None, part(Ending.HELD))
    assert (told.level, told.word, told.facts["last_error"]) == (Level.ERROR, "held", "why")


def test_before_the_first_part_nothing_is_known() -> None:
    told = Said().tell(None)
    assert (told.level, told.word, told.facts["status"]) == (Level.OK, "idle", "")
