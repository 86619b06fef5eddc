"""One trial: a robot, its services, what is done to them, and whether anything was lost but time.

Everything takes place in one loop that waits for nothing but what processes write. Each fault is a
small script that says, again and again, what it waits for next: a step of the robot, a moment, a
line of a service. So faults may overlap in any way, and none of them holds up another.

However a trial ends, none of its processes is left.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Generator
from pathlib import Path
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any, Literal, NamedTuple, Self, TypeAlias

import msgspec

from holdfast.chaos.measures import (
    ROBOT,
    FaultTimes,
    Strike,
    Told,
    times_of_strikes,
    told_of,
)
from holdfast.chaos.namespace import NetworkNamespace
from holdfast.chaos.processes import (
    ChildProcess,
    Decision,
    DecisionTable,
    Ended,
    Written,
    end_marked_processes,
    free_port,
    local_services_of,
)
from holdfast.chaos.proxy import Impairment, Place, Proxy
from holdfast.chaos.schedule import NEEDS_NAMESPACE, Fault, FaultKind, Schedule, Wire
from holdfast.chaos.twin import keep_undisturbed, run_undisturbed
from holdfast.chaos.world import WitnessedWorld, difference_of_performances
from holdfast.configuration import load
from holdfast.errors import HoldfastError
from holdfast.files import write_atomically
from holdfast.recording.compare import compare_runs
from holdfast.recording.run_directory import TIMINGS_NAME
from holdfast.runtime.leash import leash
from holdfast.runtime.links import RECOVERY_SERVICE

__all__ = ["CancelledTrialError", "Pace", "TrialOutcome", "Verdict", "run_chaos_trial"]

Verdict: TypeAlias = Literal["identical", "diverged", "failed", "timed_out"]

_MARK = "HOLDFAST_CHAOS_TRIAL"

_CONFIGURATION_NAME = "trial.yaml"
_SCHEDULE_NAME = "schedule.json"
_RUN_NAME = "disturbed"
_TWIN_NAME = "undisturbed"
_PERFORMED_NAME = "performed-{}.txt"
_ROBOT_LOG_NAME = "robot.log"
_CLOUD_LOG_NAME = "cloud-{}.log"

_MAX_TRIALS = 100
_MAX_STEPS = 90
_SENSING_INTERVALS = 3

_TURN_S = 0.008
"""How long the loop may sleep: by so much a fault may strike late."""

_READY_S = 60.0
_USUAL_START_S = 1.0
_MAX_SLOWNESS = 1.5
"""Where a service takes longer to start, the robot is slower too, or its run would be over before
all has happened."""

_STANDSTILL_S = 60.0
"""A run in which the robot decides nothing for so long does not end. (A busy machine is slow.)"""

_LONGEST_S = 600.0

_LOCAL_DECIDES_S = 5.0
_END_S = 5.0


class Pace(NamedTuple):
    """How long the robot's run is, and how fast.

    Attributes
    ----------
    min_steps : int
        Trials are added to the robot's run until it has as many task actions.
    rate_hz : float
        Task actions a second.
    """

    min_steps: int = 150
    rate_hz: float = 60.0


class TrialOutcome(msgspec.Struct, frozen=True, kw_only=True):
    """What a trial came to.

    Attributes
    ----------
    trial : int
    kind : FaultKind
    wire : str
    verdict : {"identical", "diverged", "failed", "timed_out"}
        ``identical``: every decision and every performed action is that of the twin. ``diverged``:
        one is not. ``failed``: a process ended that should not, or one was left. ``timed_out``: the
        robot decided nothing for a minute, or its run was not over after ten.
    reason : str
        Why it is not ``identical``; else empty.
    launch : str
        When the robot launches its local service.
    faults_planned : int
    faults : tuple of FaultTimes
        Those that struck before the robot's run was over.
    steps, sensing_actions : int
        Of the robot's run, all of them compared.
    robots : int
        Processes that the robot had.
    statuses : int
        Changes of the robot's status.
    took_s : float
    """

    trial: int
    kind: FaultKind
    wire: Wire
    verdict: Verdict
    reason: str
    launch: str
    faults_planned: int
    faults: tuple[FaultTimes, ...]
    steps: int
    sensing_actions: int
    robots: int
    statuses: int
    took_s: float


class CancelledTrialError(HoldfastError):
    """A trial was given up because the series is."""


class _TrialError(HoldfastError):
    """What ended a trial too early."""

    def __init__(self, verdict: Verdict, reason: str) -> None:
        super().__init__(reason)
        self.verdict: Verdict = verdict


def run_chaos_trial(
    schedule: Schedule, directory: Path, pace: Pace, cancelled: threading.Event
) -> TrialOutcome:
    """Run a trial.

    Parameters
    ----------
    schedule : Schedule
    directory : Path
        An empty one; gets both runs and all logs.
    pace : Pace
    cancelled : Event
        Once set, the trial is given up.

    Raises
    ------
    CancelledTrialError
        If it was.
    HoldfastError
        If it cannot be run at all.
    """
    began = time.monotonic()
    verdict: Verdict = "identical"
    reason = ""
    with _Trial(schedule, directory, pace, cancelled) as trial:
        try:
            trial.run()
        except _TrialError as error:
            verdict, reason = error.verdict, str(error)
    left = trial.left_behind
    if left and verdict == "identical":
        verdict, reason = "failed", f"processes were left: {', '.join(map(str, left))}"
    faults = times_of_strikes(trial.strikes, trial.told, trial.decisions)
    return TrialOutcome(
        trial=schedule.trial,
        kind=schedule.kind,
        wire=schedule.wire,
        verdict=verdict,
        reason=reason,
        launch=schedule.launch,
        faults_planned=len(schedule.faults),
        faults=tuple(faults),
        steps=trial.steps,
        sensing_actions=trial.sensing_actions,
        robots=trial.robots,
        statuses=sum(each.name == "status" for each in trial.told),
        took_s=round(time.monotonic() - began, 3),
    )


_Script: TypeAlias = Generator[Callable[[], bool], None, None]


class _Waiting:
    """A script, and what it waits for."""

    def __init__(self, script: _Script) -> None:
        self._script = script
        self._ready: Callable[[], bool] = lambda: True

    def advance(self) -> bool:
        """Go on as far as it can; False at its end."""
        try:
            while self._ready():
                self._ready = next(self._script)
        except StopIteration:
            return False
        return True


class _Trial:
    """A trial that is going on; the end of the ``with`` statement ends all of its processes."""

    def __init__(
        self, schedule: Schedule, directory: Path, pace: Pace, cancelled: threading.Event
    ) -> None:
        self._schedule = schedule
        self._directory = directory
        self._min_steps = pace.min_steps
        self._rate_hz = pace.rate_hz
        self._cancelled = cancelled
        self.strikes: list[Strike] = []
        self.told: list[Told] = []
        self.steps = 0
        self.sensing_actions = 0
        self.robots = 0
        self.left_behind: list[int] = []
        self._happened: SimpleQueue[Written | Ended] = SimpleQueue()
        self._table = DecisionTable(directory / _RUN_NAME / TIMINGS_NAME)
        self._stack = contextlib.ExitStack()
        self._children: list[ChildProcess] = []
        self._prefix: tuple[str, ...] = ()
        self._namespace: NetworkNamespace | None = None
        self._proxies: list[Proxy] = []
        self._listens_at: list[Place] = []
        self._endpoints: list[str] = []
        self._keys: Path | None = None
        self._clouds: dict[int, ChildProcess] = {}
        self._ready_at: dict[int, float] = {}
        self._robot: ChildProcess | None = None
        self._robot_code: int | None = None
        self._steps_of_trials: list[int] = []
        self._mark = secrets.token_hex(16)
        # Short, because there are local sockets in it; and what a killed process leaves there goes.
        self._temporary = tempfile.mkdtemp(prefix="holdfast-chaos-")
        self._environment = {**os.environ, _MARK: self._mark, "TMPDIR": self._temporary}

    @property
    def decisions(self) -> list[Decision]:
        """The robot's table."""
        return self._table.rows

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            for child in self._children:
                child.process.kill()
            for child in self._children:
                child.close(0.0)
            # The local services end with their robot.
            self.left_behind = end_marked_processes(_MARK, self._mark, _END_S)
        finally:
            self._stack.close()
            self._table.close()
            shutil.rmtree(self._temporary, ignore_errors=True)

    def run(self) -> None:
        """Run it to its end.

        Raises
        ------
        _TrialError
            If it does not come to the end that its twin came to.
        """
        self._lay_lines()
        self._run_twin()
        for cloud in range(self._schedule.num_clouds):
            self._start_cloud(cloud)
        self._await(
            lambda: len(self._ready_at) == len(self._clouds),
            "the cloud services did not become ready",
            _READY_S,
        )
        started_s = max(
            self._ready_at[number] - cloud.spawned_at for number, cloud in self._clouds.items()
        )
        self._rate_hz /= min(_MAX_SLOWNESS, max(1.0, started_s / _USUAL_START_S))
        self._start_robot()
        scripts = [_Waiting(self._script(fault)) for fault in self._schedule.faults]

        def done() -> bool:
            scripts[:] = [script for script in scripts if script.advance()]
            return self._robot_code is not None

        self._await(
            done,
            f"the robot's run of {sum(self._steps_of_trials)} steps did not go on",
            _STANDSTILL_S,
            lambda: (self.robots, len(self._table.rows)),
        )
        self._compare()

    # -- before and after ------------------------------------------------------------------------

    def _lay_lines(self) -> None:
        if self._schedule.needs_namespace:
            self._namespace = self._stack.enter_context(NetworkNamespace())
            self._prefix = self._namespace.prefix
        wire = self._schedule.wire
        if wire in ("tls", "udp"):
            from holdfast.transport.key_ring import make_credentials

            self._keys = Path(self._temporary) / "keys"
            make_credentials(self._keys)
        for number in range(self._schedule.num_clouds):
            place = self._new_place(f"cloud-{number}")
            entry = place
            if self._schedule.needs_proxy:
                entry = self._new_place(f"line-{number}")
                seed = f"{self._schedule.seed} {self._schedule.trial} {number}"
                proxy = Proxy(entry, place, seed, datagrams=wire == "udp")
                self._proxies.append(self._stack.enter_context(proxy))
            self._listens_at.append(place)
            self._endpoints.append(self._endpoint(entry))

    def _new_place(self, name: str) -> Place:
        return Path(self._temporary) / name if self._schedule.wire == "unix" else free_port()

    def _endpoint(self, place: Place) -> str:
        where = place if isinstance(place, Path) else f"127.0.0.1:{place}"
        return f"{self._schedule.wire}/{where}"

    def _run_twin(self) -> None:
        """Run it without faults, and see how long it is."""
        schedule = self._schedule
        path = self._directory / _CONFIGURATION_NAME
        write_atomically(
            self._directory / _SCHEDULE_NAME,
            msgspec.json.format(msgspec.json.encode(schedule), indent=2) + b"\n",
        )
        self._write_configuration(_MAX_TRIALS)
        configuration = load(path)
        seed = configuration.simulator.seed
        performed = str(self._directory / _PERFORMED_NAME.format(_TWIN_NAME))
        with contextlib.ExitStack() as worlds:

            def world(trial: int) -> WitnessedWorld:
                made = WitnessedWorld(performed, configuration.problem, seed, trial)
                worlds.callback(made.close)
                return made

            results, took_s = run_undisturbed(configuration, self._min_steps, world)
        self._steps_of_trials = [result.steps for result in results]
        self._write_configuration(len(results))
        keep_undisturbed(self._directory / _TWIN_NAME, load(path), results, took_s)

    def _write_configuration(self, num_trials: int) -> None:
        schedule = self._schedule
        offload: dict[str, Any] = {"services": self._endpoints}
        if self._keys is not None:
            offload["tls"] = str(self._keys / "robot")
        if schedule.decision_deadline_ms is not None:
            offload["decision_deadline_ms"] = schedule.decision_deadline_ms
        document = {
            "problem": "peg_in_hole_2d",
            "particle_filter": {"num_particles": schedule.num_particles},
            "active_sensing": {"num_cores": 1},
            "simulator": {
                "num_trials": num_trials,
                "max_steps": _MAX_STEPS,
                "sensing_intervals": _SENSING_INTERVALS,
                "seed": schedule.world_seed,
            },
            "offload": offload,
            "recovery": {"launch": schedule.launch},
            "environment": {
                "object": f"{WitnessedWorld.__module__}:{WitnessedWorld.__qualname__}",
                "arguments": {"path": str(self._performed_path)},
            },
        }
        # JSON is YAML as well.
        text = msgspec.json.format(msgspec.json.encode(document), indent=2)
        write_atomically(self._directory / _CONFIGURATION_NAME, text + b"\n")

    @property
    def _performed_path(self) -> Path:
        return (self._directory / _PERFORMED_NAME.format(_RUN_NAME)).resolve()

    def _compare(self) -> None:
        performed = self._directory / _PERFORMED_NAME.format(_TWIN_NAME)
        try:
            difference = difference_of_performances(performed, self._performed_path)
            comparison = compare_runs(self._directory / _TWIN_NAME, self._directory / _RUN_NAME)
        except HoldfastError as error:
            # What a fault has damaged is what this is about.
            raise _TrialError("failed", str(error)) from error
        if difference is not None:
            raise _TrialError("diverged", f"the world was acted on otherwise: {difference}")
        if not comparison.identical:
            raise _TrialError("diverged", comparison.describe())
        self.steps = comparison.task_actions
        self.sensing_actions = comparison.sensing_actions

    # -- processes -----------------------------------------------------------------------------

    def _start(
        self, arguments: list[str], log_name: str, prefix: tuple[str, ...] = ()
    ) -> ChildProcess:
        child = ChildProcess(
            arguments,
            self._directory / log_name,
            self._environment,
            self._happened.put,
            (*self._prefix, *prefix),
        )
        self._children.append(child)
        return child

    def _start_cloud(self, number: int) -> None:
        self._ready_at.pop(number, None)
        words = ["serve", "--listen", self._endpoint(self._listens_at[number]), "--log", "json"]
        if self._keys is not None:
            words += ["--tls", str(self._keys / "service")]
        self._clouds[number] = self._start(
            [*words, "--until-stdin-closes"],
            _CLOUD_LOG_NAME.format(number),
        )

    def _start_robot(self, *options: str) -> None:
        self.robots += 1
        self._robot = self._start(
            [
                *("run", str(self._directory / _CONFIGURATION_NAME)),
                *("--rate", f"{self._rate_hz:g}", "--log", "json"),
                *("--out", str(self._directory / _RUN_NAME), *options),
            ],
            _ROBOT_LOG_NAME,
            leash(),
        )

    def _await(
        self,
        done: Callable[[], bool],
        what: str,
        limit_s: float,
        progress: Callable[[], object] = lambda: None,
    ) -> None:
        """Take note of what happens until something is so; the limit begins anew with progress."""
        began = moved_at = time.monotonic()
        seen = progress()
        while True:
            self._table.read()
            if done():
                return
            if self._cancelled.is_set():
                raise CancelledTrialError(f"trial {self._schedule.trial} is given up")
            now = time.monotonic()
            if progress() != seen:
                seen, moved_at = progress(), now
            if now - moved_at > limit_s:
                raise _TrialError("timed_out", f"{what} within {limit_s:.0f} s")
            if now - began > _LONGEST_S:
                raise _TrialError("timed_out", f"it was not over after {_LONGEST_S:.0f} s")
            with contextlib.suppress(Empty):
                happened = self._happened.get(timeout=_TURN_S)
                while True:
                    if isinstance(happened, Written):
                        self._read_line(happened.child, happened.line)
                    else:
                        self._note_end(happened.child, happened.code)
                    happened = self._happened.get_nowait()

    def _note_end(self, child: ChildProcess, code: int) -> None:
        if child is self._robot and code == 0:
            self._robot_code = code
        elif not child.killed:
            who = ROBOT if child is self._robot else "cloud service"
            how = f"exit code {code}" if code >= 0 else signal.Signals(-code).name
            said = child.last_words()
            raise _TrialError(
                "failed", f"the {who} ended with {how}" + (f": {said}" if said else "")
            )

    def _read_line(self, child: ChildProcess, line: str) -> None:
        told = told_of(line)
        if told is None:
            return  # it is in the log
        if told.fields.get("component") == ROBOT:
            self.told.append(told)
        elif told.name == "ready":
            for number, cloud in self._clouds.items():
                if child is cloud:
                    self._ready_at[number] = told.at

    # -- faults --------------------------------------------------------------------------------

    def _steps_done(self) -> int:
        if not self._table.rows:
            return -1
        last = self._table.rows[-1]
        return sum(self._steps_of_trials[: last.trial]) + last.step

    def _script(self, fault: Fault) -> _Script:
        step = int(fault.at * sum(self._steps_of_trials))
        yield lambda: self._steps_done() >= step
        kind = fault.kind
        if kind in (FaultKind.CLOUD_KILLED, FaultKind.REPLICAS_KILLED):
            yield from self._kill_cloud(fault)
        elif kind is FaultKind.CLOUD_STOPPED:
            yield from self._stop_cloud(fault)
        elif kind is FaultKind.LOCAL_KILLED:
            yield from self._kill_local(fault)
        elif kind is FaultKind.ROBOT_KILLED:
            yield from self._kill_robot(fault)
        elif kind is FaultKind.ROBOT_STOPPED:
            yield from self._stop_robot(fault)
        else:
            yield from self._impair(fault)

    def _strike(self, kind: FaultKind, target: str, struck_at: float) -> Strike:
        strike = Strike(kind=kind.value, target=target, struck_at=struck_at)
        self.strikes.append(strike)
        return strike

    def _kill_cloud(self, fault: Fault) -> _Script:
        cloud = self._clouds[fault.cloud]
        if cloud.killed:
            return  # it is away already, and whoever killed it starts it again
        struck_at = cloud.kill()
        strike = self._strike(fault.kind, self._endpoints[fault.cloud], struck_at)
        yield _after(fault.duration_s)
        self._start_cloud(fault.cloud)
        yield lambda: fault.cloud in self._ready_at
        strike.usable_at = self._ready_at[fault.cloud]

    def _stop_cloud(self, fault: Fault) -> _Script:
        cloud = self._clouds[fault.cloud]
        if cloud.killed:
            return
        struck_at = cloud.stop()
        strike = self._strike(fault.kind, self._endpoints[fault.cloud], struck_at)
        yield _after(fault.duration_s)
        if not cloud.killed:
            strike.usable_at = cloud.resume()

    def _kill_local(self, fault: Fault) -> _Script:
        """Let no cloud be there, and kill the local service once it decides."""
        away = [number for number, cloud in self._clouds.items() if not cloud.killed]
        for number in away:
            self._clouds[number].kill()
        killed_at = time.time()
        back = _after(fault.duration_s)
        given_up = _after(_LOCAL_DECIDES_S)
        yield (
            lambda: (
                given_up()
                or any(
                    each.service == RECOVERY_SERVICE and each.at >= killed_at
                    for each in self._table.rows
                )
            )
        )
        robot = self._robot
        assert robot is not None
        if not robot.killed:
            for pid in local_services_of(robot.process.pid):
                struck_at = time.time()
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
                    self._strike(fault.kind, RECOVERY_SERVICE, struck_at)
        yield back
        for number in away:
            self._start_cloud(number)

    def _kill_robot(self, fault: Fault) -> _Script:
        robot = self._robot
        assert robot is not None
        if robot.killed:
            return
        struck_at = robot.kill()
        yield lambda: robot.process.poll() is not None
        if robot.process.returncode == 0:
            return  # it was faster
        strike = self._strike(fault.kind, ROBOT, struck_at)
        yield _after(fault.duration_s)
        # Only when all its lines are read, so that they stand in their order.
        robot.close(_END_S)
        self._start_robot("--resume")
        assert self._robot is not None
        strike.usable_at = self._robot.spawned_at

    def _stop_robot(self, fault: Fault) -> _Script:
        robot = self._robot
        assert robot is not None
        if robot.killed:
            return
        strike = self._strike(fault.kind, ROBOT, robot.stop())
        yield _after(fault.duration_s)
        if not robot.killed:
            strike.usable_at = robot.resume()

    def _impair(self, fault: Fault) -> _Script:
        strike = self._strike(fault.kind, self._endpoints[fault.cloud], time.time())
        if fault.kind in NEEDS_NAMESPACE:
            assert self._namespace is not None
            share = fault.loss if fault.kind is FaultKind.PACKETS_LOST else 1.0
            port = self._listens_at[fault.cloud]
            assert isinstance(port, int)
            heal = self._namespace.drop(port, fault.direction, share)
        else:
            heal = self._proxies[fault.cloud].impair(_impairment_of(fault))
        yield _after(fault.duration_s)
        strike.usable_at = time.time()
        heal()


def _after(duration_s: float) -> Callable[[], bool]:
    due = time.monotonic() + duration_s
    return lambda: time.monotonic() >= due


def _impairment_of(fault: Fault) -> Impairment:
    return Impairment(
        direction=fault.direction,
        latency_s=1e-3 * fault.latency_ms,
        jitter_s=1e-3 * fault.jitter_ms,
        loss=fault.loss,
        silent=fault.kind in (FaultKind.LINK_SILENT, FaultKind.LINK_SILENT_ONE_WAY),
        cut=fault.kind is FaultKind.LINK_CUT,
    )
