"""The thread on which a typed service answers: its bound, and its end."""

from __future__ import annotations

import threading
from concurrent.futures import Future

from holdfast_ros.decision_thread import DecisionThread

PATIENCE_S = 30.0


def refused(reason: str) -> str:
    return f"refused: {reason}"


def held(thread: DecisionThread) -> tuple[threading.Event, Future[str]]:
    """Return a request that is being answered until the event is set."""
    begun, may_end = threading.Event(), threading.Event()

    def answer() -> str:
        begun.set()
        assert may_end.wait(PATIENCE_S)
        return "first"

    future = thread.submit(answer, refused)
    assert begun.wait(PATIENCE_S)
    return may_end, future


def test_too_many_are_refused_while_nothing_moves() -> None:
    thread = DecisionThread(1)
    may_end, first = held(thread)
    second = thread.submit(lambda: "second", refused)
    third = thread.submit(lambda: "third", refused)
    assert third.result(0.0) == "refused: 1 requests are waiting already"
    may_end.set()
    assert [first.result(PATIENCE_S), second.result(PATIENCE_S)] == ["first", "second"]
    thread.close(PATIENCE_S)


def test_what_is_owed_is_answered_and_nothing_new_is_taken() -> None:
    thread = DecisionThread(1)
    may_end, first = held(thread)
    thread.take_no_more()
    assert thread.is_busy
    assert thread.submit(lambda: "late", refused).result(0.0) == "refused: this service ends"
    may_end.set()
    assert first.result(PATIENCE_S) == "first"
    thread.close(PATIENCE_S)
    thread.close(PATIENCE_S)


def test_closing_cancels_what_waits() -> None:
    thread = DecisionThread(1)
    may_end, first = held(thread)
    second = thread.submit(lambda: "second", refused)
    thread.close(0.0)
    assert second.cancelled()
    may_end.set()
    assert first.result(PATIENCE_S) == "first"
