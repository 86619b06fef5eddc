"""The table of calls in flight: each call's events in order, and one end."""

from holdfast.protocol.messages import Refused, decode_reply
from holdfast.protocol.robot_events import (
    CallEnded,
    ServiceAppeared,
    ServiceVanished,
    TransportEvent,
)
from holdfast.transport.calls import CallTable
from holdfast.transport.contract import too_large


def test_a_service_that_vanishes_ends_its_own_calls_after_that() -> None:
    calls, events = CallTable(), list[TransportEvent]()
    calls.open(events.append)
    calls.begin(1, "a")
    calls.begin(2, "b")
    calls.begin(3, "a")
    calls.appeared("cloud", "i1")
    calls.vanished("cloud", "i1", "a", "said goodbye")
    assert events == [
        ServiceAppeared("cloud", "i1"),
        ServiceVanished("cloud", "i1", "said goodbye"),
        CallEnded(1),
        CallEnded(3),
    ]
    calls.peer_lost("b")
    assert events[-1] == CallEnded(2)


def test_a_request_that_is_too_large_is_refused_with_both_sizes() -> None:
    refused = decode_reply(too_large(12, 10))
    assert isinstance(refused, Refused)
    assert "12 bytes" in refused.text
    assert "10 are allowed" in refused.text
