"""Ending signals as callbacks: the first is handled, the second has its usual effect."""

import asyncio
import signal
import threading
from collections.abc import Iterator

import pytest

from holdfast.robot.ending_signals import ending_signals


@pytest.fixture
def loop() -> Iterator[asyncio.AbstractEventLoop]:
    loop = asyncio.new_event_loop()
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield loop
    signal.signal(signal.SIGINT, before)
    loop.close()


def test_the_first_is_a_callback_and_the_second_interrupts(loop: asyncio.AbstractEventLoop) -> None:
    numbers: list[int] = []
    with pytest.raises(KeyboardInterrupt), ending_signals(loop, numbers.append):
        signal.raise_signal(signal.SIGINT)
        assert numbers == [signal.SIGINT]
        signal.raise_signal(signal.SIGINT)
    assert numbers == [signal.SIGINT]


def test_handlers_are_as_before_afterwards(loop: asyncio.AbstractEventLoop) -> None:
    before = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]
    with ending_signals(loop, lambda _: None):
        assert signal.getsignal(signal.SIGTERM) != before[1]
    after = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]
    assert after == before


def test_an_ignored_signal_stays_ignored(loop: asyncio.AbstractEventLoop) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with ending_signals(loop, lambda _: None):
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_another_thread_changes_no_handler(loop: asyncio.AbstractEventLoop) -> None:
    def enter() -> None:
        with ending_signals(loop, lambda _: None):
            handlers.append(signal.getsignal(signal.SIGINT))

    handlers: list[object] = []
    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    assert handlers == [signal.default_int_handler]
