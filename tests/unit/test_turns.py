"""Turns: who has much to do waits, by owners, and nobody waits for that."""

from __future__ import annotations

import asyncio

from holdfast.transport.turns import TURN_S, Turns


class Busy:
    """Takes so many turns, and notes each."""

    def __init__(self, turns: Turns, owner: object, number: int, taken: list[object]) -> None:
        self._turns = turns
        self._number = number
        self._taken = taken
        self.owner = owner

    def go_on(self) -> None:
        self._taken.append(self.owner)
        self._number -= 1
        if self._number:
            self._turns.wait(self)


async def test_owners_go_by_turns_however_many_they_are() -> None:
    turns, taken = Turns(), list[object]()
    for _ in range(3):
        turns.wait(Busy(turns, "mallory", 2, taken))
    turns.wait(Busy(turns, "anna", 3, taken))
    while len(taken) < 9:
        await asyncio.sleep(0)
    assert taken == ["mallory", "anna"] * 3 + ["mallory"] * 3


async def test_one_goes_on_in_each_turn_of_the_loop() -> None:
    turns, taken = Turns(), list[object]()
    for _ in range(2):
        turns.wait(Busy(turns, "mallory", 3, taken))
    for number in range(6):
        assert len(taken) == number
        await asyncio.sleep(0)


async def test_an_owner_has_one_turn_at_once_in_a_while() -> None:
    turns = Turns()
    assert turns.may_go_on("mallory", 1.0)
    turns.spend("mallory", 0.75 * TURN_S)
    assert turns.may_go_on("mallory", 1.001)
    turns.spend("mallory", 0.75 * TURN_S)
    assert not turns.may_go_on("mallory", 1.002)
    assert turns.may_go_on("anna", 1.002)
    assert turns.may_go_on("mallory", 1.006)


async def test_nobody_overtakes_another_of_the_same_owner() -> None:
    turns, taken = Turns(), list[object]()
    turns.wait(Busy(turns, "mallory", 1, taken))
    assert not turns.may_go_on("mallory", 1.0)
    assert turns.may_go_on("anna", 1.0)
    await asyncio.sleep(0)
    assert turns.may_go_on("mallory", 1.0)


async def test_between_turns_there_may_be_a_pause() -> None:
    taken: list[object] = []
    for pause_s in (3600.0, 1e-4):
        turns = Turns(pause_s)
        turns.wait(Busy(turns, pause_s, 2, taken))
    while len(taken) < 2:
        await asyncio.sleep(0.001)
    assert taken == [1e-4, 1e-4]
