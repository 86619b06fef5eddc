"""The demo's story: real processes, real kills, and what is seen of them from outside.

A demonstration proves something only if nothing in it is staged. So this module starts the same
commands that anyone can type, ends them with SIGKILL, and learns what happens from what they write
for everybody: the robot's events, its table of decisions, the service's ready line. It holds no
object of theirs, and the run that nothing disturbs is really run, to be compared in the end.

The kills come at fixed fractions of the run's steps and, each time, once the one before it has been
answered; so the story does not hang on how fast the machine is. Nothing is waited for without a
limit. Nothing here writes to a terminal: whoever shows the story gets a :class:`Chronicle`.
"""

from __future__ import annotations

import os
import shutil
import signal
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any, Literal, NamedTuple, Self

import msgspec

from holdfast.chaos.processes import (
    ChildProcess,
    Decision,
    DecisionTable,
    Ended,
    Written,
    free_port,
    time_of,
)
from holdfast.chaos.twin import keep_undisturbed, run_undisturbed
from holdfast.cli.chronicle import Audience, Change, Chronicle, Line, Mark, Row, State
from holdfast.cli.terminal import counted
from holdfast.configuration import load
from holdfast.errors import HoldfastError
from holdfast.files import write_atomically
from holdfast.recording.compare import Comparison, compare_runs
from holdfast.recording.run_directory import TIMINGS_NAME
from holdfast.runtime.leash import leash
from holdfast.runtime.links import RECOVERY_SERVICE
from holdfast.session.status import Status

__all__ = [
    "KILLED_RUN_NAME",
    "UNDISTURBED_RUN_NAME",
    "Findings",
    "Outage",
    "Plan",
    "Story",
    "StoryError",
]

CONFIGURATION_NAME = "demo.yaml"
FINDINGS_NAME = "findings.json"
KILLED_RUN_NAME = "killed"
UNDISTURBED_RUN_NAME = "undisturbed"
CLOUD_LOG_NAME = "cloud.log"
ROBOT_LOG_NAME = "robot.log"

_CONFIGURATION = """\
# What holdfast demo has run. The same without services, without kills and as fast as it goes:
#   holdfast run {path}
problem: peg_in_hole_2d
particle_filter: {{num_particles: 100}}
simulator: {{num_trials: {num_trials}, max_steps: {max_steps}, seed: {seed}}}
"""
_MAX_STEPS = 250
_MAX_TRIALS = 1000

_FIRST_KILL = 0.14
_FIRST_RESTART = 0.32
_SECOND_KILL = 0.47
_SECOND_RESTART = 0.59
_ROBOT_KILL = 0.73
"""When things happen, as fractions of the run's steps; after the last there is room for delays."""

_USUAL_START_S = 0.4
_MAX_SLOWNESS = 4.0
"""A service that takes longer to start is on a slow machine, where the robot has to be slower too:
else its run would be over before all has happened."""

_PATIENCE_S = 30.0
"""How long a reaction may take: a hundred times what it takes on an idle machine."""

_FRAME_S = 0.08
_ORDERLY_END_S = 3.0


class StoryError(HoldfastError):
    """Something that the story is about has not happened."""


# -- what comes of it ------------------------------------------------------------------------------


class Outage(msgspec.Struct, frozen=True, kw_only=True):
    """One death of the cloud service and its return.

    Attributes
    ----------
    found_ms : float
        From the kill until the robot's status is ``local_recovery``.
    first_local_decision_ms : float
        From then until the robot carries out a decision of the local service. Until then it goes on
        with the actions that it has.
    longest_wait_ms : float
        Longest time that the robot stood still for a decision while the cloud was away.
    launched_ms : float or None
        From the spawn of the local service until the robot sees it; None if it ran already.
    listening_ms : float
        From the spawn of the new cloud service until it listens.
    used_again_ms : float
        From then until the robot has an answer of it.
    """

    found_ms: float
    first_local_decision_ms: float
    longest_wait_ms: float
    launched_ms: float | None
    listening_ms: float
    used_again_ms: float


class Findings(msgspec.Struct, frozen=True, kw_only=True):
    """What the story comes to.

    Attributes
    ----------
    problem : str
    seed, trials, steps : int
    rate_hz : float
        Task actions a second.
    outages : tuple of Outage
    robot_acting_again_ms : float
        From the kill of the robot's own process until a new one carries out its first decision.
    usual_wait_ms : float
        Median time that the robot waits for the cloud's task actions: one round trip.
    statuses : tuple of tuple of str
        Those passed, for each process that the robot had.
    comparison : Comparison
        Of the run that nothing disturbed and the one with the kills.
    """

    problem: str
    seed: int
    trials: int
    steps: int
    rate_hz: float
    outages: tuple[Outage, ...]
    robot_acting_again_ms: float
    usual_wait_ms: float
    statuses: tuple[tuple[str, ...], ...]
    comparison: Comparison


class Plan(NamedTuple):
    """How long the story is to be.

    Attributes
    ----------
    min_steps : int
        Trials are added until the run has as many task actions.
    duration_s : float
        How long the robot takes for them.
    """

    min_steps: int = 400
    duration_s: float = 16.0


# -- the story -------------------------------------------------------------------------------------


class Story:
    """Tells the whole story, once; to be used in a ``with`` statement, whose end ends all of it.

    Parameters
    ----------
    directory : Path
        An empty one; gets both runs, the logs and the findings.
    seed : int
    plan : Plan
    audience : Audience

    Attributes
    ----------
    chronicle : Chronicle
    """

    def __init__(self, directory: Path, seed: int, plan: Plan, audience: Audience) -> None:
        self._directory = directory
        self._seed = seed
        self._plan = plan
        self._audience = audience
        self._began_at = time.time()
        self.chronicle = Chronicle(expected_s=plan.duration_s + 3.0)
        self._happened: SimpleQueue[Written | Ended] = SimpleQueue()
        # What a killed process leaves in the directory for temporary files goes with the story.
        self._temporary = tempfile.mkdtemp(prefix="holdfast-demo-")
        self._environment = {**os.environ, "TMPDIR": self._temporary}
        self._endpoint = f"tcp/127.0.0.1:{free_port()}"
        self._children: list[ChildProcess] = []
        self._cloud: ChildProcess | None = None
        self._cloud_listens_at: float | None = None
        self._cloud_killed_at: float | None = None
        self._robot: ChildProcess | None = None
        self._robot_spawned_at = self._began_at
        self._robot_is_up = False
        self._robot_is_done = False
        self._robot_code: int | None = None
        self._local: State = "off"
        self._launch_ms: float | None = None
        self._held = False
        self._status_at = self._began_at
        self._statuses: list[list[str]] = []
        self._table = DecisionTable(directory / KILLED_RUN_NAME / TIMINGS_NAME)
        self._steps_of_trials: list[int] = []
        self._rate_hz = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """End all processes; whatever else interrupts this ends them at once."""
        try:
            for child in self._children:
                child.terminate()
            for child in self._children:
                child.close(_ORDERLY_END_S)
        finally:
            for child in self._children:
                child.close(0.0)
            self._children.clear()
            self._table.close()
            shutil.rmtree(self._temporary, ignore_errors=True)

    def tell(self) -> Findings:
        """Run all of it.

        Returns
        -------
        Findings
            Also written to ``findings.json``.

        Raises
        ------
        StoryError
            If something does not happen in time, or a process ends that should not.
        """
        self._run_undisturbed()
        spawned_at = self._start_cloud()
        took_s = self._await_cloud() - spawned_at
        self._pace(min(_MAX_SLOWNESS, max(1.0, took_s / _USUAL_START_S)))
        self.chronicle.title += f" at {self._rate_hz:g} Hz"
        self._start_robot()
        self._await(lambda: bool(self._table.rows), "the robot's first decision")
        first = self._outage(_FIRST_KILL, _FIRST_RESTART)
        second = self._outage(_SECOND_KILL, _SECOND_RESTART)
        acting_again_ms = self._kill_robot()
        self._await(
            lambda: self._robot_code is not None,
            "the end of the robot's run",
            expected_s=sum(self._steps_of_trials) / self._rate_hz,
        )
        return self._conclude((first, second), acting_again_ms)

    # -- its parts -----------------------------------------------------------------------------

    def _run_undisturbed(self) -> None:
        """Run it without services, and see how long it is."""
        path = self._directory / CONFIGURATION_NAME
        self._write_configuration(path, _MAX_TRIALS)
        configuration = load(path)
        results, took_s = run_undisturbed(configuration, self._plan.min_steps)
        self._steps_of_trials = [result.steps for result in results]
        self._write_configuration(path, len(results))
        keep_undisturbed(self._directory / UNDISTURBED_RUN_NAME, load(path), results, took_s)
        steps = sum(self._steps_of_trials)
        self.chronicle.title = (
            f"{configuration.problem_name}, seed {self._seed}: {counted(len(results), 'trial')}, "
            f"{steps} steps"
        )
        self._say("demo", f"the run without kills, in this process, took {took_s:.2f} s")
        self._pace(1.0)

    def _pace(self, slowness: float) -> None:
        """Choose how fast the robot goes."""
        steps = sum(self._steps_of_trials)
        duration_s = self._plan.duration_s * slowness
        self._rate_hz = float(max(1, round(steps / duration_s)))
        passed_s = time.time() - self._began_at
        self.chronicle.expected_s = passed_s + 3.0 + steps / self._rate_hz

    def _write_configuration(self, path: Path, num_trials: int) -> None:
        write_atomically(
            path,
            _CONFIGURATION.format(
                path=path, num_trials=num_trials, max_steps=_MAX_STEPS, seed=self._seed
            ).encode(),
        )

    def _outage(self, kill_at: float, restart_at: float) -> Outage:
        """Kill the cloud, let the robot do without it for a while, and start it again."""
        self._await_progress(kill_at)
        self._await(lambda: self._status_is_cloud, "the use of the cloud service")
        killed_at = self._kill_cloud()
        self._await(lambda: not self._status_is_cloud, "the loss being noticed")
        found_at = max(self._status_at, killed_at)
        local = self._await_decision(
            lambda row: row.service == RECOVERY_SERVICE and row.at >= found_at,
            "a decision of the local service",
        )
        self._say("local", f"decides, from step {local.step} on", local.at)
        self._await_progress(restart_at)
        spawned_at = self._start_cloud()
        listening_at = self._await_cloud()
        self._await(lambda: self._status_is_cloud, "the cloud being used again")
        used_at = self._status_at
        # Up to the first decision after that, because it may have been waited for since before.
        last = self._await_decision(lambda row: row.at > used_at, "the decision after that")
        waits = [row.waited_ms for row in self._table.rows if killed_at <= row.at <= last.at]
        return Outage(
            found_ms=1e3 * (found_at - killed_at),
            first_local_decision_ms=1e3 * (local.at - found_at),
            longest_wait_ms=max(waits),
            launched_ms=self._launch_ms,
            listening_ms=1e3 * (listening_at - spawned_at),
            used_again_ms=1e3 * max(0.0, used_at - listening_at),
        )

    def _kill_robot(self) -> float:
        """Kill the robot's own process in mid-step, and start another one that goes on."""
        self._await_progress(_ROBOT_KILL)
        robot = self._robot
        assert robot is not None
        killed_at = robot.kill()
        self._robot_is_up = False
        self._local = "off"  # it ends with the robot that launched it
        self._mark("robot", "kill", killed_at)
        self._say("demo", f"kill -9 {robot.process.pid}: the robot's own process", killed_at)
        # Only when it is gone is its journal free.
        robot.close(_ORDERLY_END_S)
        self._start_robot("--resume")
        resumed_at = self._robot_spawned_at
        again = self._await_decision(lambda row: row.at > resumed_at, "the robot acting again")
        return 1e3 * (again.at - killed_at)

    def _conclude(self, outages: tuple[Outage, ...], acting_again_ms: float) -> Findings:
        waits = [
            row.waited_ms
            for row in self._table.rows
            if row.kind == "task"
            and row.service == self._endpoint
            and row.status != Status.LOCAL_RECOVERY.value
        ]
        comparison = compare_runs(
            self._directory / UNDISTURBED_RUN_NAME, self._directory / KILLED_RUN_NAME
        )
        findings = Findings(
            problem="peg_in_hole_2d",
            seed=self._seed,
            trials=len(self._steps_of_trials),
            steps=sum(self._steps_of_trials),
            rate_hz=self._rate_hz,
            outages=outages,
            robot_acting_again_ms=acting_again_ms,
            usual_wait_ms=statistics.median(waits) if waits else 0.0,
            statuses=tuple(tuple(passed) for passed in self._statuses),
            comparison=comparison,
        )
        text = msgspec.json.format(msgspec.json.encode(findings), indent=2)
        write_atomically(self._directory / FINDINGS_NAME, text + b"\n")
        return findings

    # -- processes -----------------------------------------------------------------------------

    @property
    def _robot_log(self) -> Path:
        return self._directory / ROBOT_LOG_NAME

    @property
    def _cloud_log(self) -> Path:
        return self._directory / CLOUD_LOG_NAME

    def _start_cloud(self) -> float:
        """Start the cloud service; return when."""
        self._cloud_listens_at = None
        self._cloud = self._start(
            ["serve", "--listen", self._endpoint, "--log", "json", "--until-stdin-closes"],
            self._cloud_log,
        )
        spawned_at = self._cloud.spawned_at
        self._mark("cloud", "start", spawned_at)
        self._say(
            "demo",
            f"starts the cloud: holdfast serve --listen {self._endpoint}",
            spawned_at,
        )
        return spawned_at

    def _await_cloud(self) -> float:
        """Wait until the cloud service listens; return since when."""
        self._await(lambda: self._cloud_listens_at is not None, "the cloud service listening")
        assert self._cloud_listens_at is not None
        return self._cloud_listens_at

    def _kill_cloud(self) -> float:
        """Kill the cloud service; return when."""
        cloud = self._cloud
        assert cloud is not None
        killed_at = cloud.kill()
        self._cloud_killed_at = killed_at
        self._launch_ms = None
        self._mark("cloud", "kill", killed_at)
        self._say("demo", f"kill -9 {cloud.process.pid}: the cloud service", killed_at)
        return killed_at

    def _start_robot(self, *options: str) -> None:
        self._robot = self._start(
            [
                *("run", str(self._directory / CONFIGURATION_NAME)),
                *("--service", self._endpoint),
                *("--rate", f"{self._rate_hz:g}", "--log", "json"),
                *("--out", str(self._directory / KILLED_RUN_NAME), *options),
            ],
            self._robot_log,
            leash(),
        )
        self._robot_spawned_at = self._robot.spawned_at
        self._statuses.append([Status.STANDARD.value])
        self.chronicle.status = Status.STANDARD.value
        self._held = False
        self._mark("robot", "start", self._robot_spawned_at)
        command = " ".join(["holdfast run CONFIG --service ...", *options])
        self._say("demo", f"starts the robot: {command}", self._robot_spawned_at)

    def _start(
        self, arguments: list[str], log_path: Path, prefix: tuple[str, ...] = ()
    ) -> ChildProcess:
        child = ChildProcess(arguments, log_path, self._environment, self._happened.put, prefix)
        self._children.append(child)
        return child

    # -- waiting -------------------------------------------------------------------------------

    @property
    def _status_is_cloud(self) -> bool:
        return self.chronicle.status != Status.LOCAL_RECOVERY.value

    def _steps_done(self) -> int:
        if not self._table.rows:
            return 0
        last = self._table.rows[-1]
        return sum(self._steps_of_trials[: last.trial]) + last.step

    def _await_progress(self, fraction: float) -> None:
        steps = int(fraction * sum(self._steps_of_trials))
        self._await(
            lambda: self._steps_done() >= steps,
            f"step {steps} of the run",
            expected_s=sum(self._steps_of_trials) / self._rate_hz,
        )

    def _await_decision(self, wanted: Callable[[Decision], bool], what: str) -> Decision:
        """Wait for a row in the robot's table, and return it."""
        found: list[Decision] = []
        start = 0

        def done() -> bool:
            nonlocal start
            found.extend(filter(wanted, self._table.rows[start:]))
            start = len(self._table.rows)
            return bool(found)

        self._await(done, what)
        return found[0]

    def _await(self, done: Callable[[], bool], what: str, *, expected_s: float = 0.0) -> None:
        """Take note of what happens until something is so."""
        limit_s = expected_s + _PATIENCE_S
        began = time.monotonic()
        while True:
            self._table.read()
            self._note_progress()
            self._audience.look(self.chronicle, time.time() - self._began_at)
            if done():
                return
            left_s = began + limit_s - time.monotonic()
            if left_s <= 0.0:
                raise StoryError(
                    f"waited {limit_s:.0f} s in vain for {what}; the logs are in {self._directory}"
                )
            if self._robot_code is not None:
                raise StoryError(f"the robot's run was over before {what}; see {self._robot_log}")
            try:
                happened = self._happened.get(timeout=min(_FRAME_S, left_s))
            except Empty:
                continue
            if isinstance(happened, Written):
                self._read_line(happened.child, happened.line)
            else:
                self._note_end(happened.child, happened.code)

    def _note_end(self, child: ChildProcess, code: int) -> None:
        if child.killed:
            return
        if child is self._robot and code == 0:
            self._robot_code = code
            self._robot_is_up = False
            self._local = "off"
            self._change()
            self._say("robot", "has finished its run")
            return
        is_robot = child is self._robot
        who, log_path = ("robot", self._robot_log) if is_robot else ("cloud", self._cloud_log)
        how = f"exit code {code}" if code >= 0 else signal.Signals(-code).name
        said = child.last_words()
        raise StoryError(
            f"the process of the {who} ended with {how}; see {log_path}"
            + (f"; the last that it said: {said}" if said else "")
        )

    def _note_progress(self) -> None:
        if not self._table.rows:
            return
        last = self._table.rows[-1]
        self.chronicle.progress = (
            f"trial {last.trial}, step {last.step}; {self._steps_done()} of "
            f"{sum(self._steps_of_trials)} steps done"
        )

    # -- what the processes say ------------------------------------------------------------------

    def _read_line(self, child: ChildProcess, line: str) -> None:
        if not line.startswith("{") or child.killed:
            return
        try:
            event = msgspec.json.decode(line, type=dict[str, Any])
            at = time_of(event["time"])
            name = str(event["event"])
        except (msgspec.DecodeError, KeyError, TypeError, ValueError):
            return  # it is in the log
        if child is self._cloud:
            if name == "ready":
                self._cloud_listens_at = at
                self._say("cloud", "listens", at)
        elif child is self._robot:
            self._robot_event(name, event, at)
        self._change(at)

    def _robot_event(self, name: str, event: dict[str, Any], at: float) -> None:
        if name == "status":
            self._status_at = at
            self.chronicle.status = str(event["to"])
            self._statuses[-1].append(str(event["to"]))
        elif name == "launch":
            self._local = "starting"
        elif name == "launched":
            self._local = "ready"
            self._launch_ms = float(event["launch_ms"])
        elif name in ("launch_failed", "recovery_exited"):
            self._local = "off"
        elif name in ("holding", "resumed"):
            self._held = name == "holding"
        elif name == "trial":
            # What it still does after the last one is to write tables and to draw.
            self._robot_is_done = event["trial"] == len(self._steps_of_trials) - 1
        self._robot_is_up = True
        text = self._in_words(name, event, at)
        if text:
            self._say("robot", text, at)
        if self._robot_is_done and name == "trial":
            self._say("robot", "has done all trials; writes its tables and draws one of them", at)

    def _in_words(self, name: str, event: dict[str, Any], at: float) -> str:
        """Return what an event says to somebody who sees the first of them; empty for nothing."""
        try:
            return self._sentence(name, event, at)
        except (KeyError, TypeError, ValueError):
            return _plainly(name, event)

    def _sentence(self, name: str, event: dict[str, Any], at: float) -> str:
        is_local = event.get("service") == RECOVERY_SERVICE
        who = "the local service" if is_local else "the cloud service"
        if name == "status" and event["to"] != Status.LOCAL_RECOVERY.value:
            return f"status {event['to']}: the cloud decides again"
        if name == "status":
            killed_at = self._cloud_killed_at
            after = "" if killed_at is None else f", {1e3 * (at - killed_at):.0f} ms after the kill"
            return f"status {event['to']}{after}"
        if name == "trial":
            how = "the peg is in" if event["success"] else "the peg is not in"
            return f"trial {event['trial']} ends after {event['steps']} steps: {how}"
        if name == "resumed_trial":
            return f"goes on with trial {event['trial']} at step {event['step']}, from its journal"
        if name in ("missed_ticks", "unreachable"):
            return ""  # the second, because here it is the demo itself that killed the service
        sentences = {
            "service_appeared": "sees {who}",
            "service_vanished": "sees that {who} is gone",
            "service_suspected": "suspects {who}: {reason}",
            "launch": "launches the local service",
            "launched": "the local service is up, {launch_ms:.0f} ms after its launch",
            "holding": "stands still at step {step}: nobody can decide yet",
            "resumed": "goes on; it stood still for {held_ms:.0f} ms",
            "restore": "hands {who} its state ({bytes:,} bytes)",
        }
        if name in sentences:
            return sentences[name].format_map({**event, "who": who})
        return _plainly(name, event)

    # -- the chronicle -------------------------------------------------------------------------

    def _say(self, who: str, text: str, at: float | None = None) -> None:
        at_s = (time.time() if at is None else at) - self._began_at
        line = Line(at_s, who, text)
        self.chronicle.lines.append(line)
        self._audience.say(line)

    def _mark(self, row: Row, kind: Literal["start", "kill"], at: float) -> None:
        self.chronicle.marks.append(Mark(at - self._began_at, row, kind))
        self._change(at)

    def _change(self, at: float | None = None) -> None:
        """Note the state of each process where it has changed."""
        at_s = (time.time() if at is None else at) - self._began_at
        used = self._robot_is_up and self._status_is_cloud and not self._robot_is_done
        cloud: State = "off"
        if self._cloud is not None and not self._cloud.killed:
            up: State = "deciding" if used else "ready"
            cloud = "starting" if self._cloud_listens_at is None else up
        local = self._local
        if local == "ready" and self._robot_is_up and not self._status_is_cloud:
            local = "deciding"
        robot: State = "off"
        if self._robot is not None and not self._robot.killed and self._robot_code is None:
            robot = "by_cloud" if self._status_is_cloud else "by_local"
            robot = "held" if self._held else robot
            robot = robot if self._robot_is_up else "starting"
            robot = "ready" if self._robot_is_done else robot
        states: dict[Row, State] = {"cloud": cloud, "local": local, "robot": robot}
        for row, state in states.items():
            changes = self.chronicle.changes[row]
            if (changes[-1].state if changes else "off") != state:
                changes.append(Change(at_s, state))


def _plainly(name: str, event: dict[str, Any]) -> str:
    reason = f": {event['reason']}" if event.get("reason") else ""
    return name.replace("_", " ") + reason
