"""Kinds of fault, and what injecting each of them does to a testbed.

Each fault is a script that waits for its step, does something, waits, and undoes it. Scripts run
beside each other, so faults may overlap in any way.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable
from enum import StrEnum

import msgspec

from holdfast.robot.links import RECOVERY_SERVICE
from holdfast_lab.testbed.bad_line import Direction, Impairment
from holdfast_lab.testbed.driver import Script, Testbed, after
from holdfast_lab.testbed.fault_times import ROBOT
from holdfast_lab.testbed.processes import Process, local_services_of

_LOCAL_DECIDES_S = 5.0
"""How long the script that kills the local service waits for a decision of it."""


class FaultKind(StrEnum):
    """Kinds of fault, and of trials."""

    CLOUD_KILLED = "cloud_killed"
    CLOUD_STOPPED = "cloud_stopped"
    LOCAL_KILLED = "local_killed"
    ROBOT_KILLED = "robot_killed"
    ROBOT_STOPPED = "robot_stopped"
    REPLICAS_KILLED = "replicas_killed"
    LINK_DELAYED = "link_delayed"
    LINK_LOSSY = "link_lossy"
    LINK_SILENT = "link_silent"
    LINK_SILENT_ONE_WAY = "link_silent_one_way"
    LINK_CUT = "link_cut"
    PACKETS_LOST = "packets_lost"
    PACKETS_DROPPED = "packets_dropped"
    PACKETS_DROPPED_ONE_WAY = "packets_dropped_one_way"
    COMBINATION = "combination"


DESCRIPTIONS = {
    FaultKind.CLOUD_KILLED: "the cloud service is killed (SIGKILL) and started again",
    FaultKind.CLOUD_STOPPED: "the cloud service is stopped for a while (SIGSTOP, SIGCONT)",
    FaultKind.LOCAL_KILLED: "the local service is killed while the cloud is away",
    FaultKind.ROBOT_KILLED: "the robot's process is killed and resumed",
    FaultKind.ROBOT_STOPPED: "the robot's process is stopped for a while",
    FaultKind.REPLICAS_KILLED: "of two cloud services, one after the other is killed",
    FaultKind.LINK_DELAYED: "a proxy adds latency and jitter",
    FaultKind.LINK_LOSSY: "a proxy delivers late, as after lost packets",
    FaultKind.LINK_SILENT: "a proxy lets nothing through, and breaks no connection",
    FaultKind.LINK_SILENT_ONE_WAY: "a proxy lets nothing through in one direction",
    FaultKind.LINK_CUT: "a proxy resets all connections and refuses new ones",
    FaultKind.PACKETS_LOST: "nftables drops some packets, at random",
    FaultKind.PACKETS_DROPPED: "nftables drops all packets",
    FaultKind.PACKETS_DROPPED_ONE_WAY: "nftables drops all packets in one direction",
    FaultKind.COMBINATION: "several of these at once",
}


class Fault(msgspec.Struct, frozen=True, kw_only=True):
    """One fault."""

    kind: FaultKind
    at: float  # when, as a fraction of the run's steps
    # How long until the killed process is started again, the stopped one resumed, or the line
    # healed.
    duration_s: float
    cloud: int = 0  # which cloud service, or the line to which one
    direction: Direction = "both"
    latency_ms: float = 0.0
    jitter_ms: float = 0.0
    loss: float = 0.0  # share of packets, or of the pieces that a proxy carries


def _kill_cloud(testbed: Testbed, fault: Fault) -> Script:
    cloud = testbed.services[fault.cloud]
    if cloud.is_away:
        return  # the fault that killed it starts it again
    injected = testbed.note_fault(fault.kind.value, cloud.endpoint, cloud.process.kill())
    yield after(fault.duration_s)
    cloud.start()
    yield lambda: cloud.ready_at is not None
    injected.usable_at = cloud.ready_at


def _stop_cloud(testbed: Testbed, fault: Fault) -> Script:
    cloud = testbed.services[fault.cloud]
    if not cloud.is_away:
        yield from _stop(testbed, fault, cloud.process, cloud.endpoint)


def _stop_robot(testbed: Testbed, fault: Fault) -> Script:
    if not testbed.robot.process.killed:
        yield from _stop(testbed, fault, testbed.robot.process, ROBOT)


def _stop(testbed: Testbed, fault: Fault, process: Process, target: str) -> Script:
    injected = testbed.note_fault(fault.kind.value, target, process.stop())
    yield after(fault.duration_s)
    if not process.killed:
        injected.usable_at = process.resume()


def _kill_local(testbed: Testbed, fault: Fault) -> Script:
    """Kill all cloud services, and the local one once it decides."""
    away = [cloud for cloud in testbed.services if not cloud.is_away]
    for cloud in away:
        cloud.process.kill()
    killed_at = time.time()
    back = after(fault.duration_s)
    given_up = after(_LOCAL_DECIDES_S)

    def local_decides() -> bool:
        return any(
            each.service == RECOVERY_SERVICE and each.at >= killed_at
            for each in testbed.robot.decisions
        )

    yield lambda: given_up() or local_decides()
    robot = testbed.robot.process
    if not robot.killed:
        for pid in local_services_of(robot.pid):
            injected_at = time.time()
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
                testbed.note_fault(fault.kind.value, RECOVERY_SERVICE, injected_at)
    yield back
    for cloud in away:
        cloud.start()


def _kill_robot(testbed: Testbed, fault: Fault) -> Script:
    process = testbed.robot.process
    if process.killed:
        return
    injected_at = process.kill()
    yield lambda: process.process.poll() is not None
    if process.process.returncode == 0:
        return  # the run had ended
    injected = testbed.note_fault(fault.kind.value, ROBOT, injected_at)
    yield after(fault.duration_s)
    testbed.robot.resume()
    injected.usable_at = testbed.robot.process.spawned_at


def _impair_line(testbed: Testbed, fault: Fault) -> Script:
    proxy = testbed.services[fault.cloud].proxy
    assert proxy is not None
    impairment = Impairment(
        direction=fault.direction,
        latency_s=1e-3 * fault.latency_ms,
        jitter_s=1e-3 * fault.jitter_ms,
        loss=fault.loss,
        silent=fault.kind in (FaultKind.LINK_SILENT, FaultKind.LINK_SILENT_ONE_WAY),
        cut=fault.kind is FaultKind.LINK_CUT,
    )
    return _until_healed(testbed, fault, lambda: proxy.impair(impairment))


def _drop_packets(testbed: Testbed, fault: Fault) -> Script:
    cloud = testbed.services[fault.cloud]
    namespace, port = cloud.namespace, cloud.port
    assert namespace is not None
    share = fault.loss if fault.kind is FaultKind.PACKETS_LOST else 1.0
    return _until_healed(testbed, fault, lambda: namespace.drop(port, fault.direction, share))


def _until_healed(
    testbed: Testbed, fault: Fault, impair: Callable[[], Callable[[], None]]
) -> Script:
    endpoint = testbed.services[fault.cloud].endpoint
    injected = testbed.note_fault(fault.kind.value, endpoint, time.time())
    heal = impair()
    yield after(fault.duration_s)
    injected.usable_at = time.time()
    heal()


_SCRIPTS: dict[FaultKind, Callable[[Testbed, Fault], Script]] = {
    FaultKind.CLOUD_KILLED: _kill_cloud,
    FaultKind.CLOUD_STOPPED: _stop_cloud,
    FaultKind.LOCAL_KILLED: _kill_local,
    FaultKind.ROBOT_KILLED: _kill_robot,
    FaultKind.ROBOT_STOPPED: _stop_robot,
    FaultKind.REPLICAS_KILLED: _kill_cloud,
    FaultKind.LINK_DELAYED: _impair_line,
    FaultKind.LINK_LOSSY: _impair_line,
    FaultKind.LINK_SILENT: _impair_line,
    FaultKind.LINK_SILENT_ONE_WAY: _impair_line,
    FaultKind.LINK_CUT: _impair_line,
    FaultKind.PACKETS_LOST: _drop_packets,
    FaultKind.PACKETS_DROPPED: _drop_packets,
    FaultKind.PACKETS_DROPPED_ONE_WAY: _drop_packets,
}

NEEDS_PROXY = frozenset(kind for kind, script in _SCRIPTS.items() if script is _impair_line)

NEEDS_NAMESPACE = frozenset(kind for kind, script in _SCRIPTS.items() if script is _drop_packets)
"""Kinds that need nftables and a network namespace."""


def inject(testbed: Testbed, fault: Fault) -> None:
    """Have the testbed inject a fault once its robot has come to the fault's step."""

    def at_its_step() -> Script:
        step = int(fault.at * testbed.robot.steps)
        yield lambda: testbed.robot.steps_done >= step
        yield from _SCRIPTS[fault.kind](testbed, fault)

    testbed.run_script(at_its_step())
