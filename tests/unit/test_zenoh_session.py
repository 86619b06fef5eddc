"""A Zenoh session that waits for its router, and one that listens."""

from __future__ import annotations

import queue
import socket
from time import monotonic
from typing import Any

import pytest
from tests.ports import free_port

from holdfast.errors import TransportError
from holdfast.ros.zenoh_session import ZenohSession, ignore_event

PATIENCE_S = 30.0


def session(port: int, *, listens: bool, on_event: Any = ignore_event) -> ZenohSession:
    return ZenohSession(
        f"tcp/127.0.0.1:{port}", listens=listens, on_open=lambda _: None, on_event=on_event
    )


def test_it_connects_to_a_router_that_comes_later() -> None:
    port = free_port()
    events: queue.SimpleQueue[str] = queue.SimpleQueue()
    client = session(port, listens=False, on_event=lambda name, **_: events.put(name))
    client.open()
    assert events.get(timeout=PATIENCE_S) == "ros2_waiting"
    with pytest.raises(TransportError, match="no router of Zenoh answers there"):
        client.get(monotonic() + PATIENCE_S)
    router = session(port, listens=True)
    router.open()
    assert events.get(timeout=PATIENCE_S) == "ros2_connected"
    assert not client.get(monotonic() + PATIENCE_S).is_closed()
    for each in (client, client, router):
        each.close()
    with pytest.raises(TransportError, match="closed"):
        client.get(monotonic() + PATIENCE_S)


def test_a_port_that_is_taken_is_named() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        taken = session(listening.getsockname()[1], listens=True)
        with pytest.raises(TransportError, match=r"cannot listen on tcp/.*: "):
            taken.open()
