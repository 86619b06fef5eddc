"""A service's event loop and threads, over the wire inside one process."""

import asyncio
import contextlib
import gc
import math
import os
import socket
import threading
from collections.abc import AsyncIterator, Callable
from typing import Any, cast

import pytest
from tests.unit.test_protocol_service import Robot, content, planning_of
from tests.unit.test_runtime_events import RecordingSink

from holdfast.errors import MessageError
from holdfast.problems.capsule_robot import CapsuleRobot
from holdfast.problems.problem import Problem
from holdfast.protocol.messages import (
    Busy,
    NeedState,
    Progress,
    Refused,
    Reply,
    Request,
    SensingAnswer,
    SessionConfiguration,
    decode_reply,
    decode_request,
    encode,
    with_checksum,
)
from holdfast.protocol.robot_events import CallEnded, ReplyReceived, ServiceAppeared, TransportEvent
from holdfast.protocol.service import Service
from holdfast.protocol.service_jobs import EndCall, Job, JobResult, SendReply, ServiceEffect
from holdfast.protocol.service_limits import ServiceLimits
from holdfast.service import shell
from holdfast.service.problem_factory import ProblemFactory
from holdfast.service.shell import ServiceShell
from holdfast_lab.testbed.in_process import InProcessNetwork

PATIENCE_S = 30.0
LARGE = b"x" * (65 << 10)


class Patient:
    """A robot's end that collects the replies of each call."""

    def __init__(self, network: InProcessNetwork) -> None:
        self.events: asyncio.Queue[TransportEvent] = asyncio.Queue()
        self.transport = network.robot(["service"])
        self.transport.start(self.events.put_nowait)
        self.calls = 0

    def send(self, payload: bytes) -> int:
        self.calls += 1
        self.transport.call("service", self.calls, payload)
        return self.calls

    async def ask(self, payload: bytes) -> list[Reply]:
        call = self.send(payload)
        return (await self.collect({call}))[call]

    async def collect(self, calls: set[int]) -> dict[int, list[Reply]]:
        replies: dict[int, list[Reply]] = {call: [] for call in calls}
        open_calls = set(calls)
        while open_calls:
            event = await self.events.get()
            if isinstance(event, ReplyReceived):
                assert event.call in open_calls
                reply = decode_reply(event.payload)
                if not isinstance(reply, Progress):
                    replies[event.call].append(reply)
            elif isinstance(event, CallEnded):
                open_calls.remove(event.call)
        return replies

    async def run_turns(self, robot: Robot, turns: int) -> None:
        for _ in range(turns):
            assert content(await self.ask(next_request(robot))) == robot.right_answer()
            robot.act_until_sensing()
            robot.sense()


class Call:
    """A call that notes what it is told."""

    on_gone: Callable[[], object] | None = None

    def __init__(self, trace: list[str], robot: str = "a robot", payload: bytes = b"") -> None:
        self.trace, self.robot, self.payload = trace, robot, payload
        self.replies: list[bytes] = []
        self.ended = asyncio.Event()

    def reply(self, payload: bytes, *, last: bool = False) -> None:
        self.replies.append(payload)
        self.trace.append(f"{'last' if last else 'reply'} {payload.decode(errors='replace')}")
        if last:
            self.ended.set()

    def end(self) -> None:
        self.trace.append("end")
        self.ended.set()

    async def answer(self) -> Reply:
        async with asyncio.timeout(PATIENCE_S):
            await self.ended.wait()
        return decode_reply(self.replies[-1])


class Held(CapsuleRobot):
    """Stands still in its policy until it is let go."""

    name = "held"

    def __init__(self) -> None:
        super().__init__()
        self.begun = threading.Event()
        self.let_go = threading.Event()
        self.error: BaseException | None = None
        self.threads: set[threading.Thread] = set()

    def policy(self, states: Any, stage: Any) -> Any:
        self.threads.add(threading.current_thread())
        if self.error is not None:
            raise self.error
        self.begun.set()
        assert self.let_go.wait(PATIENCE_S)
        return super().policy(states, stage)


class Joined:
    """A shell on a network."""

    def __init__(self, workers: int, limits: dict[str, Any]) -> None:
        self.held = Held()
        known = ProblemFactory()

        def make_problem(session_configuration: SessionConfiguration) -> Problem:
            return (
                self.held
                if session_configuration.problem == "held"
                else known(session_configuration)
            )

        self.network = InProcessNetwork()
        self.timed: list[tuple[str, float, float]] = []
        self.log = RecordingSink()
        self.shell = ServiceShell(
            Service(make_problem, workers, ServiceLimits(**limits)),
            self.network.service("service", "boot"),
            self.log,
            on_decision=lambda *times: self.timed.append(times),
        )

    async def robot_in_work(self, key: int) -> tuple[Patient, int, Robot]:
        """Let a robot's request hold a worker."""
        patient, robot = Patient(self.network), held_robot(key)
        call = patient.send(encode(robot.request()))
        while not self.held.begun.is_set():
            await asyncio.sleep(0.001)
        return patient, call, robot


@contextlib.asynccontextmanager
async def joined(workers: int = 2, **limits: Any) -> AsyncIterator[Joined]:
    both = Joined(workers, limits)
    await both.shell.start()
    try:
        yield both
    finally:
        both.held.let_go.set()
        await both.shell.close()


def held_robot(key: int) -> Robot:
    robot = Robot(key=key)
    robot.session_configuration = SessionConfiguration("held", {}, {}, planning_of(), 5)
    return robot


def next_request(robot: Robot) -> bytes:
    return encode(robot.request(since=max(0, len(robot.observed) - 1)))


async def test_trials_of_many_robots_at_once() -> None:
    async with joined() as both:
        robots = [(Patient(both.network), Robot(key=key, seed=key)) for key in range(1, 9)]
        await asyncio.gather(*(patient.run_turns(robot, 8) for patient, robot in robots))
        statistics = both.shell.statistics()
    assert (statistics.task_parts, statistics.sensing_parts) == (8 * 7, 8 * 8)
    assert (statistics.calls, statistics.running, statistics.waiting) == (0, 0, 0)
    assert len(both.timed) == 8 * 15
    assert {kind for kind, _, _ in both.timed} == {"task", "sensing"}
    assert all(computed >= 0.0 and waited >= 0.0 for _, computed, waited in both.timed)


async def test_first_jobs_and_other_peoples_code_run_on_threads() -> None:
    async with joined() as both:
        both.held.let_go.set()
        await Patient(both.network).run_turns(held_robot(1), 12)
        names = {thread.name for thread in both.held.threads}
        assert names <= {"holdfast-worker-0", "holdfast-worker-1", "holdfast-other-0"}


@pytest.mark.parametrize(
    "payload",
    [b"damaged", with_checksum(b"no request"), with_checksum(b"\x9b\x7f"), LARGE],
    ids=["checksum", "form", "version", "large"],
)
async def test_what_is_refused_leaves_nothing_for_the_collector(payload: bytes) -> None:
    """An error holds the frames that it went through, and would be held by one of them."""
    async with joined() as both:
        robot = Patient(both.network)
        gc.collect()
        others = [each for each in gc.get_objects() if type(each) is MessageError]
        gc.disable()
        try:
            for _ in range(20):
                assert isinstance((await robot.ask(payload))[0], Refused)
            async with asyncio.timeout(PATIENCE_S):
                # A thread may still be about to let go of the last one.
                while sum(type(each) is MessageError for each in gc.get_objects()) > len(others):
                    await asyncio.sleep(0.01)
        finally:
            gc.enable()


async def test_signs_of_progress_while_a_worker_computes() -> None:
    async with joined() as both:
        patient, call, _ = await both.robot_in_work(1)
        for _ in range(3):
            event = await patient.events.get()
            while isinstance(event, ServiceAppeared):
                event = await patient.events.get()
            assert isinstance(event, ReplyReceived)
            assert isinstance(decode_reply(event.payload), Progress)
        both.held.let_go.set()
        replies = (await patient.collect({call}))[call]
        assert any(isinstance(reply, SensingAnswer) for reply in replies)


async def test_calls_are_heard_while_all_workers_compute() -> None:
    async with joined(workers=1, max_waiting=1) as both:
        patient, first, _ = await both.robot_in_work(1)
        second = patient.send(encode(Robot(key=2).request()))
        other = Patient(both.network)
        answer = await other.ask(encode(Robot(key=3).request()))
        assert [type(reply) for reply in answer] == [Busy]
        assert [type(reply) for reply in await other.ask(b"rubbish")] == [Refused]
        assert [type(reply) for reply in await other.ask(LARGE)] == [Refused]
        both.held.let_go.set()
        for replies in (await patient.collect({first, second})).values():
            assert isinstance(replies[-1], SensingAnswer)


@pytest.fixture
def let_go(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Return what large requests wait for, to be decoded."""
    let_go = threading.Event()

    def decode(payload: bytes) -> Request:
        if len(payload) >= len(LARGE):
            assert let_go.wait(PATIENCE_S)
        return decode_request(payload)

    monkeypatch.setattr(shell, "decode_request", decode)
    return let_go


@pytest.mark.parametrize(
    ("bound", "value"), [("_MAX_UNDECODED", 2), ("_MAX_UNDECODED_BYTES", int(2.5 * len(LARGE)))]
)
async def test_large_requests_beyond_the_bound_are_turned_away_unread(
    bound: str, value: int, let_go: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shell, bound, value)
    async with joined() as both:
        patient = Patient(both.network)
        kept = {patient.send(LARGE), patient.send(LARGE)}
        unread = {patient.send(LARGE) for _ in range(28)}
        # What is small is decoded meanwhile.
        assert isinstance((await Patient(both.network).ask(b"rubbish"))[0], Refused)
        delays = set()
        for replies in (await patient.collect(unread)).values():
            (busy,) = replies
            assert isinstance(busy, Busy)
            assert busy.number == 0
            delays.add(busy.retry_after_ms)
        assert min(delays) == 100
        assert len(delays) > 20  # they do not come back all at once
        assert both.shell.statistics().busy == 28
        let_go.set()
        for replies in (await patient.collect(kept)).values():
            assert isinstance(replies[0], Refused)
        # There is room again.
        assert isinstance((await patient.ask(LARGE))[0], Refused)
        assert both.log.events[0][0] == "busy"


async def test_one_robot_takes_no_room_for_large_requests_from_another(
    let_go: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shell, "_MAX_UNDECODED_BYTES", 2 * len(LARGE))
    async with joined() as both:
        names = ["mallory"] * 3 + ["anna", "berta", "anna", "carla"]
        calls = [Call([], name, LARGE) for name in names]
        for call in calls:
            both.shell.deliver(call)
        for index in (2, 5, 6):  # hers beyond the room, and all beyond twice the room
            assert isinstance(await calls[index].answer(), Busy)
        let_go.set()
        for index in (0, 1, 3, 4):
            assert isinstance(await calls[index].answer(), Refused)


async def test_one_call_is_let_in_however_large_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shell, "_MAX_UNDECODED_BYTES", 10)
    async with joined() as both:
        assert isinstance((await Patient(both.network).ask(LARGE))[0], Refused)


@pytest.mark.parametrize(
    "error", [KeyboardInterrupt(), asyncio.CancelledError(), GeneratorExit(), SystemExit(1)]
)
async def test_a_problem_that_raises_anything_costs_no_worker(error: BaseException) -> None:
    async with joined() as both:
        both.held.error = error
        patient = Patient(both.network)
        for key in range(1, 6):  # more often than there are threads
            (reply,) = await patient.ask(encode(held_robot(key).request()))
            assert isinstance(reply, Refused)
            assert reply.code == "failed"
            assert type(error).__name__ in reply.text
        await patient.run_turns(Robot(key=9), 1)
        assert both.shell.statistics().refusals == {"failed": 5}


@pytest.mark.parametrize("event", ["refused", "session_taken_over"])
async def test_what_happens_often_is_logged_now_and_then_with_its_number(event: str) -> None:
    """Whoever raises the epoch of its own session with each message must not fill a disk."""
    async with joined() as both:
        patient, robot = Patient(both.network), Robot()
        for epoch in range(1, 101):
            patient.send(b"rubbish" if event == "refused" else encode(robot.request(epoch=epoch)))
        first = 1 if event == "refused" else 2
        told: list[int] = []
        while sum(1 + number for number in told) < 101 - first:
            await asyncio.sleep(0.01)
            told = [
                int(str(fields.get("similar_lines_omitted", 0)))
                for name, fields in both.log.events
                if name == event
            ]
        assert sum(1 + number for number in told) == 101 - first
        assert len(told) < 50


# -- a machine that is scripted ------------------------------------------------------------------


class Script(Service):
    """A machine that hands out the jobs that a test has made."""

    def __init__(self, *jobs: Job) -> None:
        super().__init__(ProblemFactory(), 2)
        self.jobs = list(jobs)
        self.begun_at = 0.0
        self.trace: list[str] = []
        self.times: list[float] = []
        self.outcome: JobResult | None = None

    def receive(self, call: int, *arguments: Any) -> list[ServiceEffect]:
        self.trace.append(f"call {call} of {arguments[-1]}")
        jobs, self.jobs = self.jobs, []
        return [SendReply(call, b"first"), *jobs]

    def started(self, job: Job, now: float) -> None:
        self.trace.append(f"begun {job.kind}")
        self.begun_at = now
        self.times.append(now)

    def finished(
        self, job: Job, outcome: JobResult, now: float, processor_s: float | None = None
    ) -> list[ServiceEffect]:
        self.trace.append(f"finished {job.kind}")
        self.outcome = outcome
        self.times.append(now)
        return []

    def gone(self, call: int) -> list[ServiceEffect]:
        self.trace.append(f"gone {call}")
        return []


class Scripted(Job):
    """A job of a script."""

    def __init__(self, kind: str, expected_s: float, run: Callable[[], object]) -> None:
        self.kind = kind  # type: ignore[assignment]
        self.company = None
        self.expected_s = expected_s
        self.is_brief = True
        self.run = run  # type: ignore[assignment,method-assign]


def scripted(*jobs: tuple[str, float, Callable[[], object]]) -> tuple[Script, ServiceShell]:
    machine = Script(*(Scripted(*job) for job in jobs))
    return machine, ServiceShell(
        machine, InProcessNetwork().service("service", "boot"), RecordingSink()
    )


async def test_a_call_whose_link_has_ended_is_reported_once_and_not_within_a_reply() -> None:
    machine, both = scripted()
    await both.start()
    call = Call(machine.trace)
    both.deliver(call)
    assert call.on_gone is not None
    call.on_gone()
    call.on_gone()
    assert "gone 1" not in machine.trace, "effects may still be carried out"
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert machine.trace.count("gone 1") == 1
    await both.drain(PATIENCE_S)  # it waits for no such call
    await both.close()


async def test_what_has_arrived_is_heard_before_the_next_brief_job() -> None:
    here, there = socket.socketpair()
    threads = []

    def compute() -> None:
        threads.append(threading.current_thread())
        there.send(b"a call")

    machine, both = scripted(("one", 1e-4, compute), ("two", 1e-4, compute))

    def read() -> None:
        here.recv(100)
        both.deliver(Call(machine.trace))

    with here, there:
        await both.start()
        asyncio.get_running_loop().add_reader(here, read)
        both.deliver(Call(machine.trace))
        machine.trace.append("delivered")
        while "finished two" not in machine.trace:
            await asyncio.sleep(0)
        asyncio.get_running_loop().remove_reader(here)
        await both.close()
    assert machine.trace[:9] == [
        *("call 1 of a robot", "reply first", "delivered", "begun one", "finished one"),
        *("call 2 of a robot", "reply first", "begun two", "finished two"),
    ]
    assert set(threads) == {threading.current_thread()}


@pytest.mark.parametrize("has_all", [False, True])
async def test_a_core_is_yielded_only_to_a_robot_that_awaits_more(
    has_all: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a robot's next question waits while other programs take this core."""
    machine, both = scripted(("one", 1e-4, lambda: None))
    reply = SendReply(1, b"a part")
    answers = [[reply, EndCall(1)], machine.jobs] if has_all else [[reply, *machine.jobs]]
    monkeypatch.setattr(machine, "receive", lambda *_: answers.pop(0))
    yielded: list[int] = []
    monkeypatch.setattr(os, "sched_yield", lambda: yielded.append(len(machine.trace)))
    await both.start()
    while answers:
        both.deliver(Call(machine.trace))
    while "finished one" not in machine.trace:
        await asyncio.sleep(0)
    assert yielded == ([] if has_all else [machine.trace.index("begun one")])
    await both.close()


async def test_jobs_that_cannot_be_computed_together_have_a_turn_each() -> None:
    """Else a service would say nothing while each of them uses up its time."""
    machine, both = scripted(*[("same", 1e-4, lambda: None)] * 3)
    for job in machine.jobs:
        job.company = b"equal"
    await both.start()
    both.deliver(Call(machine.trace))
    numbers = {0}
    while 3 not in numbers:
        await asyncio.sleep(0)
        numbers.add(machine.trace.count("finished same"))
    assert numbers == {0, 1, 2, 3}
    await both.close()


async def test_long_jobs_run_beside_each_other_and_beside_the_loop() -> None:
    meeting = threading.Barrier(3, timeout=PATIENCE_S)
    machine, both = scripted(("one", math.inf, meeting.wait), ("two", math.inf, meeting.wait))
    await both.start()
    both.deliver(Call(machine.trace))
    while meeting.n_waiting < 2:
        await asyncio.sleep(0)
    meeting.wait()
    while len(machine.trace) < 6:
        await asyncio.sleep(0.001)
    assert sorted(machine.trace[2:]) == ["begun one", "begun two", "finished one", "finished two"]
    await both.close()


async def test_the_way_to_a_thread_and_back_is_no_part_of_a_jobs_time() -> None:
    """Else a brief job that was once sent to a thread would be sent there for ever."""
    loop, here = asyncio.get_running_loop(), threading.current_thread()
    computed_s = 0.0

    def compute() -> None:
        nonlocal computed_s
        computed_s = 1.0

    machine, both = scripted(("one", math.inf, compute))
    await both.start()
    clock = Clock(loop, lambda: 100.0 if threading.current_thread() is here else computed_s)
    both._loop = cast(asyncio.AbstractEventLoop, clock)
    both.deliver(Call(machine.trace))
    while "finished one" not in machine.trace:
        await asyncio.sleep(0.001)
    assert machine.times == [99.0, 100.0]
    await both.close()


class Clock:
    """A loop with a clock of a test's own."""

    def __init__(self, loop: asyncio.AbstractEventLoop, time: Callable[[], float]) -> None:
        self._loop = loop
        self.time = time

    def __getattr__(self, name: str) -> Any:
        return getattr(self._loop, name)


def broken(*_: object) -> None:
    raise RuntimeError("a defect")


@pytest.mark.parametrize("expected_s", [1e-4, math.inf], ids=["loop", "thread"])
async def test_a_job_with_a_defect_is_refused_alone(expected_s: float) -> None:
    machine, both = scripted(("one", expected_s, broken))
    await both.start()
    both.deliver(Call(machine.trace))
    while machine.outcome is None:
        await asyncio.sleep(0)
    assert machine.outcome.failure is not None
    code, text = machine.outcome.failure
    assert code == "failed"
    assert "RuntimeError: a defect" in text
    await asyncio.sleep(0)
    assert both.statistics().defects == 1
    await both.close()


@pytest.mark.parametrize("method", ["receive", "finished", "tick", "started"])
async def test_a_machine_with_a_defect_forgets_everything_and_goes_on(
    method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half-way through a change its tables may not agree any more; it holds nothing of worth."""
    async with joined(workers=3) as both:
        turns, other = Robot(key=1), Robot(key=2)
        patient, busy = Patient(both.network), Patient(both.network)
        await patient.run_turns(turns, 1)
        held = busy.send(encode(held_robot(3).request()))
        while not both.held.begun.is_set():
            await asyncio.sleep(0.001)
        sound = getattr(Service, method)

        def fails_once(self: Service, *arguments: Any) -> Any:
            sound(self, *arguments)  # what it has changed is not undone
            monkeypatch.setattr(Service, method, sound)
            raise RuntimeError("a defect")

        monkeypatch.setattr(Service, method, fails_once)
        replies = await Patient(both.network).ask(encode(other.request()))
        if method == "receive":
            (refused,) = replies
            assert isinstance(refused, Refused)
            assert (refused.number, refused.code) == (0, "failed")
            assert "RuntimeError: a defect" in refused.text
        # All others are told to come again, and nothing is left of what was.
        (come_again,) = (await busy.collect({held}))[held]
        assert isinstance(come_again, Busy)
        statistics = both.shell.statistics()
        assert (statistics.defects, statistics.calls, statistics.running) == (1, 0, 0)
        (defect,) = [fields for name, fields in both.log.events if name == "defect"]
        assert "RuntimeError: a defect" in str(defect["reason"])
        assert "fails_once" in str(defect["traceback"])
        # The result of a job from before is nobody's; the next questions are answered.
        both.held.let_go.set()
        (need_state,) = await patient.ask(encode(turns.request(session_configuration=False)))
        assert isinstance(need_state, NeedState)
        assert content(await patient.ask(encode(turns.restore()))) == turns.right_answer()
        await Patient(both.network).run_turns(other, 2)
