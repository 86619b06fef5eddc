"""Many robots in one process: they ask at their rates, and hold every answer against the right one.

They play trials back that were run before, so they cost little themselves; but each has a session
of its own and asks as a robot does: with what it has observed since the service last answered it,
and with its whole state where the service says that it does not know it. One event loop has all
their links, so that they take little of the machine from the service. Takes one JSON object and
prints one, as child.py does.
"""

from __future__ import annotations

import asyncio
import gc
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.processes import usage_of
from benchmarks.robots import configuration_for
from benchmarks.turns import Turn, recorded_turns
from holdfast.protocol.messages import (
    PROTOCOL_VERSION,
    Busy,
    NeedState,
    Refused,
    Request,
    SensingAnswer,
    SessionConfiguration,
    TaskAnswer,
    decode_reply,
    encode,
)
from holdfast.protocol.robot_events import (
    CallEnded,
    ReplyReceived,
    ServiceAppeared,
    ServiceVanished,
    TransportEvent,
)
from holdfast.robot.session_configuration import session_configuration_of
from holdfast.transport.robot_end import StreamRobotTransport

_SERVICE = "cloud"
_NUM_TRIALS = 12
_PATIENCE_S = 30.0
_DRAIN_S = 1.0


class _Fleet:
    """What all robots share: what they ask, and what came of it."""

    def __init__(
        self, trials: list[list[Turn]], session_configuration: SessionConfiguration
    ) -> None:
        self.trials = trials
        self.session_configuration = session_configuration
        self.counting = False
        self.task_s: list[float] = []
        self.sensing_s: list[float] = []
        self.sent = self.complete = self.busy = self.need_state = 0
        self.lost = self.wrong = self.skipped = self.links_lost = 0


class _Robot:
    """One robot: a session, and where in which trial it is."""

    def __init__(self, fleet: _Fleet, index: int, link: _Link) -> None:
        self._fleet = fleet
        self._link = link
        self._session = index.to_bytes(16, "big")
        self._trial = index % len(fleet.trials)
        self._position = index % 3
        self._number = 0
        self._opened = self._hand_over = False
        self._acknowledged = 0
        self._sent_at = 0.0
        self._call = -1
        self._parts_missing = 0

    @property
    def waiting(self) -> bool:
        """Whether the last answer is not complete."""
        return self._parts_missing > 0

    def ask(self) -> None:
        """Ask what comes next."""
        fleet = self._fleet
        turn = fleet.trials[self._trial][self._position]
        state = turn.state
        fresh = turn.before is None
        missing = turn.observations[self._acknowledged :]
        hand_over = self._hand_over or len(missing) > 1 or not (self._opened or fresh)
        self._number += 1
        request = Request(
            PROTOCOL_VERSION,
            self._session,
            1,
            self._number,
            state.trial,
            state.step,
            state.sensed,
            turn.digest,
            () if hand_over else missing,
            None if self._opened else fleet.session_configuration,
            turn.checkpoint if hand_over else None,
        )
        self._turn = turn
        self._parts_missing = 1 if fresh else 2
        fleet.sent += fleet.counting
        payload = encode(request)
        self._call = self._link.next_call(self)
        self._sent_at = time.perf_counter()
        self._link.send(self._call, payload)

    def replied(self, call: int, payload: bytes) -> None:
        """Take a reply."""
        if call != self._call:
            return
        took_s = time.perf_counter() - self._sent_at
        fleet = self._fleet
        reply = decode_reply(payload)
        if isinstance(reply, TaskAnswer | SensingAnswer):
            fleet.wrong += not self._turn.is_right(reply)
            self._parts_missing -= 1
            if fleet.counting:
                times = fleet.task_s if isinstance(reply, TaskAnswer) else fleet.sensing_s
                times.append(took_s)
            if self._parts_missing == 0:
                fleet.complete += fleet.counting
                self._opened, self._hand_over = True, False
                self._go_on(len(self._turn.observations))
        elif isinstance(reply, Busy):
            # The robot's local service decides this one.
            fleet.busy += fleet.counting
            self._go_on(self._acknowledged)
        elif isinstance(reply, NeedState):
            fleet.need_state += 1
            self._opened, self._hand_over = False, True
            self._parts_missing = 0
        else:
            fleet.wrong += isinstance(reply, Refused)

    def ended(self, call: int) -> None:
        """Take note that nothing more comes of a call; of the one before it may be told late."""
        if call == self._call and self._parts_missing:
            self._fleet.lost += 1
            self._parts_missing = 0
            self._opened, self._hand_over = False, True

    def _go_on(self, acknowledged: int) -> None:
        self._parts_missing = 0
        self._acknowledged = acknowledged
        self._position += 1
        if self._position == len(self._fleet.trials[self._trial]):
            self._trial = (self._trial + 1) % len(self._fleet.trials)
            self._position = self._acknowledged = 0


class _Link:
    """A robot's end of the wire, for one robot or for several."""

    def __init__(self, fleet: _Fleet, endpoint: str) -> None:
        self._fleet = fleet
        self._transport = StreamRobotTransport({_SERVICE: endpoint})
        self._asked: dict[int, _Robot] = {}
        self._number = 0
        self.appeared = asyncio.Event()
        self._transport.start(self._deliver)

    def next_call(self, robot: _Robot) -> int:
        self._number += 1
        self._asked[self._number] = robot
        return self._number

    def send(self, call: int, payload: bytes) -> None:
        self._transport.call(_SERVICE, call, payload)

    async def close(self) -> None:
        await self._transport.close()

    def _deliver(self, event: TransportEvent) -> None:
        if isinstance(event, ReplyReceived):
            self._asked[event.call].replied(event.call, event.payload)
        elif isinstance(event, CallEnded):
            self._asked.pop(event.call).ended(event.call)
        elif isinstance(event, ServiceAppeared):
            self.appeared.set()
        elif isinstance(event, ServiceVanished):
            self._fleet.links_lost += 1


def _percentiles(seconds: list[float]) -> dict[str, float]:
    values = np.array(seconds or [np.nan])
    return {
        "median": float(np.median(values)),
        "percentile_99": float(np.percentile(values, 99)),
        "worst": float(values.max()),
    }


class _Clock:
    """Has robots ask in turn, each at its rate, and counts for some time."""

    def __init__(
        self, fleet: _Fleet, robots: list[_Robot], period_s: float, process_ids: list[int]
    ) -> None:
        self._fleet = fleet
        self._robots = robots
        self._period_s = period_s
        self._process_ids = process_ids
        self._loop = asyncio.get_running_loop()
        self.late_s: list[float] = []
        self._until = float("inf")

    async def run(self, warm_up_s: float, seconds: float) -> dict[str, float]:
        """Let the robots ask; return what the service and this process have used meanwhile."""
        begin = self._loop.time() + 0.05
        self._until = begin + warm_up_s + seconds
        for index, robot in enumerate(self._robots):
            at = begin + self._period_s * index / len(self._robots)
            self._loop.call_at(at, self._turn, robot, at)
        await asyncio.sleep(begin + warm_up_s - self._loop.time())
        self._fleet.counting = True
        before, own_before, counted_at = self._cpu_s(), os.times(), time.perf_counter()
        await asyncio.sleep(self._until - self._loop.time())
        wall_s = time.perf_counter() - counted_at
        after, own_after = self._cpu_s(), os.times()
        own_s = sum(own_after[:2]) - sum(own_before[:2])
        return {
            "wall_s": wall_s,
            "service_cores": (after - before) / wall_s,
            "own_cores": own_s / wall_s,
        }

    def _turn(self, robot: _Robot, at: float) -> None:
        fleet = self._fleet
        if at >= self._until:
            return
        self._loop.call_at(at + self._period_s, self._turn, robot, at + self._period_s)
        if robot.waiting:
            fleet.skipped += fleet.counting
            return
        if fleet.counting:
            self.late_s.append(self._loop.time() - at)
        robot.ask()

    def _cpu_s(self) -> float:
        return sum(usage_of(process_id).cpu_s for process_id in self._process_ids)


async def load(
    endpoint: str,
    process_ids: list[int],
    num_robots: int,
    num_links: int,
    rate_hz: float,
    sensing_interval: int,
    warm_up_s: float,
    seconds: float,
) -> dict[str, Any]:
    """Have robots ask a service for some time.

    Parameters
    ----------
    process_ids : list of int
        Of the service, to see what it uses.
    num_robots, num_links : int
        Robots, and links that they share.
    rate_hz : float
        Turns of each robot a second, evenly spaced, the robots one after another.
    warm_up_s, seconds : float
        Before anything is counted, and then.
    """
    with tempfile.TemporaryDirectory() as directory:
        configuration = configuration_for(
            Path(directory), num_trials=1, sensing_interval=sensing_interval
        )
    problem, settings = configuration.problem, configuration.planning
    trials = [recorded_turns(problem, settings, trial) for trial in range(_NUM_TRIALS)]
    fleet = _Fleet(trials, session_configuration_of(configuration))
    links = [_Link(fleet, endpoint) for _ in range(num_links)]
    for link in links:
        try:
            await asyncio.wait_for(link.appeared.wait(), _PATIENCE_S)
        except TimeoutError:
            raise RuntimeError(f"no service at {endpoint}") from None
    robots = [_Robot(fleet, index, links[index % num_links]) for index in range(num_robots)]
    gc.collect()
    gc.disable()
    clock = _Clock(fleet, robots, 1.0 / rate_hz, process_ids)
    used = await clock.run(warm_up_s, seconds)
    # What is on its way still counts.
    drained_at = time.perf_counter() + _DRAIN_S
    while any(robot.waiting for robot in robots) and time.perf_counter() < drained_at:
        await asyncio.sleep(0.01)
    unanswered = sum(robot.waiting for robot in robots)
    resident_bytes = sum(usage_of(process_id).resident_bytes for process_id in process_ids)
    await asyncio.gather(*(link.close() for link in links))
    return {
        "task": _percentiles(fleet.task_s),
        "sensing": _percentiles(fleet.sensing_s),
        "late": _percentiles(clock.late_s),
        "service_resident_bytes": resident_bytes,
        "unanswered": unanswered,
        **used,
        **{
            name: getattr(fleet, name)
            for name in (
                "sent",
                "complete",
                "busy",
                "need_state",
                "lost",
                "links_lost",
                "wrong",
                "skipped",
            )
        },
    }


if __name__ == "__main__":
    print(json.dumps(asyncio.run(load(**json.loads(sys.argv[1])))))
