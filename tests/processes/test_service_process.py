"""``holdfast serve`` as a robot and an operator meet it: real processes, sockets and signals."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import platform
import signal
import socket
import struct
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import msgspec
import pytest
from tests.ports import free_port
from tests.processes.faults import PATIENT
from tests.programs import completed
from tests.unit.test_protocol_service import Robot, content

from holdfast.protocol.messages import (
    PROTOCOL_VERSION,
    Progress,
    Refused,
    Reply,
    SensingAnswer,
    decode_reply,
    encode,
    with_checksum,
)
from holdfast.protocol.robot_events import (
    CallEnded,
    ReplyReceived,
    ServiceAppeared,
    ServiceVanished,
    TransportEvent,
)
from holdfast.transport.endpoints import TlsFiles
from holdfast.transport.robot_end import StreamRobotTransport

PATIENCE_S = 30.0
COMMAND = [sys.executable, "-m", "holdfast", "serve"]
ANYWHERE = ["--listen", "tcp/127.0.0.1:0"]

# Computes in Python until a file appears, and never sleeps: nothing but the interpreter's own
# switching lets other threads run meanwhile.
BUSY = """
from pathlib import Path

from holdfast.problems.capsule_robot import CapsuleRobot


class Busy(CapsuleRobot):
    name = "busy"

    def policy(self, states, stage):
        Path("begun").touch()
        while not Path("let_go").exists():
            pass
        return super().policy(states, stage)
"""


def robot_of_busy(directory: Path) -> Robot:
    """Write that problem's module, and return a robot that has it."""
    (directory / "busy_problem.py").write_text(BUSY)
    program = (
        "from holdfast.config.registry import problem_class\n"
        "from holdfast.config.source_digest import problem_digest\n"
        "print(problem_digest(problem_class('busy_problem:Busy')))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=directory, capture_output=True, text=True, check=True
    )
    robot = Robot()
    robot.session_configuration = msgspec.structs.replace(
        robot.session_configuration, problem="busy_problem:Busy", problem_digest=done.stdout.strip()
    )
    return robot


class Served:
    """A running service, ready."""

    def __init__(
        self, *arguments: str, directory: Path | None = None, ready: bool = True, **popen: Any
    ) -> None:
        self.process = subprocess.Popen(
            [*COMMAND, "--lease-ms", str(PATIENT["lease_ms"]), *arguments],
            cwd=directory,
            stdin=popen.pop("stdin", subprocess.DEVNULL),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            **popen,
        )
        self.ready_line = ""
        if ready:
            assert self.process.stdout is not None
            self.ready_line = self.process.stdout.readline()
            assert self.ready_line, self.process.communicate(timeout=PATIENCE_S)[1]

    @property
    def endpoint(self) -> str:
        return self.ready_line.split()[-1]

    def end(self, number: int = signal.SIGTERM) -> tuple[int, str]:
        """Send a signal; return the exit code and the log."""
        self.process.send_signal(number)
        _, log = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, log


@contextlib.contextmanager
def served(*arguments: str, **options: Any) -> Iterator[Served]:
    service = Served(*arguments, **options)
    try:
        yield service
    finally:
        service.process.kill()
        service.process.wait(PATIENCE_S)
        for stream in (service.process.stdin, service.process.stdout, service.process.stderr):
            if stream is not None:
                stream.close()


def listening_sockets(pid: int) -> set[tuple[str, int]]:
    """Return the addresses and ports at which a process listens, as the system knows them."""
    own = set()
    for descriptor in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(OSError):
            own.add(str(descriptor.readlink()))
    found = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            _, local, _, state, *_, inode = line.split()[:10]
            if state == "0A" and f"socket:[{inode}]" in own:
                address, _, port = local.partition(":")
                # Each word of an address is in the machine's own order.
                words = struct.unpack(f">{len(address) // 8}I", bytes.fromhex(address))
                packed = struct.pack(f"={len(words)}I", *words)
                family = socket.AF_INET if table == "tcp" else socket.AF_INET6
                found.add((socket.inet_ntop(family, packed), int(port, 16)))
    return found


class End:
    """A robot's end of the wire, on an event loop that has a thread of its own."""

    def __init__(
        self,
        endpoint: str | None,
        *,
        connection: socket.socket | None = None,
        tls: TlsFiles | None = None,
    ) -> None:
        self.events: SimpleQueue[TransportEvent] = SimpleQueue()
        self.loop = asyncio.new_event_loop()
        self.transport = StreamRobotTransport(
            {"service": endpoint}, lease_ms=PATIENT["lease_ms"], tls=tls
        )
        self.thread = threading.Thread(target=self.loop.run_forever, daemon=True)
        self.thread.start()
        self.on_loop(self.transport.start, self.events.put)
        if connection is not None:
            self.on_loop(self.transport.attach, "service", connection)
        self.calls = 0

    def on_loop(self, function: Callable[..., None], *arguments: object) -> None:
        """Call a function on the loop's thread, and wait until it has returned."""

        async def run() -> None:
            function(*arguments)

        asyncio.run_coroutine_threadsafe(run(), self.loop).result(PATIENCE_S)

    def close(self) -> None:
        try:
            asyncio.run_coroutine_threadsafe(self.transport.close(), self.loop).result(PATIENCE_S)
        finally:
            self.loop.call_soon_threadsafe(self.loop.stop)
            self.thread.join(PATIENCE_S)
            self.loop.close()

    def appeared(self) -> str:
        event = self.events.get(timeout=PATIENCE_S)
        assert isinstance(event, ServiceAppeared), event
        return event.incarnation

    def send(self, payload: bytes) -> int:
        self.calls += 1
        self.on_loop(self.transport.call, "service", self.calls, payload)
        return self.calls

    def ask(self, payload: bytes) -> list[Reply]:
        self.send(payload)
        return self.collect()

    def collect(self) -> list[Reply]:
        """Return the replies to the one open call, without signs of progress."""
        replies: list[Reply] = []
        while not isinstance(event := self.events.get(timeout=PATIENCE_S), CallEnded):
            assert isinstance(event, ReplyReceived), event
            reply = decode_reply(event.payload)
            if not isinstance(reply, Progress):
                replies.append(reply)
        return replies


def in_work(end: End, robot: Robot) -> TransportEvent:
    """Have a request worked on; return the sign of progress that tells so."""
    end.appeared()
    end.send(encode(robot.request()))
    event = end.events.get(timeout=PATIENCE_S)
    assert isinstance(event, ReplyReceived)
    assert isinstance(decode_reply(event.payload), Progress)
    return event


@contextlib.contextmanager
def robots_end(endpoint: str | None = None, **options: Any) -> Iterator[End]:
    end = End(endpoint, **options)
    try:
        yield end
    finally:
        end.close()


def connection() -> tuple[socket.socket, socket.socket]:
    """Return the robot's end and that of the service which it launches."""
    ours, theirs = socket.socketpair()
    ours.setblocking(False)
    return ours, theirs


def run_turns(end: End, robot: Robot, turns: int) -> None:
    for _ in range(turns):
        request = robot.request(since=max(0, len(robot.observed) - 1))
        assert content(end.ask(encode(request))) == robot.right_answer()
        robot.act_until_sensing()
        robot.sense()


def refused_to_start(*arguments: str) -> str:
    done = subprocess.run(
        [*COMMAND, *arguments], capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert done.returncode == 2, done
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
    return done.stderr


def resident_kb(pid: int) -> int:
    """Return the most memory that a process has had."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    (line,) = (line for line in lines if line.startswith("VmHWM"))
    return int(line.split()[1])


class TestServing:
    def test_a_large_message_that_is_no_request_disturbs_nobody(self) -> None:
        hostile = with_checksum(
            b"\xdd" + (10**7).to_bytes(4, "big") + bytes([PROTOCOL_VERSION]) + b"\x90" * 10**7
        )
        with (
            served(*ANYWHERE) as service,
            robots_end(service.endpoint) as attacker,
            robots_end(service.endpoint) as end,
        ):
            attacker.appeared()
            end.appeared()
            run_turns(end, Robot(), 1)
            size_kb = resident_kb(service.process.pid)
            attacker.send(hostile)
            run_turns(end, Robot(key=2), 5)
            (reply,) = attacker.collect()
            assert isinstance(reply, Refused)
            assert reply.code == "malformed"
            # As lists of lists these would be 640 MB; the message itself comes in parts.
            assert resident_kb(service.process.pid) - size_kb < 100_000
            run_turns(end, Robot(key=3), 1)

    def test_stops_in_order_while_it_computes(self, tmp_path: Path) -> None:
        robot = robot_of_busy(tmp_path)
        arguments = ["--problem", "busy_problem:Busy", "--problem-directory", str(tmp_path)]
        directory = tmp_path / "elsewhere"
        directory.mkdir()
        with (
            served(*ANYWHERE, *arguments, "--drain-s", "0.1", directory=directory) as service,
            robots_end(service.endpoint) as end,
        ):
            event = in_work(end, robot)
            code, log = service.end()
            assert code == 0, log
            assert "Fatal" not in log
            while isinstance(event, ReplyReceived):
                event = end.events.get(timeout=PATIENCE_S)
            assert isinstance(event, CallEnded | ServiceVanished)

    def test_terminated_it_answers_what_it_owes_and_takes_nothing_new(self, tmp_path: Path) -> None:
        arguments = ["--problem", "busy_problem:Busy", "--drain-s", "3600"]
        robot = robot_of_busy(tmp_path)
        with (
            served(*ANYWHERE, *arguments, directory=tmp_path) as service,
            robots_end(service.endpoint) as end,
            robots_end(service.endpoint) as other,
        ):
            in_work(end, robot)
            incarnation = other.appeared()
            service.process.terminate()
            assert service.process.stderr is not None
            while "stopping" not in service.process.stderr.readline():
                pass
            # Whoever is owed nothing leaves at once, for nobody else is there.
            gone = ServiceVanished("service", incarnation, "said goodbye")
            assert other.events.get(timeout=PATIENCE_S) == gone
            assert other.ask(encode(Robot(key=2).request())) == []
            host, _, port = service.endpoint.removeprefix("tcp/").rpartition(":")
            with pytest.raises(ConnectionRefusedError):
                socket.create_connection((host, int(port)), PATIENCE_S)
            (tmp_path / "let_go").touch()
            (reply,) = end.collect()
            assert isinstance(reply, SensingAnswer)
            assert service.process.wait(PATIENCE_S) == 0

    def test_a_second_signal_ends_it_at_once(self, tmp_path: Path) -> None:
        arguments = ["--problem", "busy_problem:Busy", "--drain-s", "3600"]
        robot = robot_of_busy(tmp_path)
        with (
            served(*ANYWHERE, *arguments, directory=tmp_path) as service,
            robots_end(service.endpoint) as end,
        ):
            in_work(end, robot)
            service.process.terminate()
            assert service.process.stderr is not None
            while "stopping" not in service.process.stderr.readline():
                pass
            code, log = service.end()
            assert code == 0, log

    def test_two_names_on_two_endpoints(self) -> None:
        with served(
            *ANYWHERE, "--listen", "tcp/127.0.0.1:0", "--name", "cloud_active_sensing_recovery"
        ) as service:
            words = service.ready_line.split()
            assert words[0] == "cloud_active_sensing_recovery"
            endpoints = [word for word in words if word.startswith("tcp/")]
            assert len(set(endpoints)) == 2
            for key, endpoint in enumerate(endpoints, 1):
                with robots_end(endpoint) as end:
                    end.appeared()
                    run_turns(end, Robot(key=key), 2)


class TestLaunched:
    def test_it_decides_for_its_robot_until_that_dies(self) -> None:
        ours, theirs = connection()
        with theirs, robots_end(connection=ours) as end:
            inherited = theirs.fileno()
            arguments = [f"--robot={inherited}", "--until-stdin-closes"]
            with served(*arguments, stdin=subprocess.PIPE, pass_fds=[inherited]) as service:
                assert service.ready_line.endswith(" decides for the robot that has launched it\n")
                end.appeared()
                run_turns(end, Robot(), 2)
                assert service.process.stdin is not None
                service.process.stdin.write("this is not the end\n")
                service.process.stdin.flush()
                run_turns(end, Robot(key=2), 2)
                _, log = service.process.communicate(timeout=PATIENCE_S)  # closes its input
                assert service.process.returncode == 0
                assert "standard input has ended" in log


class TestEnding:
    @pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGHUP, 129)])
    def test_exit_code(self, number: int, code: int) -> None:
        with served(*ANYWHERE) as service:
            assert service.end(number)[0] == code

    def test_hangup_that_is_ignored(self) -> None:
        def ignore() -> None:
            signal.signal(signal.SIGHUP, signal.SIG_IGN)

        with served(*ANYWHERE, preexec_fn=ignore) as service:
            service.process.send_signal(signal.SIGHUP)
            with robots_end(service.endpoint) as end:
                end.appeared()
                run_turns(end, Robot(), 1)
            assert service.end()[0] == 0

    def test_nobody_reads_what_it_says(self) -> None:
        """A closed terminal is no reason to stop deciding."""
        ours, theirs = connection()
        with theirs, robots_end(connection=ours) as end:
            reading, writing = os.pipe()
            os.close(reading)
            process = subprocess.Popen(
                [*COMMAND, f"--robot={theirs.fileno()}"],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=writing,
                stderr=writing,
            )
            os.close(writing)
            try:
                end.appeared()
                run_turns(end, Robot(), 2)
                process.terminate()
                assert process.wait(PATIENCE_S) in (0, 120)  # 120: Python could not flush
            finally:
                process.kill()
                process.wait()


class TestRefusing:
    """What is refused before anything is opened: unit/test_serve_refusals.py."""

    def test_an_address_that_others_can_reach_is_taken_if_it_is_said(self) -> None:
        with served("--listen", "tcp/0.0.0.0:0", "--insecure") as service:
            port = service.endpoint.rpartition(":")[2]
            with robots_end(f"tcp/127.0.0.1:{port}") as end:
                end.appeared()
                run_turns(end, Robot(), 1)

    def test_port_that_is_taken(self) -> None:
        with socket.socket() as taken:
            taken.bind(("127.0.0.1", 0))
            taken.listen()
            endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
            assert endpoint in refused_to_start("--listen", endpoint)

    def test_no_standard_input_to_wait_for(self) -> None:
        command = [*COMMAND, *ANYWHERE, "--until-stdin-closes"]
        done = completed(["/bin/sh", "-c", 'exec "$@" <&-', "sh", *command], timeout=PATIENCE_S)
        # It is as one that has ended: the service ends as well, and says why.
        assert done.returncode == 0
        assert "standard input has ended" in done.stderr


class TestTelling:
    def test_metrics(self) -> None:
        pytest.importorskip("prometheus_client")
        with served(*ANYWHERE, "--log", "json", "--metrics", "0") as service:
            ready = json.loads(service.ready_line)
            with robots_end(ready["listen"][0]) as end:
                end.appeared()
                run_turns(end, Robot(), 3)
                end.ask(with_checksum(b"rubbish"))
            url = f"http://{ready['metrics']}/metrics"
            with urllib.request.urlopen(url, timeout=PATIENCE_S) as response:
                lines = response.read().decode().splitlines()
            assert service.end()[0] == 0
        assert 'holdfast_decisions_total{kind="task"} 2.0' in lines
        assert 'holdfast_decisions_total{kind="sensing"} 3.0' in lines
        assert 'holdfast_refusals_total{code="malformed"} 1.0' in lines
        assert "holdfast_sessions 1.0" in lines

    @pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="the system's own table")
    def test_what_is_not_said_to_be_reachable_listens_for_this_machine_alone(self) -> None:
        """The sockets themselves are looked at, those of the metrics as well."""
        pytest.importorskip("prometheus_client")
        watched = ["--metrics", "0", "--health", "0"]
        with served(*ANYWHERE, "--log", "json", *watched) as service:
            ready = json.loads(service.ready_line)
            ports = {int(ready[key].rpartition(":")[2]) for key in ("metrics", "health")}
            ports.add(int(ready["listen"][0].rpartition(":")[2]))
            assert listening_sockets(service.process.pid) == {("127.0.0.1", p) for p in ports}


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="where there are such arenas")
def test_the_threads_share_arenas(tmp_path: Path) -> None:
    """Each keeps as much as its threads ever held at the same time (service/allocator.py)."""
    robot = robot_of_busy(tmp_path)
    arguments = ["--problem", "busy_problem:Busy", "--workers", "8"]
    with (
        served(*ANYWHERE, *arguments, directory=tmp_path) as service,
        contextlib.ExitStack() as stack,
    ):
        ends = [stack.enter_context(robots_end(service.endpoint)) for _ in range(8)]
        for key, end in enumerate(ends, 1):
            robot.session = key.to_bytes(16, "big")
            in_work(end, robot)
        (tmp_path / "let_go").touch()
        for end in ends:
            end.collect()
        process = Path(f"/proc/{service.process.pid}")
        threads = len(list((process / "task").iterdir()))
        heaps = _heaps((process / "maps").read_text())
    assert threads > 8
    # The first arena is the process's own heap.
    assert heaps <= 1


def _heaps(maps: str) -> int:
    """Count what is reserved for arenas: 64 MB at a multiple of it, of which a part is in use."""
    size = 64 << 20
    lines = [line.split() for line in maps.splitlines()]
    spans = [[int(end, 16) for end in line[0].split("-")] for line in lines]
    return sum(
        start % size == 0 and permissions == "rw-p" and (rest == "---p" and last == start + size)
        for (start, _), (_, last), permissions, rest in zip(
            spans,
            spans[1:],
            (line[1] for line in lines),
            (line[1] for line in lines[1:]),
            strict=False,
        )
    )


def test_a_service_is_ready_without_what_it_does_not_need() -> None:
    """Start-up time is recovery time: nothing heavy but NumPy is loaded."""
    program = """
import json, sys, threading
from holdfast.service import process as service_process
ready = service_process._say_ready
def tell(*arguments):
    ready(*arguments)
    print(json.dumps(sorted(sys.modules)), flush=True)
service_process._say_ready = tell
sys.exit(service_process.main(["--listen", "tcp/127.0.0.1:0", "--until-stdin-closes"]))
"""
    done = completed([sys.executable, "-c", program], stdin=subprocess.DEVNULL, timeout=PATIENCE_S)
    assert done.returncode == 0, done.stderr
    modules = set(json.loads(done.stdout.splitlines()[1]))
    assert "numpy" in modules
    for heavy in (
        "cryptography", "holdfast.config.loader", "holdfast.config.user_code",
        "holdfast.protocol.robot_events", "holdfast.runtime.monitoring", "importlib.metadata",
        "matplotlib", "multiprocessing", "numpy.ma", "prometheus_client", "rich", "scipy",
        "sqlite3", "ssl", "yaml",
    ):  # fmt: skip
        assert heavy not in modules


def test_robots_can_connect_while_it_loads(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{(port := free_port())}"
    (tmp_path / "far.py").write_text(
        "import socket\nfrom holdfast.problems.capsule_robot import CapsuleRobot as Far\n"
        f"robot = socket.create_connection(('127.0.0.1', {port}))\n"
    )
    with served("--listen", endpoint, "--problem", "far:Far", directory=tmp_path):
        pass


def test_whoever_sees_the_service_can_use_it() -> None:
    ours, theirs = connection()
    number = theirs.fileno()
    with (
        theirs,
        robots_end(connection=ours) as end,
        served(f"--robot={number}", ready=False, pass_fds=[number]) as service,
    ):
        end.appeared()
        (reply,) = end.ask(encode(Robot().request()))
        assert isinstance(reply, SensingAnswer)
        assert service.process.poll() is None
