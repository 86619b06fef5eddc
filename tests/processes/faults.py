"""Real processes, real signals, and a world that says when: what the tests of faults share.

The robot's world lives in the test's own process. Every time the robot senses or moves, the test
holds it at that exact point and does there whatever it likes: kills the cloud, stops it, kills the
robot before or after its motion. So a fault strikes at a step, not after a time. And the world is a
witness of its own: it counts and keeps what it was made to do.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt
import yaml
from tests.ports import free_port

from holdfast.configuration import Configuration, load
from holdfast.outcome import TaskDecision
from holdfast.recording.compare import compare_runs
from holdfast.recording.journal import Journal
from holdfast.runtime.environment import SimulatedEnvironment
from holdfast.session.records import ActingRecord

PATIENCE_S = 60.0
"""For whatever must happen; on a machine that is not busy it takes a fraction of a second."""

HERE = Path(__file__).parent
EXAMPLES = HERE.parents[1] / "examples"
PROBLEMS = ("peg_in_hole_2d", "multitier_peg_in_hole_2d", "peg_in_hole_3d", "capsule_robot")

STANDARD, LOCAL_RECOVERY, KEEP_ALIVE = "standard", "local_recovery", "keep_alive"
RECOVERY = "cloud_active_sensing_recovery"

PATIENT = {
    "detection_timeout_ms": 30_000.0,
    "lease_ms": 30_000.0,
    "startup_timeout_ms": 30_000.0,
}
"""What is dead is still found by its broken link, and what is only slow is never taken for dead."""

QUICK = {"detection_timeout_ms": 1500.0, "lease_ms": 4000.0}
"""For what is found by its silence; longer than a busy machine stands still."""

LOST = (STANDARD, LOCAL_RECOVERY)
RESTORED = (LOCAL_RECOVERY, KEEP_ALIVE)
LOST_AGAIN = (KEEP_ALIVE, LOCAL_RECOVERY)

# A figure takes longer than all else in these runs; without matplotlib there is none.
COMMAND = (
    sys.executable,
    "-c",
    "import sys; sys.modules['matplotlib'] = None; from holdfast.cli import main; main()",
)

_MARK = "HOLDFAST_TEST_SITE"

FloatArray = npt.NDArray[np.float64]
Hook = Callable[[], object]


def in_order(*hooks: Hook) -> Hook:
    """Return what calls all of them."""

    def call() -> None:
        for hook in hooks:
            hook()

    return call


def wait_until(condition: Callable[[], bool], what: str) -> None:
    """Wait for what another process does and does not tell."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain for {what}"
        time.sleep(0.002)


def wait_for_end(pid: int) -> None:
    """Wait until a process has ended, whoever its parent is."""
    try:
        descriptor = os.pidfd_open(pid)
    except ProcessLookupError:
        return
    try:
        ready, _, _ = select.select([descriptor], [], [], PATIENCE_S)
        assert ready, f"process {pid} has not ended"
    finally:
        os.close(descriptor)


class Process:
    """A process that reports events as JSON lines."""

    def __init__(
        self,
        command: Sequence[str],
        environment: Mapping[str, str],
        directory: Path,
        **options: Any,
    ) -> None:
        self._said: list[str] = []
        self.events: list[dict[str, Any]] = []
        self._heard = threading.Condition()
        self.process = subprocess.Popen(
            command,
            env=environment,
            cwd=directory,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            # Signals go to one process at a time, by its number.
            start_new_session=True,
            **options,
        )
        streams = (self.process.stdout, self.process.stderr)
        self._open_streams = len(streams)
        self._readers = [threading.Thread(target=self._read, args=(each,)) for each in streams]
        for reader in self._readers:
            reader.start()

    @property
    def pid(self) -> int:
        return self.process.pid

    @property
    def output(self) -> str:
        """What it has said that is no event, and the error that it has ended with."""
        return "".join(self._said)

    def _read(self, stream: IO[str]) -> None:
        with stream:
            for line in stream:
                event = None
                with contextlib.suppress(json.JSONDecodeError):
                    event = json.loads(line)
                with self._heard:
                    if isinstance(event, dict) and "event" in event:
                        self.events.append(event)
                        if event["event"] == "error":
                            self._said.append(_error_as_text(event))
                    else:
                        self._said.append(line)
                    self._heard.notify_all()
        with self._heard:
            self._open_streams -= 1
            self._heard.notify_all()

    def matching(self, name: str, **fields: object) -> list[dict[str, Any]]:
        """Return the events of this name that have these fields."""
        return [
            event
            for event in self.events.copy()
            if event["event"] == name and fields.items() <= event.items()
        ]

    def wait_for(self, name: str, count: int = 1, **fields: object) -> dict[str, Any]:
        """Wait until so many such events have come; return the last of them."""
        deadline = time.monotonic() + PATIENCE_S
        with self._heard:
            while len(found := self.matching(name, **fields)) < count:
                left = deadline - time.monotonic()
                if left <= 0.0 or self._open_streams == 0:
                    raise AssertionError(
                        f"no {name} {fields} (number {count}) from process {self.pid}: "
                        f"{self.account()}"
                    )
                self._heard.wait(left)
        return found[count - 1]

    def account(self) -> str:
        """Return all that it has said."""
        events = "\n".join(map(json.dumps, self.events))
        return f"exit code {self.process.poll()}\n{self.output}\n{events}"

    def signal(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def kill(self) -> None:
        """End it with SIGKILL; when this returns it is gone."""
        self.process.kill()
        self.wait()

    def stop(self) -> None:
        """Stop it with SIGSTOP; when this returns it stands still."""
        self.process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, self.pid, os.WSTOPPED)

    def resume(self) -> None:
        """Let it go on with SIGCONT."""
        self.process.send_signal(signal.SIGCONT)

    def wait(self) -> int:
        """Return the exit code; by then all that it has said is here."""
        code = self.process.wait(PATIENCE_S)
        for reader in self._readers:
            reader.join(PATIENCE_S)
        return code


def _error_as_text(event: Mapping[str, Any]) -> str:
    """Return what the command says without ``--log json``."""
    lines = [f"holdfast: error: {event['reason']}"]
    if "details" in event:
        lines.append(event["details"])
    if "resume_command" in event:
        lines.append(f"Go on with: {event['resume_command']}")
    return "".join(f"{line}\n" for line in lines)


class Service:
    """``holdfast serve`` at one endpoint; it may be killed and started again there."""

    def __init__(self, site: Site, endpoint: str, options: Sequence[str]) -> None:
        self._site = site
        self.endpoint = endpoint
        self.options = tuple(options)
        self.command: tuple[str, ...] = (sys.executable, "-m", "holdfast")
        self.variables: dict[str, str] = {}
        self.current: Process | None = None

    @property
    def process(self) -> Process:
        assert self.current is not None, "the service was never started"
        return self.current

    def start(self) -> Service:
        """Start it; when this returns, robots can connect."""
        self.current = self._site.process(
            *self.command,
            *("serve", "--listen", self.endpoint, "--log", "json"),
            *self.options,
            variables=self.variables,
        )
        self.current.wait_for("ready")
        return self

    def kill(self) -> None:
        self.process.kill()

    def stop(self) -> None:
        self.process.stop()

    def resume(self) -> None:
        self.process.resume()


class Robot(Process):
    """``holdfast run`` in a directory."""

    out: Path

    def finish(self) -> None:
        """Wait for its end, which must be a good one."""
        code = self.wait()
        assert code == 0, self.account()

    def statuses(self) -> list[tuple[str, str]]:
        """Return the changes of status that its directory tells of, of all its processes."""
        return [
            (event["from"], event["to"])
            for event in events_of(self.out)
            if event["event"] == "status"
        ]

    def recovery_pid(self) -> int:
        """Return the process of its local service."""
        found = [
            pid
            for pid, parent, arguments in _processes_of(self.pid)
            if parent == self.pid and b"--until-stdin-closes" in arguments
        ]
        assert len(found) == 1, f"{len(found)} local services: {self.account()}"
        return found[0]


def events_of(run: Path) -> list[dict[str, Any]]:
    """Return the events that the directory of a run tells of."""
    path = run / "events.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()]


def _processes_of(parent: int) -> Iterator[tuple[int, int, bytes]]:
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            # The name, in parentheses, may hold anything.
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
            if int(fields[1]) == parent and fields[0] != "Z":
                yield int(folder.name), parent, (folder / "cmdline").read_bytes()


class World:
    """What the robots of one run act on, and the witness of what they did.

    Parameters
    ----------
    configuration : Configuration
        Problem and seed make the world the same as the simulated one.

    Attributes
    ----------
    performed : dict of int to list of bytes
        Of each trial, the task actions that were carried out, in order, bit for bit.
    wrongs : list of str
        What should never have been asked.
    """

    def __init__(self, configuration: Configuration) -> None:
        self._problem = configuration.problem
        self._seed = configuration.simulator.seed
        self._trial = -1
        self._environment: SimulatedEnvironment | None = None
        self._hooks: dict[tuple[int, str, int, bool], Hook] = {}
        self._lock = threading.Lock()
        self._operator: socket.socket | None = None
        self._threads: list[threading.Thread] = []
        self._connections: list[socket.socket] = []
        self._failures: list[BaseException] = []
        self.performed: dict[int, list[bytes]] = {}
        self.wrongs: list[str] = []
        self._listener = socket.create_server(("127.0.0.1", free_port()))
        self.port: int = self._listener.getsockname()[1]
        self._start(self._accept)

    def on(
        self, what: str, step: int, hook: Hook, *, trial: int = 0, afterwards: bool = False
    ) -> None:
        """Do something, once, when a robot begins (``begin``), senses or performs at a step.

        Before it is carried out, or afterwards; in any case before the robot has an answer. If the
        robot has died by then, what it asked for is not carried out any more.
        """
        self._hooks[trial, what, step, afterwards] = hook

    @property
    def step(self) -> int:
        """How many task actions were carried out in this trial."""
        return 0 if self._environment is None else self._environment.step

    def become(self, other: World) -> None:
        """Take on the state of another world, as it is now."""
        self._trial = other._trial
        self.performed = {trial: actions.copy() for trial, actions in other.performed.items()}
        actions = [np.frombuffer(action) for action in self.performed[self._trial]]
        self._environment = SimulatedEnvironment.after(
            self._problem, self._seed, self._trial, actions
        )

    def close(self) -> None:
        """Hang up, and raise what a hook has raised."""
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for connection in self._connections:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join(PATIENCE_S)
        self.check()

    def check(self) -> None:
        """Raise what a hook has raised."""
        failures = self._failures.copy()
        self._failures.clear()
        if failures:
            raise failures[0]

    def assert_each_once(self, reference: Path) -> None:
        """Compare with a run without faults: every action was performed once, in its order."""
        assert not self.wrongs
        with Journal.read(reference / "journal.sqlite") as journal:
            for trial in sorted(journal.finished()):
                expected = [
                    np.array(decision.action).tobytes()
                    for decision in journal.decisions(trial)
                    if isinstance(decision, TaskDecision)
                ]
                assert self.performed[trial] == expected
        assert not self._hooks, "the run has passed by without these"

    def _start(self, target: Callable[..., None], *arguments: object) -> None:
        thread = threading.Thread(target=target, args=arguments)
        self._threads.append(thread)
        thread.start()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._connections.append(connection)
            # Who connected last operates it, as with a real controller.
            self._operator = connection
            self._start(self._serve, connection)

    def _serve(self, connection: socket.socket) -> None:
        try:
            with connection, connection.makefile("r") as lines:
                for line in lines:
                    with self._lock:
                        if connection is not self._operator:
                            return
                        answer = self._do(connection, json.loads(line))
                    if answer is None:
                        return
                    connection.sendall(json.dumps(answer).encode() + b"\n")
        except OSError:
            pass
        except BaseException as error:  # noqa: BLE001 - for the test's own thread to raise
            self._failures.append(error)

    def _do(self, connection: socket.socket, command: dict[str, Any]) -> dict[str, Any] | None:
        what = command["do"]
        if what == "begin":
            self._begin(command["trial"], resumed=command["resumed"])
            self._call_hook("begin", afterwards=False)
            return {}
        environment = self._environment
        assert environment is not None
        if what == "is_done":
            return {"done": environment.is_done()}
        if what == "count":
            return {"count": environment.step}
        step = environment.step
        self._call_hook(what, afterwards=False, step=step)
        if _has_hung_up(connection):
            return None
        answer: dict[str, Any]
        if what == "sense":
            shown = environment.perform_sensing(command["sensing_action"])
            answer = {"observation": shown.tolist()}
        else:
            action = np.array(command["task_action"])
            answer = {"reward": environment.perform(action)}
            self.performed[self._trial].append(action.tobytes())
        self._call_hook(what, afterwards=True, step=step)
        return answer

    def _begin(self, trial: int, *, resumed: bool) -> None:
        if resumed and trial != self._trial:
            self.wrongs.append(f"trial {trial} is resumed in the midst of trial {self._trial}")
        if not resumed:
            if self.performed.get(trial):
                self.wrongs.append(f"trial {trial} is begun again")
            self._trial = trial
            self._environment = SimulatedEnvironment(self._problem, self._seed, trial)
            self.performed[trial] = []

    def _call_hook(self, what: str, *, afterwards: bool, step: int | None = None) -> None:
        assert self._environment is not None
        at = self._environment.step if step is None else step
        hook = self._hooks.pop((self._trial, what, at, afterwards), None)
        if hook is not None:
            hook()


def _has_hung_up(connection: socket.socket) -> bool:
    try:
        return connection.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True


class Gate:
    """Stands before each longer computation of ``gated_problem`` in the processes that have it.

    Parameters
    ----------
    holds_at : int
        The computation, counted from 0, that is held, and all after it, until :meth:`open`.
    """

    def __init__(self, holds_at: int) -> None:
        self._holds_at = holds_at
        self._opened = threading.Event()
        self._reached = threading.Event()
        self._arrivals = 0
        self._listener = socket.create_server(("127.0.0.1", free_port()))
        self.port: int = self._listener.getsockname()[1]
        self._held: list[socket.socket] = []
        self._thread = threading.Thread(target=self._accept)
        self._thread.start()

    def wait(self) -> None:
        """Wait until a computation is held."""
        assert self._reached.wait(PATIENCE_S), f"only {self._arrivals} computations were begun"

    def open(self) -> None:
        """Hold nothing any more."""
        self._opened.set()
        for held in self._held:
            held.close()

    def close(self) -> None:
        self.open()
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join(PATIENCE_S)

    def _accept(self) -> None:
        while True:
            try:
                passing, _ = self._listener.accept()
            except OSError:
                return
            passing.recv(100)  # what is closed with unread data is reset
            if self._arrivals >= self._holds_at and not self._opened.is_set():
                self._held.append(passing)
                self._reached.set()
            else:
                passing.close()
            self._arrivals += 1


class Site:
    """A directory, and every process that a test starts: at the end none is left.

    Parameters
    ----------
    directory : Path
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._mark = secrets.token_hex(16)
        self._processes: list[Process] = []
        self._open: list[World | Gate] = []
        self.robot: Robot | None = None

    def __enter__(self) -> Site:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            for process in self._processes:
                if process.process.poll() is None:
                    process.process.kill()
            for process in self._processes:
                process.wait()
            # What a robot that was killed has started ends by itself.
            self.wait_for_nobody()
        finally:
            for pid in self.left_behind():
                os.kill(pid, signal.SIGKILL)
            failures = []
            for each in self._open:
                try:
                    each.close()
                except BaseException as error:  # noqa: BLE001 - all of them are closed first
                    failures.append(error)
        if failures:
            raise failures[0]

    # -- processes -------------------------------------------------------------------------------

    def environment(self, variables: Mapping[str, str] | None = None) -> dict[str, str]:
        """Return the environment variables of the test's processes."""
        return {**os.environ, _MARK: self._mark, **(variables or {})}

    def process(self, *command: str, variables: Mapping[str, str] | None = None) -> Process:
        started = Process(command, self.environment(variables), self.directory)
        self._processes.append(started)
        return started

    def holdfast(self, *arguments: str | Path) -> Process:
        """Run a command to its end."""
        process = self.process(*COMMAND, *map(str, arguments))
        process.wait()
        return process

    def left_behind(self) -> list[int]:
        """Return all processes that were started here, by whomever, and have not ended."""
        found = []
        needle = f"{_MARK}={self._mark}".encode()
        for folder in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                if needle in (folder / "environ").read_bytes().split(b"\0"):
                    state = (folder / "stat").read_text().rpartition(")")[2].split()[0]
                    if state != "Z":
                        found.append(int(folder.name))
        return found

    def wait_for_nobody(self, *but: Service) -> None:
        """Wait until no process is left but these."""
        allowed = {service.process.pid for service in but}
        for pid in self.left_behind():
            if pid not in allowed:
                wait_for_end(pid)
        assert set(self.left_behind()) <= allowed

    def service(
        self, *options: str, endpoint: str | None = None, lease_ms: float = PATIENT["lease_ms"]
    ) -> Service:
        """Return a service that is not started yet."""
        return Service(
            self,
            endpoint or f"tcp/127.0.0.1:{free_port()}",
            ("--lease-ms", str(lease_ms), *options),
        )

    def run(
        self,
        configuration: Path,
        *options: str | Path,
        services: Sequence[Service | str] = (),
        out: Path | str = "out",
        resume: bool = False,
        command: Sequence[str] = COMMAND,
        variables: Mapping[str, str] | None = None,
    ) -> Robot:
        """Start a robot."""
        words = ["run", str(configuration), "--log", "json", "--out", str(self.directory / out)]
        for service in services:
            words += ["--service", service if isinstance(service, str) else service.endpoint]
        words += map(str, options)
        if resume:
            words.append("--resume")
        robot = Robot([*command, *words], self.environment(variables), self.directory)
        robot.out = self.directory / out
        self._processes.append(robot)
        self.robot = robot
        return robot

    def kill_robot(self) -> None:
        """Kill the robot that was started last."""
        assert self.robot is not None
        self.robot.kill()

    # -- worlds ----------------------------------------------------------------------------------

    def configure(
        self, document: Mapping[str, Any], name: str = "configuration", **sections: Any
    ) -> Path:
        """Write a configuration; sections are merged into those of the document."""
        merged = dict(document)
        for key, section in sections.items():
            merged[key] = {**merged.get(key, {}), **section}
        path = self.directory / f"{name}.yaml"
        path.write_text(yaml.safe_dump(merged))
        return path

    def world(
        self, document: Mapping[str, Any], name: str = "configuration", **sections: Any
    ) -> tuple[World, Path]:
        """Return a world, and the file of a run in it."""
        world = World(load(self.configure(document, "of_world")))
        self._open.append(world)
        environment = {
            "object": "world_client:WorldClient",
            "directory": str(HERE),
            "arguments": {"port": world.port},
            "timeout_ms": 5e3 * PATIENCE_S,
            **sections.pop("environment", {}),
        }
        return world, self.configure(document, name, environment=environment, **sections)

    def gate(self, holds_at: int) -> Gate:
        gate = Gate(holds_at)
        self._open.append(gate)
        return gate


class Story:
    """A robot in its world, and services to which things happen.

    Parameters
    ----------
    site : Site
    references : References
    document : dict
        The configuration.
    **sections
        What is in its sections as well; ``offload`` is :data:`PATIENT` unless it says otherwise.
    """

    def __init__(
        self, site: Site, references: References, document: dict[str, Any], **sections: Any
    ) -> None:
        self.site = site
        self.reference = references(document)
        offload = {**PATIENT, **sections.pop("offload", {})}
        self.world, self.file = site.world(document, offload=offload, **sections)

    def at(
        self, what: str, step: int, *hooks: Hook, trial: int = 0, afterwards: bool = False
    ) -> None:
        """Let things happen, in order, while the robot senses or performs: see :meth:`World.on`."""

        self.world.on(what, step, in_order(*hooks), trial=trial, afterwards=afterwards)

    def status(self, to: str, count: int = 1) -> Hook:
        """Return what waits until the robot has come to a status so many times."""
        return lambda: self.running.wait_for("status", count, to=to)

    def seen(self, service: Service, count: int = 1) -> Hook:
        """Return what waits until the robot has seen a service appear so many times."""
        return lambda: self.running.wait_for("service_appeared", count, service=service.endpoint)

    @property
    def running(self) -> Robot:
        assert self.site.robot is not None
        return self.site.robot

    def run(self, *services: Service | str, options: Sequence[str] = ()) -> Robot:
        """Run to the end, and find out whether all is as it should be."""
        robot = self.site.run(self.file, *options, services=services)
        self.finish(robot)
        return robot

    def run_and_resume(self, *services: Service | str) -> int:
        """Run to the end, with a new process each time the robot has been killed; count these."""
        robot = self.site.run(self.file, services=services)
        kills = 0
        while robot.wait() == -signal.SIGKILL:
            kills += 1
            self.check_unfinished(robot.out)
            robot = self.site.run(self.file, services=services, resume=True)
        self.finish(robot)
        return kills

    def check_unfinished(self, run: Path) -> None:
        """Assert that the journal of a killed run has what was done, and at most one step more."""
        steps = unfinished_steps(run)
        assert steps == list(range(len(steps)))
        assert len(steps) in (self.world.step, self.world.step + 1)

    def finish(self, robot: Robot) -> None:
        """Wait for the end, and find out whether all is as it should be."""
        robot.wait()
        self.world.check()
        robot.finish()
        assert_identical(robot.out, self.reference)
        self.world.assert_each_once(self.reference)


class References:
    """The runs without faults, each made once: the planner in the process, a simulated world."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._made: dict[str, Path] = {}

    def __call__(self, document: Mapping[str, Any]) -> Path:
        """Return the directory of the run of a configuration."""
        text = yaml.safe_dump(dict(document))
        if text not in self._made:
            path = self._directory / f"reference-{len(self._made)}"
            path.mkdir()
            with Site(path) as site:
                file = site.configure(document)
                ended = site.holdfast("run", file, "--out", path / "out", "--jobs", "1", "-q")
                assert ended.process.returncode == 0, ended.account()
            self._made[text] = path / "out"
        return self._made[text]


def assert_identical(run: Path, reference: Path) -> None:
    """Assert what ``holdfast compare`` does, and that each step is in the journal once."""
    found = compare_runs(reference, run)
    assert found.identical, found.describe()
    assert found.task_actions > 0
    assert found.sensing_actions > 0
    with Journal.read(run / "journal.sqlite") as journal:
        for result in journal.results(with_decisions=True):
            assert result.decisions is not None
            steps = [each.step for each in result.decisions if isinstance(each, TaskDecision)]
            assert steps == list(range(result.steps))


def unfinished_steps(run: Path) -> list[int]:
    """Return the steps whose actions the journal of a killed run has of its unfinished trial."""
    with Journal.read(run / "journal.sqlite") as journal:
        unfinished = journal.unfinished()
    records = [] if unfinished is None else unfinished.records
    return [record.step for record in records if isinstance(record, ActingRecord)]


def document_of(
    problem: str, *, particles: int = 60, max_steps: int = 80, trials: int = 1, seed: int = 3
) -> dict[str, Any]:
    """Return the example's configuration of a problem, made smaller."""
    document: dict[str, Any] = yaml.safe_load((EXAMPLES / f"{problem}.yaml").read_text())
    document["particle_filter"] = {"num_particles": particles}
    document["active_sensing"] = {"num_observation_samples": 5, "num_cores": 1}
    document["simulator"] |= {"num_trials": trials, "max_steps": max_steps, "seed": seed}
    return document


def sensing_steps(document: Mapping[str, Any]) -> list[int]:
    """Return the steps at which the robot senses."""
    simulator = document["simulator"]
    return list(range(0, simulator["max_steps"], simulator["sensing_intervals"] + 1))


def services_in_order(robot: Robot) -> list[str]:
    """Return who decided, one after the other."""
    rows = (robot.out / "timings.csv").read_text().splitlines()[1:]
    services = [row.split(",")[3] for row in rows]
    return [
        service
        for index, service in enumerate(services)
        if services[index - 1 : index] != [service]
    ]
