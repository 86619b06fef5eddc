"""Threads that send: few at a time, and one that is held up holds up nobody else."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from queue import SimpleQueue
from time import monotonic

import pytest

from holdfast.runtime import senders
from holdfast.runtime.senders import Senders

PATIENCE_S = 30.0


class Counted:
    """Says how many were sending when it was its turn."""

    lock = threading.Lock()
    sending = 0

    def __init__(self, lane: bytes, told: SimpleQueue[int]) -> None:
        self.lane = lane
        self._told = told
        self._others = threading.Event()

    def send(self) -> None:
        with Counted.lock:
            Counted.sending += 1
            now = Counted.sending
        self._others.wait(0.002)  # let others begin, if they may
        with Counted.lock:
            Counted.sending -= 1
        self._told.put(now)


class Blocked:
    """Sends to somebody who does not read."""

    def __init__(self, lane: bytes) -> None:
        self.lane = lane
        self.begun = threading.Event()
        self.read = threading.Event()

    def send(self) -> None:
        self.begun.set()
        assert self.read.wait(PATIENCE_S)


@pytest.fixture
def sending() -> Iterator[Senders]:
    sending = Senders("test-sender")
    sending.start()
    yield sending
    sending.close(monotonic() + PATIENCE_S)


def test_of_many_who_send_few_do_at_the_same_time(
    sending: Senders, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Thirty threads that send a little each take the interpreter from the one that decides."""
    monkeypatch.setattr(senders, "_HELD_UP_S", PATIENCE_S)
    told: SimpleQueue[int] = SimpleQueue()
    for lane in range(60):
        sending.post((Counted(lane.to_bytes(2, "big"), told),))
    most = max(told.get(timeout=PATIENCE_S) for _ in range(60))
    assert most == senders._AT_ONCE


def test_those_who_are_held_up_do_not_count(sending: Senders) -> None:
    held_up = [Blocked(bytes([lane])) for lane in range(5 * senders._AT_ONCE)]
    for each in held_up:
        sending.post((each,))
    for each in held_up:
        assert each.begun.wait(PATIENCE_S)
    told: SimpleQueue[int] = SimpleQueue()
    for lane in range(20):
        sending.post((Counted(b"free" + bytes([lane]), told),))
    for _ in range(20):
        told.get(timeout=PATIENCE_S)
    for each in held_up:
        each.read.set()
