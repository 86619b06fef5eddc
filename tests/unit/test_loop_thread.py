"""A loop on its own thread: results, limits and its end."""

import asyncio
import threading

import pytest

from holdfast.errors import TransportError
from holdfast_ros.loop_thread import LoopThread

PATIENCE_S = 30.0


def test_results_and_errors_of_coroutines_come_back() -> None:
    async def name() -> str:
        return threading.current_thread().name

    async def fail() -> None:
        raise ValueError("a defect")

    thread = LoopThread("the-loop")
    assert thread.run(name(), PATIENCE_S) == "the-loop"
    with pytest.raises(ValueError, match="a defect"):
        thread.run(fail(), PATIENCE_S)
    thread.close(PATIENCE_S)


def test_a_coroutine_that_takes_too_long_is_cancelled() -> None:
    cancelled = threading.Event()

    async def wait() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            cancelled.set()

    thread = LoopThread("the-loop")
    with pytest.raises(TransportError, match="longer than 0 s"):
        thread.run(wait(), 0.0)
    assert cancelled.wait(PATIENCE_S)
    thread.close(PATIENCE_S)


def test_after_the_end_calls_do_nothing_and_waits_have_ended() -> None:
    thread = LoopThread("the-loop")
    begun = threading.Event()
    told: list[str] = []

    async def wait() -> None:
        begun.set()
        await asyncio.Event().wait()

    def run() -> None:
        with pytest.raises(TransportError, match="it is closed") as raised:
            thread.run(wait(), PATIENCE_S)
        told.append(str(raised.value))

    waiting = threading.Thread(target=run)
    waiting.start()
    assert begun.wait(PATIENCE_S)
    thread.close(PATIENCE_S)
    waiting.join(PATIENCE_S)
    assert told
    thread.close(PATIENCE_S)
    thread.call(pytest.fail, "it was called")
