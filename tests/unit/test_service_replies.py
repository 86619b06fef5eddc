"""Calls that wait, and what they are sent."""

import pytest
from tests.unit.test_protocol_service import Robot

from holdfast.protocol.computing_time import ExpectedTime
from holdfast.protocol.effects import Effects
from holdfast.protocol.messages import Busy, Progress, Refused, Reply, decode_reply
from holdfast.protocol.service_jobs import EndCall, SendReply, ServiceEffect
from holdfast.protocol.service_limits import ServiceLimits, ServiceStatistics
from holdfast.protocol.service_replies import WaitingCalls
from holdfast.protocol.service_sessions import PendingTask, Session


class Replies:
    """Two calls at most wait for a task; progress is due every 50 ms."""

    def __init__(self) -> None:
        limits = ServiceLimits(max_calls_per_request=2, progress_interval_ms=50.0)
        self.effects: Effects[ServiceEffect] = Effects()
        self.statistics = ServiceStatistics()
        self.calls = WaitingCalls(limits, self.statistics, self.effects)
        robot = Robot()
        request = robot.request()
        key = None, request.session
        times = ExpectedTime(0.001), ExpectedTime(0.001)
        session = Session(key, request, robot.session_configuration, times)
        self.task = PendingTask(
            session, b"d" * 16, sensing=True, request=request, state=None, size=9, since=0.0
        )

    def sent(self) -> list[tuple[int, Reply]]:
        """Return the replies since the last time, with their calls."""
        sent = [
            (each.call, decode_reply(each.payload))
            for each in self.effects
            if isinstance(each, SendReply)
        ]
        self.effects.clear()
        return sent


def test_a_call_that_waits_gets_signs_of_life() -> None:
    replies = Replies()
    replies.calls.attach(replies.task, 1, 11, 0.0)
    replies.calls.attach(replies.task, 2, 12, 0.045)
    assert replies.calls.progress_at() == pytest.approx(0.05)
    replies.calls.send_progress(0.049)
    assert not replies.sent()
    replies.calls.send_progress(0.05)
    assert replies.sent() == [(1, Progress(11, waiting=True))]
    assert replies.calls.progress_at() == pytest.approx(0.095)


def test_the_oldest_of_too_many_calls_is_ended() -> None:
    replies = Replies()
    for call in (1, 2, 3):
        replies.calls.attach(replies.task, call, call, 0.0)
    assert replies.effects == [EndCall(1)]
    assert [each.call for each in replies.calls.detach(replies.task)] == [2, 3]
    assert len(replies.calls) == 0


def test_refusals_are_short_text_and_counted() -> None:
    replies = Replies()
    replies.calls.send_refused(1, 11, "failed", "\ud800" + "x" * 5000)
    ((_, refused),) = replies.sent()
    assert isinstance(refused, Refused)
    assert len(refused.text) == 4000
    assert replies.statistics.refusals == {"failed": 1}


def test_robots_that_are_turned_away_together_come_back_apart() -> None:
    replies = Replies()
    for session in range(50):
        replies.calls.send_busy(1, 11, bytes([session]) * 16, 1000.0, 5)
    waits = [reply.retry_after_ms for _, reply in replies.sent() if isinstance(reply, Busy)]
    assert all(1000 <= wait <= 1250 for wait in waits)
    assert len(set(waits)) > 25
    assert replies.statistics.busy == 50
