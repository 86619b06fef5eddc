"""The table of the statuses, and the page that is made from it."""

from pathlib import Path

import pytest

from holdfast.errors import IllegalTransitionError
from holdfast.protocol.status import TRANSITIONS, Cause, Status, StatusTracker, diagram, next_status

PAGE = Path(__file__).parents[2] / "docs" / "status.md"


def test_the_thesis_statuses_in_its_order() -> None:
    status = Status.STANDARD
    passed = []
    for cause in (Cause.CLOUD_LOST, Cause.CLOUD_ANSWERED, Cause.CLOUD_LOST):
        status = next_status(status, cause)
        passed.append(status.value)
    assert passed == ["local_recovery", "keep_alive", "local_recovery"]


@pytest.mark.parametrize("status", Status)
@pytest.mark.parametrize("cause", Cause)
def test_what_is_not_in_the_table_raises(status: Status, cause: Cause) -> None:
    if (status, cause) in TRANSITIONS:
        assert next_status(status, cause) is TRANSITIONS[status, cause]
    else:
        with pytest.raises(IllegalTransitionError, match=f"{cause.name} in status {status.value}"):
            next_status(status, cause)


def test_nothing_leads_back_to_standard() -> None:
    assert Status.STANDARD not in TRANSITIONS.values()


def test_the_page_shows_the_table() -> None:
    assert f"```mermaid\n{diagram()}```" in PAGE.read_text(), (
        "docs/status.md does not show the transition table; put holdfast.protocol.status.diagram() "
        "into it"
    )


def test_an_illegal_cause_changes_nothing() -> None:
    tracker = StatusTracker()
    with pytest.raises(IllegalTransitionError):
        tracker.change(Cause.CLOUD_ANSWERED, "seen", 1.0)
    assert (tracker.status, tracker.recoveries) == (Status.STANDARD, 0)
    assert tracker.change(Cause.CLOUD_LOST, "gone", 2.0, 0.25)["silent_ms"] == 250.0
    assert tracker.is_recovering
    assert tracker.change(Cause.CLOUD_ANSWERED, "back", 3.5)["outage_ms"] == 1500.0
    assert (tracker.status, tracker.recoveries) == (Status.KEEP_ALIVE, 1)


def test_each_loss_is_counted_and_timed_from_its_own_beginning() -> None:
    tracker = StatusTracker()
    assert not tracker.is_recovering
    for turn, start in enumerate((2.0, 10.0), 1):
        lost = tracker.change(Cause.CLOUD_LOST, "gone", start)
        assert (lost["to"], lost["reason"]) == ("local_recovery", "gone")
        assert "silent_ms" not in lost  # it was never there
        assert "outage_ms" not in lost
        back = tracker.change(Cause.CLOUD_ANSWERED, "back", start + 0.5)
        assert (back["from"], back["to"]) == ("local_recovery", "keep_alive")
        assert back["outage_ms"] == 500.0
        assert tracker.recoveries == turn
    assert not tracker.is_recovering
