"""Many robots in one process: they ask at their rates, and hold every answer against the right one.

They play trials back that were run before, so they cost little themselves; but each has a session
of its own and asks as a robot does: with what it has observed since the service last answered it,
and with its whole state where the service says that it does not know it. Takes one JSON object and
prints one, as child.py does.
"""

from __future__ import annotations

import gc
import heapq
import json
import os
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.processes import usage_of
from benchmarks.robots import configuration_for
from benchmarks.turns import Turn, recorded_turns
from holdfast.runtime.robot_process import opening_of
from holdfast.runtime.transport.zenoh_transport import ZenohRobotTransport
from holdfast.session.events import Appeared, Ended, Replied, TransportEvent, Vanished
from holdfast.session.messages import (
    PROTOCOL_VERSION,
    Busy,
    NeedState,
    Opening,
    Refused,
    Request,
    SensingAnswer,
    TaskAnswer,
    decode_reply,
    encode,
)
from holdfast.transport.endpoints import ServiceAddress

_SERVICE = "cloud"
_NUM_TRIALS = 12
_PATIENCE_S = 30.0
_DRAIN_S = 1.0


class _Fleet:
    """What all robots share: what they ask, and what came of it."""

    def __init__(self, trials: list[list[Turn]], opening: Opening) -> None:
        self.trials = trials
        self.opening = opening
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
            None if self._opened else fleet.opening,
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
        """Take a reply; on a thread of the transport."""
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
        self._transport = ZenohRobotTransport({_SERVICE: ServiceAddress(endpoint)})
        self._asked: dict[int, _Robot] = {}
        self._number = 0
        self.appeared = threading.Event()
        self._transport.start(self._deliver)

    def next_call(self, robot: _Robot) -> int:
        self._number += 1
        self._asked[self._number] = robot
        return self._number

    def send(self, call: int, payload: bytes) -> None:
        self._transport.call(_SERVICE, call, payload)

    def close(self) -> None:
        self._transport.close()

    def _deliver(self, event: TransportEvent) -> None:
        if isinstance(event, Replied):
            self._asked[event.call].replied(event.call, event.payload)
        elif isinstance(event, Ended):
            self._asked.pop(event.call).ended(event.call)
        elif isinstance(event, Appeared):
            self.appeared.set()
        elif isinstance(event, Vanished):
            self._fleet.links_lost += 1


def _percentiles(seconds: list[float]) -> dict[str, float]:
    values = np.array(seconds or [np.nan])
    return {
        "median": float(np.median(values)),
        "percentile_99": float(np.percentile(values, 99)),
        "worst": float(values.max()),
    }


def load(
    endpoint: str,
    process_id: int,
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
    endpoint : str
    process_id : int
        Of the service, to see what it uses.
    num_robots, num_links : int
        Robots, and links that they share.
    sensing_interval : int
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
    fleet = _Fleet(trials, opening_of(configuration))
    links = [_Link(fleet, endpoint) for _ in range(num_links)]
    for link in links:
        if not link.appeared.wait(_PATIENCE_S):
            raise RuntimeError(f"no service at {endpoint}")
    robots = [_Robot(fleet, index, links[index % num_links]) for index in range(num_robots)]
    gc.collect()
    gc.disable()

    period_s = 1.0 / rate_hz
    begin = time.perf_counter() + 0.05
    counted_from, until = begin + warm_up_s, begin + warm_up_s + seconds
    due = [(begin + period_s * index / num_robots, index) for index in range(num_robots)]
    heapq.heapify(due)
    late_s = []
    before = own_before = None
    while due[0][0] < until:
        at, index = due[0]
        now = time.perf_counter()
        if now < at:
            time.sleep(at - now)
            continue
        if not fleet.counting and at >= counted_from:
            fleet.counting = True
            before, own_before, counted_at = usage_of(process_id), os.times(), now
        heapq.heapreplace(due, (at + period_s, index))
        if robots[index].waiting:
            fleet.skipped += fleet.counting
            continue
        if fleet.counting:
            late_s.append(now - at)
        robots[index].ask()
    wall_s = time.perf_counter() - counted_at
    after, own_after = usage_of(process_id), os.times()
    assert before is not None and own_before is not None
    # What is on its way still counts.
    drained_at = time.perf_counter() + _DRAIN_S
    while any(robot.waiting for robot in robots) and time.perf_counter() < drained_at:
        time.sleep(0.01)
    unanswered = sum(robot.waiting for robot in robots)
    for link in links:
        link.close()
    own_s = sum(own_after[:2]) - sum(own_before[:2])
    return {
        "task": _percentiles(fleet.task_s),
        "sensing": _percentiles(fleet.sensing_s),
        "late": _percentiles(late_s),
        "wall_s": wall_s,
        "service_cores": (after.cpu_s - before.cpu_s) / wall_s,
        "service_resident_bytes": after.resident_bytes,
        "own_cores": own_s / wall_s,
        "unanswered": unanswered,
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
    print(json.dumps(load(**json.loads(sys.argv[1]))))
