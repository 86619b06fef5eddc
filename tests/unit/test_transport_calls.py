"""The table of calls in flight: each call's events in order, and one end."""

from __future__ import annotations

import pytest

from holdfast.protocol.events import (
    CallEnded,
    ServiceAppeared,
    ServiceVanished,
    TransportEvent,
)
from holdfast.protocol.messages import Refused, decode_reply
from holdfast.transport.calls import CallTable, PendingCall, too_large


class Table:
    def __init__(self) -> None:
        self.events: list[TransportEvent] = []
        self.calls = CallTable()
        self.calls.open(self.events.append)

    def begin(self, number: int, peer: object = "peer") -> PendingCall:
        call = self.calls.begin(number, peer)
        assert call is not None
        return call


@pytest.fixture
def table() -> Table:
    return Table()


def test_a_service_that_vanishes_ends_its_own_calls_after_that(table: Table) -> None:
    table.begin(1, "a")
    table.begin(2, "b")
    table.begin(3, "a")
    table.calls.appeared("cloud", "i1")
    table.calls.vanished("cloud", "i1", "a")
    assert table.events == [
        ServiceAppeared("cloud", "i1"),
        ServiceVanished("cloud", "i1"),
        CallEnded(1),
        CallEnded(3),
    ]
    table.calls.peer_lost("b")
    assert table.events[-1] == CallEnded(2)


def test_a_call_begun_while_the_loss_is_reported_belongs_to_the_next_process() -> None:
    calls, events = CallTable(), list[TransportEvent]()

    def deliver(event: TransportEvent) -> None:
        events.append(event)
        if isinstance(event, ServiceVanished):
            calls.abandon(1)
            assert calls.begin(1, "a") is not None

    calls.open(deliver)
    calls.begin(1, "a")
    calls.vanished("cloud", "i1", "a")
    assert events == [ServiceVanished("cloud", "i1")]


def test_a_request_that_is_too_large_is_refused_with_both_sizes() -> None:
    refused = decode_reply(too_large(12, 10))
    assert isinstance(refused, Refused)
    assert "12 bytes" in refused.text
    assert "10 are allowed" in refused.text
