"""Robots whose cloud service is far away, is killed, and comes back: real processes, real times.

As in the thesis, a robot inserts its peg while the service that decides for it dies. It starts with
the cloud service; at a step that is drawn by seed that service is ended with SIGKILL; the robot
finds it dead, launches its local service and goes on with that; after some decisions the cloud is
started again and used again. In the end every decision is compared with those of the same trials
run in one process, without services and without anything that goes wrong.

What is measured is what the robot's process writes for everybody, and the service's ready line. All
processes are on one machine and write its one clock.
"""

from __future__ import annotations

import contextlib
import os
import random
import secrets
import shutil
import tempfile
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, TypeAlias

import msgspec

from holdfast.chaos.measures import FaultTimes, Strike, Told, times_of_strikes, told_of
from holdfast.chaos.processes import (
    ChildProcess,
    DecisionTable,
    Ended,
    Written,
    end_marked_processes,
)
from holdfast.chaos.twin import keep_undisturbed, run_undisturbed
from holdfast.chaos.wide_area import Path as NetworkPath
from holdfast.chaos.wide_area import Transport, lay_path
from holdfast.chaos.world import (
    Performance,
    WitnessedWorld,
    difference_of_performances,
    performances,
)
from holdfast.configuration import load as load_configuration
from holdfast.experiments.tables import Cell, Table
from holdfast.experiments.tasks import TaskError
from holdfast.files import write_atomically
from holdfast.recording.compare import compare_runs
from holdfast.recording.run_directory import TIMINGS_NAME
from holdfast.runtime.leash import leash
from holdfast.runtime.links import RECOVERY_SERVICE

__all__ = ["COLUMNS", "CloudTrials", "rows_of_run", "run_cloud_trials"]

COLUMNS = (
    "run",
    "what",
    "at_s",
    "trial",
    "step",
    "service",
    "status",
    "waited_ms",
    "round_trip_ms",
    "computed_ms",
    "found_ms",
    "first_local_ms",
    "launch_ms",
    "away_ms",
    "failback_ms",
    "identical",
    "emulated_by",
    "load",
    "rate_hz",
    "carried_bytes",
)
"""Of the table of such trials: a row for each decision, each kill and, if wanted, each task action.

``at_s`` counts from the run's first decision. A decision has what the robot's ``timings.csv`` has.
A kill has, in milliseconds: ``found_ms``, from the kill until the robot says that it has lost the
cloud; ``first_local_ms``, from then until it carries out a decision of the local service;
``launch_ms``, from the start of that service's process until the robot sees it (nothing, if it ran
before); ``away_ms``, from the kill until the ready line of the cloud that was started again;
``failback_ms``, from that line until the robot carries out a decision of it; and ``waited_ms``, the
longest time that it stood still for a decision until then. ``load`` is how many processes wanted a
core when the run began, over the minute before: times on a busy machine say little. ``rate_hz`` is
at how many task actions a second the robot really ran, ``carried_bytes`` the bytes of all packets
that were sent between robot and cloud from the start of the robot to its end, where packets are
seen.
"""

_PROBLEM = "peg_in_hole_2d"
_MAX_TRIALS = 100
_USUAL_START_S = 1.0
_MAX_SLOWNESS = 3.0

_EARLIEST_KILL, _LATEST_KILL = 0.15, 0.3
"""As fractions of the run's steps; the rest is for the local service and for the return."""

_TWIN, _DISTURBED = "undisturbed", "disturbed"

_MARK = "HOLDFAST_CLOUD_TRIALS"
_TURN_S = 0.005
_READY_S = 60.0
_STANDSTILL_S = 60.0
_LONGEST_S = 600.0
_END_S = 5.0


class CloudTrials(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Runs of one robot each, with the same settings.

    Attributes
    ----------
    particles : int
    transport : {"tcp", "tls", "udp"}
    round_trip_ms : float
        Of the emulated path; 0 is the machine's own loopback.
    loss : float
        Share of packets that the path loses, each way.
    first_run, runs : int
        Their numbers; each has worlds of its own.
    seed : int
    min_steps : int
        Trials are added to a run until it has as many task actions.
    rate_hz : float
        Task actions a second. On a machine where services start slowly it is less, down to a third,
        or the run would be over before all has happened.
    local_decisions : int
        Sensing actions that the local service chooses before the cloud is started again.
    max_steps, sensing_interval, num_observation_samples, num_nearest_neighbors : int
        The thesis's.
    num_cores : int
        Threads of a decision, at most.
    packets : bool
        Whether the path may be one for packets; see :mod:`holdfast.chaos.wide_area`.
    actions : bool
        Whether there is a row for each task action that was performed, too.
    kills : bool
        Whether the cloud is killed at all.
    """

    particles: int
    transport: Transport = "tcp"
    round_trip_ms: float = 0.0
    loss: float = 0.0
    first_run: int = 0
    runs: int = 1
    seed: int = 0
    min_steps: int = 400
    rate_hz: float = 100.0
    local_decisions: int = 8
    max_steps: int = 700
    sensing_interval: int = 8
    num_observation_samples: int = 10
    num_nearest_neighbors: int = 5
    num_cores: int = 8
    packets: bool = True
    actions: bool = False
    kills: bool = True


def run_cloud_trials(**trials: Any) -> Table:
    """Run them; the function of tasks of the kind ``cloud_trials``.

    Parameters
    ----------
    **trials
        The fields of :class:`CloudTrials`.

    Returns
    -------
    Table
        With the columns of :data:`COLUMNS`.

    Raises
    ------
    TaskError
        If a process ends that should not, or nothing goes on any more.
    HoldfastError
        If a process or the path cannot be had.
    """
    wanted = msgspec.convert(trials, CloudTrials)
    table = Table({name: [] for name in COLUMNS})
    seed = f"cloud trials {wanted.seed} {wanted.first_run}"
    with (
        tempfile.TemporaryDirectory(prefix="holdfast-experiment-") as directory,
        lay_path(
            wanted.transport, wanted.round_trip_ms, wanted.loss, seed, packets=wanted.packets
        ) as path,
        _Processes(wanted, Path(directory), path) as processes,
    ):
        for run in range(wanted.first_run, wanted.first_run + wanted.runs):
            table.extend(processes.run(run))
    return table


def rows_of_run(
    run: int,
    table: DecisionTable,
    fault: FaultTimes | None,
    struck_at: float | None,
    *,
    identical: bool,
    emulated_by: str,
    load: float | None = None,
    rate_hz: float | None = None,
    carried_bytes: int | None = None,
    performed: Iterable[Performance] = (),
) -> Table:
    """Return the rows of a run: its decisions, its kill, if there was one, and its actions.

    Parameters
    ----------
    run : int
    table : DecisionTable
        The robot's.
    fault : FaultTimes or None
    struck_at : float or None
        When the cloud was killed, in seconds since the epoch.
    identical : bool
        Whether all decisions and actions are those of the undisturbed run.
    emulated_by : str
    load : float or None
        Of the machine.
    rate_hz : float or None
        Of the robot.
    carried_bytes : int or None
        Between the robot and the cloud.
    performed : iterable of Performance
        Task actions to be listed.
    """
    began = table.rows[0].at
    ends: dict[str, Cell] = {
        "identical": identical,
        "emulated_by": emulated_by,
        "load": load,
        "rate_hz": rate_hz,
        "carried_bytes": carried_bytes,
    }
    rows: list[dict[str, Cell]] = [
        {
            "run": run,
            "what": each.kind,
            "at_s": round(each.at - began, 6),
            "trial": each.trial,
            "step": each.step,
            "service": "local" if each.service == RECOVERY_SERVICE else "cloud",
            "status": each.status,
            "waited_ms": each.waited_ms,
            "round_trip_ms": each.round_trip_ms,
            "computed_ms": each.computed_ms,
            **ends,
        }
        for each in table.rows
    ]
    if fault is not None and struck_at is not None:
        decided_ms = None
        if fault.recovery_ms is not None and fault.detection_ms is not None:
            decided_ms = round(max(0.0, fault.recovery_ms - fault.detection_ms), 3)
        rows.append(
            {
                "run": run,
                "what": "kill",
                "at_s": round(struck_at - began, 6),
                "waited_ms": fault.longest_wait_ms,
                "found_ms": fault.detection_ms,
                "first_local_ms": decided_ms,
                "launch_ms": fault.launch_ms,
                "away_ms": fault.away_ms,
                "failback_ms": fault.failback_ms,
                **ends,
            }
        )
    rows += [
        {
            "run": run,
            "what": "action",
            "at_s": round(each.at - began, 6),
            "trial": each.trial,
            "step": each.step,
            **ends,
        }
        for each in performed
    ]
    return Table({name: [row.get(name) for row in rows] for name in COLUMNS})


_Script: TypeAlias = Generator[Callable[[], bool], None, None]


class _Processes:
    """A cloud service, and one robot after another; the end of the ``with`` statement ends all."""

    def __init__(self, wanted: CloudTrials, directory: Path, path: NetworkPath) -> None:
        self._wanted = wanted
        self._directory = directory
        self._path = path
        self._happened: SimpleQueue[Written | Ended] = SimpleQueue()
        self._children: list[ChildProcess] = []
        self._cloud: ChildProcess | None = None
        self._cloud_ready_at: float | None = None
        self._slowness = 1.0
        self._robot: ChildProcess | None = None
        self._robot_done = False
        self._told: list[Told] = []
        self._mark = secrets.token_hex(16)
        # Short, because there are local sockets in it; and what a killed process leaves there goes.
        self._temporary = tempfile.mkdtemp(prefix="holdfast-")
        self._environment = {**os.environ, _MARK: self._mark, "TMPDIR": self._temporary}
        self._keys: Path | None = None

    def __enter__(self) -> _Processes:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            for child in self._children:
                child.process.kill()
            for child in self._children:
                child.close(0.0)
            # The local services end with their robot.
            end_marked_processes(_MARK, self._mark, _END_S)
        finally:
            shutil.rmtree(self._temporary, ignore_errors=True)

    def run(self, run: int) -> Table:
        """Run one robot, and return the rows of its run."""
        directory = self._directory / f"run-{run}"
        directory.mkdir()
        load = os.getloadavg()[0]
        steps_of_trials = self._run_twin(run, directory)
        if self._cloud is None or self._cloud.killed:
            self._start_cloud()
        self._await(lambda: self._cloud_ready_at is not None, "the cloud service", _READY_S)
        self._told = []
        self._robot_done = False
        with contextlib.closing(DecisionTable(directory / _DISTURBED / TIMINGS_NAME)) as table:
            rate_hz = self._wanted.rate_hz / self._slowness
            carried_before = self._carried_bytes()
            robot = self._start_robot(directory, rate_hz)
            chance = random.Random(f"kill {self._wanted.seed} {run}")
            strikes: list[Strike] = []
            kill_step = int(chance.uniform(_EARLIEST_KILL, _LATEST_KILL) * sum(steps_of_trials))
            turn_s = (self._wanted.sensing_interval + 1) / rate_hz
            pause_s = chance.uniform(0.0, turn_s)
            script = self._script(table, strikes, kill_step, pause_s, steps_of_trials)
            waiting = next(script)

            def done() -> bool:
                nonlocal waiting
                table.read()
                with contextlib.suppress(StopIteration):
                    while waiting():
                        waiting = next(script)
                return self._robot_done

            self._await(done, "the robot", _STANDSTILL_S, lambda: len(table.rows))
            robot.close(_END_S)
            table.read()
            comparison = compare_runs(directory / _TWIN, directory / _DISTURBED)
            difference = difference_of_performances(
                directory / f"{_TWIN}.txt", directory / f"{_DISTURBED}.txt"
            )
            faults = times_of_strikes(strikes, self._told, table.rows)
            rows = rows_of_run(
                run,
                table,
                faults[0] if faults else None,
                strikes[0].struck_at if strikes else None,
                identical=comparison.identical and difference is None,
                emulated_by=self._path.emulated_by,
                load=round(load, 2),
                rate_hz=round(rate_hz, 2),
                carried_bytes=self._carried_bytes(since=carried_before),
                performed=(
                    list(performances(directory / f"{_DISTURBED}.txt"))
                    if self._wanted.actions
                    else ()
                ),
            )
        self._children.remove(robot)
        shutil.rmtree(directory)
        return rows

    def _script(
        self,
        table: DecisionTable,
        strikes: list[Strike],
        kill_step: int,
        pause_s: float,
        steps_of_trials: list[int],
    ) -> _Script:
        """Say what is waited for next, and do what is due then."""
        if not self._wanted.kills:
            yield lambda: False

        def steps_done() -> int:
            if not table.rows:
                return -1
            last = table.rows[-1]
            return sum(steps_of_trials[: last.trial]) + last.step

        yield lambda: steps_done() >= kill_step and table.rows[-1].service == self._path.connect
        # The table grows when the robot gets an answer; a service dies at any moment between two.
        due = time.monotonic() + pause_s
        yield lambda: time.monotonic() >= due
        assert self._cloud is not None
        killed_at = self._cloud.kill()
        strike = Strike(kind="cloud_killed", target=self._path.connect, struck_at=killed_at)
        strikes.append(strike)

        def local_decisions() -> int:
            return sum(
                each.kind == "sensing" and each.service == RECOVERY_SERVICE and each.at > killed_at
                for each in table.rows
            )

        yield lambda: local_decisions() >= self._wanted.local_decisions
        self._start_cloud()
        yield lambda: self._cloud_ready_at is not None
        strike.usable_at = self._cloud_ready_at
        yield lambda: False

    def _carried_bytes(self, *, since: int | None = 0) -> int | None:
        carried = self._path.carried_bytes
        return None if carried is None or since is None else carried() - since

    # -- before --------------------------------------------------------------------------------

    def _run_twin(self, run: int, directory: Path) -> list[int]:
        """Run it in this process, without services, and see how long it is."""
        path = directory / "trials.yaml"
        self._write_configuration(path, run, _MAX_TRIALS)
        configuration = load_configuration(path)
        seed = configuration.simulator.seed
        with contextlib.ExitStack() as worlds:

            def world(trial: int) -> WitnessedWorld:
                performed = str(directory / f"{_TWIN}.txt")
                made = WitnessedWorld(performed, configuration.problem, seed, trial)
                worlds.callback(made.close)
                return made

            results, took_s = run_undisturbed(configuration, self._wanted.min_steps, world)
        self._write_configuration(path, run, len(results))
        keep_undisturbed(directory / _TWIN, load_configuration(path), results, took_s)
        return [result.steps for result in results]

    def _write_configuration(self, path: Path, run: int, num_trials: int) -> None:
        wanted = self._wanted
        offload: dict[str, Any] = {"services": [self._path.connect]}
        if wanted.transport != "tcp":
            offload["tls"] = str(self._credentials() / "robot")
        document = {
            "problem": _PROBLEM,
            "particle_filter": {"num_particles": wanted.particles},
            "active_sensing": {
                "num_observation_samples": wanted.num_observation_samples,
                "num_nearest_neighbors": wanted.num_nearest_neighbors,
                "num_cores": wanted.num_cores,
            },
            "selector": {"estimator": "nearest_neighbor"},  # the thesis's
            "simulator": {
                "num_trials": num_trials,
                "max_steps": wanted.max_steps,
                "sensing_intervals": wanted.sensing_interval,
                "seed": wanted.seed + run,
            },
            "offload": offload,
            # A witness of what is done to it. (And of a world of its own nobody draws a figure.)
            "environment": {
                "object": f"{WitnessedWorld.__module__}:{WitnessedWorld.__qualname__}",
                "arguments": {"path": str(path.parent / f"{_DISTURBED}.txt")},
            },
        }
        # JSON is YAML as well.
        write_atomically(path, msgspec.json.encode(document) + b"\n")

    def _credentials(self) -> Path:
        """Return the directory with keys for both ends."""
        if self._keys is None:
            from holdfast.transport.key_ring import make_credentials

            self._keys = self._directory / "keys"
            make_credentials(self._keys, hosts=[self._path.host])
        return self._keys

    # -- processes -----------------------------------------------------------------------------

    def _start_cloud(self) -> None:
        self._cloud_ready_at = None
        arguments = ["serve", "--listen", self._path.listen, "--log", "json"]
        if self._wanted.transport != "tcp":
            arguments += ["--tls", str(self._credentials() / "service")]
        elif self._path.service_prefix:
            arguments.append("--insecure")  # nobody else is in that network
        self._cloud = self._start(
            [*arguments, "--until-stdin-closes"], "cloud.log", self._path.service_prefix
        )

    def _start_robot(self, directory: Path, rate_hz: float) -> ChildProcess:
        self._robot = self._start(
            [
                *("run", str(directory / "trials.yaml"), "--log", "json"),
                *("--rate", f"{rate_hz:g}"),
                *("--out", str(directory / _DISTURBED)),
            ],
            "robot.log",
            (*self._path.robot_prefix, *leash()),
        )
        return self._robot

    def _start(self, arguments: list[str], log: str, prefix: tuple[str, ...]) -> ChildProcess:
        child = ChildProcess(
            arguments, self._directory / log, self._environment, self._happened.put, prefix
        )
        self._children.append(child)
        return child

    # -- what happens --------------------------------------------------------------------------

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
        while not done():
            now = time.monotonic()
            if progress() != seen:
                seen, moved_at = progress(), now
            if now - moved_at > limit_s:
                raise TaskError(f"{self._named()}: {what} did not go on for {now - moved_at:.0f} s")
            if now - began > _LONGEST_S:
                raise TaskError(f"{self._named()}: {what} was not done within {_LONGEST_S:.0f} s")
            for happened in self._news():
                self._note(happened)

    def _news(self) -> Iterator[Written | Ended]:
        with contextlib.suppress(Empty):
            yield self._happened.get(timeout=_TURN_S)
            while True:
                yield self._happened.get_nowait()

    def _note(self, happened: Written | Ended) -> None:
        child = happened.child
        if isinstance(happened, Ended):
            if child is self._robot and happened.code == 0:
                self._robot_done = True
            elif not child.killed:
                who = "robot" if child is self._robot else "cloud service"
                raise TaskError(
                    f"{self._named()}: the {who} ended with code {happened.code}: "
                    f"{child.last_words()}"
                )
            return
        told = told_of(happened.line)
        if told is None:
            return
        if child is self._robot:
            self._told.append(told)
        elif child is self._cloud and told.name == "ready":
            self._cloud_ready_at = told.at
            started_s = told.at - child.spawned_at
            self._slowness = min(_MAX_SLOWNESS, max(1.0, started_s / _USUAL_START_S))

    def _named(self) -> str:
        wanted = self._wanted
        return (
            f"cloud trials with {wanted.particles} particles over {wanted.transport}, "
            f"{wanted.round_trip_ms:g} ms, loss {wanted.loss:g}, seed {wanted.seed}"
        )
