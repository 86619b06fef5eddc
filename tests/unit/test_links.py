"""What a link's methods raise; the contracts of the links show that nobody else notices it."""

import asyncio
import socket
from typing import cast

import pytest

from holdfast.transport.frames import (
    MAGIC,
    PING,
    Frame,
    Hello,
    encode_frame,
    encode_goodbye,
    encode_hello,
)
from holdfast.transport.link_settings import LinkSettings
from holdfast.transport.links import Link, LinkOwner, ends_link


class Fragile:
    """Stands for a link."""

    def __init__(self) -> None:
        self.failed: list[Exception] = []

    def fail(self, error: Exception) -> None:
        self.failed.append(error)


def test_an_exception_ends_the_link_and_goes_no_further() -> None:
    @ends_link
    def take(link: Link, error: BaseException, *, twice: bool) -> None:
        """Take a frame."""
        assert twice
        raise error

    link, defect = Fragile(), ValueError("year 10000")
    take(cast(Link, link), defect, twice=True)
    assert link.failed == [defect]
    assert (take.__name__, take.__doc__) == ("take", "Take a frame.")
    with pytest.raises(KeyboardInterrupt):  # this process is asked to end
        take(cast(Link, link), KeyboardInterrupt(), twice=True)
    assert link.failed == [defect]


class Owner(LinkOwner):
    """Takes whatever comes."""

    def refusal(self, link: Link, hello: Hello) -> None:
        """Refuse nobody."""

    def on_hello(self, link: Link, hello: Hello) -> None:
        """Note nothing."""

    def on_frame(self, link: Link, frame: Frame) -> None:
        """Note nothing."""

    def on_ended(self, link: Link) -> None:
        """Note nothing."""


@pytest.mark.parametrize("says_goodbye", [True, False])
async def test_a_goodbye_counts_that_a_write_finds_before_a_read(*, says_goodbye: bool) -> None:
    """As on a busy machine: its end is known from a failed write, and what it said is unread."""
    settings = LinkSettings(bytes, 1000.0, 1000, pauses_for_readers=False)
    link = Link(Owner(), settings, speaks_first=False)
    ours, theirs = socket.socketpair()
    await link.connect(ours)
    theirs.send(MAGIC + (encode_goodbye("") if says_goodbye else b""))
    theirs.close()
    link.send(b"too late")
    await link.closed
    assert link.said_goodbye == says_goodbye


@pytest.mark.parametrize("pings", [True, False])
async def test_a_loop_that_stalls_in_turn_after_turn_ends_a_silent_link_alone(
    monkeypatch: pytest.MonkeyPatch, *, pings: bool
) -> None:
    """As where a policy takes long: the loop stalls again between a ping and the check for it."""
    loop = asyncio.get_running_loop()
    clock, stalled_s = loop.time, 0.0
    monkeypatch.setattr(loop, "time", lambda: clock() + stalled_s)

    def stall() -> None:
        nonlocal stalled_s
        stalled_s += 0.9
        if pings:
            theirs.send(encode_frame(PING))

    class Stalling(Link):
        def buffer_updated(self, nbytes: int) -> None:
            super().buffer_updated(nbytes)
            stall()

        def _tick(self) -> None:
            super()._tick()
            stall()

    settings = LinkSettings(bytes, 1000.0, 1000, pauses_for_readers=False)
    link = Stalling(Owner(), settings, speaks_first=False)
    ours, theirs = socket.socketpair()
    await link.connect(ours)
    theirs.send(encode_hello("service", "cloud", "1", 500.0))
    for _ in range(60):
        await asyncio.sleep(0)
    assert link.ended != pings
    link.end("")
    await link.closed
    theirs.close()
