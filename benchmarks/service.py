"""What deciding elsewhere costs: time, bytes, and what the service itself takes of a machine.

Everything is on loopback, and what is compared runs in turns. The robots are the production code
(see robots.py); what has to be known of them is noted where they hand it over.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from benchmarks.common import Context
from benchmarks.echo import ECHO_BYTES, EchoClient
from benchmarks.measure import without_collection
from benchmarks.processes import (
    EchoProcess,
    ServiceProcess,
    pipe_round_trip_s,
    usage_of,
)
from benchmarks.report import Bar, Result, Table, milliseconds, paragraph
from benchmarks.robots import Notebook, configuration_for, run_robot
from benchmarks.turns import Asker, decided_in_process, recorded_turns
from holdfast.journal.journal import Journal
from holdfast.planning.inputs import ActingRecord, Moved, encode_floats
from holdfast.planning.outcome import TrialResult
from holdfast.planning.planner import Planner, digest, encode_checkpoint
from holdfast.protocol.messages import DIGEST_SIZE
from holdfast.robot.session_configuration import session_configuration_of
from holdfast.robot.trial import run_trial
from holdfast_lab.testbed.processes import free_port
from holdfast_lab.testbed.proxy import Proxy

__all__ = ["capacity", "offload", "paced", "robot_loop", "serve", "wire"]

# What was asked for.
MORE_BAR_MS = 0.3
ECHOES_BAR = 2.5
WHOLE_RUN_BAR_MS = 0.4
JOURNALLED_BAR = 1.4
ROUND_TRIPS_BAR = 1.0
WIRE_BAR_BYTES = 525.0
READY_BAR_MS = 90.0
IDLE_BAR_PERCENT = 2.0
RESIDENT_BAR_MB = 80.0
FLEET_BAR_MS = 30.0
FLEET = 100
LARGE_FLEET = 800
FLEET_RATE_HZ = 10.0

THESIS_MORE_MS = 6.0
RATE_HZ = 50.0
FAST_RATE_HZ = 200.0
PACED_ECHOES_BAR = 3.0

_LOAD = Path(__file__).with_name("load.py")
_MB = 1e6


# -- one question ------------------------------------------------------------------------------


def offload(context: Context) -> Result:
    """Compare single questions to a service with the same decisions in process, in turns."""
    num_trials = 3 if context.quick else 30
    num_alone = 20 if context.quick else 600
    kinds = ("steady", "bare", "task", "turn", "again", "echo")
    here: dict[str, list[float]] = {kind: [] for kind in kinds}
    there: dict[str, list[float]] = {kind: [] for kind in kinds}
    computed: dict[str, list[float]] = {kind: [] for kind in kinds}
    after_pause: list[float] = []

    def note(kind: str, here_s: float, there_s: float, computed_us: int) -> None:
        here[kind].append(here_s)
        there[kind].append(there_s)
        computed[kind].append(1e-6 * computed_us)

    with (
        tempfile.TemporaryDirectory() as directory,
        ServiceProcess() as service,
        EchoProcess() as echo,
    ):
        configuration = configuration_for(Path(directory), num_trials=1)
        problem, settings = configuration.problem, configuration.planning
        session_configuration = session_configuration_of(configuration)
        with (
            EchoClient(echo.port) as bare_echo,
            Asker(service.endpoint, session_configuration, b"is handed states") as stranger,
            Asker(service.endpoint, session_configuration, b"follows a robot.") as follower,
        ):
            for trial in range(num_trials + 1):
                for turn in recorded_turns(problem, settings, trial):
                    state = turn.sensing_state
                    checkpoint = encode_checkpoint(state)
                    start = time.perf_counter()
                    Planner(problem, settings).choose_sensing_action(state)
                    alone_s = time.perf_counter() - start
                    bare = stranger.ask(state, turn.sensing_digest, checkpoint=checkpoint)
                    again = stranger.ask(state, turn.sensing_digest)
                    start = time.perf_counter()
                    decided_in_process(problem, settings, turn)
                    whole_s = time.perf_counter() - start
                    whole = follower.ask(turn.state, turn.digest, turn.observations[-1:])
                    for asked in (bare, again, whole):
                        if asked.sensing is None or not turn.is_right(asked.sensing):
                            raise RuntimeError(f"wrong answer in trial {trial}")
                    if trial == 0:
                        continue  # the problem is built, memory is touched for the first time
                    assert bare.sensing is not None and whole.sensing is not None
                    note("bare", alone_s, bare.sensing_s, bare.sensing.computed_us)
                    note("again", 0.0, again.sensing_s, 0)
                    if whole.task is not None:
                        task_us = whole.task.computed_us
                        note("task", 0.0, whole.task_s, task_us)
                        sensing_us = whole.sensing.computed_us
                        note("turn", whole_s, whole.sensing_s, task_us + sensing_us)
                context.progress(0.8 * trial / num_trials)
            for trial in range(num_trials + 1, num_trials + 1 + num_alone):
                # A trial's first question is for a sensing action and nothing else. The service
                # makes the trial's first state, too, and holds its digest against the robot's.
                start = time.perf_counter()
                state = Planner(problem, settings).init(configuration.simulator.seed, trial)
                sensing_action, _ = Planner(problem, settings).choose_sensing_action(state)
                alone_s = time.perf_counter() - start
                state_digest = digest(state)[:DIGEST_SIZE]
                steady = follower.ask(state, state_digest)
                if steady.sensing is None or steady.sensing.sensing_action != sensing_action:
                    raise RuntimeError(f"wrong answer in trial {trial}")
                note("steady", alone_s, steady.sensing_s, steady.sensing.computed_us)
                # From the same pause, since a core that has slept is slower.
                Planner(problem, settings).choose_sensing_action(state)
                note("echo", 0.0, bare_echo.round_trip_s(), 0)
                time.sleep(0.001)
                start = time.perf_counter()
                Planner(problem, settings).choose_sensing_action(state)
                after_pause.append(time.perf_counter() - start)
    wakes_s = pipe_round_trip_s()
    rows = []
    for kind, what in (
        ("steady", "a sensing action"),
        ("bare", "a sensing action, the state handed over"),
        ("task", "a turn, until its task actions are there"),
        ("turn", "a turn, until its sensing action is there, too"),
        ("again", "what was asked before"),
        ("echo", "nothing: a bare echo over asyncio"),
    ):
        compared = any(here[kind])
        more = np.subtract(there[kind], here[kind])
        rows.append(
            [
                what,
                str(len(more)),
                milliseconds(float(np.median(here[kind]))) if compared else "",
                *_median_and_rare(there[kind]),
                milliseconds(float(np.median(computed[kind]))),
                *(_median_and_rare(more) if compared else ["", ""]),
            ]
        )
    bars = [
        _bar(f"{what}, 100 particles: more than in process", more, MORE_BAR_MS)
        for what, more in (
            ("sensing decision", np.subtract(there["steady"], here["steady"])),
            ("whole turn", np.subtract(there["turn"], here["turn"])),
        )
    ]
    more = np.subtract(there["steady"], here["steady"])
    bars.append(
        Bar(
            "sensing decision: more than in process, in bare echoes",
            float(np.median(more)) / float(np.median(there["echo"])),
            ECHOES_BAR,
            "times",
        )
    )
    return Result(
        [
            paragraph(
                f"""Milliseconds; 100 particles, peg_in_hole_2d, tcp on loopback, nothing else
                asked meanwhile. Each question is timed from before it is encoded until its answer
                is decoded, and the same is computed in process just before it; "more" is the
                difference of the two. A turn is what a robot asks at a time: fold an observation
                in, nine task actions, and the sensing action that comes after them. What was asked
                before is answered from the service's memory. A bare echo is {ECHO_BYTES} bytes to
                a process that sends back whatever comes and knows nothing of holdfast, both ends
                on an event loop of asyncio: what the system and the loop take by themselves. On
                this machine a byte that goes through a pipe to a process on another core and back
                takes {1e6 * wakes_s:.0f} microseconds, for two wake-ups. And a core that has slept
                computes slower: the same sensing action in process, a millisecond after the
                process last did something, takes
                {milliseconds(float(np.median(after_pause)))} ms.
                (The thesis's service cost {THESIS_MORE_MS:g} ms more.)"""
            ),
            Table(
                (
                    "question",
                    "asked",
                    "in process",
                    "service",
                    "99 %",
                    "computed there",
                    "more",
                    "more, 99 %",
                ),
                rows,
            ),
        ],
        bars,
    )


# -- whole runs --------------------------------------------------------------------------------


def robot_loop(context: Context) -> Result:
    """Compare whole trials: plainly in a loop, as a robot by itself, and as one with a service."""
    rounds, num_trials = (2, 4) if context.quick else (12, 10)
    per_turn: dict[str, list[float]] = {kind: [] for kind in ("loop", "own", "sensing", "all")}
    per_step: dict[str, list[float]] = {kind: [] for kind in per_turn}
    waited: dict[str, list[float]] = {kind: [] for kind in ("own", "all")}

    def note(kind: str, seconds: float, result: TrialResult) -> None:
        per_turn[kind].append(seconds / result.sensing_decisions)
        per_step[kind].append(seconds / result.steps)

    with tempfile.TemporaryDirectory() as directory, ServiceProcess() as service:
        for number in range(rounds):
            digests = []
            for kind in ("own", "sensing", "all"):
                own = Path(directory) / f"{kind}-{number}"
                own.mkdir()
                services = () if kind == "own" else (service.endpoint,)
                what = "sensing" if kind == "own" else kind
                configuration = configuration_for(
                    own, num_trials=num_trials, services=services, what=what
                )
                notebook = Notebook()
                run_robot(configuration, own, notebook)
                before = notebook.finished[0]
                for finished in notebook.finished[1:]:
                    note(kind, finished.at - before.at, finished.result)
                    before = finished
                if kind in waited:
                    waited[kind] += [
                        each.timing.waited_ms
                        for each in notebook.decided
                        if each.timing.kind == "task" and each.timing.trial > 0
                    ]
                digests.append([each.result.digest for each in notebook.finished])
            plain = []
            with without_collection():
                for trial in range(num_trials):
                    start = time.perf_counter()
                    result = run_trial(
                        Planner(configuration.problem, configuration.planning),
                        configuration.simulator.seed,
                        trial,
                        max_steps=configuration.simulator.max_steps,
                    )
                    if trial:
                        note("loop", time.perf_counter() - start, result)
                    plain.append(result.digest)
            if digests != [plain, plain, plain]:
                raise RuntimeError("the runs did not decide the same")
            context.progress(0.8 * (number + 1) / rounds)
        journal_rows = _journal_rows(Path(directory), 200 if context.quick else 3000)
    names = {
        "loop": "a plain loop (`run_trial`), nothing written down",
        "own": "a robot with its own planner, every step journalled",
        "sensing": "the same with a service for sensing actions (the default)",
        "all": "the same with a service for all actions",
    }
    rows = [
        [
            names[kind],
            *_median_and_rare(per_turn[kind]),
            *_median_and_rare(per_step[kind]),
            *(_median_and_rare(1e-3 * np.array(waited[kind])) if kind in waited else ["", ""]),
        ]
        for kind in per_turn
    ]
    more = np.subtract(per_turn["sensing"], per_turn["own"])
    of_all = np.subtract(per_turn["all"], per_turn["own"])
    rest = np.subtract(per_turn["own"], per_turn["loop"])
    return Result(
        [
            paragraph(
                f"""The same {num_trials - 1} trials of 100 particles, {rounds} times in turns,
                as fast as each goes; milliseconds of wall time of a trial, for each of its sensing
                steps (nine steps, but at a trial's end) and for each step, and what a robot stood
                still for task actions. All decide the same. At this rate the robot itself leaves
                the service hardly any time to compute ahead; see the next section for a rate that
                robots have. A sensing step of a robot with a service takes
                {_median_and_rare(more)[0]} ms more than of one with its own planner (median over
                trials, 99 %: {_median_and_rare(more)[1]}), {_median_and_rare(of_all)[0]} ms if the
                service decides all, and that of the own planner takes
                {_median_and_rare(rest)[0]} ms more than the plain loop."""
            ),
            Table(
                (
                    "trials",
                    "per sensing step",
                    "99 %",
                    "per step",
                    "99 %",
                    "waited for task actions",
                    "99 %",
                ),
                rows,
            ),
            "Writing two records of a step down, in microseconds:",
            Table(("what a step outlives", "median", "99 %"), journal_rows),
        ],
        [
            _bar(
                "whole runs, a sensing step: more than with its own planner",
                more,
                WHOLE_RUN_BAR_MS,
            ),
            Bar(
                "a journalled sensing step, in those of a plain loop",
                float(np.median(np.divide(per_turn["own"], per_turn["loop"]))),
                JOURNALLED_BAR,
                "times",
            ),
        ],
    )


def _journal_rows(directory: Path, number: int) -> list[list[str]]:
    rows = []
    kinds: tuple[Literal["process_crash", "power_cut"], ...] = ("process_crash", "power_cut")
    for survives in kinds:
        path = directory / f"{survives}.bin"
        seconds = []
        with Journal.create(path, {}, survives=survives) as journal:
            for step in range(number if survives == "process_crash" else number // 10):
                records = (
                    Moved(step, -0.1),
                    ActingRecord(step + 1, encode_floats([0.1, 0.1, 0.1])),
                )
                start = time.perf_counter()
                journal.append(0, records)
                seconds.append(time.perf_counter() - start)
        shown = [f"{1e6 * value:.3g}" for value in _quantiles(seconds[1:])]
        rows.append([f"`{survives}`", *shown])
    return rows


def _paced_echoes(context: Context, service: ServiceProcess) -> tuple[list[float], list[float]]:
    """Return round trips for task actions, less the computing, and bare echoes: seconds, paced."""
    trips, echoes = [], []
    with (
        tempfile.TemporaryDirectory() as directory,
        EchoProcess() as echo,
        EchoClient(echo.port) as bare,
    ):
        for number in range(1 if context.quick else 5):
            own = Path(directory) / str(number)
            own.mkdir()
            configuration = configuration_for(
                own, num_trials=4, services=(service.endpoint,), num_particles=300
            )
            notebook = Notebook()
            run_robot(configuration, own, notebook, FAST_RATE_HZ)
            timings = [each.timing for each in notebook.decided if each.timing.kind == "task"]
            trips += [
                1e-3 * (timing.round_trip_ms - timing.computed_ms)
                for timing in timings
                if timing.trial > 0 and timing.step > 0
            ]
            for _ in range(50):
                time.sleep(1.0 / FAST_RATE_HZ)
                echoes.append(bare.round_trip_s())
    return trips, echoes


def paced(context: Context) -> Result:
    """Run a robot at a rate at which robots move, and see what it waits for."""
    rounds, num_trials = (1, 1) if context.quick else (3, 3)
    kinds = ("own", "service")
    waited: dict[tuple[str, str], list[float]] = {
        (kind, part): [] for kind in kinds for part in ("sensing", "task")
    }
    trips: list[float] = []
    requests, turns, missed = 0, 0, dict.fromkeys(kinds, 0)
    steps = 0
    with tempfile.TemporaryDirectory() as directory, ServiceProcess() as service:
        for number in range(rounds):
            for kind, services in (("own", ()), ("service", (service.endpoint,))):
                own = Path(directory) / f"{kind}-{number}"
                own.mkdir()
                configuration = configuration_for(own, num_trials=num_trials, services=services)
                notebook = Notebook()
                robot = run_robot(configuration, own, notebook, RATE_HZ)
                missed[kind] += robot.robot.missed_ticks
                for each in notebook.decided:
                    timing = each.timing
                    if timing.step == 0:
                        continue  # nothing moves yet: a trial's first question cannot be foreseen
                    waited[kind, timing.kind].append(1e-3 * timing.waited_ms)
                    if (kind, timing.kind) == ("service", "task"):
                        trips.append(1e-3 * (timing.round_trip_ms - timing.computed_ms))
                if kind == "service":
                    requests += notebook.num_sent
                    turns += sum(each.result.sensing_decisions for each in notebook.finished)
                    # A trial's first question has no turn before it.
                    requests -= len(notebook.finished)
                    steps += sum(each.result.steps for each in notebook.finished)
            context.progress(0.7 * (number + 1) / rounds)
        fast, echoes = _paced_echoes(context, service)
    names = {"own": "its own planner", "service": "a service"}
    rows = []
    for (kind, part), seconds in waited.items():
        rows.append(
            [
                f"{part}, with {names[kind]}",
                str(len(seconds)),
                *_median_and_rare(seconds),
                milliseconds(max(seconds)),
            ]
        )
    more = float(np.median(waited["service", "task"])) - float(np.median(waited["own", "task"]))
    return Result(
        [
            paragraph(
                f"""Robots at {RATE_HZ:g} steps a second, with their own planner and with a service
                in turns: what they stood still for, in milliseconds, without the first question of
                a trial. The sensing action is computed while the robot moves, so it is there when
                it is needed; for the task actions after a sensing step it waits one round trip
                with the service's work on it (which it would wait for in process, too: more by
                {milliseconds(more)}). Without that work a round trip took
                {_median_and_rare(trips)[0]} ms. {requests} requests were sent for {turns} sensing
                steps. Ticks missed of {steps}: {missed["service"]} with a service,
                {missed["own"]} without. At {FAST_RATE_HZ:g} Hz and with 300 particles a round trip
                without that work took {_median_and_rare(fast)[0]} ms (99 %:
                {_median_and_rare(fast)[1]}), of which the first part is the robot's own: it folds
                its observation in and writes it down; a bare echo after a pause of
                {milliseconds(1.0 / FAST_RATE_HZ)} ms took {_median_and_rare(echoes)[0]} ms."""
            ),
            Table(("decision", "number", "waited, median", "99 %", "worst"), rows),
        ],
        [
            _bar(
                f"sensing decision at {RATE_HZ:g} Hz: waited",
                np.array(waited["service", "sensing"]),
                MORE_BAR_MS,
            ),
            Bar(
                f"task actions at {FAST_RATE_HZ:g} Hz: round trip less computing, in bare echoes",
                float(np.median(fast)) / float(np.median(echoes)),
                PACED_ECHOES_BAR,
                "times",
            ),
            Bar(
                "round trips that a robot waits for, a sensing step",
                requests / turns,
                ROUND_TRIPS_BAR,
                "",
            ),
        ],
    )


# -- the wire ----------------------------------------------------------------------------------


def wire(context: Context) -> Result:
    """Count the bytes between a robot and its service."""
    sizes = (100, 1000) if context.quick else (100, 1000, 10_000)
    idle_s = 1.0 if context.quick else 5.0
    rows, bars = [], []
    with tempfile.TemporaryDirectory() as directory, ServiceProcess() as service:
        for done, num_particles in enumerate(sizes):
            own = Path(directory) / str(num_particles)
            own.mkdir()
            with _counting_proxy(service) as (endpoint, carried):
                counted, up, seconds = _bytes_per_turn(own, num_particles, endpoint, carried)
            median, rare = _quantiles(counted)
            rows.append(
                [
                    f"{num_particles:,}",
                    str(len(counted)),
                    f"{median:.0f}",
                    f"{rare:.0f}",
                    f"{np.median(up):.0f}",
                    f"{median - np.median(up):.0f}",
                    f"{np.median(seconds) * 1e3:.1f}",
                ]
            )
            bars.append(
                Bar(
                    f"bytes of a sensing step, {num_particles:,} particles",
                    median,
                    WIRE_BAR_BYTES,
                    "bytes",
                    percentile_99=rare,
                )
            )
            context.progress((done + 1) / (len(sizes) + 1))
        with _counting_proxy(service) as (endpoint, carried):
            configuration = configuration_for(Path(directory), num_trials=1)
            with Asker(
                endpoint,
                session_configuration_of(configuration),
                b"only looks on...",
            ) as asker:
                before = carried.total()
                asker.pause(idle_s)
                keep_alive = (carried.total() - before) / idle_s
    return Result(
        [
            paragraph(
                f"""Between a robot and its service, all that TCP carries (headers of TCP and below
                left out), from one sensing step to the next, without the first two of a run; as
                fast as the robot goes. It does not depend on the number of particles. Beside it, a
                link on which nothing is asked carries {keep_alive:.0f} bytes a second to be kept
                alive (lease 400 ms); what of it falls into a sensing step is counted in."""
            ),
            Table(
                (
                    "particles",
                    "sensing steps",
                    "bytes, median",
                    "99 %",
                    "to the service",
                    "to the robot",
                    "ms a step",
                ),
                rows,
            ),
        ],
        bars,
    )


@contextlib.contextmanager
def _counting_proxy(service: ServiceProcess) -> Iterator[tuple[str, Counter[str]]]:
    """Yield the endpoint of a proxy before a service, and the bytes that it carries each way."""
    carried: Counter[str] = Counter()
    proxy = Proxy(
        free_port(),
        service.port,
        "wire",
        overhear=lambda _, way, piece: carried.update({way: len(piece)}),
    )
    with proxy:
        yield f"tcp/127.0.0.1:{proxy.place}", carried


def _bytes_per_turn(
    directory: Path, num_particles: int, endpoint: str, carried: Counter[str]
) -> tuple[list[float], list[float], list[float]]:
    """Return the bytes of each sensing step both ways and upwards, and the seconds of each."""
    configuration = configuration_for(
        directory,
        num_trials=4 if num_particles < 10_000 else 2,
        services=(endpoint,),
        num_particles=num_particles,
    )
    notebook = Notebook()
    cuts: list[tuple[int, int, float]] = []
    notebook.on_decided = lambda timing: (
        cuts.append((carried.total(), carried["to_service"], time.monotonic()))
        if timing.kind == "sensing"
        else None
    )
    run_robot(configuration, directory, notebook)
    differences = np.diff(np.array(cuts[2:]), axis=0)
    both, up, seconds = differences.T.tolist()
    return both, up, seconds


# -- the process -------------------------------------------------------------------------------


def serve(context: Context) -> Result:
    """Measure how soon ``holdfast serve`` is there, and what it takes while nobody asks."""
    starts = 3 if context.quick else 25
    idle_s = 2.0 if context.quick else 10.0
    ready_s = []
    with ServiceProcess():
        pass  # modules that were changed are compiled now
    for number in range(starts):
        with ServiceProcess() as service:
            ready_s.append(service.start_s)
        context.progress(0.4 * (number + 1) / starts)
    rows = []
    idle: dict[str, tuple[float, float]] = {}

    def watch(what: str, pause: Callable[[float], None]) -> None:
        pause(1.5)
        before = usage_of(service.process.pid)
        pause(idle_s)
        after = usage_of(service.process.pid)
        percent = 100.0 * (after.cpu_s - before.cpu_s) / idle_s
        idle[what] = (percent, after.resident_bytes / _MB)
        rows.append(
            [what, f"{percent:.2f}", f"{after.resident_bytes / _MB:.1f}", str(after.threads)]
        )

    with tempfile.TemporaryDirectory() as directory, ServiceProcess() as service:
        configuration = configuration_for(Path(directory), num_trials=1)
        watch("nobody there", time.sleep)
        with Asker(
            service.endpoint, session_configuration_of(configuration), b"looks on, silent"
        ) as asker:
            watch("one robot there, silent", asker.pause)
            for turn in recorded_turns(configuration.problem, configuration.planning, 0):
                asker.ask(turn.state, turn.digest, turn.observations[-1:])
            watch("the same, after a trial", asker.pause)
        context.progress(1.0)
    median, rare = _quantiles(ready_s)
    return Result(
        [
            paragraph(
                f"""`holdfast serve` on loopback. From its start to its ready line: median
                {milliseconds(median)} ms, 99 % {milliseconds(rare)} ms, fastest
                {milliseconds(min(ready_s))} ms of {starts}. Then, over {idle_s:g} s each:"""
            ),
            Table(("while idle", "CPU, % of a core", "resident, MB", "threads"), rows),
        ],
        [
            _bar("`holdfast serve`: start to ready line", np.array(ready_s), READY_BAR_MS),
            Bar("idle: CPU", max(cpu for cpu, _ in idle.values()), IDLE_BAR_PERCENT, "%"),
            Bar("idle: memory", max(size for _, size in idle.values()), RESIDENT_BAR_MB, "MB"),
        ],
    )


# -- many robots -------------------------------------------------------------------------------


def capacity(context: Context) -> Result:
    """Let one service decide for many robots, for as many as it holds and for four times that."""
    warm_up_s, seconds = (1.0, 2.0) if context.quick else (3.0, 15.0)

    def measured(processes: int, **arguments: Any) -> dict[str, Any]:
        with ServiceProcess("--processes", str(processes)) as service:
            return _load(service, warm_up_s=warm_up_s, seconds=seconds, **arguments)

    rows, bars = [], []
    fleets = (FLEET, 4 * FLEET) if context.quick else tuple(FLEET * k for k in (1, 2, 3, 4))
    cases = [
        *((1, count, 8, FLEET_RATE_HZ / 9.0) for count in (*fleets, LARGE_FLEET)),
        (2, LARGE_FLEET, 8, FLEET_RATE_HZ / 9.0),
        *((1, count, interval, FLEET_RATE_HZ) for interval in (0, 8) for count in fleets),
    ]
    barred = {(1, FLEET, 0), (1, FLEET, 8), (2, LARGE_FLEET, 8)}
    wrong = 0
    for done, (processes, count, interval, rate_hz) in enumerate(cases):
        found = measured(
            processes,
            num_robots=count,
            num_links=count,
            rate_hz=rate_hz,
            sensing_interval=interval,
        )
        wrong += found["wrong"]
        asked = max(1, found["sent"])
        rows.append(
            [
                f"{count} x {rate_hz:.3g} turns of {interval + 1} + 1",
                str(processes),
                f"{found['complete'] / found['wall_s']:.0f}",
                f"{found['busy'] / asked:.1%}",
                *(_both(found[part]) for part in ("task", "sensing")),
                str(found["wrong"]),
                str(found["lost"]),
                f"{found['service_cores']:.2f}",
                f"{found['own_cores']:.2f}",
                f"{found['skipped'] / (asked + found['skipped']):.1%}",
            ]
        )
        if (processes, count, interval) in barred:
            bars.append(
                Bar(
                    f"{count} robots, each {rate_hz:.3g} turns a second, of {interval + 1} task "
                    f"action{'s' if interval else ''} and 1 sensing action, "
                    f"{processes} process{'es' if processes > 1 else ''}: 99 % of whole answers",
                    1e3 * found["sensing"]["percentile_99"],
                    FLEET_BAR_MS,
                    "ms",
                )
            )
        context.progress((done + 1) / (len(cases) + 1))
    told, differing = _robot_in_a_crowd(seconds)
    bars.append(Bar("answers that are wrong, at any load", wrong, 0.0, ""))
    bars.append(Bar("runs that decide otherwise, at four times the load", differing, 0.0, ""))
    return Result(
        [
            paragraph(
                """One service and its load on the same two cores. Each robot has a session and a
                link of its own, and asks in regular turns; every answer is held against the one
                that was computed in process before. A turn of 9 + 1 is an observation to be folded
                in, nine task actions and a sensing action: the published sensing interval of 8. So
                1.11 such turns a second are a robot of ten steps a second, ten are one of 90. A
                turn of 1 + 1 is of a robot that senses at every step. Times are milliseconds from
                the request to each part of the answer, median / 99 %. A robot whose last answer is
                not complete lets its turn pass. Calls that ended without an answer are lost: a
                robot asks again, or elsewhere. The load itself used the cores of the column
                "load"."""
            ),
            Table(
                (
                    "robots",
                    "processes",
                    "answered/s",
                    "busy",
                    "task actions",
                    "whole answer",
                    "wrong",
                    "lost",
                    "service, cores",
                    "load, cores",
                    "turns passed",
                ),
                rows,
            ),
            told,
        ],
        bars,
    )


def _load(service: ServiceProcess, **arguments: Any) -> dict[str, Any]:
    with _loaded(service, **arguments) as process:
        output, errors = process.communicate()
    if process.returncode:
        raise RuntimeError(errors)
    found: dict[str, Any] = json.loads(output)
    return found


def _loaded(service: ServiceProcess, **arguments: Any) -> subprocess.Popen[str]:
    request = {"endpoint": service.endpoint, "process_ids": service.process_ids, **arguments}
    return subprocess.Popen(
        [sys.executable, str(_LOAD), json.dumps(request)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def _robot_in_a_crowd(seconds: float) -> tuple[str, int]:
    """Run a robot to its end while many others overload its service."""
    with tempfile.TemporaryDirectory() as directory, ServiceProcess() as service:
        configuration = configuration_for(
            Path(directory), num_trials=3, services=(service.endpoint,), launch="on_failure"
        )
        crowd = _loaded(
            service,
            num_robots=4 * FLEET,
            num_links=4 * FLEET,
            rate_hz=FLEET_RATE_HZ,
            sensing_interval=8,
            warm_up_s=1.0,
            seconds=seconds,
        )
        try:
            notebook = Notebook()
            time.sleep(3.0)  # the crowd is there
            run_robot(configuration, Path(directory), notebook)
        finally:
            crowd.kill()
            crowd.communicate()
    differing = 0
    for trial, finished in enumerate(notebook.finished):
        alone = run_trial(
            Planner(configuration.problem, configuration.planning),
            configuration.simulator.seed,
            trial,
            max_steps=configuration.simulator.max_steps,
        )
        differing += finished.result.digest != alone.digest
    told = [each.name for each in notebook.events]
    by_service = [each.timing.service for each in notebook.decided]
    return (
        paragraph(
            f"""A robot that ran {len(notebook.finished)} trials amid {4 * FLEET} others was told
            `busy` {told.count("busy")} times, and its local service made
            {sum(name != service.endpoint for name in by_service)} of {len(by_service)} decisions;
            {differing} trials decided otherwise than alone."""
        ),
        differing,
    )


# -- numbers -----------------------------------------------------------------------------------


def _quantiles(values: Sequence[float] | npt.NDArray[np.float64]) -> tuple[float, float]:
    return float(np.median(values)), float(np.percentile(values, 99))


def _median_and_rare(seconds: Sequence[float] | npt.NDArray[np.float64]) -> list[str]:
    return [milliseconds(value) for value in _quantiles(seconds)]


def _both(found: dict[str, float]) -> str:
    return f"{milliseconds(found['median'])} / {milliseconds(found['percentile_99'])}"


def _bar(what: str, seconds: npt.NDArray[np.float64], limit_ms: float) -> Bar:
    median, rare = _quantiles(seconds)
    return Bar(what, 1e3 * median, limit_ms, "ms", percentile_99=1e3 * rare)
