"""Worker processes that are ended, or end, at the worst moment."""

import os
import signal
import struct
import sys
import threading
from collections.abc import Iterable
from multiprocessing.connection import Connection

import pytest
from tests.programs import said_by

from holdfast.runtime.workers import WorkerProcess, end_workers


def say_half(connection: Connection) -> None:
    """Announce a thousand bytes, send ten, and die."""
    os.write(connection.fileno(), struct.pack("!i", 1000) + b"0123456789")
    os.kill(os.getpid(), signal.SIGKILL)


def wait(connection: Connection) -> None:
    connection.send_bytes(b"here")
    connection.recv_bytes()


def test_half_a_message_is_none() -> None:
    worker = WorkerProcess("half", say_half, (), 1)
    try:
        worker.start()
        assert worker.receive() is None
        assert worker.how_it_ended() == ("was killed by SIGKILL", True)
    finally:
        end_workers([worker])


def test_an_interruption_that_comes_as_signals_are_blocked(monkeypatch: pytest.MonkeyPatch) -> None:
    """CPython runs the handler of a signal that came before when the mask is set already."""
    worker = WorkerProcess("waits", wait, (), 1)
    worker.start()
    assert worker.receive() == b"here"
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    set_mask = signal.pthread_sigmask
    interrupted: list[bool] = []

    def interrupt_once(how: int, mask: Iterable[int]) -> set[int | signal.Signals]:
        found = set_mask(how, mask)
        if how == signal.SIG_BLOCK and set(mask) and not interrupted:
            interrupted.append(True)
            raise KeyboardInterrupt
        return found

    monkeypatch.setattr("signal.pthread_sigmask", interrupt_once)
    with pytest.raises(KeyboardInterrupt):
        end_workers([worker])
    assert interrupted
    assert worker.how_it_ended() == ("was killed by SIGKILL", True)
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == before
    end_workers([worker])


def test_workers_that_nobody_ended_do_not_hold_the_process_up() -> None:
    """They do not hear SIGTERM, with which multiprocessing would end them, and then wait."""
    program = """
from holdfast.runtime.workers import WorkerProcess
from tests.unit.test_workers import wait
if __name__ == "__main__":
    worker = WorkerProcess("waits", wait, (), 1)
    worker.start()
    print(worker.receive(), flush=True)
"""
    assert said_by(program) == "b'here'\n"


def test_threads_that_start_workers_leave_the_process_as_it_was() -> None:
    main, before = sys.modules["__main__"], dict(os.environ)
    workers = [WorkerProcess(f"of-thread-{number}", wait, (), 1) for number in range(12)]
    threads = [threading.Thread(target=worker.start) for worker in workers]
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert sys.modules["__main__"] is main
        assert dict(os.environ) == before
    finally:
        end_workers(workers)
