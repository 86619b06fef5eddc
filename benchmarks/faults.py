"""What a robot loses when its service is killed, and how soon a new one is used."""

from __future__ import annotations

import random
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.common import Context
from benchmarks.processes import ServiceProcess
from benchmarks.report import Bar, Result, Table, milliseconds, paragraph
from benchmarks.robots import Notebook, configuration_for, robot_in_thread
from holdfast.robot.links import RECOVERY_SERVICE

__all__ = ["kills"]

# What was asked for.
FOUND_BAR_MS = 5.0
WARM_BAR_MS = 100.0
COLD_BAR_MS = 450.0
LAUNCH_BAR_MS = 90.0
USED_AGAIN_BAR_MS = 30.0

THESIS_LAUNCH_MS = 370.0
THESIS_TIMEOUT_MS = 5000.0

_FOREVER = 1_000_000
_PATIENCE_S = 30.0
_LATEST_KILL_S = 0.0015
"""After a request; by then a turn of 100 particles is computed."""
_LOST = ("service_vanished", "service_suspected")


class _Times:
    """What came of the kills, in seconds."""

    def __init__(self) -> None:
        self.found: list[float] = []
        self.struck: list[float] = []
        self.decided: list[float] = []
        self.launched: list[float] = []
        self.first_decision: list[float] = []
        self.used_after_ready: list[float] = []
        self.used_after_start: list[float] = []


def kills(context: Context) -> Result:
    """Kill the cloud again and again, in the middle of a robot's request."""
    number = 3 if context.quick else 30
    chance = random.Random(0)
    cold, warm = _Times(), _Times()
    _kill_cold(_Times(), chance)  # modules that were changed are compiled now
    for done in range(number):
        _kill_cold(cold, chance)
        context.progress(0.5 * (done + 1) / number)
    _kill_warm(warm, number, chance, lambda done: context.progress(0.5 + 0.5 * done / number))
    rows = []
    for what, cold_s, warm_s in (
        ("kill until found", cold.found, warm.found),
        ("delay of the struck decision", cold.struck, warm.struck),
        ("kill until the first local decision", cold.decided, warm.decided),
        ("launch until the local service is seen", cold.launched, []),
        ("launch until its first decision", cold.first_decision, []),
        ("cloud's ready line until it is used again", [], warm.used_after_ready),
        ("cloud's start until it is used again", [], warm.used_after_start),
    ):
        row = [what]
        for seconds in (cold_s, warm_s):
            if seconds:
                values = (np.median(seconds), np.percentile(seconds, 99), max(seconds))
                row += [milliseconds(float(value)) for value in values]
            else:
                row += ["", "", ""]
        rows.append(row)
    return Result(
        [
            paragraph(
                f"""A robot as fast as it goes, 100 particles, tcp on loopback; its cloud service is
                killed (SIGKILL) 0 to {1e3 * _LATEST_KILL_S:g} ms after a request was sent, so
                mostly while the robot stands still for the answer: {number} times with the local
                service launched on failure, a new robot each time, and {number} times with one
                kept warm, the cloud started again after each. Milliseconds. The struck decision is
                the first that the local service made; its delay is all that the robot waited for
                it. (The thesis: a timeout of {THESIS_TIMEOUT_MS:g} ms, then
                {THESIS_LAUNCH_MS:g} ms for the launch.)"""
            ),
            Table(
                (
                    "",
                    "cold launch, median",
                    "99 %",
                    "worst",
                    "warm, median",
                    "99 %",
                    "worst",
                ),
                rows,
            ),
        ],
        [
            _bar("cloud killed: found", [*cold.found, *warm.found], FOUND_BAR_MS),
            _bar("struck decision, warm recovery", warm.struck, WARM_BAR_MS),
            _bar("struck decision, cold launch", cold.struck, COLD_BAR_MS),
            _bar("cold launch: spawn to first decision", cold.first_decision, LAUNCH_BAR_MS),
            _bar(
                "restarted cloud: ready line to first decision used",
                warm.used_after_ready,
                USED_AGAIN_BAR_MS,
            ),
        ],
    )


def _kill_cold(times: _Times, chance: random.Random) -> None:
    with tempfile.TemporaryDirectory() as name, ServiceProcess() as cloud:
        directory = Path(name)
        configuration = configuration_for(
            directory, num_trials=_FOREVER, services=(cloud.endpoint,), launch="on_failure"
        )
        with robot_in_thread(configuration, directory) as notebook:
            notebook.wait_for(lambda: len(notebook.decided) > 20, "decisions of the cloud")
            killed_at = _kill_after_a_request(notebook, cloud, chance)
            _note_kill(times, notebook, cloud, killed_at)
            launch = notebook.first_event("launch", killed_at)
            launched = notebook.first_event("launched", killed_at)
            first = notebook.first_decided(RECOVERY_SERVICE, killed_at)
            assert launch is not None and launched is not None and first is not None
            times.launched.append(launched.at - launch.at)
            times.first_decision.append(first.at - launch.at)


def _kill_warm(
    times: _Times, number: int, chance: random.Random, progress: Callable[[int], None]
) -> None:
    with tempfile.TemporaryDirectory() as name, ServiceProcess() as cloud:
        directory = Path(name)
        configuration = configuration_for(
            directory, num_trials=_FOREVER, services=(cloud.endpoint,), launch="at_start"
        )
        with robot_in_thread(configuration, directory) as notebook:
            notebook.wait_for(
                lambda: notebook.first_event("launched", 0.0) is not None, "the local service"
            )
            for done in range(number):
                _kill_and_bring_back(times, notebook, cloud, chance)
                progress(done + 1)


def _kill_and_bring_back(
    times: _Times, notebook: Notebook, cloud: ServiceProcess, chance: random.Random
) -> None:
    before = len(notebook.decided)
    notebook.wait_for(lambda: len(notebook.decided) > before + 40, "decisions")
    killed_at = _kill_after_a_request(notebook, cloud, chance)
    _note_kill(times, notebook, cloud, killed_at)
    cloud.close()
    # The robot's attempts to connect come at their own times.
    time.sleep(chance.uniform(0.1, 0.5))
    started_at = cloud.start().process.spawned_at
    notebook.wait_for(
        lambda: notebook.first_decided(cloud.endpoint, started_at) is not None,
        "a decision of the cloud that was started again",
    )
    ready_at = cloud.wait_ready()
    used = notebook.first_decided(cloud.endpoint, started_at)
    assert used is not None
    times.used_after_ready.append(used.at - ready_at)
    times.used_after_start.append(used.at - started_at)


def _kill_after_a_request(
    notebook: Notebook, cloud: ServiceProcess, chance: random.Random
) -> float:
    """Kill the cloud with the robot's next request to it, or a moment after; return when."""
    asked = threading.Event()
    killed_at: list[float] = []
    # To wake another thread takes about as long as to compute a turn: half of them are killed here.
    at_once = chance.random() < 0.5

    def on_sent(service: str) -> None:
        if service == cloud.endpoint and not asked.is_set():
            if at_once:
                killed_at.append(cloud.process.kill())
            asked.set()

    notebook.on_sent = on_sent
    if not asked.wait(_PATIENCE_S):
        raise RuntimeError("the robot asks nothing")
    notebook.on_sent = None
    if at_once:
        return killed_at[0]
    time.sleep(chance.uniform(0.0, _LATEST_KILL_S))
    return cloud.process.kill()


def _note_kill(times: _Times, notebook: Notebook, cloud: ServiceProcess, killed_at: float) -> None:
    notebook.wait_for(
        lambda: notebook.first_decided(RECOVERY_SERVICE, killed_at) is not None,
        "a decision of the local service",
    )
    found = min(
        told.at
        for name in _LOST
        if (told := notebook.first_event(name, killed_at, service=cloud.endpoint)) is not None
    )
    first = notebook.first_decided(RECOVERY_SERVICE, killed_at)
    assert first is not None
    times.found.append(found - killed_at)
    times.decided.append(first.at - killed_at)
    times.struck.append(1e-3 * first.timing.waited_ms)


def _bar(what: str, seconds: list[float], limit_ms: float) -> Bar:
    return Bar(
        what,
        1e3 * float(np.median(seconds)),
        limit_ms,
        "ms",
        percentile_99=1e3 * float(np.percentile(seconds, 99)),
    )
