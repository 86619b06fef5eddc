"""A loop on its own thread: results, limits and its end."""

import asyncio
import threading
from typing import Any

import pytest

from holdfast.errors import TransportError
from holdfast_ros.loop_thread import LoopThread

PATIENCE_S = 30.0


def test_results_and_errors_of_coroutines_come_back() -> None:
    async def name() -> str:
        return threading.current_thread().name

    async def fail() -> None:
        raise TimeoutError("of its own")

    thread = LoopThread("the-loop")
    assert thread.run(name(), PATIENCE_S) == "the-loop"
    with pytest.raises(TimeoutError, match="of its own"):
        thread.run(fail())
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


def test_who_comes_while_the_loop_closes_does_not_wait_for_ever(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    thread = LoopThread("the-loop")
    begun, asked, ended = threading.Event(), threading.Event(), threading.Event()

    def run() -> None:
        with pytest.raises(TransportError, match="it is closed"):
            thread.run(asyncio.Event().wait())
        ended.set()

    async def wait() -> None:
        begun.set()
        try:
            await asyncio.Event().wait()
        finally:
            threading.Thread(target=run, daemon=True).start()
            assert asked.wait(PATIENCE_S)

    def submit(coroutine: Any, loop: Any, real: Any = asyncio.run_coroutine_threadsafe) -> Any:
        future = real(coroutine, loop)
        asked.set()
        return future

    asyncio.run_coroutine_threadsafe(wait(), thread._loop)
    assert begun.wait(PATIENCE_S)
    monkeypatch.setattr(asyncio, "run_coroutine_threadsafe", submit)
    thread.close(PATIENCE_S)
    assert ended.wait(PATIENCE_S)
