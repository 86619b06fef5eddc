"""The demo's state, and what makes it of events on the testbed: activities, marks and lines."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, TypeAlias

from holdfast.protocol.status import Status
from holdfast.robot.links import RECOVERY_SERVICE
from holdfast_lab.testbed.driver import ServiceCommand, Testbed
from holdfast_lab.testbed.processes import Process
from holdfast_lab.testbed.records import LogEvent

_SENTENCES = {
    "service_appeared": "sees {who}",
    "service_vanished": "sees that {who} is gone",
    "service_suspected": "suspects {who}: {reason}",
    "launch": "launches the local service",
    "launched": "the local service is up, {launch_ms:.0f} ms after its launch",
    "holding": "holds still at step {step}: no service can decide yet",
    "resumed": "goes on; it held still for {held_ms:.0f} ms",
    "restore": "sends {who} its state ({bytes:,} bytes)",
    "resumed_trial": "goes on with trial {trial} at step {step}, from its journal",
    # The demo has killed the service itself.
    "unreachable": "",
    "missed_ticks": "",
}


Row: TypeAlias = Literal["cloud", "local", "robot"]
Activity: TypeAlias = Literal[
    "off", "starting", "ready", "deciding", "by_cloud", "by_local", "held"
]
"""States of a service: off, starting, ready, deciding. Of the robot: off, starting, which service
decides for it, held, or ready at the end."""


class Change(NamedTuple):
    """From this moment on a row has another activity."""

    at_s: float
    activity: Activity


class Mark(NamedTuple):
    """The demo has started or killed a process."""

    at_s: float
    row: Row
    kind: Literal["start", "kill"]


class Line(NamedTuple):
    """One thing that happened, in words."""

    at_s: float
    who: str
    text: str


@dataclass
class DemoState:
    """All that has happened so far; times count from the beginning of the demo."""

    title: str = ""
    began_at: float = field(default_factory=time.time)  # in seconds since the epoch
    expected_s: float = 1.0  # how long the demo will take, as far as can be known
    # Of each row, in order of time.
    changes: dict[Row, list[Change]] = field(
        default_factory=lambda: {"cloud": [], "local": [], "robot": []}
    )
    marks: list[Mark] = field(default_factory=list)
    lines: list[Line] = field(default_factory=list)
    status: Status = Status.STANDARD
    progress: str = ""

    @property
    def now_s(self) -> float:
        """Seconds since the beginning."""
        return time.time() - self.began_at


class Narrator:
    """Follows a testbed with one cloud service and one robot."""

    def __init__(
        self,
        testbed: Testbed,
        cloud: ServiceCommand,
        state: DemoState,
        show: Callable[[Line], object],
    ) -> None:
        self._testbed = testbed
        self._cloud = cloud
        self._state = state
        self._show = show
        self._ready_process: Process | None = None
        self._num_events = 0
        self._local: Activity = "off"
        self._is_up = self._is_held = self._has_done_all = self._has_finished = False
        self.statuses: list[list[str]] = []

    @property
    def cloud_decides(self) -> bool:
        """Whether the robot's decisions are the cloud's."""
        return self._state.status is not Status.LOCAL_RECOVERY

    # -- what the demo does --------------------------------------------------------------------

    def started_cloud(self) -> None:
        """Note a start of the cloud service."""
        command = f"holdfast serve --listen {self._cloud.endpoint}"
        self._mark("cloud", "start", self._cloud.process.spawned_at, f"starts the cloud: {command}")

    def started_robot(self, *options: str) -> None:
        """Note a start of the robot."""
        self.statuses.append([Status.STANDARD.value])
        self._state.status = Status.STANDARD
        self._is_held = False
        command = " ".join(["holdfast run CONFIG --service ...", *options])
        started_at = self._testbed.robot.process.spawned_at
        self._mark("robot", "start", started_at, f"starts the robot: {command}")

    def killed(self, row: Row, process: Process, what: str) -> None:
        """Note a kill of the cloud service, or of the robot, with which its local service ends."""
        if row == "robot":
            self._is_up = False
            self._local = "off"
        self._mark(row, "kill", process.killed_at or 0.0, f"kill -9 {process.pid}: {what}")

    def say(self, who: str, text: str, at: float | None = None) -> None:
        """Add a line."""
        line = Line((time.time() if at is None else at) - self._state.began_at, who, text)
        self._state.lines.append(line)
        self._show(line)

    # -- what the testbed shows ----------------------------------------------------------------

    def update(self) -> None:
        """Take in what has happened since the last call."""
        cloud = self._cloud
        ready_at = None if cloud.is_away else cloud.ready_at
        if ready_at is not None and cloud.process is not self._ready_process:
            self._ready_process = cloud.process
            self.say("cloud", "listens", ready_at)
            self._note_changes(ready_at)
        robot = self._testbed.robot_or_none
        if robot is None:
            return
        new = robot.events[self._num_events :]
        self._num_events += len(new)
        for event in new:
            if event.at >= robot.process.spawned_at and not robot.process.killed:
                self._take(event)
        if robot.decisions:
            last = robot.decisions[-1]
            self._state.progress = (
                f"trial {last.trial}, step {last.step}; {robot.steps_done} of {robot.steps} "
                "steps done"
            )
        if robot.is_done and not self._has_finished:
            self._has_finished = True
            self._is_up = False
            self._local = "off"
            self._note_changes(time.time())
            self.say("robot", "has finished its run")

    def _take(self, event: LogEvent) -> None:
        name = event.name
        if name == "status":
            self._state.status = Status(event["to"])
            self.statuses[-1].append(str(event["to"]))
        elif name == "launch":
            self._local = "starting"
        elif name == "launched":
            self._local = "ready"
        elif name in ("launch_failed", "recovery_exited"):
            self._local = "off"
        elif name in ("holding", "resumed"):
            self._is_held = name == "holding"
        self._is_up = True
        text = self._in_words(event)
        if text:
            self.say("robot", text, event.at)
        if name == "trial" and event["trial"] == self._testbed.robot.num_trials - 1:
            self._has_done_all = True
            text = "has done all trials; writes its tables and draws one of them"
            self.say("robot", text, event.at)
        self._note_changes(event.at)

    def _in_words(self, event: LogEvent) -> str:
        """Describe an event to a reader who sees one for the first time; empty for nothing."""
        name = event.name
        if name == "status" and self.cloud_decides:
            return f"status {event['to']}: the cloud decides again"
        if name == "status":
            killed_at = self._cloud.process.killed_at
            after = killed_at and f", {1e3 * (event.at - killed_at):.0f} ms after the kill"
            return f"status {event['to']}{after or ''}"
        if name == "trial":
            how = "the peg is in" if event["success"] else "the peg is not in"
            return f"trial {event['trial']} ends after {event['steps']} steps: {how}"
        if name in _SENTENCES:
            is_local = event.fields.get("service") == RECOVERY_SERVICE
            who = "the local service" if is_local else "the cloud service"
            return _SENTENCES[name].format_map({**event.fields, "who": who})
        reason = f": {event['reason']}" if event.fields.get("reason") else ""
        return name.replace("_", " ") + reason

    # -- activities ----------------------------------------------------------------------------

    def _mark(self, row: Row, kind: Literal["start", "kill"], at: float, text: str) -> None:
        self._state.marks.append(Mark(at - self._state.began_at, row, kind))
        self._note_changes(at)
        self.say("demo", text, at)

    def _note_changes(self, at: float) -> None:
        """Note the activity of each row where it has changed."""
        at_s = at - self._state.began_at
        robot = self._testbed.robot_or_none
        cloud: Activity = "off"
        if not self._cloud.is_away:
            is_used = self._is_up and self.cloud_decides and not self._has_done_all
            up: Activity = "deciding" if is_used else "ready"
            cloud = "starting" if self._cloud.ready_at is None else up
        local = self._local
        if local == "ready" and self._is_up and not self.cloud_decides:
            local = "deciding"
        doing: Activity = "off"
        if robot is not None and not robot.process.killed and not robot.is_done:
            doing = "by_cloud" if self.cloud_decides else "by_local"
            doing = "held" if self._is_held else doing
            doing = doing if self._is_up else "starting"
            doing = "ready" if self._has_done_all else doing
        self._change("cloud", cloud, at_s)
        self._change("local", local, at_s)
        self._change("robot", doing, at_s)

    def _change(self, row: Row, activity: Activity, at_s: float) -> None:
        changes = self._state.changes[row]
        if (changes[-1].activity if changes else "off") != activity:
            changes.append(Change(at_s, activity))
