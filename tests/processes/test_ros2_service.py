"""A service in ROS 2 without ROS: real processes, Zenoh's own sockets, and what goes wrong."""

from __future__ import annotations

import json
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from tests.ports import free_port
from tests.process_states import stop
from tests.unit.test_ros_client import EXAMPLE, configuration, decisions, in_process

from holdfast.config.loader import Configuration
from holdfast.errors import TransportError
from holdfast.robot.environment import SimulatedEnvironment
from holdfast.ros import messages
from holdfast.ros.active_sensing import (
    ActiveSensing,
    DecisionAnswer,
    DecisionRequest,
    ErrorCode,
    RequestKind,
)
from holdfast.ros.client import ActiveSensingClient, DecisionService
from holdfast.ros.ros2_client import Ros2Service
from holdfast.ros.ros2_keys import NO_HASH, Attachment, service_key
from holdfast.ros.ros2_service import Ros2Server

PATIENCE_S = 30.0
NAME = "cloud_active_sensing"
DOMAIN = 17
TRIAL = 2
ROUTER = Path(__file__).parents[1] / "ros" / "zenoh_router.py"
BEGIN = DecisionRequest(RequestKind.INITIALIZE, seed=1)

SETTINGS = configuration(**{"particle_filter.num_particles": 500})
"""Of the services that are processes: they decide by the example as it is."""


@contextmanager
def running(*command: object, ready: str) -> Iterator[subprocess.Popen[str]]:
    """Run a process that says when it is ready and ends with its standard input."""
    with subprocess.Popen(
        [sys.executable, *map(str, command)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        timer = threading.Timer(PATIENCE_S, process.kill)
        timer.start()
        try:
            assert process.stdout is not None and process.stdin is not None
            line = process.stdout.readline()
            timer.cancel()
            assert ready in line, (line, process.stderr and process.stderr.read())
            yield process
            process.send_signal(signal.SIGCONT)
            process.stdin.close()
            process.wait(PATIENCE_S)
        finally:
            timer.cancel()
            process.kill()


def service(way: str, port: int, name: str = NAME) -> Any:
    # fmt: off
    return running(
        "-m", "holdfast", "serve", "--ros2-domain", DOMAIN, "--ros2-name", name,
        f"--ros2-{way}", f"tcp/127.0.0.1:{port}", "--configuration", EXAMPLE,
        "--until-stdin-closes",
        ready="offers ros2",
    )
    # fmt: on


def router(port: int) -> Any:
    return running(ROUTER, port, ready="ready")


@contextmanager
def way_to(port: int, name: str = NAME, type_hash: str | None = None) -> Iterator[Ros2Service]:
    way = Ros2Service(name, DOMAIN, f"tcp/127.0.0.1:{port}", type_hash=type_hash)
    try:
        yield way
    finally:
        way.close()


def until_answered(way: DecisionService, attempts: int = 600) -> DecisionAnswer:
    """Ask until somebody is there."""
    reason = ""
    for _ in range(attempts):
        try:
            # What was sent to somebody who does not read may be lost: that costs its deadline.
            return way.ask(BEGIN, 1.0)
        except TransportError as error:
            reason = str(error)
            threading.Event().wait(0.05)
    raise AssertionError(reason)


def trial(
    cloud: DecisionService,
    recovery: DecisionService,
    settings: Configuration,
    on_sensing: Callable[[int], None] = lambda _: None,
    on_event: Callable[..., None] | None = None,
) -> list[Any]:
    class World(SimulatedEnvironment):
        def perform_sensing(self, sensing_action: int) -> np.ndarray:
            on_sensing(self.step)
            return super().perform_sensing(sensing_action)

    simulator = settings.simulator
    with ActiveSensingClient(cloud, recovery, PATIENCE_S, on_event) as client:
        world = World(settings.problem, simulator.seed, TRIAL)
        return decisions(client, world, simulator.seed, TRIAL, simulator.max_steps)


def test_a_trial_decides_as_in_process_though_the_cloud_is_killed() -> None:
    ports = free_port(), free_port()
    statuses: list[object] = []
    with (
        service("listen", ports[0]) as cloud,
        service("listen", ports[1], "recovery") as _,
        way_to(ports[0]) as way,
        way_to(ports[1], "recovery", NO_HASH) as other_way,
    ):
        made = trial(
            way,
            other_way,
            SETTINGS,
            lambda step: cloud.kill() if step >= 12 else None,
            lambda _, **fields: statuses.append(fields.get("status")),
        )
    assert made == in_process(SETTINGS, TRIAL)
    assert statuses == ["local_recovery"]


def test_a_service_that_dies_while_it_is_asked_is_noticed_then() -> None:
    port = free_port()
    outcome: queue.SimpleQueue[str] = queue.SimpleQueue()

    def ask(way: Ros2Service) -> None:
        try:
            way.ask(BEGIN, 2 * PATIENCE_S)
        except TransportError as error:
            outcome.put(str(error))

    with service("listen", port) as process, way_to(port) as way:
        until_answered(way)
        stop(process.pid)
        threading.Thread(target=ask, args=(way,), daemon=True).start()
        with pytest.raises(queue.Empty):
            outcome.get(timeout=0.3)
        process.kill()
        assert "has died" in outcome.get(timeout=PATIENCE_S)
        with pytest.raises(TransportError):
            way.ask(BEGIN, 1.0)


def test_a_service_that_is_stopped_costs_its_deadline_again_and_again() -> None:
    port = free_port()
    particles = configuration(**{"particle_filter.num_particles": 20_000})
    state = ActiveSensing(particles).answer(BEGIN).state
    with service("listen", port) as process, way_to(port) as way:
        until_answered(way)
        stop(process.pid)
        # Half a megabyte each, much more than sockets hold: sending must not wait for it either.
        for _ in range(20):
            with pytest.raises(TransportError, match=r"no answer in 0\.1 s|has died"):
                way.ask(DecisionRequest(RequestKind.CHOOSE_SENSING_ACTION, state=state), 0.1)
        process.send_signal(signal.SIGCONT)
        until_answered(way)


def test_through_a_router_that_comes_later_and_goes_and_comes_again() -> None:
    port = free_port()
    with service("router", port) as process, way_to(port) as way:
        with pytest.raises(TransportError, match=f"cannot connect to tcp/127.0.0.1:{port}"):
            way.ask(BEGIN, PATIENCE_S)
        with router(port):
            assert until_answered(way).error is ErrorCode.OK
        with pytest.raises(TransportError):
            way.ask(BEGIN, PATIENCE_S)
        with router(port):
            assert until_answered(way).error is ErrorCode.OK
            process.kill()
            process.wait()
            with pytest.raises(TransportError, match="has died"):
                way.ask(BEGIN, 2 * PATIENCE_S)


def test_robots_of_both_kinds_are_served_by_one_process(tmp_path: Path) -> None:
    ports = free_port(), free_port()
    # fmt: off
    with running(
        "-m", "holdfast", "serve", "--listen", f"tcp/127.0.0.1:{ports[0]}", "--log", "json",
        "--ros2-domain", DOMAIN, "--ros2-listen", f"tcp/127.0.0.1:{ports[1]}",
        "--configuration", EXAMPLE, "--until-stdin-closes",
        ready=f'"ros2":"/{NAME} in domain {DOMAIN} (listening on tcp/127.0.0.1:{ports[1]})"',
    ), way_to(ports[1]) as way:
        done = subprocess.run(
            [sys.executable, "-m", "holdfast", "run", str(EXAMPLE), "--out", str(tmp_path / "run"),
             "--service", f"tcp/127.0.0.1:{ports[0]}", "--recovery", "never", "--trials", "1"],
            capture_output=True, text=True, timeout=PATIENCE_S, check=False,
        )
        assert way.ask(BEGIN, PATIENCE_S).error is ErrorCode.OK
    # fmt: on
    assert done.returncode == 0, done.stderr


def test_it_answers_what_it_owes_and_ends_with_0() -> None:
    port = free_port()
    with service("listen", port) as process, way_to(port) as way:
        until_answered(way)
        process.terminate()
        assert process.wait(PATIENCE_S) == 0
        assert process.stderr is not None
        assert "Traceback" not in process.stderr.read()


def test_a_port_that_is_taken() -> None:
    port = free_port()
    with service("listen", port):
        # fmt: off
        done = subprocess.run(
            [sys.executable, "-m", "holdfast", "serve", "--ros2-domain", "0",
             "--ros2-listen", f"tcp/127.0.0.1:{port}", "--configuration", str(EXAMPLE)],
            capture_output=True, text=True, timeout=PATIENCE_S, check=False,
        )
        # fmt: on
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("holdfast: error: ")
    assert f"cannot listen on tcp/127.0.0.1:{port}" in done.stderr
    assert "in use" in done.stderr


class Gated(ActiveSensing):
    """Answers when it may."""

    def __init__(self) -> None:
        super().__init__(configuration())
        self.begun = threading.Semaphore(0)
        self.may = threading.Event()

    def answer(self, request: DecisionRequest) -> DecisionAnswer:
        self.begun.release()
        assert self.may.wait(PATIENCE_S)
        return super().answer(request)


@contextmanager
def gated() -> Iterator[tuple[Gated, Ros2Server, Ros2Service]]:
    port = free_port()
    answers = Gated()
    server = Ros2Server(answers, NAME, DOMAIN, f"tcp/127.0.0.1:{port}", listens=True)
    server.start()
    try:
        with way_to(port) as way:
            yield answers, server, way
    finally:
        answers.may.set()
        server.close(PATIENCE_S)


class Asked:
    """A request that is asked on a thread of its own."""

    def __init__(
        self,
        way: Ros2Service,
        outcomes: queue.SimpleQueue[DecisionAnswer | TransportError] | None = None,
    ) -> None:
        self._outcome = outcomes or queue.SimpleQueue()
        self._way = way
        threading.Thread(target=self._ask, daemon=True).start()

    def _ask(self) -> None:
        try:
            self._outcome.put(self._way.ask(BEGIN, 2 * PATIENCE_S))
        except TransportError as error:
            self._outcome.put(error)

    def outcome(self) -> DecisionAnswer | TransportError:
        return self._outcome.get(timeout=PATIENCE_S)


def test_whoever_comes_when_too_many_wait_is_told_so() -> None:
    outcomes: queue.SimpleQueue[DecisionAnswer | TransportError] = queue.SimpleQueue()
    with gated() as (answers, _, way):
        for _ in range(21):
            Asked(way, outcomes)
        # One is being answered and 16 wait; the others are told so while nothing moves.
        for _ in range(4):
            refused = outcomes.get(timeout=PATIENCE_S)
            assert isinstance(refused, DecisionAnswer) and refused.error is ErrorCode.BUSY
            assert "16 requests are waiting" in refused.message
        answers.may.set()
        for _ in range(17):
            answered = outcomes.get(timeout=PATIENCE_S)
            assert isinstance(answered, DecisionAnswer) and answered.error is ErrorCode.OK


def test_what_is_owed_is_answered_and_nothing_new_is_taken() -> None:
    with gated() as (answers, server, way):
        owed = Asked(way)
        assert answers.begun.acquire(timeout=PATIENCE_S)
        assert server.is_busy
        server.take_no_more()
        assert way.ask(BEGIN, 2 * PATIENCE_S).error is ErrorCode.BUSY
        answers.may.set()
        answered = owed.outcome()
        assert isinstance(answered, DecisionAnswer) and answered.error is ErrorCode.OK


def test_a_defect_costs_its_request_alone() -> None:
    class Defective(ActiveSensing):
        def answer(self, request: DecisionRequest) -> DecisionAnswer:
            if request.seed == 7:
                raise KeyError("a defect")
            return super().answer(request)

    port = free_port()
    told: list[tuple[str, object]] = []
    server = Ros2Server(
        Defective(configuration()),
        NAME,
        DOMAIN,
        f"tcp/127.0.0.1:{port}",
        listens=True,
        on_event=lambda name, **fields: told.append((name, fields["reason"])),
    )
    server.start()
    with way_to(port) as way:
        with pytest.raises(TransportError, match="a defect of the service: KeyError"):
            way.ask(DecisionRequest(RequestKind.INITIALIZE, seed=7), PATIENCE_S)
        assert way.ask(BEGIN, PATIENCE_S).error is ErrorCode.OK
    server.close(PATIENCE_S)
    assert told == [("ros2_failed", "KeyError: 'a defect'")]
    assert not server.is_busy


def test_closing_ends_what_is_asked() -> None:
    with gated() as (answers, _, way):
        asked = Asked(way)
        assert answers.begun.acquire(timeout=PATIENCE_S)
        way.close()
        assert "closed" in str(asked.outcome())
        with pytest.raises(TransportError, match="closed"):
            way.ask(BEGIN, PATIENCE_S)


def test_a_service_that_closes_ends_what_waits() -> None:
    with gated() as (answers, server, way):
        asked = [Asked(way) for _ in range(3)]
        assert answers.begun.acquire(timeout=PATIENCE_S)
        closing = threading.Thread(target=server.close, args=(PATIENCE_S,))
        closing.start()
        answers.may.set()
        for each in asked:
            outcome = each.outcome()
            assert isinstance(outcome, TransportError) or outcome.error in (
                ErrorCode.OK,
                ErrorCode.BUSY,
            )
        closing.join(PATIENCE_S)
        assert not closing.is_alive()


def raw_session(port: int) -> zenoh.Session:
    settings = zenoh.Config()
    for key, value in {
        "mode": "client",
        "connect/endpoints": [f"tcp/127.0.0.1:{port}"],
        "scouting/multicast/enabled": False,
    }.items():
        settings.insert_json5(key, json.dumps(value))
    return zenoh.open(settings)


def test_what_is_no_request_is_refused_and_the_next_is_answered() -> None:
    port = free_port()
    told: list[str] = []
    server = Ros2Server(
        ActiveSensing(configuration()),
        NAME,
        DOMAIN,
        f"tcp/127.0.0.1:{port}",
        listens=True,
        on_event=lambda name, **fields: told.append(f"{name}: {fields['reason']}"),
    )
    server.start()
    attachment = Attachment(1, 1, bytes(16)).encode()
    good = messages.encode_request(BEGIN)
    with raw_session(port) as session, way_to(port) as way:
        for type_hash in (messages.type_hash(), NO_HASH):
            key = service_key(DOMAIN, NAME, type_hash)
            for payload, attached, expected in (
                (good, None, "attachment of 0 bytes"),
                (good, attachment[:-1], "attachment of 32 bytes"),
                (None, attachment, "0 bytes are no"),
                (good[:-3], attachment, "are no"),
                (b"\xff" * 100, attachment, "are no"),
            ):
                reply = next(iter(session.get(key, payload=payload, attachment=attached)))
                if reply.ok is None:
                    assert reply.err is not None
                    assert expected in reply.err.payload.to_string()
                else:
                    answer = messages.decode_answer(reply.ok.payload.to_bytes())
                    assert answer.error is ErrorCode.BAD_REQUEST
                    assert expected in answer.message
        assert way.ask(BEGIN, PATIENCE_S).error is ErrorCode.OK
    server.close(PATIENCE_S)
    assert len(told) == 10


def test_the_reply_has_the_attachment_of_its_request() -> None:
    port = free_port()
    server = Ros2Server(
        ActiveSensing(configuration()), NAME, DOMAIN, f"tcp/127.0.0.1:{port}", listens=True
    )
    server.start()
    gid = bytes(range(16))
    with raw_session(port) as session:
        reply = next(
            iter(
                session.get(
                    service_key(DOMAIN, NAME, messages.type_hash()),
                    target=zenoh.QueryTarget.ALL_COMPLETE,
                    payload=messages.encode_request(BEGIN),
                    attachment=Attachment(7, 1, gid).encode(),
                )
            )
        )
        assert reply.ok is not None and reply.ok.attachment is not None
        attached = Attachment.decode(reply.ok.attachment.to_bytes())
        assert (attached.sequence_number, attached.gid) == (7, gid)
        assert attached.source_timestamp > 1
        # What ros2 service list looks at.
        tokens = {
            str(each.ok.key_expr)
            for each in session.liveliness().get(f"@ros2_lv/{DOMAIN}/**")
            if each.ok is not None
        }
        kinds = {token.split("/")[5]: token for token in tokens}
        assert set(kinds) == {"NN", "SS"}
        assert f"%{NAME}/holdfast_interfaces::srv::dds_::ActiveSensing_/" in kinds["SS"]
    server.close(PATIENCE_S)
