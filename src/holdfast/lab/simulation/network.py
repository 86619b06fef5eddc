"""The wire between a robot and its services, without a wire.

It keeps what every transport promises (:mod:`holdfast.runtime.transport.contract`): a call always
ends, nothing comes of it after its end, and whoever is gone is said to have vanished. All else it
breaks as the schedule wants: single messages are lost, late, doubled or damaged, and links are cut.

A link is a connection between the robot's process and one of a service's. It goes up if both run
and hear each other, and down when one of them has been silent for the lease, or has died and the
news gets through.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

from holdfast.lab.simulation.event_queue import EventQueue
from holdfast.lab.simulation.schedule import LOCAL_SERVICE, MessageFault, RunSettings
from holdfast.lab.simulation.service_node import ServiceNode
from holdfast.protocol.events import (
    CallEnded,
    ReplyReceived,
    ServiceAppeared,
    ServiceVanished,
    TransportEvent,
)

if TYPE_CHECKING:
    from holdfast.lab.simulation.checkers import WireChecker

__all__ = ["Network", "SimulatedLink"]

_CONNECT_S = 0.01
_LOCAL_LATENCY_S = 0.0001
_UNREACHABLE_S = 0.0001
_LONGEST_CALL_S = 60.0
_GOLDEN = 0.6180339887498949
"""Multiples of it fill the unit interval evenly: a jitter that needs no chance."""

_ROBOT, _ANOTHER = "robot", "another"
"""Names in certificates: of the robot that is looked at, and of all others."""

Way = Literal["to", "from"]


class SimulatedLink:
    """What lies between the robot and one service.

    Attributes
    ----------
    incarnation : int or None
        Of the service's process while the link is up.
    cuts : dict of str to int
        By direction, how many cuts there are.
    died_at : float
        When the robot's machine finds out that the process of a link has died.
    """

    __slots__ = (
        "arrived",
        "counts",
        "cuts",
        "died_at",
        "held",
        "incarnation",
        "latency_s",
        "service",
        "token",
        "unhealthy_since",
    )

    def __init__(self, service: ServiceNode, latency_s: float) -> None:
        self.service = service
        self.latency_s = latency_s
        self.incarnation: int | None = None
        self.cuts: dict[Way, int] = {"to": 0, "from": 0}
        self.counts: dict[Way, int] = {"to": 0, "from": 0}
        self.arrived: dict[Way, float] = {"to": 0.0, "from": 0.0}
        self.held: dict[Way, list[tuple[Callable[..., None], tuple[object, ...]]]]
        self.held = {"to": [], "from": []}
        self.token = 0
        self.unhealthy_since: float | None = None
        self.died_at = 0.0


class _Call:
    """A call of the robot, as the network knows it: one key for each time that it arrives."""

    __slots__ = ("end_is_lost", "incarnation", "keys", "link", "number", "process")

    def __init__(self, link: SimulatedLink, process: int, number: int) -> None:
        self.link = link
        self.incarnation = link.incarnation
        self.process = process
        self.number = number
        self.keys: list[int] = []
        self.end_is_lost = False


class Network:
    """All links of one robot."""

    def __init__(
        self,
        run: RunSettings,
        queue: EventQueue,
        faults: list[MessageFault],
        checker: WireChecker,
        deliver: Callable[[int, TransportEvent], None],
        happened: Callable[[MessageFault, float], None],
    ) -> None:
        self._run = run
        self._queue = queue
        self._faults: dict[tuple[str, str, int], list[MessageFault]] = {}
        for fault in faults:
            key = fault.service, fault.direction, fault.number
            self._faults.setdefault(key, []).append(fault)
        self._checker = checker
        self._deliver = deliver
        self._happened = happened
        self._links: dict[str, SimulatedLink] = {}
        self._calls: dict[int, _Call] = {}
        self._open: dict[int, _Call] = {}
        self._process = 0
        self._robot_hears = False
        self.messages = 0

    def add(self, service: ServiceNode) -> None:
        """Lay a link to a service."""
        local = service.name == LOCAL_SERVICE
        latency_s = _LOCAL_LATENCY_S if local else self._run.latency_s
        self._links[service.name] = SimulatedLink(service, latency_s)

    # -- who is there ----------------------------------------------------------------------------

    def robot_started(self, process: int) -> None:
        """Let a new process of the robot connect to whoever is there."""
        self._process = process
        self._robot_hears = True
        self._review_all()

    def robot_ended(self) -> None:
        """Close all links of the robot's process."""
        self._process = 0
        self._robot_hears = False
        for link in self._links.values():
            self._close(link)
            self.review(link.service)

    def robot_stopped(self, *, stopped: bool) -> None:
        """Take note that the robot's process is stopped, or goes on."""
        self._robot_hears = not stopped and self._process > 0
        self._review_all()

    def service_died(self, service: ServiceNode, found_after_s: float) -> None:
        """Let the robot find out that a service's process has died."""
        link = self._links[service.name]
        if link.incarnation is not None and not link.cuts["from"]:
            # Through a cut no such news comes: the lease will tell.
            wait_s = min(found_after_s, self._run.lease_s)
            link.died_at = self._queue.now + wait_s
            self._queue.after(wait_s, self._broke, link, link.token)
        self.review(service)

    def cut(self, name: str, way: Way) -> None:
        """Let nothing through any more."""
        link = self._links[name]
        link.cuts[way] += 1
        self.review(link.service)

    def heal(self, name: str, way: Way) -> None:
        """Take a cut away."""
        link = self._links[name]
        link.cuts[way] -= 1
        if not link.cuts[way]:
            held, link.held[way] = link.held[way], []
            for do, arguments in held:
                self._carry(link, way, link.latency_s, do, arguments)
        self.review(link.service)

    def _review_all(self) -> None:
        for link in self._links.values():
            self.review(link.service)

    def review(self, service: ServiceNode) -> None:
        """Look whether a link can go up, or will go down."""
        link = self._links[service.name]
        both_hear = (
            service.up
            and not service.stopped
            and self._robot_hears
            and not link.cuts["to"]
            and not link.cuts["from"]
        )
        if both_hear:
            if link.incarnation != service.incarnation:
                self._queue.after(_CONNECT_S, self._connect, link, link.token, service.incarnation)
            else:
                link.unhealthy_since = None
        elif link.incarnation is not None and link.unhealthy_since is None:
            now = self._queue.now
            link.unhealthy_since = now
            self._queue.after(self._run.lease_s, self._expire, link, link.token, now)

    def _connect(self, link: SimulatedLink, token: int, incarnation: int) -> None:
        service = link.service
        if (
            token != link.token
            or link.incarnation == incarnation
            or incarnation != service.incarnation
        ):
            return
        if not (service.up and not service.stopped and self._robot_hears):
            return
        if link.cuts["to"] or link.cuts["from"]:
            return
        before = link.incarnation
        if before is not None:
            # The next process is there before anybody knows that this one is not.
            self._queue.at(link.died_at, self._old_broke, link, self._process, before)
            for held in link.held.values():
                held.clear()
        link.token += 1
        link.incarnation = incarnation
        link.unhealthy_since = None
        self._deliver(self._process, ServiceAppeared(service.name, str(incarnation)))

    def _old_broke(self, link: SimulatedLink, process: int, incarnation: int) -> None:
        """Let the robot know that a process of a service is gone which the next one outlives."""
        if process != self._process:
            return
        ended = [
            call
            for call in self._open.values()
            if call.link is link and call.incarnation == incarnation
        ]
        for call in ended:
            self._forget(call)
        self._deliver(process, ServiceVanished(link.service.name, str(incarnation)))
        for call in ended:
            self._deliver(process, CallEnded(call.number))

    def _expire(self, link: SimulatedLink, token: int, since: float) -> None:
        if token == link.token and link.unhealthy_since == since:
            self._broke(link, token)

    def _broke(self, link: SimulatedLink, token: int) -> None:
        """Let both ends know that the link is down."""
        if token != link.token or link.incarnation is None:
            return
        incarnation = link.incarnation
        process = self._process
        ended = self._close(link)
        if process:
            self._deliver(process, ServiceVanished(link.service.name, str(incarnation)))
            for number in ended:
                self._deliver(process, CallEnded(number))
        self.review(link.service)

    def _close(self, link: SimulatedLink) -> list[int]:
        link.incarnation = None
        link.unhealthy_since = None
        link.token += 1
        for held in link.held.values():
            held.clear()
        ended = [call for call in self._open.values() if call.link is link]
        for call in ended:
            self._forget(call)
        return [call.number for call in ended]

    # -- calls -----------------------------------------------------------------------------------

    def call(self, name: str, number: int, payload: bytes) -> None:
        """Send a request of the robot's present process."""
        link = self._links[name]
        if link.incarnation is None:
            self._queue.after(_UNREACHABLE_S, self._deliver, self._process, CallEnded(number))
            return
        call = _Call(link, self._process, number)
        self._open[number] = call
        key = self._key(call)
        owner = _ROBOT if self._run.certificates else None
        self._checker.requested(key, payload, owner)
        self._checker.open_calls(
            sum(each.link is link and not each.end_is_lost for each in self._open.values())
        )
        self._send(
            link, "to", payload, self._request_arrives, key, owner, link.service, link.incarnation
        )

    def call_of_another(self, service: ServiceNode, payload: bytes) -> None:
        """Deliver a request of another robot, whose replies are not looked at."""
        self.messages += 1
        owner = _ANOTHER if self._run.certificates else None
        self._checker.requested(self.messages, payload, owner)
        self._request_arrives(payload, self.messages, owner, service, service.incarnation)

    def abandon(self, number: int) -> None:
        """Give a call up."""
        call = self._open.get(number)
        if call is not None:
            self._forget(call)

    def _key(self, call: _Call) -> int:
        self.messages += 1
        call.keys.append(self.messages)
        self._calls[self.messages] = call
        return self.messages

    def _forget(self, call: _Call) -> None:
        for key in call.keys:
            del self._calls[key]
        del self._open[call.number]

    def reply(self, service: ServiceNode, key: int, payload: bytes) -> None:
        """Send a reply of a service's process."""
        self._checker.replied(service.name, service.incarnation, key, payload)
        call = self._calls.get(key)
        if call is not None:
            self.messages += 1
            self._send(call.link, "from", payload, self._reply_arrives, key)

    def end(self, service: ServiceNode, key: int) -> None:
        """End a call."""
        self._checker.ended(service.name, key)
        call = self._calls.get(key)
        if call is not None:
            self._send(call.link, "from", b"", self._end_arrives, key)

    # -- messages --------------------------------------------------------------------------------

    def _send(
        self, link: SimulatedLink, way: Way, payload: bytes, arrive: Callable[..., None], *more: Any
    ) -> None:
        number = link.counts[way]
        link.counts[way] = number + 1
        latency_s = link.latency_s
        if self._run.jitter_s:
            latency_s += self._run.jitter_s * (number * _GOLDEN % 1.0)
        if self._run.bytes_per_s is not None:
            latency_s += len(payload) / self._run.bytes_per_s
        faults = self._faults.get((link.service.name, way, number))
        for fault in faults or ():
            self._happened(fault, latency_s + fault.seconds)
            if fault.what in ("drop", "misroute") and arrive == self._end_arrives:
                self._lose_end(more[0])
            if fault.what == "drop":
                return
            if fault.what == "corrupt":
                payload = _damaged(payload, fault.bit)
            elif fault.what == "duplicate":
                copy_s = latency_s + fault.seconds
                self._queue.after(copy_s, arrive, payload, *more)
            elif fault.what == "misroute":
                late_s = latency_s + fault.seconds
                self._queue.after(late_s, self._arrives_elsewhere, payload, link)
                return
            else:
                # Not in line with the others: it is overtaken.
                self._queue.after(latency_s + fault.seconds, arrive, payload, *more)
                return
        if not link.cuts[way]:
            self._carry(link, way, latency_s, arrive, (payload, *more))
        elif not self._run.lost_in_cut:
            link.held[way].append((arrive, (payload, *more)))

    def _carry(
        self,
        link: SimulatedLink,
        way: Way,
        latency_s: float,
        do: Callable[..., None],
        arguments: tuple[object, ...],
    ) -> None:
        arrives = max(self._queue.now + latency_s, link.arrived[way])
        link.arrived[way] = arrives
        self._queue.at(arrives, do, *arguments)

    def _request_arrives(
        self, payload: bytes, key: int, owner: str | None, service: ServiceNode, incarnation: int
    ) -> None:
        if incarnation != service.incarnation or not service.up:
            return
        if self._checker.has_arrived(key):
            # A copy is another call to the service, whose replies come to the same one here.
            call = self._calls.get(key)
            self.messages += 1
            original, key = key, self.messages if call is None else self._key(call)
            self._checker.copied(original, key)
        self._checker.arrived(service.name, incarnation, key, payload)
        service.receive(incarnation, key, payload, owner)

    def _reply_arrives(self, payload: bytes, key: int) -> None:
        call = self._calls.get(key)
        if call is not None:
            self._deliver(call.process, ReplyReceived(call.number, payload))

    def _lose_end(self, key: int) -> None:
        """Let a call whose end is lost end all the same, as a transport does after a long time."""
        call = self._calls.get(key)
        if call is not None:
            call.end_is_lost = True
            self._queue.after(_LONGEST_CALL_S, self._end_arrives, b"", key)

    def _arrives_elsewhere(self, payload: bytes, link: SimulatedLink) -> None:
        """Deliver a reply to the newest call of its service, whoever made that."""
        calls = [call for call in self._open.values() if call.link is link]
        if calls and payload:
            self._deliver(calls[-1].process, ReplyReceived(calls[-1].number, payload))

    def _end_arrives(self, payload: bytes, key: int) -> None:
        del payload
        call = self._calls.get(key)
        if call is not None:
            self._forget(call)
            self._deliver(call.process, CallEnded(call.number))


def _damaged(payload: bytes, bit: int) -> bytes:
    if not payload:
        return payload
    position = bit % (8 * len(payload))
    damaged = bytearray(payload)
    damaged[position // 8] ^= 1 << position % 8
    return bytes(damaged)
