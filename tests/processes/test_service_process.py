"""``holdfast serve`` as a robot and an operator meet it: real processes, sockets and signals."""

import contextlib
import json
import os
import platform
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
from tests.ports import free_port
from tests.processes.faults import PATIENT, Service, Site, page, wait_until
from tests.programs import completed
from tests.unit.test_protocol_service import Robot, content
from tests.wire import END, GOODBYE, PING, REPLY, RawClient, hello_of

from holdfast.protocol.messages import (
    PROTOCOL_VERSION,
    Progress,
    Refused,
    SensingAnswer,
    decode_reply,
    encode,
    with_checksum,
)

PATIENCE_S = 120.0
COMMAND = [sys.executable, "-m", "holdfast", "serve"]

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


@contextlib.contextmanager
def launched(
    *options: str, says_to: int = subprocess.PIPE
) -> Iterator[tuple[RawClient, subprocess.Popen[str]]]:
    """Launch a service as its robot does."""
    ours, theirs = socket.socketpair()
    with (
        theirs,
        subprocess.Popen(
            [*COMMAND, f"--robot={theirs.fileno()}", *options],
            stdin=subprocess.PIPE,
            stdout=says_to,
            stderr=says_to,
            text=True,
            pass_fds=[theirs.fileno()],
        ) as process,
    ):
        try:
            with RawClient(ours, hello=hello_of(lease_ms=PATIENT["lease_ms"])) as robot:
                yield robot, process
        finally:
            process.kill()


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


def run_turns(end: RawClient, robot: Robot, turns: int) -> None:
    for _ in range(turns):
        request = robot.request(since=max(0, len(robot.observed) - 1))
        assert content(end.ask(request)) == robot.right_answer()
        robot.act_until_sensing()
        robot.sense()


def in_work(end: RawClient, robot: Robot) -> int:
    """Have a request worked on, of which there is a sign of progress; return its call."""
    call = end.send_call(encode(robot.request()))
    while (frame := end.receive()) is not None and frame.kind == PING:
        pass
    assert frame is not None and frame.kind == REPLY
    assert isinstance(decode_reply(frame.payload), Progress)
    return call


def resident_kb(pid: int) -> int:
    """Return the most memory that a process has had."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    (line,) = (line for line in lines if line.startswith("VmHWM"))
    return int(line.split()[1])


def busy(site: Site, *options: str) -> tuple[Service, Robot]:
    """Return a service that has that problem, and a robot that will ask it."""
    folder = site.directory / "problems"
    folder.mkdir()
    robot = robot_of_busy(folder)
    problem = ("--problem", "busy_problem:Busy", "--problem-directory", str(folder))
    return site.service(*problem, *options).start(), robot


class TestServing:
    def test_a_large_message_that_is_no_request_disturbs_nobody(self, site: Site) -> None:
        hostile = with_checksum(
            b"\xdd" + (10**7).to_bytes(4, "big") + bytes([PROTOCOL_VERSION]) + b"\x90" * 10**7
        )
        service = site.service().start()
        with RawClient(service.endpoint) as attacker, RawClient(service.endpoint) as end:
            run_turns(end, Robot(), 1)
            size_kb = resident_kb(service.process.pid)
            call = attacker.send_call(hostile)
            run_turns(end, Robot(key=2), 5)
            (reply,) = attacker.replies_to(call)
            assert isinstance(reply, Refused)
            assert reply.code == "malformed"
            # As lists of lists these would be 640 MB; the message itself comes in parts.
            assert resident_kb(service.process.pid) - size_kb < 100_000
            run_turns(end, Robot(key=3), 1)

    def test_stops_in_order_while_it_computes(self, site: Site) -> None:
        service, robot = busy(site, "--drain-s", "0.1")
        with RawClient(service.endpoint) as end:
            in_work(end, robot)
            service.process.signal(signal.SIGTERM)
            assert service.process.wait() == 0, service.process.account()
            assert "Fatal" not in service.process.output
            # Nobody answers any more.
            assert {frame.kind for frame in end.until_the_end()} <= {PING, REPLY, END, GOODBYE}

    def test_terminated_it_answers_what_it_owes_and_takes_nothing_new(self, site: Site) -> None:
        service, robot = busy(site, "--drain-s", "3600")
        with RawClient(service.endpoint) as end, RawClient(service.endpoint) as other:
            call = in_work(end, robot)
            service.process.signal(signal.SIGTERM)
            service.process.wait_for("stopping")
            # Whoever is owed nothing is told, and leaves.
            told = next(frame.kind for frame in other.until_the_end() if frame.kind != PING)
            assert told == GOODBYE
            other.close()
            host, _, port = service.endpoint.removeprefix("tcp/").rpartition(":")
            with pytest.raises(ConnectionRefusedError):
                socket.create_connection((host, int(port)), PATIENCE_S)
            (site.directory / "let_go").touch()
            *_, reply = end.replies_to(call)
            assert isinstance(reply, SensingAnswer)
            end.close()
            assert service.process.wait() == 0

    def test_a_second_signal_ends_it_at_once(self, site: Site) -> None:
        service, robot = busy(site, "--drain-s", "3600")
        with RawClient(service.endpoint) as end:
            in_work(end, robot)
            service.process.signal(signal.SIGTERM)
            service.process.wait_for("stopping")
            service.process.signal(signal.SIGTERM)
            assert service.process.wait() == 0, service.process.account()

    def test_two_names_on_two_endpoints(self, site: Site) -> None:
        name, second = "cloud_active_sensing_recovery", f"tcp/127.0.0.1:{free_port()}"
        service = site.process(
            *(*COMMAND, "--listen", "tcp/127.0.0.1:0", "--listen", second, "--name", name)
        )
        wait_until(lambda: bool(service.lines), "it to be ready")
        words = service.lines[0].split()
        assert words[0] == name
        endpoints = {word for word in words if word.startswith("tcp/")}
        assert second in endpoints
        for key, endpoint in enumerate(endpoints, 1):
            with RawClient(endpoint) as end:
                run_turns(end, Robot(key=key), 2)
        assert len(endpoints) == 2


class TestLaunched:
    def test_it_decides_for_its_robot_until_that_dies(self) -> None:
        with launched("--until-stdin-closes") as (end, process):
            run_turns(end, Robot(), 2)
            assert process.stdin is not None
            process.stdin.write("this is not the end\n")
            process.stdin.flush()
            run_turns(end, Robot(key=2), 2)
            said, log = process.communicate(timeout=PATIENCE_S)  # closes its input
            assert process.returncode == 0
            assert said.endswith(" decides for the robot that has launched it\n")
            assert "standard input has ended" in log

    def test_whoever_sees_it_can_use_it(self) -> None:
        with launched() as (end, process):
            assert isinstance(end.ask(Robot().request())[-1], SensingAnswer)
            assert process.poll() is None

    def test_nobody_reads_what_it_says(self) -> None:
        """A closed terminal is no reason to stop deciding."""
        reading, writing = os.pipe()
        os.close(reading)
        with launched(says_to=writing) as (end, process):
            os.close(writing)
            run_turns(end, Robot(), 2)
            process.terminate()
            assert process.wait(PATIENCE_S) in (0, 120)  # 120: Python could not flush


class TestEnding:
    @pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGHUP, 129)])
    def test_exit_code(self, number: signal.Signals, code: int, site: Site) -> None:
        service = site.service().start()
        service.process.signal(number)
        assert service.process.wait() == code

    def test_hangup_that_is_ignored(self, site: Site) -> None:
        service = site.service()
        service.command = ("sh", "-c", "trap '' HUP; exec \"$@\"", "sh", *service.command)
        service.start().process.signal(signal.SIGHUP)
        with RawClient(service.endpoint) as end:
            run_turns(end, Robot(), 1)
        service.process.signal(signal.SIGTERM)
        assert service.process.wait() == 0


class TestRefusing:
    """What is refused before anything is opened: unit/test_serve_refusals.py."""

    def test_an_address_that_others_can_reach_is_taken_if_it_is_said(self, site: Site) -> None:
        port = free_port("0.0.0.0")
        site.service("--insecure", endpoint=f"tcp/0.0.0.0:{port}").start()
        with RawClient(f"tcp/127.0.0.1:{port}") as end:
            run_turns(end, Robot(), 1)

    def test_port_that_is_taken(self) -> None:
        with socket.socket() as taken:
            taken.bind(("127.0.0.1", 0))
            taken.listen()
            endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
            done = completed([*COMMAND, "--listen", endpoint], timeout=PATIENCE_S)
        assert (done.returncode, done.stdout) == (2, "")
        assert endpoint in done.stderr
        assert "Traceback" not in done.stderr

    def test_no_standard_input_to_wait_for(self) -> None:
        command = [*COMMAND, "--listen", "tcp/127.0.0.1:0", "--until-stdin-closes"]
        done = completed(["/bin/sh", "-c", 'exec "$@" <&-', "sh", *command], timeout=PATIENCE_S)
        # It is as one that has ended: the service ends as well, and says why.
        assert done.returncode == 0
        assert "standard input has ended" in done.stderr


def test_metrics_and_sockets_of_this_machine_alone(site: Site) -> None:
    """The sockets themselves are looked at, those of the metrics as well."""
    service = site.service("--metrics", "0", "--health", "0").start()
    with RawClient(service.endpoint) as end:
        run_turns(end, Robot(), 3)
        end.ask(with_checksum(b"rubbish"))
    (ready,) = service.process.matching("ready")
    status, text = page(ready["metrics"], "/metrics")
    lines = text.splitlines()
    assert status == 200
    assert 'holdfast_decisions_total{kind="task"} 2.0' in lines
    assert 'holdfast_decisions_total{kind="sensing"} 3.0' in lines
    assert 'holdfast_refusals_total{code="malformed"} 1.0' in lines
    assert "holdfast_sessions 1.0" in lines
    places = (ready["metrics"], ready["health"], service.endpoint)
    ports = {int(place.rpartition(":")[2]) for place in places}
    assert listening_sockets(service.process.pid) == {("127.0.0.1", port) for port in ports}


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="where there are such arenas")
def test_the_threads_share_arenas(site: Site) -> None:
    """Each keeps as much as its threads ever held at the same time (service/allocator.py)."""
    service, robot = busy(site, "--workers", "8")
    with contextlib.ExitStack() as stack:
        ends = [stack.enter_context(RawClient(service.endpoint)) for _ in range(8)]
        calls = []
        for key, end in enumerate(ends, 1):
            robot.session = key.to_bytes(16, "big")
            calls.append(in_work(end, robot))
        (site.directory / "let_go").touch()
        for end, call in zip(ends, calls, strict=True):
            end.replies_to(call)
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


def test_robots_can_connect_while_it_loads(site: Site) -> None:
    service = site.service("--problem", "far:Far")
    port = service.endpoint.rpartition(":")[2]
    (site.directory / "far.py").write_text(
        "import socket\nfrom holdfast.problems.capsule_robot import CapsuleRobot as Far\n"
        f"robot = socket.create_connection(('127.0.0.1', {port}))\n"
    )
    service.start()
