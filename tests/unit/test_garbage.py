"""Garbage that refers to itself, collected by the event loop's thread alone."""

import gc
import weakref
from collections.abc import Callable, Iterator
from typing import Any, cast

import pytest

from holdfast.service.garbage import collect_in_loop


class Node:
    """An object that refers to itself."""

    def __init__(self) -> None:
        self.itself = self


class Loop:
    """An event loop's timers, which run when a test says so."""

    def __init__(self) -> None:
        self.timers: list[Callable[[], None]] = []

    def call_later(self, delay: float, callback: Callable[[], None]) -> None:
        self.timers.append(callback)

    def turn(self) -> None:
        self.timers.pop(0)()


@pytest.fixture
def loop() -> Iterator[Loop]:
    made = Loop()
    threshold = gc.get_threshold()
    gc.collect()
    try:
        collect_in_loop(cast(Any, made))
        yield made
    finally:
        gc.unfreeze()
        gc.set_threshold(*threshold)
        gc.enable()


def garbage(count: int) -> list[weakref.ref[Node]]:
    return [weakref.ref(Node()) for _ in range(count)]


def test_garbage_waits_for_the_loop(loop: Loop) -> None:
    left = garbage(20_000)
    assert all(each() is not None for each in left)
    loop.turn()
    assert not any(each() is not None for each in left)
    assert len(loop.timers) == 1


def test_little_garbage_is_not_worth_a_collection(loop: Loop) -> None:
    loop.turn()
    gc.collect()
    left = garbage(10)
    loop.turn()
    assert all(each() is not None for each in left)


def test_garbage_that_has_grown_old_is_collected_some_time(loop: Loop) -> None:
    old = Node()
    gc.collect()  # old from now on
    left = weakref.ref(old)
    del old
    for _ in range(2 * 10 * 10):
        garbage(1_000)
        loop.turn()
    assert left() is None
