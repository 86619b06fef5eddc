"""``holdfast chaos`` with real processes: what it finds, what it leaves, and how it ends.

What it makes of two runs: lab/tests/test_chaos_trial.py.
"""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec
import pytest
from tests.command_line import run_here
from tests.marked_command import PATIENCE_S, MarkedCommand
from tests.process_states import state_of

from holdfast_lab.chaos.schedule import WIRES, Schedule, Wire, kinds_over
from holdfast_lab.chaos.trial import Pace, TrialOutcome, run_chaos_trial
from holdfast_lab.testbed.faults import NEEDS_NAMESPACE, Fault, FaultKind
from holdfast_lab.testbed.world import performances

COMMAND = (sys.executable, "-m", "holdfast", "chaos")
BRIEF = Pace(min_steps=60, rate_hz=60.0)


def schedule_of(
    *faults: Fault, kind: FaultKind, num_clouds: int = 1, wire: Wire = "tcp"
) -> Schedule:
    return Schedule(
        seed=0,
        trial=0,
        kind=kind,
        wire=wire,
        world_seed=11,
        num_particles=30,
        num_clouds=num_clouds,
        launch="on_failure",
        decision_deadline_ms=None,
        what="all",
        faults=faults,
    )


def run(schedule: Schedule, directory: Path, pace: Pace = BRIEF) -> TrialOutcome:
    return run_chaos_trial(schedule, directory, pace, threading.Event())


# Over udp there are all parts of a chaos run: proxies for a stream and for datagrams, and TLS.
@pytest.mark.parametrize(
    "wire",
    ["udp", *(pytest.param(wire, marks=pytest.mark.slow) for wire in WIRES if wire != "udp")],
)
def test_a_cloud_and_a_robot_are_killed(tmp_path: Path, wire: Wire) -> None:
    """Both in one run; the robot goes on in a new process, and nothing is done twice."""
    schedule = schedule_of(
        Fault(kind=FaultKind.CLOUD_KILLED, at=0.1, duration_s=0.3),
        Fault(kind=FaultKind.ROBOT_KILLED, at=0.3, duration_s=0.0),
        kind=FaultKind.COMBINATION,
        wire=wire,
    )
    outcome = run(schedule, tmp_path)
    assert outcome.verdict == "identical", outcome.reason
    assert outcome.reason == ""
    assert [fault.kind for fault in outcome.faults] == ["cloud_killed", "robot_killed"]
    assert outcome.faults[0].detection_ms is not None
    assert outcome.faults[1].recovery_ms is not None
    assert outcome.robots == 2
    assert outcome.steps >= 60
    performed = list(performances(tmp_path / "performed-disturbed.txt"))
    assert len(performed) == outcome.steps
    assert len({each.process for each in performed}) == 2


def test_a_robot_that_ends_by_itself_has_failed(tmp_path: Path) -> None:
    def kill_the_robot() -> None:
        path = tmp_path / "performed-disturbed.txt"
        deadline = time.monotonic() + PATIENCE_S
        while not path.exists() or not path.stat().st_size:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        os.kill(next(performances(path)).process, signal.SIGKILL)

    killer = threading.Thread(target=kill_the_robot)
    killer.start()
    outcome = run(schedule_of(kind=FaultKind.COMBINATION), tmp_path, Pace(200, 40.0))
    killer.join()
    assert outcome.verdict == "failed"
    assert outcome.reason.startswith("the robot ended with SIGKILL")


@pytest.mark.slow
def test_a_run_that_does_not_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("holdfast_lab.chaos.trial._STALL_S", 8.0)
    stop = Fault(kind=FaultKind.ROBOT_STOPPED, at=0.1, duration_s=1000.0)
    outcome = run(schedule_of(stop, kind=FaultKind.ROBOT_STOPPED), tmp_path)
    assert outcome.verdict == "timed_out"
    assert outcome.reason.startswith("waited 8 s in vain for the next of ")
    # Stopped or not, nothing is left.
    mark = next(iter(performances(tmp_path / "performed-disturbed.txt"))).process
    assert not Path(f"/proc/{mark}").exists()


class Chaos(MarkedCommand):
    def __init__(self, directory: Path, *arguments: str) -> None:
        super().__init__(directory, "chaos", *arguments)


@pytest.fixture
def started(tmp_path: Path) -> Iterator[list[Chaos]]:
    chaoses: list[Chaos] = []
    yield chaoses
    for chaos in chaoses:
        chaos.close()


def only(kinds: Sequence[FaultKind]) -> list[str]:
    return [word for kind in kinds for word in ("--only", kind.value)]


@pytest.mark.slow
@pytest.mark.parametrize("wire", WIRES)
def test_every_kind_of_fault(tmp_path: Path, started: list[Chaos], wire: Wire) -> None:
    possible = set(kinds_over(wire, tuple(FaultKind)))
    trials = str(len(possible))
    chaos = Chaos(tmp_path, *("--trials", trials, "--seed", "3", "--jobs", "2", "--wire", wire))
    started.append(chaos)
    output, errors = chaos.end()
    assert chaos.process.returncode == 0, output + errors
    assert not chaos.others()
    assert sorted(path.name for path in chaos.out.iterdir()) == [
        "summary.json",
        "table.txt",
        "trials.jsonl",
    ]
    summary = json.loads((chaos.out / "summary.json").read_text())
    assert summary["identical"] == summary["finished"] == len(possible)
    left_out = set(summary["left_out"])
    assert left_out in (set(), set(NEEDS_NAMESPACE))
    assert {row["kind"] for row in summary["kinds"]} == possible - left_out
    assert summary["wires"] == {wire: len(possible)}
    for kind in left_out:
        assert kind in errors  # and why
    lines = (chaos.out / "trials.jsonl").read_bytes().splitlines()
    outcomes = [msgspec.json.decode(line, type=TrialOutcome) for line in lines]
    struck = {fault.kind for outcome in outcomes for fault in outcome.faults}
    assert struck >= possible - left_out - {"combination"}
    for outcome in outcomes:
        if outcome.kind in (FaultKind.CLOUD_KILLED, FaultKind.LINK_CUT):
            assert all((fault.detection_ms or 0.0) > 0.0 for fault in outcome.faults)
    assert "no divergence" in output
    assert re.search(r"^cloud_killed +\d", output, re.MULTILINE)
    assert (chaos.out / "table.txt").read_text() in output
    assert "\x1b" not in output + errors


@pytest.mark.slow
def test_an_interruption_ends_all_processes_and_the_series_goes_on(
    tmp_path: Path, started: list[Chaos]
) -> None:
    options = ["--trials", "3", *only([FaultKind.CLOUD_STOPPED, FaultKind.LINK_SILENT])]
    chaos = Chaos(tmp_path, *options)
    started.append(chaos)
    lines = chaos.out / "trials.jsonl"
    deadline = time.monotonic() + PATIENCE_S
    while not lines.exists():
        assert time.monotonic() < deadline
        time.sleep(0.02)
    chaos.wait_until("holdfast run", present=True)
    chaos.process.send_signal(signal.SIGINT)
    _, errors = chaos.end()
    assert chaos.process.returncode == 130
    assert not chaos.others()
    assert "Interrupted; all processes are ended. 1 of 3 trials are finished" in errors
    again = re.search(r"Go on with: (holdfast chaos .*)", errors)
    assert again is not None
    assert not list(chaos.out.glob("trial-*"))
    assert json.loads((chaos.out / "summary.json").read_text())["finished"] == 1

    words = shlex.split(again[1])[2:]
    assert words == ["--trials", "2", *options[2:], "--first", "1"]
    others = tmp_path / "others"
    done = subprocess.run(
        [*COMMAND, *words, "--out", str(others)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert done.returncode == 0, done.stderr
    text = lines.read_text() + (others / "trials.jsonl").read_text()
    assert [json.loads(line)["trial"] for line in text.splitlines()] == [0, 1, 2]


@pytest.mark.slow
def test_nothing_is_left_of_it_even_if_it_is_killed(tmp_path: Path, started: list[Chaos]) -> None:
    """The system itself wakes what is stopped, and hangs up on it."""
    chaos = Chaos(tmp_path, "--trials", "2", "--jobs", "2", *only([FaultKind.ROBOT_STOPPED]))
    started.append(chaos)
    deadline = time.monotonic() + PATIENCE_S
    while not any(state_of(pid) == "T" for pid in chaos.others()):
        assert time.monotonic() < deadline
        time.sleep(0.002)
    chaos.process.kill()
    chaos.end()
    chaos.wait_until("", present=False)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--only", "earthquake"), "--only is 'earthquake'; allowed are cloud_killed, "),
        (("--only", "link-slient"), "; did you mean link_silent?"),
        (("--wire", "token_ring"), f"--wire is 'token_ring'; allowed are {', '.join(WIRES)}"),
        (("--kinds", "cloud_killed"), "is no option of holdfast chaos; did you mean --kind?"),
    ],
)
def test_what_is_no_kind_is_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, arguments: tuple[str, ...], says: str
) -> None:
    done = run_here(capsys, tmp_path, "chaos", *arguments)
    assert done.code == 2
    assert says in done.stderr
    assert list(tmp_path.iterdir()) == []
