"""FairScheduler: who has much to do waits, by owners, and nobody waits for that."""

import asyncio

import pytest

from holdfast.transport import link_settings
from holdfast.transport.link_settings import SLICE_S, FairScheduler


class Busy:
    """Takes so many slices, and notes each."""

    def __init__(
        self, scheduler: FairScheduler, owner: object, number: int, taken: list[object]
    ) -> None:
        self._scheduler = scheduler
        self._number = number
        self._taken = taken
        self.owner = owner

    def enqueue(self) -> None:
        self._scheduler.enqueue(self.owner, self.run_slice)

    def run_slice(self) -> None:
        self._taken.append(self.owner)
        self._number -= 1
        if self._number:
            self.enqueue()


async def test_owners_go_by_turns_however_many_they_are() -> None:
    scheduler, taken = FairScheduler(), list[object]()
    for _ in range(3):
        Busy(scheduler, "mallory", 2, taken).enqueue()
    Busy(scheduler, "anna", 3, taken).enqueue()
    while len(taken) < 9:
        await asyncio.sleep(0)
    assert taken == ["mallory", "anna"] * 3 + ["mallory"] * 3


async def test_waiting_ones_go_on_for_so_long_in_each_turn_of_the_loop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each slice takes 1 ms of the thread's time, and a turn has 2 ms."""
    scheduler, taken = FairScheduler(), list[object]()
    monkeypatch.setattr(link_settings, "_TURN_S", 0.002)
    monkeypatch.setattr(link_settings, "thread_time", lambda: 1e-3 * len(taken))
    for owner in ("anna", "berta", "mallory"):
        Busy(scheduler, owner, 2, taken).enqueue()
    for turn in range(3):
        assert len(taken) == 2 * turn
        await asyncio.sleep(0)
    assert taken == ["anna", "berta", "mallory"] * 2
    assert not scheduler._waiting


async def test_a_slice_that_fails_stops_no_other() -> None:
    scheduler, taken = FairScheduler(), list[object]()

    def fails() -> None:
        raise RuntimeError

    scheduler.enqueue("mallory", fails)
    Busy(scheduler, "anna", 1, taken).enqueue()
    asyncio.get_running_loop().set_exception_handler(lambda *_: None)
    for _ in range(2):
        await asyncio.sleep(0)
    assert taken == ["anna"]


async def test_all_that_is_handled_at_once_takes_half_of_the_time() -> None:
    scheduler = FairScheduler()
    for number in range(3):
        assert scheduler.may_run(number, 1.0)
        scheduler.charge(number, 0.9 * SLICE_S)
    assert not scheduler.may_run("anna", 1.004)
    assert scheduler.may_run("anna", 1.006)


async def test_an_owner_has_one_turn_at_once_in_a_while() -> None:
    scheduler = FairScheduler()
    assert scheduler.may_run("mallory", 1.0)
    scheduler.charge("mallory", 0.75 * SLICE_S)
    assert scheduler.may_run("mallory", 1.001)
    scheduler.charge("mallory", 0.75 * SLICE_S)
    assert not scheduler.may_run("mallory", 1.002)
    assert scheduler.may_run("anna", 1.002)
    assert scheduler.may_run("mallory", 1.006)


async def test_nobody_overtakes_another_of_the_same_owner() -> None:
    scheduler, taken = FairScheduler(), list[object]()
    Busy(scheduler, "mallory", 1, taken).enqueue()
    assert not scheduler.may_run("mallory", 1.0)
    assert scheduler.may_run("anna", 1.0)
    await asyncio.sleep(0)
    assert scheduler.may_run("mallory", 1.0)


async def test_between_turns_there_may_be_a_pause() -> None:
    taken: list[object] = []
    for pause_s in (3600.0, 1e-4):
        scheduler = FairScheduler(pause_s)
        Busy(scheduler, pause_s, 2, taken).enqueue()
    while len(taken) < 2:
        await asyncio.sleep(0.001)
    assert taken == [1e-4, 1e-4]


async def test_a_slice_that_is_used_up_is_over_and_a_window_ends_on_time() -> None:
    scheduler = FairScheduler()
    assert scheduler.may_run("mallory", 1.0)
    scheduler.charge("mallory", SLICE_S)
    assert not scheduler.may_run("mallory", 1.0)
    ends_at = scheduler._window_ends_at
    assert ends_at == 1.005
    assert not scheduler.may_run("mallory", 1.0049)
    assert scheduler.may_run("mallory", ends_at)
