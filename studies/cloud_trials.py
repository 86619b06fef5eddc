"""Robots whose cloud service is far away, is killed, and comes back: real processes, real times.

As in the thesis, a robot inserts its peg while the service that decides for it dies. It starts with
the cloud service, which is killed at a random step; the robot detects that, launches its local
service and goes on with it; after some decisions the cloud is started again and used again. In the
end every decision is compared with the reference run.
"""

from __future__ import annotations

import os
import random
import shutil
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

import msgspec
import pandas as pd

from holdfast.planning.settings import ActiveSensingSettings
from holdfast.reports.compare import compare_runs
from holdfast.robot.links import RECOVERY_SERVICE
from holdfast_lab.errors import NoProgressError, ProcessEndedError
from holdfast_lab.testbed.driver import Script, Testbed, after
from holdfast_lab.testbed.fault_times import FaultTimes, times_of_faults
from holdfast_lab.testbed.records import DecisionTable
from holdfast_lab.testbed.reference_run import make_reference_run
from holdfast_lab.testbed.wide_area import Route, Transport, lay_route
from holdfast_lab.testbed.world import (
    Performance,
    difference_of_performances,
    performances,
    witnessed_by,
)
from studies.errors import TaskError
from studies.tables import Cell

COLUMNS = (
    "run", "what", "at_s", "trial", "step", "service", "status", "waited_ms", "round_trip_ms",
    "computed_ms", "found_ms", "first_local_ms", "launch_ms", "away_ms", "failback_ms",
    "identical", "emulated_by", "load", "rate_hz", "carried_bytes",
)  # fmt: skip
"""Columns of such a table: a row for each decision, each kill and, if wanted, each task action.

``at_s`` counts from the run's first decision. A decision has what the robot's ``timings.csv`` has.
A kill has, in milliseconds: ``found_ms``, from the kill until the robot logs the loss of the
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

PROBLEM = "peg_in_hole_2d"
MAX_STEPS = 700
SENSING_INTERVAL = 8
SENSING = ActiveSensingSettings(num_observation_samples=10, num_nearest_neighbors=5, num_cores=8)
"""The thesis's settings."""

_USUAL_START_S = 1.0
_MAX_SLOWNESS = 3.0

_EARLIEST_KILL, _LATEST_KILL = 0.15, 0.3
"""As fractions of the run's steps; the rest is for the local service and for the return."""

_CONFIGURATION_NAME = "trials.yaml"
_REFERENCE, _WITH_KILL = "undisturbed", "disturbed"
_STALL_S = 60.0


class CloudTrials(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Runs of one robot each, with the same settings."""

    particles: int
    transport: Transport = "tcp"
    round_trip_ms: float = 0.0  # of the emulated path; 0 is the machine's own loopback
    loss: float = 0.0  # share of packets that the path loses, each way
    first_run: int = 0
    runs: int = 1  # each has worlds of its own
    seed: int = 0
    min_steps: int = 400  # trials are added to a run until it has as many task actions
    rate_hz: float = 100.0
    """Task actions a second. On a machine where services start slowly it is less, down to a third,
    or the run would be over before all has happened."""
    local_decisions: int = 8  # by the local service before the cloud is started again
    packets: bool = True  # a path for packets, if possible: holdfast_lab.testbed.wide_area
    actions: bool = False  # a row for each task action that was performed, too
    kills: bool = True
    what: Literal["sensing", "all"] = "all"  # which decisions the services make; the thesis's: all


def run_cloud_trials(**trials: Any) -> pd.DataFrame:
    """Run them; the function of tasks of the kind ``cloud_trials``.

    It gets the fields of :class:`CloudTrials`, and returns a table with the columns of
    :data:`COLUMNS`. TaskError if a process ends that should not, or nothing goes on any more.
    """
    wanted = msgspec.convert(trials, CloudTrials)
    seed = f"cloud trials {wanted.seed} {wanted.first_run}"
    try:
        with (
            tempfile.TemporaryDirectory(prefix="holdfast-") as directory,
            lay_route(
                wanted.transport, wanted.round_trip_ms, wanted.loss, seed, packets=wanted.packets
            ) as path,
            Testbed(Path(directory)) as testbed,
        ):
            series = _Series(wanted, testbed, path)
            runs = range(wanted.first_run, wanted.first_run + wanted.runs)
            return pd.concat([series.run(run) for run in runs], ignore_index=True)
    except (NoProgressError, ProcessEndedError) as error:
        raise TaskError(
            f"cloud trials with {wanted.particles} particles over {wanted.transport}, "
            f"{wanted.round_trip_ms:g} ms, loss {wanted.loss:g}, seed {wanted.seed}: {error}"
        ) from error


def rows_of_run(
    run: int,
    table: DecisionTable,
    fault: FaultTimes | None,
    killed_at: float | None,
    performed: Iterable[Performance] = (),
    **of_all: Cell,
) -> pd.DataFrame:
    """Return the rows of a run: its decisions, its kill, if there was one, and its actions.

    ``killed_at`` in seconds since the epoch. The columns ``of_all`` are the same in all rows.
    """
    began = table.rows[0].at
    rows: list[dict[str, Cell]] = [
        {
            "what": each.kind,
            "at_s": each.at - began,
            "trial": each.trial,
            "step": each.step,
            "service": "local" if each.service == RECOVERY_SERVICE else "cloud",
            "status": each.status,
            "waited_ms": each.waited_ms,
            "round_trip_ms": each.round_trip_ms,
            "computed_ms": each.computed_ms,
        }
        for each in table.rows
    ]
    if fault is not None and killed_at is not None:
        decided_ms = None
        if fault.recovery_ms is not None and fault.detection_ms is not None:
            decided_ms = round(max(0.0, fault.recovery_ms - fault.detection_ms), 3)
        rows.append(
            {
                "what": "kill",
                "at_s": killed_at - began,
                "waited_ms": fault.longest_wait_ms,
                "found_ms": fault.detection_ms,
                "first_local_ms": decided_ms,
                "launch_ms": fault.launch_ms,
                "away_ms": fault.away_ms,
                "failback_ms": fault.failback_ms,
            }
        )
    rows += [
        {"what": "action", "at_s": each.at - began, "trial": each.trial, "step": each.step}
        for each in performed
    ]
    listed = pd.DataFrame(rows, columns=list(COLUMNS)).assign(run=run, **of_all)
    return listed.assign(at_s=listed["at_s"].round(6))


class _Series:
    """A cloud service on a testbed, and one robot after another."""

    def __init__(self, wanted: CloudTrials, testbed: Testbed, path: Route) -> None:
        self._wanted = wanted
        self._testbed = testbed
        self._path = path
        self._keys: Path | None = None
        options: list[str] = []
        if wanted.transport != "tcp":
            from holdfast.transport.key_ring import make_credentials

            self._keys = testbed.temporary / "keys"
            make_credentials(self._keys, hosts=[path.host])
            options = ["--tls", str(self._keys / "service")]
        elif path.service_prefix:
            options = ["--insecure"]  # that network has no other members
        self._cloud = testbed.add_service(
            path.listen, *options, endpoint=path.connect, prefix=path.service_prefix
        )

    def run(self, run: int) -> pd.DataFrame:
        """Run one robot, and return the rows of its run."""
        wanted, testbed = self._wanted, self._testbed
        directory = testbed.directory / f"run-{run}"
        directory.mkdir()
        performed = {name: directory / f"{name}.txt" for name in (_REFERENCE, _WITH_KILL)}
        load = os.getloadavg()[0]
        reference = make_reference_run(
            directory / _REFERENCE,
            directory / _CONFIGURATION_NAME,
            self._configuration(directory, run),
            wanted.min_steps,
            performed[_REFERENCE],
        )
        if self._cloud.is_away:
            testbed.start_services()
        slowness = min(_MAX_SLOWNESS, max(1.0, self._cloud.start_s / _USUAL_START_S))
        rate_hz = wanted.rate_hz / slowness
        carried_before = self._carried_bytes()
        robot = testbed.start_robot(
            directory / _CONFIGURATION_NAME,
            directory / _WITH_KILL,
            reference.steps_of_trials,
            rate_hz,
            prefix=self._path.robot_prefix,
        )
        testbed.faults.clear()
        if wanted.kills:
            testbed.run_script(self._kill_and_restart(random.Random(f"kill {wanted.seed} {run}")))
        testbed.wait_for_end_of_run(_STALL_S)
        comparison = compare_runs(directory / _REFERENCE, directory / _WITH_KILL)
        difference = difference_of_performances(*performed.values())
        times = times_of_faults(testbed.faults, robot.events, robot.decisions)
        rows = rows_of_run(
            run,
            robot.table,
            times[0] if times else None,
            testbed.faults[0].injected_at if times else None,
            performed=list(performances(performed[_WITH_KILL])) if wanted.actions else (),
            identical=comparison.identical and difference is None,
            emulated_by=self._path.emulated_by,
            load=round(load, 2),
            rate_hz=round(rate_hz, 2),
            carried_bytes=self._carried_bytes(since=carried_before),
        )
        shutil.rmtree(directory)
        return rows

    def _kill_and_restart(self, chance: random.Random) -> Script:
        """Kill the cloud; start it again once the local service has decided for a while."""
        testbed, cloud, robot = self._testbed, self._cloud, self._testbed.robot
        kill_step = int(chance.uniform(_EARLIEST_KILL, _LATEST_KILL) * robot.steps)
        turn_s = (SENSING_INTERVAL + 1) / robot.rate_hz
        pause_s = chance.uniform(0.0, turn_s)
        yield (
            lambda: robot.steps_done >= kill_step and robot.decisions[-1].service == cloud.endpoint
        )
        # The table grows when the robot gets an answer; a service may die at any other moment too.
        yield after(pause_s)
        fault = testbed.note_fault("cloud_killed", cloud.endpoint, cloud.process.kill())

        def local_decisions() -> int:
            return sum(
                each.kind == "sensing"
                and each.service == RECOVERY_SERVICE
                and each.at > fault.injected_at
                for each in robot.decisions
            )

        yield lambda: local_decisions() >= self._wanted.local_decisions
        cloud.start()
        yield lambda: cloud.ready_at is not None
        fault.usable_at = cloud.ready_at

    def _carried_bytes(self, *, since: int | None = 0) -> int | None:
        carried = self._path.carried_bytes
        return None if carried is None or since is None else carried() - since

    def _configuration(self, directory: Path, run: int) -> dict[str, Any]:
        wanted = self._wanted
        offload: dict[str, Any] = {"services": [self._path.connect], "what": wanted.what}
        if self._keys is not None:
            offload["tls"] = str(self._keys / "robot")
        return {
            "problem": PROBLEM,
            "particle_filter": {"num_particles": wanted.particles},
            "active_sensing": {
                "num_observation_samples": SENSING.num_observation_samples,
                "num_nearest_neighbors": SENSING.num_nearest_neighbors,
                "num_cores": SENSING.num_cores,
            },
            # The thesis's.
            "selector": {"method": "action_entropy", "estimator": "nearest_neighbor"},
            "simulator": {
                "max_steps": MAX_STEPS,
                "sensing_intervals": SENSING_INTERVAL,
                "seed": wanted.seed + run,
            },
            "offload": offload,
            "environment": witnessed_by(directory / f"{_WITH_KILL}.txt"),
        }
