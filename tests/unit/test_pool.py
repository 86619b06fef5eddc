"""Threads of both shells: results come back to the loop, and errors do, too."""

import asyncio
import os
import sys
import threading

import pytest

from holdfast.runtime.pool import ThreadPool


async def test_results_come_back_on_the_loops_thread() -> None:
    errors: list[BaseException] = []
    pool = ThreadPool(2, "test", errors.append)
    done: asyncio.Future[tuple[str, str]] = asyncio.get_running_loop().create_future()
    here = threading.current_thread()
    pool.submit(
        lambda: threading.current_thread().name,
        lambda name: done.set_result((name, threading.current_thread().name)),
    )
    assert pool.num_open == 1
    name, of_result = await done
    assert name.startswith("test-")
    assert of_result == here.name
    assert pool.num_open == 0
    assert errors == []
    pool.close()


async def test_an_error_is_handed_over_and_the_thread_goes_on() -> None:
    loop = asyncio.get_running_loop()
    failed: asyncio.Future[BaseException] = loop.create_future()
    pool = ThreadPool(1, "test", failed.set_result)
    pool.submit(lambda: 1 // 0, lambda _: None)
    assert isinstance(await failed, ZeroDivisionError)
    done: asyncio.Future[int] = loop.create_future()
    pool.submit(lambda: 7, done.set_result)
    assert await done == 7
    pool.close()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere it is the whole process's")
async def test_only_its_own_threads_are_nice() -> None:
    before = os.getpriority(os.PRIO_PROCESS, 0)
    found: asyncio.Future[int] = asyncio.get_running_loop().create_future()
    pool = ThreadPool(1, "nice", niceness=3)
    pool.submit(
        lambda: os.getpriority(os.PRIO_PROCESS, threading.get_native_id()), found.set_result
    )
    assert await found == min(19, before + 3)
    assert os.getpriority(os.PRIO_PROCESS, 0) == before
    pool.close()


async def test_a_sandbox_that_refuses_it_stops_no_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """Found by a real unit of systemd: its threads ended, and no decision came."""

    def refused(*_: int) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "setpriority", refused)
    found: asyncio.Future[int] = asyncio.get_running_loop().create_future()
    pool = ThreadPool(1, "nice", niceness=3)
    pool.submit(lambda: 7, found.set_result)
    async with asyncio.timeout(30.0):
        assert await found == 7
    pool.close()


async def test_no_more_threads_than_allowed() -> None:
    pool = ThreadPool(2, "few", lambda _: None)
    gate = threading.Event()
    names: set[str] = set()
    done: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    def work() -> str:
        gate.wait()
        return threading.current_thread().name

    def note(name: str) -> None:
        names.add(name)
        if pool.num_open == 0:
            done.set_result(None)

    for _ in range(6):
        pool.submit(work, note)
    assert pool.num_open == 6
    gate.set()
    await done
    assert names <= {"few-0", "few-1"}
    pool.close()


async def test_after_the_end_nothing_is_delivered_and_the_last_function_runs() -> None:
    pool = ThreadPool(1, "test")
    gate = threading.Event()
    delivered: list[object] = []
    ran: list[str] = []

    def first() -> None:
        gate.wait()
        ran.append("first")

    pool.submit(first, delivered.append)
    pool.close(last=lambda: ran.append("last"))
    assert ran == []
    gate.set()
    pool.close(30.0)
    await asyncio.sleep(0)
    assert (ran, delivered) == (["first", "last"], [])


def test_the_last_function_runs_also_when_the_loop_ends_before_the_work_does() -> None:
    gate, ended = threading.Event(), threading.Event()

    async def submit() -> None:
        pool = ThreadPool(1, "test")
        pool.submit(gate.wait, lambda _: None)
        pool.close(last=ended.set)

    asyncio.run(submit())
    gate.set()
    assert ended.wait(30.0)
