"""Whose turn it is."""

import pytest
from tests.unit.test_protocol_service import Robot
from tests.unit.test_service_jobs import job

from holdfast.protocol.computing_time import ExpectedTime
from holdfast.protocol.messages import Request
from holdfast.protocol.request_queue import RequestQueue
from holdfast.protocol.service_jobs import Job
from holdfast.protocol.service_limits import ServiceLimits
from holdfast.protocol.service_sessions import PendingTask, Session


class TestRequestQueue:
    """One worker; works named by the order in which they came."""

    def setup_method(self) -> None:
        self.queue = RequestQueue(1, ServiceLimits(prefetch_patience_ms=20.0))
        self.now = 0.0

    def session(self, key: int) -> Session:
        robot = Robot(key=key)
        request = robot.request()
        return Session(
            (None, request.session),
            request,
            robot.session_configuration,
            (ExpectedTime(0.001), ExpectedTime(0.001)),
        )

    def task(self, session: Session, name: bytes, since: float, *, prefetched: bool) -> PendingTask:
        request: Request | None = None if prefetched else Robot().request()
        task = PendingTask(
            session, name, sensing=True, request=request, state=None, size=10, since=since
        )
        self.queue.enqueue(task)
        self.now = max(self.now, since)
        return task

    def run_one(self) -> tuple[bytes, Job]:
        task = self.queue.take(self.now)
        assert task is not None
        own = job(Robot(), task.request)
        self.queue.handed_out(task, own, 0.0)
        return task.digest, own

    def finish(self, job: Job) -> None:
        task, _ = self.queue.end(job)
        self.queue.release_held(task.session)

    def test_those_that_robots_stand_still_for_go_first(self) -> None:
        self.task(self.session(1), b"ahead", 0.0, prefetched=True)
        self.task(self.session(2), b"awaited", 0.01, prefetched=False)
        assert self.run_one()[0] == b"awaited"

    def test_but_not_for_ever(self) -> None:
        self.task(self.session(1), b"ahead", 0.0, prefetched=True)
        self.task(self.session(2), b"awaited", 0.03, prefetched=False)
        assert self.run_one()[0] == b"ahead"

    @pytest.mark.parametrize("held", [False, True])
    def test_what_is_awaited_meanwhile_goes_first(self, held: bool) -> None:
        session = self.session(1)
        job = None
        if held:
            # Behind another one of the same robot.
            self.task(session, b"before", 0.0, prefetched=True)
            _, job = self.run_one()
        hastened = self.task(session, b"hastened", 0.0, prefetched=True)
        self.task(self.session(2), b"other", 0.001, prefetched=True)
        self.queue.promote(hastened)
        if job is not None:
            self.finish(job)
        self.task(self.session(3), b"awaited", 0.002, prefetched=False)
        assert self.run_one()[0] == b"hastened"

    def test_a_robot_has_one_turn_at_a_time(self) -> None:
        session = self.session(1)
        self.task(session, b"first", 0.0, prefetched=False)
        name, job = self.run_one()
        assert name == b"first"
        self.task(session, b"second", 0.0, prefetched=False)
        self.task(self.session(2), b"other", 0.1, prefetched=False)
        self.finish(job)
        # It was held back meanwhile, so the other robot's turn comes before.
        assert self.run_one()[0] == b"other"

    def test_no_more_than_there_are_workers(self) -> None:
        for key in range(3):
            self.task(self.session(key), b"%d" % key, 0.0, prefetched=False)
        _, job = self.run_one()
        assert self.queue.take(self.now) is None
        assert self.queue.waiting.num == 2
        self.finish(job)
        assert self.run_one()[0] == b"1"
        assert self.queue.waiting.num == 1

    def test_prefetches_that_waited_together_run_together(self) -> None:
        """Found by the simulator (seed 27053): the second end found the slot free already."""
        self.queue = RequestQueue(2, ServiceLimits(prefetch_patience_ms=20.0))
        session = self.session(1)
        for name in (b"first", b"second"):
            self.task(session, name, 0.0, prefetched=True)
        (_, first), (_, second) = self.run_one(), self.run_one()
        self.finish(first)
        self.finish(second)
        assert (len(self.queue.running), self.queue.waiting.num) == (0, 0)


def made(
    number: int,
    owner: str | None = None,
    *,
    size: int = 10,
    prefetched: bool = False,
    since: float = 0.0,
) -> PendingTask:
    """Return a task that is expected to take 50 ms."""
    robot = Robot(key=number)
    request = robot.request()
    session = Session(
        (owner, request.session),
        request,
        robot.session_configuration,
        (ExpectedTime(0.05), ExpectedTime(0.05)),
    )
    return PendingTask(
        session,
        b"%d" % number,
        sensing=True,
        request=None if prefetched else request,
        state=None,
        size=size,
        since=since,
    )


def turns(queue: RequestQueue, count: int, now: float) -> list[bytes]:
    taken = [queue.take(now) for _ in range(count)]
    return [task.digest for task in taken if task is not None]


class TestTurns:
    """Prefetches are patient for 20 ms."""

    def order(self, *tasks: PendingTask, now: float) -> list[bytes]:
        queue = RequestQueue(99, ServiceLimits(prefetch_patience_ms=20.0, max_wait_ms=100.0))
        for task in tasks:
            queue.enqueue(task)
        return turns(queue, len(tasks), now)

    def test_a_prefetch_that_has_waited_no_longer_than_its_patience(self) -> None:
        prefetch = made(1, "anna", prefetched=True)
        assert self.order(prefetch, made(2, "berta", since=0.02), now=0.02) == [b"2", b"1"]
        assert self.order(prefetch, made(2, "berta", since=0.021), now=0.03) == [b"1", b"2"]

    @pytest.mark.parametrize(("since", "prefetch", "first"), [(0.0, 0.6, b"3"), (2.0, 1.5, b"3")])
    def test_who_had_a_turn_waits_since_then(
        self, since: float, prefetch: float, first: bytes
    ) -> None:
        """Or since the task came, if that was later."""
        queue = RequestQueue(99, ServiceLimits(prefetch_patience_ms=20.0))
        for task in (made(1, "anna"), made(2, "anna", since=since)):
            queue.enqueue(task)
        begun = queue.take(1.0)
        assert begun is not None
        assert begun.digest == b"1"
        queue.enqueue(made(3, "berta", prefetched=True, since=prefetch))
        assert turns(queue, 2, 2.0) == [first, b"2"]
        assert queue._urgent._last_turn == {}  # of owners with tasks alone


class TestTheWait:
    """Four workers; each task is expected to take 50 ms."""

    def setup_method(self) -> None:
        self.limits = ServiceLimits(max_wait_ms=100.0)
        self.queue = RequestQueue(4, self.limits)

    def add(self, number: int, owner: str | None = None, *, size: int = 10) -> None:
        self.queue.enqueue(made(number, owner, size=size))

    def overloaded(self, owner: str | None = None) -> bool:
        return self.queue.is_overloaded(0.0, owner)

    def test_the_longest_wait_is_that_of_all_workers_together(self) -> None:
        for number in range(8):
            self.add(number)
        assert self.queue.wait_s(0.0, None) == pytest.approx(0.1)
        assert not self.overloaded()
        self.add(8)
        assert self.overloaded()

    def test_nobody_is_turned_away_while_a_worker_is_free(self) -> None:
        self.limits = ServiceLimits(max_waiting=1, max_wait_ms=1.0)
        self.queue = RequestQueue(4, self.limits)
        for number in range(3):
            self.add(number)
            assert not self.overloaded()
        self.add(3)
        assert self.overloaded()

    @pytest.mark.parametrize("bound", ["max_waiting", "max_waiting_bytes"])
    def test_a_lane_has_its_share_of_the_room(self, bound: str) -> None:
        limits = {"max_waiting": 16, "max_waiting_bytes": 16_000, "max_wait_ms": 1e6}
        limits["max_waiting_bytes" if bound == "max_waiting" else "max_waiting"] = 10**6
        for room, most in ((1.0, 16), (0.5, 8)):
            self.queue = RequestQueue(4, ServiceLimits(**limits), room)  # type: ignore[arg-type]
            for number in range(most):
                assert not self.overloaded()
                self.add(number, size=1000)
            assert self.overloaded()

    def test_one_robot_has_no_more_than_its_share(self) -> None:
        limits = ServiceLimits(max_waiting_per_robot=6, max_wait_ms=1e6, max_waiting_bytes=1000)
        self.queue = RequestQueue(4, limits)
        for number in range(6):
            assert not self.overloaded("anna")
            self.add(number, "anna")
        assert self.overloaded("anna")
        assert not self.overloaded("berta")
        assert not self.overloaded()  # those without a certificate are many
        self.queue = RequestQueue(4, limits)
        for number in range(5):
            self.add(number, "anna", size=100)
            assert self.overloaded("anna") == (number == 4)
        assert not self.overloaded("berta")

    def test_what_runs_counts_for_the_rest_of_its_time(self) -> None:
        task = made(1)
        self.queue.enqueue(task)
        assert self.queue.take(1.0) is task
        assert self.wait_s(1.0) == 0.0
        own = job(Robot(), task.request)
        self.queue.handed_out(task, own, 1.0)
        running = [task.running]
        assert self.wait_s(1.02) == pytest.approx(0.03 / 4)
        self.queue.started(own, 1.5)
        assert self.wait_s(1.51) == pytest.approx(0.04 / 4)
        assert self.wait_s(9.0) == 0.0  # longer than was expected
        assert self.queue.end(own) == (task, 1.5)
        assert [*running, task.running] == [True, False]
        assert (len(self.queue.running), self.wait_s(1.5)) == (0, 0.0)

    def wait_s(self, now: float) -> float:
        return self.queue.wait_s(now, None)

    def test_what_is_removed_or_replaced_counts_no_more(self) -> None:
        limits = ServiceLimits(max_waiting_bytes=100, max_wait_ms=1e6)
        self.queue = RequestQueue(1, limits)
        first, second = made(1, size=60), made(2, size=50)
        for task in (first, second):
            self.queue.enqueue(task)
        assert self.overloaded()
        self.queue.replace(second, Robot().request(step=7), sensing=False, size=30)
        assert (second.sensing, second.size, second.cost_s) == (False, 30, 0.1)
        assert not self.overloaded()
        assert self.wait_s(0.0) == pytest.approx(0.15)
        self.queue.remove(first)
        assert self.queue.waiting.num == 1
        assert self.wait_s(0.0) == pytest.approx(0.1)
        self.queue.remove(second)
        assert (self.queue.waiting.num, self.wait_s(0.0)) == (0, 0.0)
        assert self.queue._waiting_of == {}
        assert self.queue.take(1.0) is None

    def test_before_an_owners_next_task_go_its_own_and_one_more_of_each(self) -> None:
        for number in range(12):
            self.add(number, "anna" if number < 8 else f"other {number}")
        assert self.queue.wait_s(0.0, "berta") == pytest.approx(5 * 0.05 / 4)
        self.add(12, "berta")
        assert self.queue.wait_s(0.0, "berta") == pytest.approx(7 * 0.05 / 4)
        assert self.queue.wait_s(0.0, "anna") == pytest.approx(13 * 0.05 / 4)
