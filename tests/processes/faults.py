"""What the tests of faults share: robots and services as processes, and one run as a story.

The robot's world (:mod:`tests.processes.world`) is in the test's own process, so a test injects a
fault at a step, not after a time.
"""

from __future__ import annotations

import csv
import json
import os
import select
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import yaml
from tests.command_line import done_here
from tests.ports import free_port
from tests.process_states import stop
from tests.processes.world import PATIENCE_S as PATIENCE_S
from tests.processes.world import Gate, World
from tests.processes.world import Hook as Hook
from tests.programs import completed

from holdfast.config.loader import load
from holdfast.config.registry import BUILT_IN
from holdfast.journal.journal import Journal
from holdfast.planning.inputs import ActingRecord
from holdfast.reports.compare import compare_runs
from holdfast_lab.testbed import processes as lab
from holdfast_lab.testbed.driver import ServiceCommand
from holdfast_lab.testbed.records import LogEvent, log_event_of

HERE = Path(__file__).parent
EXAMPLES = HERE.parents[1] / "examples"
PROBLEMS = tuple(BUILT_IN)

STANDARD, LOCAL_RECOVERY, KEEP_ALIVE = "standard", "local_recovery", "keep_alive"
RECOVERY = "cloud_active_sensing_recovery"

PATIENT = {"detection_timeout_ms": 30_000.0, "lease_ms": 30_000.0, "startup_timeout_ms": 30_000.0}
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


class Process(lab.Process):
    """A process that reports events as JSON lines."""

    def __init__(
        self, command: Sequence[str], environment: Mapping[str, str], directory: Path
    ) -> None:
        super().__init__(command, environment, directory=directory, own_session=True)

    @property
    def output(self) -> str:
        """Its output that is no event, and the error that it has ended with."""
        events = ((line, log_event_of(line)) for line in self.lines)
        return "".join(line if event is None else _error_as_text(event) for line, event in events)

    def kill(self) -> float:
        """End it with SIGKILL; when this returns it is gone."""
        killed_at = super().kill()
        self.wait()
        return killed_at

    def stop(self) -> float:
        """Stop it with SIGSTOP; when this returns it stands still."""
        stopped_at = time.time()
        stop(self.pid)
        return stopped_at

    def signal(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def wait(self) -> int:
        """Return the exit code; by then all its output is here."""
        return self.close(PATIENCE_S)


def _error_as_text(event: LogEvent) -> str:
    """Return what the command says without ``--log json``."""
    lines = [f"holdfast: error: {event['reason']}"]
    if "details" in event.fields:
        lines.append(event["details"])
    if "resume_command" in event.fields:
        lines.append(f"Go on with: {event['resume_command']}")
    return "".join(f"{line}\n" for line in lines)


class Service(ServiceCommand):
    """``holdfast serve`` at one endpoint; it may be killed and started again there."""

    def __init__(self, site: Site, endpoint: str, options: Sequence[str]) -> None:
        super().__init__(self._start_process, endpoint)
        self._site = site
        self.options = tuple(options)
        self.command: tuple[str, ...] = lab.HOLDFAST
        self.verb = "serve"
        self.variables: dict[str, str] = {}

    def _start_process(self) -> Process:
        return self._site.process(
            *self.command,
            *(self.verb, "--listen", self.endpoint, "--log", "json"),
            *self.options,
            variables=self.variables,
        )

    @property
    def process(self) -> Process:
        process = super().process
        assert isinstance(process, Process)
        return process

    def start(self) -> Self:
        """Start it; when this returns, robots can connect."""
        super().start().process.wait_for("ready")
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
        found = lab.local_services_of(self.pid)
        assert len(found) == 1, f"{len(found)} local services: {self.account()}"
        return found[0]


def events_of(run: Path) -> list[dict[str, Any]]:
    """Return the events that the directory of a run tells of."""
    path = run / "events.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()]


def summary_of(run: Path) -> dict[str, Any]:
    """Return the summary in the directory of a run."""
    found: dict[str, Any] = json.loads((run / "summary.json").read_text())
    return found


def rows_of(run: Path, name: str = "trials.csv") -> list[dict[str, str]]:
    """Return the rows of a table in the directory of a run."""
    with (run / name).open(newline="") as file:
        return list(csv.DictReader(file))


def holdfast(
    directory: Path, *arguments: str, command: Sequence[str] = COMMAND
) -> subprocess.CompletedProcess[str]:
    """Run a command in a directory to its end."""
    return completed([*command, *arguments], cwd=directory, timeout=PATIENCE_S)


def page(address: str, path: str) -> tuple[int, str]:
    """Return what is answered by HTTP: the status and the text."""
    try:
        with urllib.request.urlopen(f"http://{address}{path}", timeout=PATIENCE_S) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


class Site:
    """A directory, and every process that a test starts: at the end none is left."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._group = lab.ProcessGroup()
        self._open: list[World | Gate] = []
        self.robot: Robot | None = None

    def __enter__(self) -> Site:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        failures: list[BaseException] = []
        try:
            # What a robot that was killed has started ends by itself.
            left = self._group.close(PATIENCE_S)
        finally:
            for each in self._open:
                try:
                    each.close()
                except BaseException as error:  # noqa: BLE001 - all of them are closed first
                    failures.append(error)
        assert left == []
        if failures:
            raise failures[0]

    # -- processes -------------------------------------------------------------------------------

    def environment(self, variables: Mapping[str, str] | None = None) -> dict[str, str]:
        """Return the environment variables of the test's processes."""
        return self._group.environment(variables or {})

    def process(self, *command: str, variables: Mapping[str, str] | None = None) -> Process:
        started = Process(command, self.environment(variables), self.directory)
        self._group.processes.append(started)
        return started

    def holdfast(self, *arguments: str | Path) -> Process:
        """Run a command to its end."""
        process = self.process(*COMMAND, *map(str, arguments))
        process.wait()
        return process

    def left_behind(self) -> list[int]:
        """Return all processes that were started here, by whomever, and have not ended."""
        return self._group.living()

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
        self._group.processes.append(robot)
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
    """A robot in its world, and services to which things happen."""

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
            file = Site(path).configure(document).name
            done_here(path, ("run", file, "--out", "out", "--jobs", "1", "-q"))
            self._made[text] = path / "out"
        return self._made[text]


def assert_identical(run: Path, reference: Path) -> None:
    """Assert what ``holdfast compare`` does, and that each step is in the journal once."""
    found = compare_runs(reference, run)
    assert found.identical, found.describe()
    assert found.task_actions > 0
    assert found.sensing_actions > 0
    with Journal.read(run / "journal.bin") as journal:
        for result in journal.results(with_decisions=True):
            assert result.decisions is not None
            steps = [each.step for each in result.decisions if isinstance(each, ActingRecord)]
            assert steps == list(range(result.steps))


def unfinished_steps(run: Path) -> list[int]:
    """Return the steps whose actions the journal of a killed run has of its unfinished trial."""
    with Journal.read(run / "journal.bin") as journal:
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
    """Return who decided, one after the other, but for task actions that the robot took itself."""
    rows = (robot.out / "timings.csv").read_text().splitlines()[1:]
    services = [row.split(",")[3] for row in rows if ",task,in_process," not in row]
    return [
        service
        for index, service in enumerate(services)
        if services[index - 1 : index] != [service]
    ]
