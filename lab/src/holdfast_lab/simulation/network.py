"""The wire between a robot and its services, without a wire.

It keeps what every transport promises (:mod:`holdfast.transport.contract`): a call always ends,
nothing comes of it after its end, and whoever is gone is said to have vanished. All else it breaks
as the schedule wants: single messages are lost, late, doubled or damaged, and lines are cut.

A connection is between the robot's process and one of a service's. It is made if both run and hear
each other, and breaks when one of them has been silent for the lease, or has died and the news gets
through.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal

from holdfast.protocol.robot_events import (
    CallEnded,
    ReplyReceived,
    ServiceAppeared,
    ServiceVanished,
)
from holdfast_lab.simulation.schedule import LOCAL_SERVICE, Direction, MessageFault
from holdfast_lab.simulation.service_node import ServiceNode

if TYPE_CHECKING:
    from holdfast_lab.simulation.world import World


_CONNECT_S = 0.01
_LOCAL_LATENCY_S = 0.0001
_UNREACHABLE_S = 0.0001
_LONGEST_CALL_S = 60.0
_GOLDEN = 0.6180339887498949
"""Multiples of it fill the unit interval evenly: a jitter that needs no chance."""

_ROBOT, _ANOTHER = "robot", "another"
"""Names in certificates: of the robot that is looked at, and of all others."""

Way = Literal["to", "from"]


class _Line:
    """What lies between the robot and one service."""

    __slots__ = ("arrived", "connection", "counts", "cuts", "held", "latency_s", "service")

    def __init__(self, service: ServiceNode, latency_s: float) -> None:
        self.service = service
        self.latency_s = latency_s
        self.connection: _Connection | None = None  # the last that was made, until it breaks
        self.cuts: dict[Way, int] = {"to": 0, "from": 0}
        self.counts: dict[Way, int] = {"to": 0, "from": 0}  # of messages
        # When the last message arrives, which none overtakes, and those that wait for a cut's end.
        self.arrived: dict[Way, float] = {"to": 0.0, "from": 0.0}
        self.held: dict[Way, list[tuple[Callable[..., None], tuple[Any, ...]]]]
        self.held = {"to": [], "from": []}


class _Connection:
    """Between a process of the robot and one of a service, by their numbers."""

    __slots__ = ("died_at", "incarnation", "is_down", "line", "process", "silent_since")

    def __init__(self, line: _Line, process: int, incarnation: int) -> None:
        self.line = line
        self.process = process
        self.incarnation = incarnation
        self.silent_since: float | None = None
        self.died_at = 0.0
        self.is_down = False


class _Call:
    """A call of the robot, as the network knows it: one key for each time that it arrives."""

    __slots__ = ("connection", "end_is_lost", "keys", "number")

    def __init__(self, connection: _Connection, number: int) -> None:
        self.connection = connection
        self.number = number
        self.keys: list[int] = []
        self.end_is_lost = False


class Network:
    """All lines of one robot."""

    def __init__(self, world: World, faults: Sequence[MessageFault]) -> None:
        self._world = world
        self._run = run = world.run
        self._queue = world.queue
        self._checker = world.checker
        self._faults: dict[tuple[str, str, int], list[MessageFault]] = {}
        for fault in faults:
            key = fault.service, fault.direction, fault.number
            self._faults.setdefault(key, []).append(fault)
        self._lines = {
            name: _Line(service, _LOCAL_LATENCY_S if name == LOCAL_SERVICE else run.latency_s)
            for name, service in world.services.items()
        }
        self._calls: dict[int, _Call] = {}
        self._open: dict[int, _Call] = {}
        self._others: set[int] = set()
        self.messages = 0

    # -- who is there ----------------------------------------------------------------------------

    def robot_ended(self) -> None:
        """Close all connections of the robot's process."""
        self._calls.clear()
        self._open.clear()
        for line in self._lines.values():
            if line.connection is not None:
                self._close(line.connection)
        self.review_all()

    def service_died(self, service: ServiceNode, found_after_s: float) -> None:
        """Let the robot find out that a service's process has died."""
        line = self._lines[service.name]
        if line.connection is not None and not line.cuts["from"]:
            # Through a cut no such news comes: the lease will tell.
            wait_s = min(found_after_s, self._run.lease_s)
            line.connection.died_at = self._queue.now + wait_s
            self._queue.after(wait_s, self._broke, line.connection)
        self.review(service)

    def cut(self, name: str, direction: Direction) -> None:
        """Let nothing through any more."""
        line = self._lines[name]
        for way in _ways(direction):
            line.cuts[way] += 1
        self.review(line.service)

    def heal(self, name: str, direction: Direction) -> None:
        """Take a cut away."""
        line = self._lines[name]
        for way in _ways(direction):
            line.cuts[way] -= 1
            if not line.cuts[way]:
                held, line.held[way] = line.held[way], []
                for do, arguments in held:
                    self._carry(line, way, line.latency_s, do, arguments)
        self.review(line.service)

    def review_all(self) -> None:
        """Look at all lines anew."""
        for line in self._lines.values():
            self.review(line.service)

    def review(self, service: ServiceNode) -> None:
        """Look whether a connection can be made, or will break."""
        line = self._lines[service.name]
        connection = line.connection
        if self._hear_each_other(line):
            if connection is None or connection.incarnation != service.incarnation:
                process = self._world.robot.incarnation
                attempt = _Connection(line, process, service.incarnation)
                self._queue.after(_CONNECT_S, self._connect, attempt, connection)
            else:
                connection.silent_since = None
        elif connection is not None and connection.silent_since is None:
            connection.silent_since = now = self._queue.now
            self._queue.after(self._run.lease_s, self._expire, connection, now)

    def _hear_each_other(self, line: _Line) -> bool:
        robot, service, cuts = self._world.robot, line.service, line.cuts
        both_run = robot.up and not robot.stopped and service.up and not service.stopped
        return both_run and not cuts["to"] and not cuts["from"]

    def _connect(self, connection: _Connection, before: _Connection | None) -> None:
        line = connection.line
        if (
            line.connection is not before
            or connection.incarnation != line.service.incarnation
            or connection.process != self._world.robot.incarnation
            or not self._hear_each_other(line)
        ):
            return
        if before is not None:
            # The next process is there before anybody knows that this one is not.
            self._queue.at(before.died_at, self._broke, before)
            self._forget_held(line)
        line.connection = connection
        appeared = ServiceAppeared(line.service.name, str(connection.incarnation))
        self._world.deliver(connection.process, appeared)

    def _expire(self, connection: _Connection, since: float) -> None:
        if connection.silent_since == since:
            self._broke(connection)

    def _broke(self, connection: _Connection) -> None:
        """Let both ends know that a connection is down."""
        if connection.is_down:
            return
        ended = [call for call in self._open.values() if call.connection is connection]
        for call in ended:
            self._forget(call)
        self._close(connection)
        service, process = connection.line.service, connection.process
        vanished = ServiceVanished(service.name, str(connection.incarnation))
        self._world.deliver(process, vanished)
        for call in ended:
            self._world.deliver(process, CallEnded(call.number))
        self.review(service)

    def _close(self, connection: _Connection) -> None:
        connection.is_down = True
        if connection.line.connection is connection:
            connection.line.connection = None
            self._forget_held(connection.line)

    @staticmethod
    def _forget_held(line: _Line) -> None:
        for held in line.held.values():
            held.clear()

    # -- calls -----------------------------------------------------------------------------------

    def call(self, name: str, number: int, payload: bytes) -> None:
        """Send a request of the robot's present process."""
        line = self._lines[name]
        connection = line.connection
        if connection is None:
            process = self._world.robot.incarnation
            self._queue.after(_UNREACHABLE_S, self._world.deliver, process, CallEnded(number))
            return
        call = self._open[number] = _Call(connection, number)
        key = self._key(call)
        owner = _ROBOT if self._run.certificates else None
        self._checker.requested(key, payload, owner)
        self._checker.open_calls(
            sum(
                each.connection.line is line and not each.end_is_lost
                for each in self._open.values()
            )
        )
        incarnation = connection.incarnation
        self._send(
            line, "to", payload, self._request_arrives, key, owner, line.service, incarnation
        )

    def call_of_another(self, service: ServiceNode, payload: bytes) -> None:
        """Deliver a request of another robot, whose replies are not looked at."""
        self.messages += 1
        self._others.add(self.messages)
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
            self._send(call.connection.line, "from", payload, self._reply_arrives, key)

    def end(self, service: ServiceNode, key: int) -> None:
        """End a call."""
        self._checker.ended(service.name, key)
        call = self._calls.get(key)
        if call is not None:
            self._send(call.connection.line, "from", b"", self._end_arrives, key)
        elif key in self._others:
            self._world.other_was_served()

    # -- messages --------------------------------------------------------------------------------

    def _send(
        self, line: _Line, way: Way, payload: bytes, arrive: Callable[..., None], *more: Any
    ) -> None:
        number = line.counts[way]
        line.counts[way] = number + 1
        latency_s = line.latency_s + self._run.jitter_s * (number * _GOLDEN % 1.0)
        if self._run.bytes_per_s is not None:
            latency_s += len(payload) / self._run.bytes_per_s
        for fault in self._faults.get((line.service.name, way, number), ()):
            late_s = latency_s + fault.seconds
            self._world.happened(fault, late_s)
            if fault.what in ("drop", "misroute") and arrive == self._end_arrives:
                self._lose_end(more[0])
            if fault.what == "corrupt":
                payload = _damaged(payload, fault.bit)
            elif fault.what == "duplicate":
                self._queue.after(late_s, arrive, payload, *more)
            else:
                if fault.what == "delay":
                    # Not in line with the others: it is overtaken.
                    self._queue.after(late_s, arrive, payload, *more)
                elif fault.what == "misroute":
                    self._queue.after(late_s, self._arrives_elsewhere, payload, line)
                return
        if not line.cuts[way]:
            self._carry(line, way, latency_s, arrive, (payload, *more))
        elif not self._run.lost_in_cut:
            line.held[way].append((arrive, (payload, *more)))

    def _carry(
        self,
        line: _Line,
        way: Way,
        latency_s: float,
        do: Callable[..., None],
        arguments: tuple[Any, ...],
    ) -> None:
        line.arrived[way] = arrives = max(self._queue.now + latency_s, line.arrived[way])
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
        self._checker.arrived(service.name, incarnation, key)
        service.receive(incarnation, key, payload, owner)

    def _reply_arrives(self, payload: bytes, key: int) -> None:
        call = self._calls.get(key)
        if call is not None:
            self._world.deliver(call.connection.process, ReplyReceived(call.number, payload))

    def _lose_end(self, key: int) -> None:
        """Let a call whose end is lost end all the same, as a transport does after a long time."""
        call = self._calls.get(key)
        if call is not None:
            call.end_is_lost = True
            self._queue.after(_LONGEST_CALL_S, self._end_arrives, b"", key)

    def _arrives_elsewhere(self, payload: bytes, line: _Line) -> None:
        """Deliver a reply to the newest call of its service, whoever made that."""
        calls = [call for call in self._open.values() if call.connection.line is line]
        if calls and payload:
            reply = ReplyReceived(calls[-1].number, payload)
            self._world.deliver(calls[-1].connection.process, reply)

    def _end_arrives(self, payload: bytes, key: int) -> None:
        del payload
        call = self._calls.get(key)
        if call is not None:
            self._forget(call)
            self._world.deliver(call.connection.process, CallEnded(call.number))


def _ways(direction: Direction) -> tuple[Way, ...]:
    return ("to", "from") if direction == "both" else (direction,)


def _damaged(payload: bytes, bit: int) -> bytes:
    if not payload:
        return payload
    position = bit % (8 * len(payload))
    damaged = bytearray(payload)
    damaged[position // 8] ^= 1 << position % 8
    return bytes(damaged)
