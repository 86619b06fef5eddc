"""The threads around a service's machine, over the wire inside one process."""

from __future__ import annotations

import asyncio
import gc
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import msgspec
import pytest
from tests.unit.test_session_service import Robot, content, planning_of

from holdfast.errors import ConfigurationError, OtherCodeError, UnknownProblemError
from holdfast.problems import registry
from holdfast.problems.capsule_robot import CapsuleRobot
from holdfast.problems.problem import Problem
from holdfast.runtime.service_shell import KnownProblems, ServiceBrokenError, ServiceShell
from holdfast.runtime.transport.in_process import InProcessNetwork
from holdfast.session.events import Appeared, Ended, Replied, TransportEvent
from holdfast.session.messages import (
    Busy,
    MessageError,
    Opening,
    Progress,
    Refused,
    Reply,
    SensingAnswer,
    TaskAnswer,
    decode_reply,
    encode,
    sealed,
)
from holdfast.session.service import Service
from holdfast.session.service_limits import ServiceLimits
from holdfast.source_digest import core_version, problem_digest

PATIENCE_S = 20.0


class Patient:
    """A robot's end that collects the replies of each call."""

    def __init__(self, network: InProcessNetwork) -> None:
        self.events: SimpleQueue[TransportEvent] = SimpleQueue()
        self.transport = network.robot(["service"])
        self.transport.start(self.events.put)
        assert isinstance(self.events.get(timeout=PATIENCE_S), Appeared)
        self.calls = 0

    def send(self, payload: bytes) -> int:
        self.calls += 1
        self.transport.call("service", self.calls, payload)
        return self.calls

    def ask(self, payload: bytes) -> list[Reply]:
        call = self.send(payload)
        return self.collect({call})[call]

    def collect(self, calls: set[int]) -> dict[int, list[Reply]]:
        replies: dict[int, list[Reply]] = {call: [] for call in calls}
        open_calls = set(calls)
        while open_calls:
            event = self.events.get(timeout=PATIENCE_S)
            if isinstance(event, Replied):
                assert event.call in open_calls
                reply = decode_reply(event.payload)
                if not isinstance(reply, Progress):
                    replies[event.call].append(reply)
            elif isinstance(event, Ended):
                open_calls.remove(event.call)
        return replies


class Held(CapsuleRobot):
    """Stands still in its policy until it is let go."""

    name = "held"

    def __init__(self) -> None:
        super().__init__()
        self.begun = threading.Event()
        self.let_go = threading.Event()
        self.error: BaseException | None = None

    def policy(self, states: Any, stage: Any) -> Any:
        if self.error is not None:
            raise self.error
        self.begun.set()
        assert self.let_go.wait(PATIENCE_S)
        return super().policy(states, stage)


CODE = core_version(), problem_digest(object)
"""Of a problem that is one of holdfast's."""

HELD_OPENING = Opening("held", {}, {}, planning_of(), 5)


class Joined:
    """A shell on a network, with a thread that keeps its time."""

    def __init__(self, workers: int = 2, **limits: Any) -> None:
        self.held = Held()
        known = KnownProblems()

        def make_problem(opening: Opening) -> Problem:
            return self.held if opening.problem == "held" else known(opening)

        self.network = InProcessNetwork()
        self.service = Service(make_problem, workers, ServiceLimits(**limits))
        self.timed: list[tuple[str, float, float]] = []
        self.shell = ServiceShell(
            self.service,
            self.network.service("service", "boot"),
            workers,
            on_decision=lambda *times: self.timed.append(times),
        )
        self.shell.start()
        self.reasons: SimpleQueue[int | Exception] = SimpleQueue()
        self.thread = threading.Thread(target=self._wait)
        self.thread.start()

    def _wait(self) -> None:
        try:
            self.reasons.put(self.shell.wait())
        except ServiceBrokenError as error:
            self.reasons.put(error)

    def close(self) -> None:
        self.held.let_go.set()
        self.shell.stop()
        self.thread.join(PATIENCE_S)
        assert not self.thread.is_alive()
        self.shell.close()

    def robot_in_work(self, patient: Patient, key: int) -> tuple[int, Robot]:
        """Let a robot's request hold a worker."""
        robot = Robot(key=key)
        robot.opening = HELD_OPENING
        call = patient.send(encode(robot.request()))
        assert self.held.begun.wait(PATIENCE_S)
        return call, robot


@pytest.fixture
def joined() -> Iterator[Joined]:
    joined = Joined()
    yield joined
    joined.close()


def test_trials_of_many_robots_at_once(joined: Joined) -> None:
    failures: list[BaseException] = []

    def run(key: int) -> None:
        try:
            patient, robot = Patient(joined.network), Robot(key=key, seed=key)
            for _ in range(8):
                request = robot.request(since=max(0, len(robot.observed) - 1))
                assert content(patient.ask(encode(request))) == robot.right_answer()
                robot.act_until_sensing()
                robot.sense()
            patient.transport.close()
        except BaseException as error:
            failures.append(error)
            raise

    threads = [threading.Thread(target=run, args=(key,)) for key in range(1, 9)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE_S)
    assert not failures
    statistics = joined.shell.statistics()
    assert (statistics.task_parts, statistics.sensing_parts) == (8 * 7, 8 * 8)
    assert (statistics.calls, statistics.running, statistics.waiting) == (0, 0, 0)
    assert len(joined.timed) == 8 * 15
    assert {kind for kind, _, _ in joined.timed} == {"task", "sensing"}
    assert all(computed >= 0.0 and waited >= 0.0 for _, computed, waited in joined.timed)


def test_signs_of_progress_while_a_worker_computes(joined: Joined) -> None:
    patient = Patient(joined.network)
    call, _ = joined.robot_in_work(patient, 1)
    for _ in range(3):
        event = patient.events.get(timeout=PATIENCE_S)
        assert isinstance(event, Replied)
        assert isinstance(decode_reply(event.payload), Progress)
    joined.held.let_go.set()
    replies = patient.collect({call})[call]
    assert any(isinstance(reply, SensingAnswer) for reply in replies)


@pytest.mark.parametrize(
    "payload",
    [b"damaged", sealed(b"no request"), sealed(b"\x9b\x7f")],
    ids=["checksum", "form", "version"],
)
def test_what_is_refused_leaves_nothing_for_the_collector(joined: Joined, payload: bytes) -> None:
    """An error holds the frames that it went through, and would be held by one of them."""
    robot = Patient(joined.network)
    gc.collect()
    gc.disable()
    try:
        for _ in range(20):
            assert isinstance(robot.ask(payload)[0], Refused)
        kept = sum(type(each) is MessageError for each in gc.get_objects())
    finally:
        gc.enable()
    # The last one's thread may not be done with it.
    assert kept <= 1


def test_calls_are_heard_while_all_workers_compute() -> None:
    joined = Joined(workers=1, max_waiting=1)
    try:
        patient = Patient(joined.network)
        first, _ = joined.robot_in_work(patient, 1)
        second = patient.send(encode(Robot(key=2).request()))
        other = Patient(joined.network)
        assert [type(reply) for reply in other.ask(encode(Robot(key=3).request()))] == [Busy]
        assert [type(reply) for reply in other.ask(b"rubbish")] == [Refused]
        joined.held.let_go.set()
        for replies in patient.collect({first, second}).values():
            assert isinstance(replies[-1], SensingAnswer)
    finally:
        joined.close()


class Silent:
    """A transport over which nothing comes but what the test delivers."""

    def start(self, deliver: Any) -> None:
        self.deliver = deliver

    def close(self, timeout_s: float = 1.0) -> None:
        pass


class Call:
    def __init__(self, payload: bytes) -> None:
        self._payload = payload
        self.replies: SimpleQueue[bytes | None] = SimpleQueue()

    @property
    def payload(self) -> bytes:
        return self._payload

    @property
    def size_bytes(self) -> int:
        return len(self._payload)

    def reply(self, payload: bytes) -> None:
        self.replies.put(payload)

    def end(self) -> None:
        self.replies.put(None)


class Unreadable(Call):
    def __init__(self, error: BaseException) -> None:
        super().__init__(b"")
        self._error = error

    @property
    def payload(self) -> bytes:
        raise self._error


class Unanswerable(Call):
    def reply(self, payload: bytes) -> None:
        raise RuntimeError("no reply")


class Deaf(Call):
    """Blocks whoever sends to it until it is let go."""

    def __init__(self, payload: bytes, let_go: threading.Event) -> None:
        super().__init__(payload)
        self._let_go = let_go
        self.threads: set[threading.Thread] = set()

    def reply(self, payload: bytes) -> None:
        self.threads.add(threading.current_thread())
        assert self._let_go.wait(PATIENCE_S)
        super().reply(payload)

    def end(self) -> None:
        self.threads.add(threading.current_thread())
        assert self._let_go.wait(PATIENCE_S)
        super().end()


class Stuck(Call):
    """Keeps whoever reads it until it is let go."""

    let_go = threading.Event()

    @property
    def payload(self) -> bytes:
        assert self.let_go.wait(PATIENCE_S)
        return self._payload


@pytest.mark.parametrize("bound", ["calls", "bytes"])
def test_calls_beyond_the_queue_are_turned_away_unread(bound: str) -> None:
    payload = b"x" * 100
    limits: dict[str, Any] = (
        {"max_incoming": 2} if bound == "calls" else {"max_incoming_bytes": 250}
    )
    Stuck.let_go.clear()
    shell = ServiceShell(Service(KnownProblems(), 1), Silent(), 1, **limits)
    shell.start()
    try:
        calls = [Stuck(payload) for _ in range(30)]
        for call in calls:
            shell.deliver(call)
        delays = set()
        for call in calls[2:]:
            busy = decode_reply(call.replies.get(timeout=PATIENCE_S) or b"")
            assert isinstance(busy, Busy)
            assert busy.number == 0
            delays.add(busy.retry_after_ms)
            assert call.replies.get(timeout=PATIENCE_S) is None
        assert min(delays) == 100
        assert len(delays) > 20  # they do not come back all at once
        assert shell.statistics().busy == 28
        Stuck.let_go.set()
        for call in calls[:2]:
            assert isinstance(decode_reply(call.replies.get(timeout=PATIENCE_S) or b""), Refused)
    finally:
        Stuck.let_go.set()
        shell.close()


def test_one_call_is_let_in_however_large_it_is() -> None:
    shell = ServiceShell(Service(KnownProblems(), 1), Silent(), 1, max_incoming_bytes=10)
    shell.start()
    try:
        call = Call(b"x" * 1000)
        shell.deliver(call)
        assert isinstance(decode_reply(call.replies.get(timeout=PATIENCE_S) or b""), Refused)
    finally:
        shell.close()


@pytest.mark.parametrize("error", [RuntimeError("no payload"), KeyboardInterrupt("no payload")])
def test_a_failing_worker_ends_the_service(error: BaseException) -> None:
    shell = ServiceShell(Service(KnownProblems(), 1), Silent(), 1)
    shell.start()
    shell.deliver(Unreadable(error))
    with pytest.raises(ServiceBrokenError, match="no payload"):
        shell.wait()
    shell.close()


def test_a_failing_sender_ends_the_service() -> None:
    shell = ServiceShell(Service(KnownProblems(), 1), Silent(), 1)
    shell.start()
    shell.deliver(Unanswerable(b""))
    with pytest.raises(ServiceBrokenError, match="no reply"):
        shell.wait()
    shell.close()


@pytest.mark.parametrize(
    "error", [KeyboardInterrupt(), asyncio.CancelledError(), GeneratorExit(), SystemExit(1)]
)
def test_a_problem_that_raises_anything_costs_no_worker(error: BaseException) -> None:
    joined = Joined(workers=2)
    try:
        joined.held.error = error
        patient = Patient(joined.network)
        for key in range(1, 6):  # more often than there are threads
            robot = Robot(key=key)
            robot.opening = HELD_OPENING
            (reply,) = patient.ask(encode(robot.request()))
            assert isinstance(reply, Refused)
            assert reply.code == "failed"
            assert type(error).__name__ in reply.text
        sound = Robot(key=9)
        assert content(patient.ask(encode(sound.request()))) == sound.right_answer()
        assert joined.shell.statistics().refusals == {"failed": 5}
    finally:
        joined.close()


def test_clients_that_do_not_read_hold_up_nobody_else() -> None:
    network = InProcessNetwork()
    transport = network.service("service", "boot")
    shell = ServiceShell(Service(KnownProblems(), 2, ServiceLimits(max_sessions=50)), transport, 2)
    shell.start()
    timekeeper = threading.Thread(target=shell.wait)
    timekeeper.start()
    let_go = threading.Event()
    try:
        # Much more of them than there are workers, and some of them robots, as far as one can tell.
        rude = [Deaf(b"rubbish", let_go) for _ in range(200)]
        rude += [Deaf(encode(Robot(key=key).request()), let_go) for key in range(1, 11)]
        for call in rude:
            shell.deliver(call)  # returns, although no reply can be sent
        patient, robot = Patient(network), Robot(key=99)
        for _ in range(5):
            request = robot.request(since=max(0, len(robot.observed) - 1))
            assert content(patient.ask(encode(request))) == robot.right_answer()
            robot.act_until_sensing()
            robot.sense()
        assert all(call.replies.empty() for call in rude)
        let_go.set()
        for call in rude:
            while call.replies.get(timeout=PATIENCE_S) is not None:
                pass
        assert threading.current_thread() not in {thread for c in rude for thread in c.threads}
        assert timekeeper not in {thread for call in rude for thread in call.threads}
    finally:
        let_go.set()
        shell.stop()
        timekeeper.join(PATIENCE_S)
        shell.close()


class Noting(Call):
    """Notes which threads reply to it."""

    def __init__(self, payload: bytes) -> None:
        super().__init__(payload)
        self.threads: set[threading.Thread] = set()

    def reply(self, payload: bytes) -> None:
        self.threads.add(threading.current_thread())
        super().reply(payload)

    def answer(self) -> list[Reply]:
        replies = []
        while (payload := self.replies.get(timeout=PATIENCE_S)) is not None:
            replies.append(decode_reply(payload))
        return [reply for reply in replies if not isinstance(reply, Progress)]


class Slow(Call):
    """Takes longer for each reply than it takes until there is another sign of progress."""

    def reply(self, payload: bytes) -> None:
        time.sleep(0.06)
        super().reply(payload)


def next_request(robot: Robot) -> bytes:
    return encode(robot.request(since=max(0, len(robot.observed) - 1)))


def go_on(robot: Robot) -> None:
    robot.act_until_sensing()
    robot.sense()


def take_a_brief_job_and_stand_still(joined: Joined) -> Noting:
    """Let the leader have a job that is known to be brief, and never let it end."""
    joined.held.let_go.set()
    robot = Robot(key=1)
    robot.opening = HELD_OPENING
    for _ in range(12):
        call = Noting(next_request(robot))
        joined.shell.deliver(call)
        assert isinstance(call.answer()[-1], SensingAnswer)
        go_on(robot)
    joined.held.let_go.clear()
    joined.held.begun.clear()
    stuck = Noting(next_request(robot))
    joined.shell.deliver(stuck)
    assert joined.held.begun.wait(PATIENCE_S)
    return stuck


def test_the_transports_thread_only_hands_over(joined: Joined) -> None:
    robot = Robot(key=1)
    for _ in range(5):
        call = Noting(next_request(robot))
        joined.shell.deliver(call)
        assert content(call.answer()) == robot.right_answer()
        assert threading.current_thread() not in call.threads
        go_on(robot)


def test_a_worker_that_is_held_up_leads_no_more(joined: Joined) -> None:
    stuck = take_a_brief_job_and_stand_still(joined)
    patient, other = Patient(joined.network), Robot(key=2)
    for _ in range(3):
        assert content(patient.ask(next_request(other))) == other.right_answer()
        go_on(other)
    joined.held.let_go.set()
    assert [type(reply) for reply in stuck.answer()] == [TaskAnswer, SensingAnswer]


def test_one_that_was_deposed_while_it_waited_takes_nothing() -> None:
    # A timekeeper that was stopped deposes by what it saw long ago. Two wait for calls then.
    joined = Joined(workers=2)
    try:
        for _ in range(3):
            term = joined.shell._term
            assert term is not None
            joined.shell._pass_on(term)
            deadline = time.monotonic() + PATIENCE_S
            while joined.shell._term in (None, term):
                assert time.monotonic() < deadline
                time.sleep(0.001)
            patient, robot = Patient(joined.network), Robot(key=7)
            for _ in range(3):
                assert content(patient.ask(next_request(robot))) == robot.right_answer()
                go_on(robot)
        # The one that leads now can be deposed as well.
        stuck = take_a_brief_job_and_stand_still(joined)
        patient, other = Patient(joined.network), Robot(key=9)
        assert content(patient.ask(next_request(other))) == other.right_answer()
        joined.held.let_go.set()
        assert isinstance(stuck.answer()[-1], SensingAnswer)
    finally:
        joined.close()


def test_the_timekeeper_is_awake_when_a_reply_blocks(joined: Joined) -> None:
    robot = Robot(key=1)
    call = Noting(next_request(robot))
    joined.shell.deliver(call)
    assert isinstance(call.answer()[-1], SensingAnswer)
    deadline = time.monotonic() + PATIENCE_S
    while joined.shell._wakes_at < time.monotonic() + 10.0:  # sleeps until something happens
        assert time.monotonic() < deadline
        time.sleep(0.01)
    let_go = threading.Event()
    try:
        # The same question again: answered from memory, so no work is open.
        deaf = Deaf(next_request(robot), let_go)
        joined.shell.deliver(deaf)
        patient, other = Patient(joined.network), Robot(key=2)
        assert content(patient.ask(next_request(other))) == other.right_answer()
        assert deaf.replies.empty()
    finally:
        let_go.set()


def test_a_robot_that_reads_slowly_keeps_no_worker() -> None:
    joined = Joined(workers=1)
    try:
        slow_robot = Robot(key=1)
        for _ in range(3):
            slow = Slow(next_request(slow_robot))
            joined.shell.deliver(slow)
            patient, robot = Patient(joined.network), Robot(key=2)
            for _ in range(2):
                assert content(patient.ask(next_request(robot))) == robot.right_answer()
                go_on(robot)
            while slow.replies.get(timeout=PATIENCE_S) is not None:
                pass
            go_on(slow_robot)
    finally:
        joined.close()


def test_replies_of_one_call_keep_their_order() -> None:
    shell = ServiceShell(Service(KnownProblems(), 4), Silent(), 4)
    shell.start()
    try:
        robots = [Robot(key=key) for key in range(1, 41)]
        calls = [Call(encode(robot.request())) for robot in robots for _ in range(5)]
        for robot in robots:
            robot.sense()
        calls += [Call(encode(robot.request())) for robot in robots]
        for call in calls:
            shell.deliver(call)
        for call in calls:
            kinds = []
            while (payload := call.replies.get(timeout=PATIENCE_S)) is not None:
                kinds.append(type(decode_reply(payload)).__name__)
            kinds = [kind for kind in kinds if kind != "Progress"]
            # The end may come early, for a later request; nothing comes out of order, or after it.
            expected = (["SensingAnswer"], ["TaskAnswer", "SensingAnswer"], ["Busy"])
            assert any(kinds == each[: len(kinds)] for each in expected), kinds
            assert call.replies.empty()
    finally:
        shell.close()


def test_what_happens_often_is_logged_now_and_then_with_its_number() -> None:
    events: SimpleQueue[tuple[str, dict[str, object]]] = SimpleQueue()

    class Log:
        def event(self, name: str, /, **fields: object) -> None:
            events.put((name, fields))

        def close(self) -> None:
            pass

    shell = ServiceShell(Service(KnownProblems(), 1), Silent(), 1, Log())
    shell.start()
    timekeeper = threading.Thread(target=shell.wait)
    timekeeper.start()
    try:
        for _ in range(100):
            shell.deliver(Call(b"rubbish"))
        told: list[int] = []
        while sum(1 + number for number in told) < 100:
            name, fields = events.get(timeout=PATIENCE_S)
            assert name == "refused"
            omitted = fields.get("similar_lines_omitted", 0)
            assert isinstance(omitted, int)
            told.append(omitted)
        assert sum(1 + number for number in told) == 100
        assert len(told) < 50
    finally:
        shell.stop()
        timekeeper.join(PATIENCE_S)
        shell.close()


def test_takeovers_are_logged_now_and_then() -> None:
    """Whoever raises the epoch of its own session with each message must not fill a disk."""
    events: SimpleQueue[tuple[str, dict[str, object]]] = SimpleQueue()

    class Log:
        def event(self, name: str, /, **fields: object) -> None:
            events.put((name, fields))

        def close(self) -> None:
            pass

    shell = ServiceShell(Service(KnownProblems(), 1), Silent(), 1, Log())
    shell.start()
    try:
        robot = Robot()
        calls = []
        for epoch in range(1, 101):
            calls.append(Call(encode(robot.request(epoch=epoch))))
            shell.deliver(calls[-1])
        for call in calls:
            while call.replies.get(timeout=PATIENCE_S) is not None:
                pass
        told = 0
        while not events.empty():
            told += events.get()[0] == "session_taken_over"
        assert 1 <= told < 50
    finally:
        shell.close()


def test_close_does_not_wait_for_a_computation() -> None:
    joined = Joined(workers=1)
    patient = Patient(joined.network)
    call, _ = joined.robot_in_work(patient, 1)
    joined.shell.stop()
    assert joined.reasons.get(timeout=PATIENCE_S) == 0
    begun = time.monotonic()
    joined.shell.close()
    assert time.monotonic() - begun < PATIENCE_S / 2  # the computation would take all of it
    joined.held.let_go.set()
    joined.thread.join(PATIENCE_S)
    assert call == 1


class TestKnownProblems:
    def test_built_in_problems(self) -> None:
        for name in registry.BUILT_IN:
            assert KnownProblems()(Opening(name, {}, {}, planning_of(), 0, *CODE)).name == name

    def test_settings_are_those_of_the_opening(self) -> None:
        opening = Opening("peg_in_hole_2d", {"peg_width": 2.0}, {}, planning_of(), 0, *CODE)
        built: Any = KnownProblems()(opening)
        assert built.model.peg_width == 2.0

    def test_settings_that_do_not_fit_are_explained(self) -> None:
        opening = Opening("peg_in_hole_2d", {"peg_width": -2.0}, {}, planning_of(), 0, *CODE)
        with pytest.raises(ConfigurationError, match=r"model\.peg_width is -2\.0; expected"):
            KnownProblems()(opening)

    def test_unknown_keys_are_explained(self) -> None:
        opening = Opening("peg_in_hole_2d", {"peg_with": 2.0}, {}, planning_of(), 0, *CODE)
        with pytest.raises(ConfigurationError, match=r"model\.peg_with.*did you mean peg_width"):
            KnownProblems()(opening)

    def test_unknown_name(self) -> None:
        with pytest.raises(UnknownProblemError, match=r"problem nix: .*capsule_robot"):
            KnownProblems()(Opening("nix", {}, {}, planning_of(), 0, *CODE))

    def test_unknown_names_are_not_looked_for_each_time(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """To look through all that is installed takes as long as ten decisions."""
        looked: list[str] = []
        registered = registry.names()

        def names() -> list[str]:
            looked.append("names")
            return registered

        monkeypatch.setattr(registry, "names", names)
        monkeypatch.setattr(registry, "problem_class", looked.append)
        known = KnownProblems()
        for number in range(20):
            with pytest.raises(UnknownProblemError, match=f"problem nobody_{number}: is not known"):
                known(Opening(f"nobody_{number}", {}, {}, planning_of(), 0, *CODE))
        assert looked == ["names"]

    def test_code_of_the_robots_choice_is_not_run(self, tmp_path: Path) -> None:
        opening = Opening(
            "holdfast.problems.capsule_robot:CapsuleRobot", {}, {}, planning_of(), 0, *CODE
        )
        with pytest.raises(UnknownProblemError, match="--problem"):
            KnownProblems()(opening)

    def test_own_problem_that_was_named(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(sys, "path", sys.path.copy())
        (tmp_path / "a_robot_of_ones_own.py").write_text(
            "from holdfast.problems.capsule_robot import CapsuleRobot\n"
            "class Mine(CapsuleRobot):\n    name = 'mine'\n"
        )
        name = "a_robot_of_ones_own:Mine"
        known = KnownProblems([name], tmp_path)
        code = core_version(), problem_digest(registry.problem_class(name))
        assert known(Opening(name, {}, {}, planning_of(), 0, *code)).name == "mine"
        # What is on the disk now is not what was loaded.
        module = tmp_path / "a_robot_of_ones_own.py"
        module.write_text(module.read_text() + "# changed\n")
        assert known(Opening(name, {}, {}, planning_of(), 0, *code)).name == "mine"
        changed = problem_digest(registry.problem_class(name))
        with pytest.raises(OtherCodeError) as refused:
            known(Opening(name, {}, {}, planning_of(), 0, code[0], changed))
        for part in (name, code[1], changed, "deploy the same version"):
            assert part in str(refused.value)
        assert code[0] not in str(refused.value)

    @pytest.mark.parametrize("told", ["0.1.0+0123456789abcdef", ""])
    def test_other_holdfast(self, told: str) -> None:
        opening = Opening("capsule_robot", {}, {}, planning_of(), 0, told, CODE[1])
        with pytest.raises(OtherCodeError) as refused:
            KnownProblems()(opening)
        for part in ("capsule_robot", core_version(), told or "not told"):
            assert part in str(refused.value)

    def test_digest_that_is_not_told(self) -> None:
        opening = Opening("capsule_robot", {}, {}, planning_of(), 0, CODE[0])
        with pytest.raises(OtherCodeError, match="not told on the robot"):
            KnownProblems()(opening)

    def test_unknown_name_at_the_start(self) -> None:
        with pytest.raises(UnknownProblemError, match="nix"):
            KnownProblems(["nix"])

    def test_a_problem_is_built_anew_for_other_settings(self) -> None:
        opening = Opening("capsule_robot", {}, {}, planning_of(), 0, *CODE)
        known = KnownProblems()
        assert known(opening) is not known(msgspec.structs.replace(opening, seed=1))

    def test_several_workers_build_their_first_problem_at_once(self) -> None:
        program = """
import sys, threading
from holdfast.problems import registry
from holdfast.runtime.service_shell import KnownProblems
from holdfast.session.messages import Opening
from holdfast.settings import PlanningSettings
from holdfast.source_digest import core_version, problem_digest

code = core_version(), problem_digest(object)
sys.setswitchinterval(1e-6)
known = KnownProblems()
barrier = threading.Barrier(4)
built = []

def build():
    for name in registry.BUILT_IN:
        barrier.wait()
        built.append(known(Opening(name, {}, {}, PlanningSettings(), 0, *code)).name)

threads = [threading.Thread(target=build) for _ in range(4)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
assert len(built) == 16
"""
        done = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, timeout=60
        )
        assert done.returncode == 0, done.stderr
