"""The service's machine among hostile robots: it keeps its limits, and serves the honest ones.

Rules send whatever may come, in any order, and let jobs end in any order. After each of them all
that the machine holds is measured, not only what it says of itself.
"""

import random
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from tests.fuzz import corpus, strategies
from tests.fuzz.attack_messages import hostile_settings, nearly_right, odd_requests
from tests.fuzz.targets import SPECIMENS
from tests.unit.test_protocol_service import Bench, Robot, content, planning_of

from holdfast.protocol.messages import Request, encode, with_checksum
from holdfast.protocol.request_queue import _MOST_TOGETHER, _TOGETHER_S, RequestQueue
from holdfast.protocol.service_sessions import BRIEF, FIRST, LONG, MEDIUM, NEW, PendingTask

HONEST = (1, 2)
KEYS = st.integers(100, 115)
"""Sessions of the hostile ones: an honest robot's is 16 random bytes that nobody else knows.

Where they have a certificate of another name, they know these bytes, too.
"""

WORDS = st.sampled_from((0, 1, 2, 3, 64, 2**31, 2**32 - 1))


class HostileRobots(RuleBasedStateMachine):
    """Two honest robots, and whoever else there is."""

    def __init__(self) -> None:
        super().__init__()
        self.chance = random.Random(0)
        self.robots = [Robot(key=key, planning=planning_of(2, 12)) for key in HONEST]
        self.asked: dict[int, tuple[int, list[tuple[Any, ...]]]] = {}
        self.turns = [0, 0]
        self.sent: list[bytes] = []

    @initialize(
        workers=st.integers(1, 3),
        max_sessions=st.sampled_from((2, 3, 12)),
        max_waiting=st.sampled_from((1, 3, 100)),
        max_state_bytes=st.sampled_from((100, 2000, 1 << 20)),
        max_configuration_bytes=st.sampled_from((1000, 1 << 20)),
        answers_per_session=st.integers(1, 8),
        max_calls_per_request=st.integers(1, 3),
        max_sessions_per_robot=st.sampled_from((None, 1, 2)),
        max_waiting_per_robot=st.sampled_from((1, 2, 50)),
        max_brief_s=st.sampled_from((0.0, 0.001, 0.02)),
        max_medium_s=st.sampled_from((0.0, 0.1)),
        certificates=st.sampled_from(((None, None), ("honest", "hostile"), ("honest", None))),
    )
    def begin(
        self, workers: int, certificates: tuple[str | None, str | None], **limits: Any
    ) -> None:
        self.limits = limits
        self.honest_owner, self.hostile_owner = certificates
        self.bench = Bench(
            workers=workers, max_particles=200, max_decision_s=0.2, max_steps=200, **limits
        )

    # -- the honest ones -------------------------------------------------------------------------

    @rule(index=st.integers(0, 1), whole=st.booleans())
    def an_honest_robot_asks(self, index: int, whole: bool) -> None:
        robot = self.robots[index]
        request = robot.restore() if whole else robot.request()
        call = self.bench.send(request, self.honest_owner)
        self.asked[call] = (index, robot.right_answer())

    @rule(times=st.integers(1, 4), which=st.integers(0, 2))
    def jobs_end(self, times: int, which: int) -> None:
        for _ in range(times):
            if self.bench.jobs:
                self.bench.now += 0.001
                self.bench.run(which % len(self.bench.jobs))

    @rule(seconds=st.sampled_from((0.0, 0.02, 0.05, 1.0, 601.0)))
    def time_passes(self, seconds: float) -> None:
        # A job that runs for longer than four times the longest decision is given up.
        self.bench.now += min(seconds, 0.1) if self.bench.jobs else seconds
        self.bench.apply(self.bench.service.tick(self.bench.now))

    # -- the others ------------------------------------------------------------------------------

    def hostile(self, payload: bytes) -> None:
        self.sent.append(payload)
        self.bench.send(payload, self.hostile_owner)

    def session_of(self, key: int) -> bytes:
        """Return a hostile one's session, or an honest one's where that is another for them."""
        if self.honest_owner != self.hostile_owner and key % 4 == 0:
            return self.robots[key // 4 % 2].session
        return key.to_bytes(16, "big")

    @rule(payload=strategies.spoilt(SPECIMENS["request"]), seals=st.booleans())
    def spoilt_bytes(self, payload: bytes, seals: bool) -> None:
        self.hostile(with_checksum(payload) if seals else payload)

    @rule(seed=st.integers(0, 2**32))
    def odd_values_and_hostile_settings(self, seed: int) -> None:
        chance = random.Random(seed)
        self.hostile(next(chance.choice((odd_requests, hostile_settings))(chance)))

    @rule(request=strategies.requests)
    def a_request_of_any_content(self, request: Request) -> None:
        self.hostile(encode(request))

    @rule(key=KEYS, seed=st.integers(0, 2**32), changes=st.integers(1, 4))
    def a_request_that_is_nearly_right(self, key: int, seed: int, changes: int) -> None:
        self.hostile(encode(nearly_right(random.Random(seed), self.session_of(key), changes)))

    @rule(key=KEYS, epoch=WORDS, index=st.integers(0, 1000))
    def a_valid_request_of_any_epoch(self, key: int, epoch: int, index: int) -> None:
        requests = corpus.requests(self.session_of(key), epoch)
        self.hostile(encode(requests[index % len(requests)]))

    @precondition(lambda self: self.sent)
    @rule(index=st.integers(0, 10**6), times=st.integers(1, 6))
    def a_replay(self, index: int, times: int) -> None:
        for _ in range(times):
            self.bench.send(self.sent[index % len(self.sent)], self.hostile_owner)

    @rule(start=st.integers(0, 10**6), count=st.integers(1, 30))
    def a_flood_of_new_sessions(self, start: int, count: int) -> None:
        for key in range(start, start + count):
            request = corpus.requests((key + 10**6).to_bytes(16, "big"))[1]
            self.bench.send(encode(request), self.hostile_owner)

    # -- what must hold --------------------------------------------------------------------------

    @invariant()
    def the_honest_are_told_what_is_right(self) -> None:
        if not hasattr(self, "bench"):
            return
        for call in sorted(set(self.asked) & self.bench.ended):
            index, right = self.asked.pop(call)
            told = content(self.bench.replies[call])
            if told and isinstance(told[0][0], str):
                assert told == right[: len(told)]
            robot = self.robots[index]
            if told == right == robot.right_answer():
                self.turns[index] += 1
                robot.act_until_sensing()
                robot.sense()

    @invariant()
    def all_limits_are_kept(self) -> None:
        if hasattr(self, "bench"):
            check_limits(self.bench, self.limits)

    def teardown(self) -> None:
        if not hasattr(self, "bench"):
            return
        self.bench.run_all()
        self.the_honest_are_told_what_is_right()
        statistics = self.bench.service.statistics
        assert (statistics.waiting, statistics.running, statistics.calls) == (0, 0, 0)
        # Every call has had its end, whoever made it.
        assert self.bench.ended == set(self.bench.replies)
        check_limits(self.bench, self.limits)
        for robot in self.robots:
            answer = self.bench.ask(robot.restore(), self.honest_owner)
            assert content(answer) == robot.right_answer()


def check_limits(bench: Bench, limits: dict[str, Any]) -> None:
    """Measure all that a service holds."""
    service, statistics = bench.service, bench.service.statistics
    sessions, queue, calls = service._sessions, service._queue, service._calls
    kept = list(sessions._sessions.values())
    assert statistics.sessions == len(kept) <= limits["max_sessions"]
    epochs = list(sessions._epochs)
    assert len(epochs) == sessions._epochs._count <= max(4 * limits["max_sessions"], 4096)
    assert not set(epochs) & set(sessions._sessions)
    assert sessions._num_unserved == sum(not session.served for session in kept)
    # Owners.
    owners = {session.owner for session in kept}
    assert set(sessions._num_of) == set(sessions._configuration_bytes_of) == owners
    assert set(sessions._state_bytes_of) <= owners
    for owner in owners:
        theirs = [session for session in kept if session.owner == owner]
        assert sessions._num_of[owner] == len(theirs)
        states = sum(session.num_bytes for session in theirs)
        assert sessions._state_bytes_of[owner] == states
        configurations = sum(len(session.configuration) for session in theirs)
        assert sessions._configuration_bytes_of[owner] == configurations
        if owner is not None and limits["max_sessions_per_robot"] is not None:
            assert len(theirs) <= limits["max_sessions_per_robot"]
    # States.
    assert sum(session.num_bytes for session in kept) == sessions.state_bytes
    assert sum(session.size() for session in kept) <= sessions.state_bytes
    assert sessions.state_bytes <= limits["max_state_bytes"]
    assert sum(len(session.configuration) for session in kept) == sessions.configuration_bytes
    assert sessions.configuration_bytes <= limits["max_configuration_bytes"] or len(kept) == 1
    assert all(len(session.answers) <= limits["answers_per_session"] for session in kept)
    # Works.
    tasks = [task for session in kept for task in session.pending.values()]
    lanes = queue._lanes
    running = [task for lane in lanes for task in lane.running.values()]
    waiting = [task for task in tasks if not task.running]
    assert statistics.running == len(running) == len(bench.jobs)
    fewer = max(1, bench.workers - 1)
    most = {NEW: fewer, FIRST: fewer, BRIEF: bench.workers, MEDIUM: fewer, LONG: fewer}
    assert statistics.waiting == len(waiting)
    for number, lane in enumerate(lanes):
        # One worker has several that are short together.
        times = [job.expected_s for job in lane.running]
        most_together = len(times) <= _MOST_TOGETHER and sum(times) <= _TOGETHER_S
        assert len(times) <= most[number] or most_together
        in_lane = [task for task in waiting if queue[task.lane] is lane]
        check_lane(lane, in_lane)
        requested = sum(task.request is not None for task in in_lane)
        room = limits["max_waiting"] if number > FIRST else (limits["max_waiting"] + 1) // 2
        # One owner finds room, if another has taken that of all.
        assert requested <= max(room, 2 * bench.workers) + 2 * bench.workers
    for session in kept:
        assert sum(not task.running for task in session.pending.values()) <= 2
        assert len(session.pending) <= 4
        assert not session.closed
    for task in tasks:
        assert task.request is None or task.request.session_configuration is None
    # Calls: each waits for one work that is still to be done.
    attached = [record for waiting in calls._of.values() for record in waiting.values()]
    assert set(calls._of) <= set(tasks)
    assert len(attached) == len(calls) == statistics.calls
    assert all(calls._calls[record.call] is record for record in attached)
    most = 2 * limits["max_calls_per_request"]
    assert all(0 < len(waiting) <= most for waiting in calls._of.values())
    assert set(calls._calls) == set(bench.replies) - bench.ended
    # Problems.
    pool = service._problems._idle
    assert len(pool) <= 32
    assert len(service._problems._costs) <= 128 * 32
    assert sum(map(len, pool.values())) <= 32 * bench.workers


def check_lane(queue: RequestQueue, waiting: list[PendingTask]) -> None:
    """Check that a lane's counts are those of its tasks."""
    lined_up = [*queue._urgent, *queue._later]
    held = list(queue._held.values())
    assert {id(task) for task in waiting} == {id(task) for task in (*lined_up, *held)}
    assert set(queue._waiting_of) == {task.session.owner for task in waiting}
    for owner in (*queue._waiting_of, "all"):
        load = queue.waiting if owner == "all" else queue._waiting_of[owner]
        some = [task for task in waiting if owner in ("all", task.session.owner)]
        assert load.num == len(some)
        assert load.num_bytes == sum(task.size for task in some)
        assert abs(load.cost_s - sum(task.cost_s for task in some)) < 1e-6


@pytest.mark.parametrize(
    ("runs", "steps"),
    [pytest.param(6, 30, id="quick"), pytest.param(250, 80, marks=pytest.mark.slow, id="slow")],
)
def test_hostile_robots_break_no_limit_and_disturb_nobody(runs: int, steps: int) -> None:
    run_state_machine_as_test(
        HostileRobots,
        settings=settings(
            max_examples=runs, stateful_step_count=steps, suppress_health_check=list(HealthCheck)
        ),
    )
