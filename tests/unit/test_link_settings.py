"""Bounds on the memory of all links: which link is ended when it runs out."""

from typing import cast

from holdfast.transport.frames import HEADER_BYTES
from holdfast.transport.link_settings import LinkSettings, MemoryBudget
from holdfast.transport.links import Link


class Holder:
    """Stands for a link of an owner; notes whether it was ended."""

    def __init__(self, owner: str) -> None:
        self.owner = owner
        self.reason = ""

    def end(self, reason: str, *, abort: bool = False) -> None:
        self.reason = reason
        self.aborted = abort

    def holds(self, budget: MemoryBudget, size_bytes: int) -> None:
        budget.note(cast(Link, self), size_bytes)


def test_within_the_bound_nobody_is_ended() -> None:
    budget = MemoryBudget(100, "holds too much")
    holders = [Holder(name) for name in "abc"]
    for holder in holders:
        holder.holds(budget, 30)
    holders[0].holds(budget, 40)
    holders[0].holds(budget, 0)
    holders[1].holds(budget, 70)
    assert not any(holder.reason for holder in holders)


def test_the_owner_that_holds_the_most_loses_its_oldest() -> None:
    budget = MemoryBudget(100, "holds too much")
    small = Holder("small")
    greedy = [Holder("greedy") for _ in range(3)]
    small.holds(budget, 20)
    for holder in greedy:
        holder.holds(budget, 30)
    assert [bool(holder.reason) for holder in (small, *greedy)] == [False, True, False, False]
    # What it held is free again.
    greedy[0].holds(budget, 0)
    small.holds(budget, 40)
    assert not small.reason


def test_what_has_shrunk_meanwhile_is_measured_before_anybody_is_ended() -> None:
    now = {"a": 60, "b": 30, "c": 30}
    budget = MemoryBudget(100, "holds too much", lambda link: now[cast(str, link.owner)])
    holders = [Holder(name) for name in now]
    for holder in holders:
        holder.holds(budget, now[holder.owner])
    assert [holder.reason for holder in holders] == ["holds too much", "", ""]
    assert holders[0].aborted
    again = Holder("a")
    again.holds(budget, 60)
    now |= {"a": 10}
    holders[1].holds(budget, 30)
    assert not again.reason


def test_ends_do_not_share_a_buffer() -> None:
    first, second = (
        LinkSettings(bytes, 1000.0, 1000, pauses_for_readers=False).buffer for _ in range(2)
    )
    first[0] = 7
    assert second[0] == 0
    assert len(first) == 256 * 1024


def test_the_bound_is_for_two_of_the_largest_messages() -> None:
    settings = LinkSettings(bytes, 1000.0, 1000, pauses_for_readers=False)
    first, second = Holder("a"), Holder("b")
    for holder in (first, second):
        holder.holds(settings.partial_messages, 1000 + HEADER_BYTES)
    assert not first.reason
    assert not second.reason
    second.holds(settings.partial_messages, 1001 + HEADER_BYTES)
    assert first.reason


def test_who_holds_half_of_the_most_may_be_the_one() -> None:
    """So of near equals the one that began first goes, not the one with a byte more."""
    for held, ended in ((40, True), (39, False)):
        budget = MemoryBudget(100, "sends too slowly")
        first, most = Holder("first"), Holder("most")
        first.holds(budget, held)
        most.holds(budget, 80)
        assert bool(first.reason) == ended
        assert bool(most.reason) != ended
