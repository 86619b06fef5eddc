"""A bad line: it delays, loses, falls silent and is cut, in a thread of its own.

A subclass has the ends of the line and listens to them: :class:`~holdfast_lab.testbed.proxy.Proxy`
sockets of this machine, :mod:`~holdfast_lab.testbed.wide_area` devices of two networks.

Several impairments may be active at the same time; what is carried suffers from all of them. What
is under way is bounded, as in a router.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import selectors
import threading
from collections import Counter
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, Literal, Self, TypeAlias, get_args

Direction: TypeAlias = Literal["both", "to_service", "to_robot"]

Carrier: TypeAlias = Literal["streams", "datagrams"]
CARRIERS: tuple[Carrier, ...] = get_args(Carrier)

_PATIENCE_S = 10.0
_CAPACITY = 4096
"""Datagrams on the way in one direction: 6 MB of the usual size, as a router may hold."""


@dataclass(frozen=True, kw_only=True)
class Impairment:
    """An impairment of the line."""

    direction: Direction = "both"  # what it affects. A cut has no direction.
    # Everything is late by the latency and up to the jitter.
    latency_s: float = 0.0
    jitter_s: float = 0.0
    # Share of datagrams that are dropped, and of a stream's pieces that are late by TCP's
    # retransmission timeout.
    loss: float = 0.0
    silent: bool = False
    cut: bool = False
    doubled: bool = False  # whether datagrams come twice
    carriers: tuple[Carrier, ...] = CARRIERS  # what it affects


class BadLine:
    """A line without ends; to be used in a ``with`` statement.

    ``overhear`` gets what is carried, a piece of a stream or a datagram, and which way; in another
    thread. The selector waits; one that knows whole milliseconds only would falsify short delays.
    """

    def __init__(
        self,
        name: str,
        seed: str,
        overhear: Callable[[Carrier, Direction, bytes], object] = lambda *_: None,
        selector: selectors.BaseSelector | None = None,
    ) -> None:
        self._chance = random.Random(seed)
        self._overhear = overhear
        self._impairments: dict[object, Impairment] = {}
        self._under_way: Counter[Direction] = Counter()
        self._loop = asyncio.SelectorEventLoop(selector)
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def impair(self, impairment: Impairment) -> Callable[[], None]:
        """Put an impairment on the line; return what takes it away, which may be repeated."""
        key = object()
        self._call(self._change(key, impairment))
        return lambda: self._call(self._change(key, None))

    def close(self) -> None:
        """Carry nothing more; may be repeated."""
        if not self._thread.is_alive():
            return
        self._call(self._end())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    # -- on the thread of the loop -------------------------------------------------------------

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_forever()

    def _call(self, coroutine: Coroutine[Any, Any, None]) -> None:
        if self._loop.is_closed():
            coroutine.close()
            return
        future: Future[None] = asyncio.run_coroutine_threadsafe(coroutine, self._loop)
        future.result(_PATIENCE_S)

    async def _change(self, key: object, impairment: Impairment | None) -> None:
        """Put an impairment on the line, or take it away."""
        if impairment is None:
            self._impairments.pop(key, None)
        else:
            self._impairments[key] = impairment

    async def _end(self) -> None:
        self._impairments.clear()

    def _active(self, carrier: Carrier, direction: Direction = "both") -> Iterator[Impairment]:
        for each in self._impairments.values():
            if carrier in each.carriers and (
                direction == each.direction or "both" in (direction, each.direction)
            ):
                yield each

    def _is_cut(self, carrier: Carrier) -> bool:
        return any(each.cut for each in self._active(carrier))

    def _is_silent(self, carrier: Carrier, direction: Direction) -> bool:
        return any(each.silent for each in self._active(carrier, direction))

    def _fate(self, carrier: Carrier, direction: Direction) -> tuple[float, int]:
        """Return by how much something comes later, and how often it is lost."""
        delay_s, losses = 0.0, 0
        for each in self._active(carrier, direction):
            delay_s += each.latency_s + each.jitter_s * self._chance.random()
            losses += each.loss > 0.0 and self._chance.random() < each.loss
        return delay_s, losses

    def _carry_datagram(
        self, content: bytes, direction: Direction, send: Callable[[bytes], object]
    ) -> None:
        """Send a datagram or a packet: once, later, twice or never."""
        delay_s, losses = self._fate("datagrams", direction)
        full = self._under_way[direction] >= _CAPACITY
        if losses or full or self._is_silent("datagrams", direction):
            return
        self._overhear("datagrams", direction, content)
        for _ in range(1 + any(each.doubled for each in self._active("datagrams", direction))):
            self._under_way[direction] += 1
            self._loop.call_later(delay_s, self._arrive, content, direction, send)

    def _arrive(
        self, content: bytes, direction: Direction, send: Callable[[bytes], object]
    ) -> None:
        self._under_way[direction] -= 1
        with contextlib.suppress(OSError):  # no room, no receiver, or a cut line
            send(content)
