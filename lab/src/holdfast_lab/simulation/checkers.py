"""What must hold whatever happens, checked by eyes of their own.

Nothing here calls the code that it watches, or reads its types: messages are read as the bare
MessagePack that they are, statuses by the names that people are shown, and what the robot does is
compared with the run that nothing disturbed (:mod:`holdfast_lab.simulation.environment_model`). A
checker that shared code with what it checks would share its errors.

A check that fails raises :class:`~holdfast_lab.errors.Violation`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import msgspec

from holdfast_lab.errors import Violation
from holdfast_lab.simulation.schedule import LOCAL_SERVICE

_decode = msgspec.msgpack.Decoder().decode

_SESSION_AT, _EPOCH_AT = 1, 2
"""Positions of a robot's session and epoch in a request."""

_ANSWERS = frozenset({1, 2})
"""Tags of the replies by which a robot acts."""

_NEED_STATE = 4
_DIVERGED_AT = 3
"""Tag of the reply of a service that lacks the state, and where it says that it came to another."""

_REPLY_TAG_AT = 1
"""Position of the tag in the bytes of a reply."""

_CHECKSUM_BYTES = 4
_MAX_OPEN_CALLS = 8
"""Open calls of one robot to one service: four of which it awaits something, and others that were
answered and whose end is on its way."""

_MAX_UNENDED = 64
"""Calls of one robot that a service has not ended; the robot has far fewer open."""

_MAX_REPLIES = 2000
"""To one call: a sign of life each 50 ms for 60 s, and more than that is a flood."""

_FOLLOWS = {
    "standard": {"local_recovery"},
    "local_recovery": {"keep_alive"},
    "keep_alive": {"local_recovery"},
}


_TABLES = (dict, list, tuple, set, deque)
_ATOMS = frozenset({int, float, bool, str, bytes, type(None)})

_MAX_ITEMS = 512
"""Items of any one table of a machine; a trial has 40 steps, a service has 100 robots."""


def check_size(name: str, machine: object) -> None:
    """Check that no table that a machine holds has more than 512 entries, whatever it is called."""
    seen = set()
    left = [machine]
    while left:
        found = left.pop()
        if id(found) in seen:
            continue
        seen.add(id(found))
        parts: Iterable[object]
        if isinstance(found, _TABLES):
            if len(found) > _MAX_ITEMS:
                raise Violation(f"{name} holds a {type(found).__name__} of {len(found)} entries")
            parts = found.values() if isinstance(found, dict) else found
        else:
            parts = [getattr(found, slot, None) for slot in _PLACES[type(found)]]
        left += [part for part in parts if type(part) not in _ATOMS]


class _Places(dict[type, tuple[str, ...]]):
    """Where the instances of each type hold something; only the machines' own types count."""

    def __missing__(self, kind: type) -> tuple[str, ...]:
        places: list[str] = []
        if kind.__module__.startswith(("holdfast.protocol", "holdfast.planning.tracking")):
            places = [slot for each in kind.__mro__ for slot in getattr(each, "__slots__", ())]
            places.append("__dict__")
        self[kind] = tuple(places)
        return self[kind]


_PLACES = _Places()


class StatusChecker:
    """The statuses that one process of the robot reports."""

    def __init__(self) -> None:
        self._status = "standard"
        self._cloud_has_answered = False

    def heard(self, service: str, payload: bytes) -> None:
        """Take note of a reply that the robot gets, damaged or not."""
        if service != LOCAL_SERVICE and payload[_REPLY_TAG_AT] in _ANSWERS:
            self._cloud_has_answered = True

    def changed(self, before: object, after: object) -> None:
        """Check that a change is in the table, follows from the status before, and has a reason."""
        if before != self._status or after not in _FOLLOWS[self._status]:
            raise Violation(f"status {before} -> {after}, where the status was {self._status}")
        if after == "local_recovery":
            self._cloud_has_answered = False
        elif not self._cloud_has_answered:
            raise Violation(f"status {before} -> {after}: no service of the cloud has answered")
        self._status = str(after)


class WireChecker:
    """All messages between a robot and its services."""

    def __init__(self, *, services_forget: bool = False) -> None:
        self._may_diverge = services_forget
        self._sent: dict[int, tuple[str | None, bytes]] = {}
        self._sessions: dict[int, tuple[tuple[str | None, bytes], int]] = {}
        self._newest: dict[tuple[str, int, tuple[str | None, bytes]], int] = {}
        self._unended: dict[tuple[str, int], int] = {}
        self._arrived: dict[int, tuple[str, int]] = {}
        self._ended: set[int] = set()
        self._replies: dict[int, int] = {}
        self._crowd = 0

    def robot_forgets(self) -> None:
        """Take note of a power cut: a service may know what the robot has forgotten."""
        self._may_diverge = True

    def requested(self, call: int, payload: bytes, owner: str | None = None) -> None:
        """Take note of a request, and of the certificate with which it is sent."""
        self._sent[call] = owner, payload

    def crowded(self, robots: int) -> None:
        """Take note that so many other robots ask, once each."""
        self._crowd += robots

    def has_arrived(self, call: int) -> bool:
        """Tell whether a request has arrived before."""
        return call in self._arrived

    def copied(self, call: int, copy: int) -> None:
        """Take note that a request arrives once more, under another number."""
        self._sent[copy] = self._sent[call]

    def arrived(self, service: str, incarnation: int, call: int) -> None:
        """Take note of a request; its service's process must have ended enough of those before."""
        process = service, incarnation
        self._arrived[call] = process
        unended = self._unended[process] = self._unended.get(process, 0) + 1
        if unended > _MAX_UNENDED + self._crowd:
            raise Violation(f"{service} has {unended} calls that it has not ended")

    def taken(self, service: str, incarnation: int, call: int, payload: bytes) -> None:
        """Take note that a service's process reads a request: one that was stopped does so late."""
        owner, sent = self._sent[call]
        if payload != sent:
            return  # damaged: it says nothing
        request = _decode(payload[:-_CHECKSUM_BYTES])
        session, epoch = (owner, request[_SESSION_AT]), request[_EPOCH_AT]
        self._sessions[call] = session, epoch
        place = service, incarnation, session
        self._newest[place] = max(epoch, self._newest.get(place, 0))

    def replied(self, service: str, incarnation: int, call: int, payload: bytes) -> None:
        """Check a reply: its call is open, its request was whole and of the newest epoch.

        No service comes to another state than the robot, which it was told, unless it has forgotten
        the robot: then an old request may be new to it.
        """
        if call in self._ended:
            raise Violation(f"{service} replies to call {call} after its end")
        count = self._replies[call] = self._replies.get(call, 0) + 1
        if count > _MAX_REPLIES:
            raise Violation(f"{service} has sent {count} replies to call {call}")
        fields = _decode(payload[:-_CHECKSUM_BYTES])
        tag = fields[0]
        if tag == _NEED_STATE and fields[_DIVERGED_AT] and not self._may_diverge:
            raise Violation(f"{service} comes to another state in call {call} than the robot")
        if tag not in _ANSWERS:
            return
        if call not in self._sessions:
            raise Violation(f"{service} answers call {call}, which was damaged on its way")
        session, epoch = self._sessions[call]
        newest = self._newest.get((service, incarnation, session), 0)
        if epoch < newest:
            raise Violation(
                f"{service} answers a request of epoch {epoch}, after one of epoch {newest}"
            )

    def ended(self, service: str, call: int) -> None:
        """Take note of the end of a call, which comes once."""
        if call in self._ended:
            raise Violation(f"{service} ends call {call} again")
        self._ended.add(call)
        self._unended[self._arrived[call]] -= 1

    def unended(self, service: str, incarnation: int) -> int:
        """Return how many of its calls a service's process has not ended."""
        return self._unended.get((service, incarnation), 0)

    def open_calls(self, count: int) -> None:
        """Check how many calls to a service the robot has open."""
        if count > _MAX_OPEN_CALLS:
            raise Violation(
                f"the robot has {count} calls open to one service: allowed are {_MAX_OPEN_CALLS}"
            )
