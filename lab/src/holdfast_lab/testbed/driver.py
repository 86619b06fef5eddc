"""One robot, its services, and the faults injected into them: real processes in one loop.

A script over a :class:`Testbed` adds services, starts a robot, injects faults, waits for what it
wants to see, and compares in the end. One loop, :meth:`Testbed.wait_until`, reads what the
processes log, advances all injected faults, and notices a process that ends too early. Whatever
happens, no process is left when the ``with`` statement ends.
"""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path
from typing import Self, TypeAlias

from holdfast.journal.run_directory import TIMINGS_NAME
from holdfast.runtime.parent_death import parent_death_prefix
from holdfast.runtime.process_ends import signal_name
from holdfast_lab.errors import NoProgressError, ProcessEndedError
from holdfast_lab.testbed.fault_times import InjectedFault
from holdfast_lab.testbed.namespace import NetworkNamespace
from holdfast_lab.testbed.processes import HOLDFAST, Process, ProcessGroup
from holdfast_lab.testbed.proxy import Proxy
from holdfast_lab.testbed.records import Decision, DecisionTable, LogEvent

Script: TypeAlias = Generator[Callable[[], bool], None, None]
"""Yields what it waits for, and goes on once that is true."""

_TURN_S = 0.008
"""How long the loop may sleep, so how late a fault may be injected."""

_READY_S = 60.0
_LONGEST_S = 600.0
_END_S = 5.0

ROBOT_LOG_NAME = "robot.log"


class ServiceCommand:
    """``holdfast serve`` at one endpoint; it may be killed and started again there."""

    def __init__(
        self,
        start: Callable[[], Process],
        endpoint: str,
        port: int = 0,
        proxy: Proxy | None = None,
        namespace: NetworkNamespace | None = None,
    ) -> None:
        self._start = start
        self._process: Process | None = None
        self.endpoint = endpoint
        self.port = port
        self.proxy = proxy
        self.namespace = namespace

    @property
    def process(self) -> Process:
        """The process that was started last."""
        assert self._process is not None, "the service was never started"
        return self._process

    @property
    def is_away(self) -> bool:
        """Whether it was never started, or was killed and not started again."""
        return self._process is None or self._process.killed

    @property
    def ready_at(self) -> float | None:
        """When its process became ready, in seconds since the epoch; None before."""
        ready = self.process.matching("ready")
        return ready[0].at if ready else None

    @property
    def start_s(self) -> float:
        """How long its process took until it was ready."""
        assert self.ready_at is not None
        return self.ready_at - self.process.spawned_at

    def start(self) -> Self:
        """Start it; return at once."""
        self._process = self._start()
        return self


class RobotCommand:
    """``holdfast run`` into one directory: one process, or several that resume the run.

    ``steps_of_trials`` has the task actions of each trial, as in the reference run.
    """

    def __init__(
        self,
        start: Callable[[Sequence[str]], Process],
        out: Path,
        steps_of_trials: Sequence[int],
        rate_hz: float,
    ) -> None:
        self._start = start
        self._steps_of_trials = steps_of_trials
        self.rate_hz = rate_hz
        self.out = out
        self.table = DecisionTable(out / TIMINGS_NAME)
        self.processes = [start(())]

    @property
    def process(self) -> Process:
        """The process that was started last."""
        return self.processes[-1]

    @property
    def events(self) -> list[LogEvent]:
        """What all its processes have logged, in order."""
        return [event for process in self.processes for event in process.events.copy()]

    @property
    def is_done(self) -> bool:
        """Whether its run has ended well."""
        return self.process.exit_code == 0

    @property
    def decisions(self) -> list[Decision]:
        """The rows of its table that have been read."""
        return self.table.rows

    @property
    def num_trials(self) -> int:
        """The number of trials of the whole run."""
        return len(self._steps_of_trials)

    @property
    def steps(self) -> int:
        """The number of task actions of the whole run."""
        return sum(self._steps_of_trials)

    @property
    def steps_done(self) -> int:
        """How far the run is, in task actions; -1 before its first decision."""
        if not self.decisions:
            return -1
        last = self.decisions[-1]
        return sum(self._steps_of_trials[: last.trial]) + last.step

    def resume(self) -> None:
        """Start a process that resumes the run of one that was killed."""
        # Before that its journal is not free, and its events are not all read.
        self.process.close(_END_S)
        self.processes.append(self._start(("--resume",)))


class Testbed:
    """Starts, watches and ends the processes of a run; to be used in a ``with`` statement.

    Parameters
    ----------
    directory : Path
        Gets the logs of all processes.
    on_turn : callable
        Called in each turn of the loop; what it raises ends the waiting.
    prefix : sequence of str
        A command that runs another one, in a network namespace say; for all processes.
    orderly_end_s : float
        How long processes have to end after SIGTERM; at 0 they are killed at once.

    Attributes
    ----------
    temporary : Path
        A directory for as long as the testbed lasts, also the processes' own for temporary files.
        Its path is short, because local sockets lie there.
    left_behind : list of int
        Processes that had not ended by themselves after all was over, and were killed.
    """

    __test__ = False  # the name is no test's

    def __init__(
        self,
        directory: Path,
        *,
        on_turn: Callable[[], None] = lambda: None,
        prefix: Sequence[str] = (),
        orderly_end_s: float = 0.0,
    ) -> None:
        self.directory = directory
        self.on_turn = on_turn
        self._prefix = tuple(prefix)
        self._orderly_end_s = orderly_end_s
        self._group = ProcessGroup()
        self._scripts: list[Iterator[None]] = []
        self.robot_or_none: RobotCommand | None = None
        self.temporary = Path(tempfile.mkdtemp(prefix="holdfast-"))
        self.services: list[ServiceCommand] = []
        self.faults: list[InjectedFault] = []
        self.left_behind: list[int] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            # Local services end with their robot.
            self.left_behind = self._group.close(_END_S, self._orderly_end_s)
        finally:
            if self.robot_or_none is not None:
                self.robot_or_none.table.close()
            shutil.rmtree(self.temporary, ignore_errors=True)

    # -- processes -----------------------------------------------------------------------------

    def add_service(
        self,
        listen: str,
        *options: str,
        endpoint: str | None = None,
        log_name: str = "cloud.log",
        prefix: Sequence[str] = (),
        proxy: Proxy | None = None,
        namespace: NetworkNamespace | None = None,
    ) -> ServiceCommand:
        """Add a service, which is not started yet; ``endpoint`` is where the robot reaches it."""
        arguments = ("serve", "--listen", listen, "--log", "json", "--until-stdin-closes", *options)
        port = listen.rpartition(":")[2]
        service = ServiceCommand(
            lambda: self._start(arguments, log_name, prefix),
            endpoint or listen,
            int(port) if port.isdigit() else 0,
            proxy,
            namespace,
        )
        self.services.append(service)
        return service

    def start_services(self) -> float:
        """Start all services and wait until they are ready; return the slowest start in s."""
        for service in self.services:
            service.start()
        self.wait_until(
            lambda: all(service.ready_at is not None for service in self.services),
            "all cloud services being ready",
            _READY_S,
        )
        return max(service.start_s for service in self.services)

    def start_robot(
        self,
        configuration: Path,
        out: Path,
        steps_of_trials: Sequence[int],
        rate_hz: float,
        *options: str,
        prefix: Sequence[str] = (),
    ) -> RobotCommand:
        """Start the robot of a new run; one robot at a time."""
        if self.robot_or_none is not None:
            self.robot_or_none.process.close(_END_S)
            self.robot_or_none.table.close()
            for process in self.robot_or_none.processes:
                self._group.processes.remove(process)
            self._scripts.clear()
        arguments = ["run", str(configuration), *options, "--rate", f"{rate_hz:g}"]
        arguments += ["--log", "json", "--out", str(out)]
        # The robot ends with this process, however that ends.
        self.robot_or_none = RobotCommand(
            lambda more: self._start(
                [*arguments, *more], ROBOT_LOG_NAME, (*prefix, *parent_death_prefix())
            ),
            out,
            steps_of_trials,
            rate_hz,
        )
        return self.robot_or_none

    @property
    def robot(self) -> RobotCommand:
        """The robot that was started last."""
        assert self.robot_or_none is not None, "no robot was started"
        return self.robot_or_none

    def _start(self, arguments: Sequence[str], log_name: str, prefix: Sequence[str]) -> Process:
        process = Process(
            (*self._prefix, *prefix, *HOLDFAST, *arguments),
            self._group.environment({"TMPDIR": str(self.temporary)}),
            log_path=self.directory / log_name,
            changed=self._group.changed,
        )
        self._group.processes.append(process)
        return process

    # -- faults --------------------------------------------------------------------------------

    def run_script(self, script: Script) -> None:
        """Advance a script in each turn of the loop, beside all others."""
        self._scripts.append(_turns(script))

    def note_fault(self, kind: str, target: str, injected_at: float) -> InjectedFault:
        """Note that a fault was injected."""
        fault = InjectedFault(kind=kind, target=target, injected_at=injected_at)
        self.faults.append(fault)
        return fault

    # -- the loop ------------------------------------------------------------------------------

    def wait_until(
        self,
        done: Callable[[], bool],
        what: str,
        limit_s: float,
        progress: Callable[[], object] = lambda: None,
    ) -> None:
        """Run the loop until something is so; ``what`` names it in messages.

        The limit begins anew whenever the progress changes. Raises NoProgressError if it does not
        happen in time; ProcessEndedError if a process ends that was not killed.
        """
        began = moved_at = time.monotonic()
        seen = progress()
        while True:
            if self.robot_or_none is not None:
                self.robot_or_none.table.read()
            self._scripts = [turns for turns in self._scripts if next(turns, True) is None]
            self.on_turn()
            if done():
                return
            now = time.monotonic()
            if progress() != seen:
                seen, moved_at = progress(), now
            if now - moved_at > limit_s:
                raise NoProgressError(f"waited {limit_s:.0f} s in vain for {what}")
            if now - began > _LONGEST_S:
                raise NoProgressError(f"waited {_LONGEST_S:.0f} s in vain for {what}")
            self._require_nobody_ended()
            with self._group.changed:
                self._group.changed.wait(_TURN_S)

    def wait_for_end_of_run(self, limit_s: float) -> None:
        """Wait until the robot's run has ended; the limit begins anew with each decision."""
        robot = self.robot
        self.wait_until(
            lambda: robot.is_done,
            f"the next of {robot.steps} steps",
            limit_s,
            lambda: (len(robot.processes), len(robot.decisions)),
        )
        robot.table.read()

    def _require_nobody_ended(self) -> None:
        robots = [] if self.robot_or_none is None else self.robot_or_none.processes
        for process in self._group.processes:
            code, is_robot = process.exit_code, process in robots
            if code is None or process.killed or (is_robot and code == 0):
                continue
            name = "robot" if is_robot else "cloud service"
            how = f"exit code {code}" if code >= 0 else signal_name(-code)
            last = process.last_line()
            raise ProcessEndedError(
                f"the {name} ended with {how}; see {process.log_path}"
                + (f"; its last line: {last}" if last else "")
            )


def _turns(script: Script) -> Iterator[None]:
    """Go on with a script as far as possible in each turn."""
    for is_ready in script:
        while not is_ready():
            yield


def after(duration_s: float) -> Callable[[], bool]:
    """Return a condition that becomes true some time after this call."""
    due = time.monotonic() + duration_s
    return lambda: time.monotonic() >= due
