"""One trial: a robot and its services, the faults of a schedule, and a comparison.

The reference run tells how long the run is and what must be decided. The testbed runs the same
trials with services, injects the faults at their steps, and the two runs are compared.
"""

from __future__ import annotations

import contextlib
import threading
import time
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import msgspec

from holdfast.errors import HoldfastError
from holdfast.reports.compare import Comparison, compare_runs
from holdfast.runtime.files import write_atomically
from holdfast_lab.chaos.schedule import Schedule, Wire
from holdfast_lab.errors import CancelledTrialError, NoProgressError, ProcessEndedError
from holdfast_lab.testbed.driver import Testbed
from holdfast_lab.testbed.fault_times import FaultTimes, times_of_faults
from holdfast_lab.testbed.faults import FaultKind, inject
from holdfast_lab.testbed.namespace import NetworkNamespace
from holdfast_lab.testbed.processes import free_port
from holdfast_lab.testbed.proxy import Place, Proxy, endpoint_at
from holdfast_lab.testbed.reference_run import ReferenceRun, make_reference_run
from holdfast_lab.testbed.world import difference_of_performances, witnessed_by

Verdict: TypeAlias = Literal["identical", "diverged", "failed", "timed_out"]

_CONFIGURATION_NAME = "trial.yaml"
_SCHEDULE_NAME = "schedule.json"
_RUN_NAME = "disturbed"
_REFERENCE_NAME = "undisturbed"
_PERFORMED_NAME = "performed-{}.txt"
_CLOUD_LOG_NAME = "cloud-{}.log"

_MAX_STEPS = 90
_SENSING_INTERVALS = 3

_USUAL_START_S = 1.0
_MAX_SLOWNESS = 1.5
"""Where a service takes longer to start, the robot is slower too; otherwise its run would end
before all faults are injected."""

_STALL_S = 60.0
"""A run without a decision for so long has stalled. (A busy machine is slow.)"""


class Pace(NamedTuple):
    """The length and the speed of the robot's run."""

    min_steps: int = 150  # trials are added to the run until it has as many task actions
    rate_hz: float = 60.0  # task actions per second


class TrialOutcome(msgspec.Struct, frozen=True, kw_only=True):
    """The outcome of a trial."""

    trial: int
    kind: FaultKind
    wire: Wire
    # ``identical``: every decision and every performed action is that of the reference run.
    # ``diverged``: one is not. ``failed``: a process ended that should not, or one was left.
    # ``timed_out``: the robot decided nothing for a minute, or its run took over ten.
    verdict: Verdict
    reason: str  # why it is not ``identical``; otherwise empty
    launch: str
    faults: tuple[FaultTimes, ...]  # those that were injected before the robot's run was over
    # Of the robot's run, all of them compared.
    steps: int
    sensing_actions: int
    robots: int  # processes that the robot had
    took_s: float


def run_chaos_trial(
    schedule: Schedule, directory: Path, pace: Pace, cancelled: threading.Event
) -> TrialOutcome:
    """Run a trial in an empty directory, which gets both runs and all logs.

    Raises CancelledTrialError if it was cancelled; HoldfastError if it cannot be run at all.
    """
    began = time.monotonic()
    verdict: Verdict = "identical"
    reason = ""
    comparison: Comparison | None = None
    text = msgspec.json.format(msgspec.json.encode(schedule), indent=2)
    write_atomically(directory / _SCHEDULE_NAME, text + b"\n")

    def stop_if_cancelled() -> None:
        if cancelled.is_set():
            raise CancelledTrialError(f"trial {schedule.trial} is given up")

    with contextlib.ExitStack() as lines:
        namespace = None
        if schedule.needs_namespace:
            namespace = lines.enter_context(NetworkNamespace())
        prefix = () if namespace is None else namespace.prefix
        with Testbed(directory, on_turn=stop_if_cancelled, prefix=prefix) as testbed:
            keys = _add_services(testbed, schedule, lines, namespace)
            reference = _make_reference_run(testbed, schedule, pace.min_steps, keys)
            try:
                _run_with_faults(testbed, schedule, reference, pace.rate_hz)
            except ProcessEndedError as error:
                verdict, reason = "failed", str(error)
            except NoProgressError as error:
                verdict, reason = "timed_out", str(error)
    if verdict == "identical":
        verdict, reason, comparison = compare_with_reference(directory)
    if verdict == "identical" and testbed.left_behind:
        left = ", ".join(map(str, testbed.left_behind))
        verdict, reason = "failed", f"processes were left: {left}"
    robot = testbed.robot_or_none
    events = [] if robot is None else robot.events
    decisions = [] if robot is None else robot.decisions
    return TrialOutcome(
        trial=schedule.trial,
        kind=schedule.kind,
        wire=schedule.wire,
        verdict=verdict,
        reason=reason,
        launch=schedule.launch,
        faults=tuple(times_of_faults(testbed.faults, events, decisions)),
        steps=0 if comparison is None else comparison.task_actions,
        sensing_actions=0 if comparison is None else comparison.sensing_actions,
        robots=0 if robot is None else len(robot.processes),
        took_s=round(time.monotonic() - began, 3),
    )


def _run_with_faults(
    testbed: Testbed, schedule: Schedule, reference: ReferenceRun, rate_hz: float
) -> None:
    slowness = min(_MAX_SLOWNESS, max(1.0, testbed.start_services() / _USUAL_START_S))
    directory = testbed.directory
    testbed.start_robot(
        directory / _CONFIGURATION_NAME,
        directory / _RUN_NAME,
        reference.steps_of_trials,
        rate_hz / slowness,
    )
    for fault in schedule.faults:
        inject(testbed, fault)
    testbed.wait_for_end_of_run(_STALL_S)


def _add_services(
    testbed: Testbed,
    schedule: Schedule,
    lines: contextlib.ExitStack,
    namespace: NetworkNamespace | None,
) -> Path | None:
    """Add the services with proxies before them; return the directory of the keys, if any."""
    wire = schedule.wire
    keys = None
    options: list[str] = []
    if wire in ("tls", "udp"):
        from holdfast.transport.key_ring import make_credentials

        keys = testbed.temporary / "keys"
        make_credentials(keys)
        options = ["--tls", str(keys / "service")]

    def new_place(name: str) -> Place:
        return testbed.temporary / name if wire == "unix" else free_port()

    for number in range(schedule.num_clouds):
        place = entry = new_place(f"cloud-{number}")
        proxy = None
        if schedule.needs_proxy:
            entry = new_place(f"line-{number}")
            seed = f"{schedule.seed} {schedule.trial} {number}"
            proxy = lines.enter_context(Proxy(entry, place, seed, datagrams=wire == "udp"))
        testbed.add_service(
            endpoint_at(wire, place),
            *options,
            endpoint=endpoint_at(wire, entry),
            log_name=_CLOUD_LOG_NAME.format(number),
            proxy=proxy,
            namespace=namespace,
        )
    return keys


def _make_reference_run(
    testbed: Testbed, schedule: Schedule, min_steps: int, keys: Path | None
) -> ReferenceRun:
    directory = testbed.directory
    offload: dict[str, Any] = {"services": [service.endpoint for service in testbed.services]}
    offload["what"] = schedule.what
    if keys is not None:
        offload["tls"] = str(keys / "robot")
    if schedule.decision_deadline_ms is not None:
        offload["decision_deadline_ms"] = schedule.decision_deadline_ms

    document = {
        "problem": "peg_in_hole_2d",
        "particle_filter": {"num_particles": schedule.num_particles},
        "active_sensing": {"num_cores": 1},
        "simulator": {
            "max_steps": _MAX_STEPS,
            "sensing_intervals": _SENSING_INTERVALS,
            "seed": schedule.world_seed,
        },
        "offload": offload,
        "recovery": {"launch": schedule.launch},
        "environment": witnessed_by(directory / _PERFORMED_NAME.format(_RUN_NAME)),
    }
    return make_reference_run(
        directory / _REFERENCE_NAME,
        directory / _CONFIGURATION_NAME,
        document,
        min_steps,
        directory / _PERFORMED_NAME.format(_REFERENCE_NAME),
    )


def compare_with_reference(directory: Path) -> tuple[Verdict, str, Comparison | None]:
    """Compare the two runs of a trial; return the verdict, and why or what was compared."""
    performed = [directory / _PERFORMED_NAME.format(name) for name in (_REFERENCE_NAME, _RUN_NAME)]
    try:
        difference = difference_of_performances(*performed)
        comparison = compare_runs(directory / _REFERENCE_NAME, directory / _RUN_NAME)
    except HoldfastError as error:
        return "failed", str(error), None  # a fault has damaged a file
    if difference is not None:
        return "diverged", f"the world was acted on otherwise: {difference}", None
    if not comparison.identical:
        return "diverged", comparison.describe(), None
    return "identical", "", comparison
