"""A region dies and comes back: robots by the thousand in virtual time.

Robots and services are the production machines, and robots dial by the production code's pauses.
What is simulated is what lies between: connections, which wait for their handshake as
:mod:`holdfast.transport.listener` has them wait, and processors, of which handshakes get a share. A
load balancer hands each connection to a process that lives, by chance. Everything follows from the
seed.
"""

from __future__ import annotations

import itertools
import math
import random
from collections import Counter, deque
from collections.abc import Iterator
from typing import Literal, NamedTuple

import msgspec

from benchmarks.region_robots import CLOUD, MachineShell, RegionRobot, Setup
from holdfast.planning.settings import ParticleFilterSettings, PlanningSettings, SelectorSettings
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.protocol.messages import Busy, SessionConfiguration, encode
from holdfast.protocol.robot_events import (
    CallEnded,
    ReplyReceived,
    ServiceAppeared,
    ServiceVanished,
)
from holdfast.protocol.service_limits import ServiceLimits
from holdfast.transport.dialer import _SHARE_OF_OUTAGE, RetryPauses
from holdfast.transport.links import OPENING_TIMEOUT_S
from holdfast.transport.listener import MAX_WAITING
from holdfast_lab.simulation.event_queue import EventQueue

__all__ = ["Outcome", "Scenario", "broken_promises", "make_setup", "scenarios", "simulate"]

_SEED = 20_261
_LEASE_S = 0.4
_UNREACHABLE_S = 0.0001
_RECOVERY = "local_recovery"
_BUSY = [encode(Busy(0, retry_after_ms)) for retry_after_ms in range(100, 126)]


class Scenario(msgspec.Struct, frozen=True, kw_only=True):
    """A region, and what happens to it.

    Attributes
    ----------
    handshake_s, share : float
        Processor time of a handshake, and the share of a process's time for handshakes while it has
        others to do.
    task_s, sensing_s : float
        Processor time of the parts of an answer.
    dies : {"killed", "silent"}
        Whether links break at once, or robots find out by the lease.
    down_s, every_s : float
        Until the first process is back, and from each to the next.
    back : float
        Share of the processes that come back.
    flaps : int
        How often all of them die again, two seconds after they are back, for three seconds.
    busy_for_s : float
        For so long after their return they turn every request away.
    in_phase : bool
        Whether all robots begin at the same moment.
    """

    robots: int = 300
    processes: int = 3
    act_s: float = 0.1
    way_s: float = 0.01
    launch_s: float = 0.15
    handshake_s: float = 0.002
    share: float = 0.5
    task_s: float = 0.0004
    sensing_s: float = 0.0006
    dies: Literal["killed", "silent"] = "killed"
    down_s: float = 5.0
    every_s: float = 0.0
    back: float = 1.0
    flaps: int = 0
    busy_for_s: float = 0.0
    in_phase: bool = False
    after_s: float = 15.0
    seed: int = _SEED


class Outcome(NamedTuple):
    """What came of it; times in seconds, from the return of the last process where not said.

    Attributes
    ----------
    standstills : list of float
        The longest of each robot, from the death on.
    linked, decided : list of float
        When each robot had a link again that lasted to the end, and when the cloud decided for it
        again; infinity if never.
    peak : int
        The most connections that were opened within 10 ms.
    crowding : float
        Links of the process with the most, in those of an even spread.
    connections, handshakes, lost_handshakes : int
        Opened, computed, and computed for robots that had given up, since the death.
    longest_round_trip_s : float
        Of a robot that was in, since the return.
    in_cloud : float
        Share of the robots that the cloud decides for at the end.
    busy : float
        Share of the processors' time that was used, over the last five seconds.
    """

    standstills: list[float]
    linked: list[float]
    decided: list[float]
    peak: int
    crowding: float
    connections: int
    handshakes: int
    lost_handshakes: int
    longest_round_trip_s: float
    in_cloud: float
    busy: float
    launches: int
    trials: int


class _Process:
    """A service's process: its queue of handshakes, its machine, and one processor."""

    def __init__(self, region: _Region, number: int) -> None:
        self._region = region
        self.incarnation = f"process-{number}"
        self.waiting: deque[_Connection] = deque()
        self.linked: dict[_Connection, None] = {}
        self.calls: dict[int, tuple[_Connection, int]] = {}
        self._keys = itertools.count(1)
        self._is_shaking_hands = False
        scenario = region.scenario
        self.shell = MachineShell(
            region.setup,
            region.queue,
            ServiceLimits(max_sessions=4000),
            {"task": scenario.task_s, "sensing": scenario.sensing_s},
            self._reply,
            self._end,
            lambda: 1.0 / (1.0 - scenario.share) if self._is_shaking_hands else 1.0,
        )

    def connect(self, connection: _Connection) -> None:
        """Have a connection wait for its handshake."""
        if not self.shell.up or len(self.waiting) >= MAX_WAITING:
            self._region.queue.after(self._region.scenario.way_s, connection.closed)
            return
        self.waiting.append(connection)
        if not self._is_shaking_hands:
            self._shake_hands()

    def _shake_hands(self) -> None:
        while self.waiting and self.waiting[0].given_up:
            self.waiting.popleft()
        self._is_shaking_hands = bool(self.waiting) and self.shell.up
        if self._is_shaking_hands:
            scenario = self._region.scenario
            connection = self.waiting.popleft()
            self._region.queue.after(scenario.handshake_s / scenario.share, self._done, connection)

    def _done(self, connection: _Connection) -> None:
        if not self.shell.up:
            return
        region = self._region
        region.handshakes += 1
        region.lost_handshakes += connection.given_up
        if not connection.given_up:
            self.linked[connection] = None
            # Three more ways: the handshake's own, and the hello's.
            region.queue.after(3.0 * region.scenario.way_s, connection.established)
        self._shake_hands()

    def die(self) -> None:
        """End the process: robots find out by a reset, or by the lease."""
        region, scenario = self._region, self._region.scenario
        self.shell.up = False
        found_s = scenario.way_s if scenario.dies == "killed" else _LEASE_S
        for connection in (*self.linked, *self.waiting):
            region.queue.after(found_s, connection.closed)

    # -- calls -----------------------------------------------------------------------------------

    def call(self, connection: _Connection, number: int, payload: bytes) -> None:
        """Take a request."""
        key = next(self._keys)
        self.calls[key] = connection, number
        region = self._region
        if region.queue.now < region.busy_until:
            self._reply(key, _BUSY[key % len(_BUSY)])
            self._end(key)
        else:
            self.shell.receive(key, payload, f"robot-{connection.line.robot.number}")

    def _reply(self, key: int, payload: bytes) -> None:
        connection, number = self.calls[key]
        self._region.queue.after(
            self._region.scenario.way_s, connection.hear, ReplyReceived(number, payload)
        )

    def _end(self, key: int) -> None:
        connection, number = self.calls.pop(key)
        self._region.queue.after(self._region.scenario.way_s, connection.hear, CallEnded(number))


class _Connection:
    """Of a robot with one process."""

    def __init__(self, line: _Line, process: _Process) -> None:
        self.line = line
        self.process = process
        self.given_up = self.is_linked = False

    def established(self) -> None:
        """The service has said hello."""
        if not self.given_up and self.process.shell.up:
            self.is_linked = True
            self.line.appeared(self)

    def give_up(self) -> None:
        """The robot does not wait any longer."""
        if not self.is_linked:
            self.closed()

    def closed(self) -> None:
        """The connection is gone."""
        if not self.given_up:
            self.given_up = True
            self.process.linked.pop(self, None)
            self.line.lost(self)

    def hear(self, event: ReplyReceived | CallEnded) -> None:
        """Something has come over it."""
        if self.is_linked and not self.given_up:
            self.line.hear(event)


class _Line:
    """A robot's end: what :mod:`holdfast.transport.dialer` does, in virtual time."""

    def __init__(self, region: _Region, robot: RegionRobot) -> None:
        self._region = region
        self._queue = region.queue
        self.robot = robot
        self._pauses = RetryPauses(region.random.random)
        self._connections: set[_Connection] = set()
        self._current: _Connection | None = None
        self._next_link_at = 0.0
        self._dial = 0
        self._began_at: dict[_Connection, float] = {}
        self._sent_at: dict[int, float] = {}
        self.linked_at = float("inf")
        self.round_trips: list[tuple[float, float]] = []

    def start(self) -> None:
        self._pauses.begin(self._queue.now)
        self._next_link_at = 0.0
        self._dial += 1
        self._attempt(self._dial)

    def _attempt(self, dial: int) -> None:
        now = self._queue.now
        if dial != self._dial:
            return
        self._queue.after(self._pauses.next_attempt_s(now), self._attempt, dial)
        process = self._region.any_process()
        if process is None or now < self._next_link_at:
            return
        self._next_link_at = now + self._pauses.next_link_s()
        connection = _Connection(self, process)
        self._connections.add(connection)
        self._began_at[connection] = now
        self._region.note_connection()
        # Its first byte comes with the third packet.
        self._queue.after(3.0 * self._region.scenario.way_s, process.connect, connection)
        self._queue.after(OPENING_TIMEOUT_S, connection.give_up)

    def appeared(self, connection: _Connection) -> None:
        self._current = connection
        self._dial += 1
        self._pauses.succeeded()
        for other in list(self._connections):
            if other is not connection:
                other.given_up = True
                other.process.linked.pop(other, None)
        self._connections = {connection}
        self.linked_at = self._queue.now
        self.robot.hear(ServiceAppeared(CLOUD, connection.process.incarnation))

    def lost(self, connection: _Connection) -> None:
        self._connections.discard(connection)
        lasted = self._queue.now - self._began_at.pop(connection) >= 1.0
        self._pauses.ended(useful=connection.is_linked and lasted)
        if connection is self._current:
            self._current = None
            self.linked_at = float("inf")
            self.robot.hear(ServiceVanished(CLOUD, connection.process.incarnation))
            for call in list(self._sent_at):
                self.hear(CallEnded(call))
            self.start()
        elif not self._connections:
            self._next_link_at = 0.0

    def hear(self, event: ReplyReceived | CallEnded) -> None:
        sent_at = self._sent_at.get(event.call)
        if sent_at is None:
            return  # abandoned
        if isinstance(event, CallEnded):
            del self._sent_at[event.call]
        else:
            self.round_trips.append((self._queue.now, self._queue.now - sent_at))
        self.robot.hear(event)

    # -- the wire of its robot -------------------------------------------------------------------

    def call(self, service: str, call: int, payload: bytes) -> None:
        assert service == CLOUD
        self._sent_at[call] = self._queue.now
        connection = self._current
        if connection is None:
            self._queue.after(_UNREACHABLE_S, self.hear, CallEnded(call))
        else:
            way_s = self._region.scenario.way_s
            self._queue.after(way_s, connection.process.call, connection, call, payload)

    def abandon(self, call: int) -> None:
        self._sent_at.pop(call, None)


class _Region:
    """All of it; see :func:`simulate`."""

    def __init__(self, setup: Setup, scenario: Scenario) -> None:
        self.setup = setup
        self.scenario = scenario
        self.queue = EventQueue()
        self.random = random.Random(scenario.seed)
        self.processes: list[_Process] = []
        self.busy_until = 0.0
        self.handshakes = self.lost_handshakes = 0
        self.connections: list[float] = []
        self._num_processes = 0
        self._ended: list[_Process] = []
        self.lines = [
            _Line(
                self,
                RegionRobot(
                    number,
                    setup,
                    self.queue,
                    act_s=scenario.act_s,
                    launch_s=scenario.launch_s * self.random.uniform(0.7, 1.0),
                ),
            )
            for number in range(scenario.robots)
        ]

    def any_process(self) -> _Process | None:
        return self.random.choice(self.processes) if self.processes else None

    def note_connection(self) -> None:
        self.connections.append(self.queue.now)

    def _start_process(self) -> None:
        self._num_processes += 1
        self.processes.append(_Process(self, self._num_processes))

    def _end_all(self) -> None:
        self._ended += self.processes
        for process in self.processes:
            process.die()
        self.processes = []

    def _run_for(self, seconds: float) -> None:
        until = self.queue.now + seconds
        self.queue.at(until, lambda: None)
        while self.queue.now < until and self.queue.step():
            pass

    def _busy_s(self) -> float:
        return sum(each.shell.busy_s for each in (*self.processes, *self._ended))

    def run(self) -> Outcome:
        scenario = self.scenario
        for _ in range(scenario.processes):
            self._start_process()
        turn_s = 9.0 * scenario.act_s
        for number, line in enumerate(self.lines):
            begins_s = 0.0 if scenario.in_phase else turn_s * number / scenario.robots
            self.queue.after(begins_s, line.robot.start, line)
            self.queue.after(begins_s, line.start)
        # All are in, and have turns behind them.
        fill_s = scenario.robots * scenario.handshake_s / scenario.processes / scenario.share
        self._run_for(fill_s + 1.2 * turn_s + 1.0)
        died_at, self.handshakes, self.lost_handshakes = self.queue.now, 0, 0
        self.connections = []
        for pause_s in (scenario.down_s, *([3.0] * scenario.flaps)):
            self._end_all()
            self._run_for(pause_s)
            self.busy_until = self.queue.now + scenario.busy_for_s
            for number in range(max(1, round(scenario.back * scenario.processes))):
                if number:
                    self._run_for(scenario.every_s)
                self._start_process()
            back_at = self.queue.now
            if scenario.flaps:
                self._run_for(2.0)
        self._run_for(scenario.after_s + scenario.busy_for_s - 5.0)
        busy_s = self._busy_s()
        self._run_for(5.0)
        return self._outcome(died_at, back_at, (self._busy_s() - busy_s) / 5.0)

    def _outcome(self, died_at: float, back_at: float, busy_cores: float) -> Outcome:
        now, robots = self.queue.now, [line.robot for line in self.lines]
        standstills = [
            max(
                max(0.0, now - robot.waits_since()),
                *(took for at, took, *_ in robot.standstills if at >= died_at),
                0.0,
            )
            for robot in robots
        ]
        decided = [
            float("inf") if robot.statuses[-1][1] == _RECOVERY else robot.statuses[-1][0] - back_at
            for robot in robots
        ]
        trips = [
            took
            for line in self.lines
            for at, took in line.round_trips
            if at - took >= max(back_at, line.linked_at)
        ]
        return Outcome(
            standstills,
            [line.linked_at - back_at for line in self.lines],
            decided,
            max(Counter(int(100.0 * at) for at in self.connections).values(), default=0),
            max(len(each.linked) for each in self.processes) * len(self.processes) / len(robots),
            len(self.connections),
            self.handshakes,
            self.lost_handshakes,
            max(trips, default=0.0),
            sum(robot.status != _RECOVERY for robot in robots) / len(robots),
            busy_cores / max(1, len(self.processes)),
            sum(robot.launches for robot in robots),
            sum(robot.trials for robot in robots),
        )


def broken_promises(scenario: Scenario, outcome: Outcome) -> list[str]:
    """Return which promises of docs/scale.md an outcome breaks."""
    # Nobody stands still for longer than it takes to notice, and to launch a local service.
    noticed_s = _LEASE_S if scenario.dies == "silent" else scenario.way_s
    still_s = noticed_s + scenario.launch_s + 2.0 * scenario.way_s + 0.01
    # All are in as soon as their handshakes can be computed.
    processes = max(1, round(scenario.back * scenario.processes))
    computed_s = scenario.robots * scenario.handshake_s / scenario.share / processes
    in_s = 1.5 * computed_s + 0.025 * scenario.down_s + 10.0 * scenario.way_s + 0.3
    # The cloud decides for all with their next turn, of at most ten task actions and a trial's
    # begin; but robots in phase ask at once, and it turns away those that would wait for 100 ms.
    decided_s = in_s + scenario.busy_for_s + 12.0 * scenario.act_s + 1.0
    turned_away = scenario.in_phase and scenario.robots > 1000
    # Evenly within the last pause, of 2 % of the outage: six sigma (false alarms: 1e-6).
    even = min(scenario.robots, scenario.robots * 0.01 / (_SHARE_OF_OUTAGE * scenario.down_s))
    most = scenario.robots if scenario.flaps else even + 6.0 * math.sqrt(even)
    found = (
        ("longest standstill, s", max(outcome.standstills), still_s),
        ("launches", outcome.launches, 1.05 * scenario.robots),
        ("all are in after, s", max(outcome.linked), in_s),
        ("handshakes", outcome.handshakes, 1.1 * scenario.robots * (1 + scenario.flaps)),
        ("handshakes for nothing", outcome.lost_handshakes, 0.05 * outcome.handshakes),
        ("decided after, s", 0.0 if turned_away else max(outcome.decided), decided_s),
        ("not decided for", 1.0 - outcome.in_cloud, 0.8 if turned_away else 0.0),
        ("a wait of one that is in, s", outcome.longest_round_trip_s, 0.2 + 2.0 * scenario.way_s),
        ("connections in 10 ms", outcome.peak, most),
    )
    return [f"{what}: {value:.3f} > {most:.3f}" for what, value, most in found if value > most]


def make_setup() -> Setup:
    """Return what regions share: a small belief, the published method."""
    problem = PegInHole2D()
    planning = PlanningSettings(
        particle_filter=ParticleFilterSettings(num_particles=30),
        selector=SelectorSettings(method="action_entropy", estimator="nearest_neighbor"),
    )
    return Setup(problem, planning, SessionConfiguration(problem.name, {}, {}, planning, 20_260))


def simulate(scenario: Scenario, setup: Setup | None = None) -> Outcome:
    """Run a scenario. Any decision that is not the undisturbed one raises a Violation."""
    return _Region(setup or make_setup(), scenario).run()


def scenarios(base: Scenario) -> Iterator[tuple[str, Scenario]]:
    """Yield the ways in which a region comes back."""
    replace = msgspec.structs.replace
    yield "all at once", base
    yield "silently, all at once", replace(base, dies="silent")
    yield "one by one", replace(base, every_s=1.0)
    yield "half of it", replace(base, back=0.5)
    yield "it flaps", replace(base, flaps=4)
    yield "it is busy for five seconds", replace(base, busy_for_s=5.0)
    yield "robots in phase", replace(base, in_phase=True)
