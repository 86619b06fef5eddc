"""``holdfast run`` as a person runs it: the real command, real processes, real signals."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from tests.command_line import PEG
from tests.ports import free_port
from tests.processes.faults import COMMAND, holdfast, rows_of, summary_of, wait_until

from holdfast.config.source_digest import core_version, machines

WITH_FIGURES = [sys.executable, "-c", "from holdfast.cli import main; main()"]

# Notes the process and the time of each trial's start. All but the first trials of the workers wait
# for leave, so that the run is still going on whatever a test does meanwhile; those of the command
# itself, which come first, are long enough for workers to be worth their start.
HELD = """
import multiprocessing
import os
import time
from pathlib import Path

from holdfast.problems.peg_in_hole_2d import PegInHole2D

HERE = Path(__file__).parent


class Held(PegInHole2D):
    name = "held"

    def initial_states(self, stream, count):
        if count == 1:
            marks = HERE / "marks"
            marks.mkdir(exist_ok=True)
            (marks / f"{time.time_ns()}-{os.getpid()}").touch()
            if multiprocessing.parent_process() is None and not (HERE / "go").exists():
                time.sleep(0.25)
            else:
                while len(list(marks.iterdir())) > FREELY and not (HERE / "go").exists():
                    time.sleep(0.01)
        return super().initial_states(stream, count)
"""
FREELY = 6

BROKEN_ROBOT = """
class MyRobot:
    def perform_sensing(self, sensing_action):
        return [0.5]

    def perform(self, task_action):
        raise RuntimeError("the gripper is stuck")

    def is_done(self):
        return False
"""

HELD_CONFIGURATION = """
problem: held_problem:Held
particle_filter: {num_particles: 20}
active_sensing: {num_observation_samples: 2, num_cores: 1}
simulator: {num_trials: 16, max_steps: 10, seed: 3}
"""


def decided(directory: Path) -> list[tuple[str, ...]]:
    """The table of trials, without the times."""
    return [
        tuple(value for key, value in row.items() if key != "mean_sensing_ms")
        for row in rows_of(directory)
    ]


@pytest.fixture
def workplace(tmp_path: Path) -> Path:
    (tmp_path / "peg.yaml").write_text(PEG)
    (tmp_path / "held.yaml").write_text(HELD_CONFIGURATION)
    (tmp_path / "held_problem.py").write_text(HELD.replace("FREELY", str(FREELY)))
    return tmp_path


class HeldRun:
    """A run that goes on until :meth:`let_go`."""

    def __init__(self, workplace: Path) -> None:
        self._marks = workplace / "marks"
        self.process = subprocess.Popen(
            [*COMMAND, "run", "held.yaml", "--jobs", "2", "--out", "out"],
            cwd=workplace,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            # A process group of its own, which gets the signals that a terminal would send.
            start_new_session=True,
        )

    def workers(self) -> list[int]:
        """Processes that have started a trial, without the parent, in the order of their starts."""
        names = sorted(path.name for path in self._marks.glob("*"))
        pids = dict.fromkeys(int(name.split("-")[1]) for name in names)
        return [pid for pid in pids if pid != self.process.pid]

    def wait_for_workers(self) -> None:
        """Wait until both have begun a trial, and some trials are done."""
        wait_until(
            lambda: len(self.workers()) == 2 and len(list(self._marks.glob("*"))) > FREELY,
            "two workers",
        )

    def let_go(self) -> None:
        """Hold no trial any more."""
        self._marks.with_name("go").touch()

    def end(self) -> str:
        _, errors = self.process.communicate(timeout=120)
        return errors


@pytest.fixture
def held_run(workplace: Path) -> Iterator[HeldRun]:
    run = HeldRun(workplace)
    with run.process:
        try:
            yield run
        finally:
            # The group is the run's own, and empty if all went well.
            with contextlib.suppress(ProcessLookupError):
                os.killpg(run.process.pid, signal.SIGKILL)


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


class TestOutput:
    def test_files_and_what_is_said(self, workplace: Path) -> None:
        done = holdfast(workplace, "run", "peg.yaml", "--out", "out", command=WITH_FIGURES)
        assert done.returncode == 0, done.stderr
        names = {path.name for path in (workplace / "out").iterdir()}
        assert names == {"trials.csv", "summary.json", "config.yaml", "journal.bin", "trial.png"}
        assert all(name in done.stdout for name in names)
        assert "success" in done.stdout
        assert done.stderr.splitlines() == ["peg_in_hole_2d, 6 trials, seed 3; results in out"]
        assert [row[0] for row in decided(workplace / "out")] == ["0", "1", "2", "3", "4", "5"]
        assert summary_of(workplace / "out")["finished"] == 6

    def test_with_log_json_the_standard_error_has_nothing_else(self, workplace: Path) -> None:
        service = f"tcp/127.0.0.1:{free_port()}"
        arguments = ("run", "peg.yaml", "--trials", "1", "--log", "json", "--service", service)
        done = holdfast(workplace, *arguments, "--out", "out")
        assert done.returncode == 0, done.stderr
        events = [json.loads(line) for line in done.stderr.splitlines()]
        assert [event["reason"] for event in events if event["event"] == "unreachable"] == [
            "connection refused"
        ]
        (status,) = [event for event in events if event["event"] == "status"]
        assert status["reason"] == f"{service} has not appeared"
        notes = [event["reason"] for event in events if event["event"] == "note"]
        assert f"{service} decided nothing: connection refused" in notes
        found = summary_of(workplace / "out")
        decided = found["sensing_decisions_by_service"]
        assert decided == {"cloud_active_sensing_recovery": found["sensing_decisions"]}
        assert "decided by" in done.stdout

    @pytest.mark.parametrize(
        "options",
        [
            (),
            pytest.param(("--rate", "10000"), marks=pytest.mark.slow),
            ("--rate", "10000", "--log", "json"),
        ],
    )
    def test_a_standard_error_that_cannot_be_written_ends_no_run(
        self, workplace: Path, options: tuple[str, ...]
    ) -> None:
        arguments = ("run", "peg.yaml", "--trials", "1", "--out", "out", *options)
        with Path("/dev/full").open("w") as full:
            done = subprocess.run(
                [*COMMAND, *arguments],
                cwd=workplace,
                stdout=subprocess.PIPE,
                stderr=full,
                text=True,
                timeout=120,
                check=False,
            )
        assert done.returncode == 0
        assert "digest" in done.stdout
        assert summary_of(workplace / "out")["finished"] == 1

    def test_version(self, workplace: Path) -> None:
        done = holdfast(workplace, "--version")
        assert done.returncode == 0
        assert done.stdout == f"holdfast {core_version()} ({machines()} state machines)\n"


class TestInterruption:
    def test_ctrl_c_ends_promptly_and_resume_ends_as_if_nothing_was(
        self, workplace: Path, held_run: HeldRun
    ) -> None:
        held_run.wait_for_workers()
        # The whole group, as Ctrl-C at a terminal does it: the workers get it as well.
        os.killpg(held_run.process.pid, signal.SIGINT)
        errors = held_run.end()
        assert held_run.process.returncode == 130
        assert "Traceback" not in errors
        assert "Interrupted." in errors
        assert "holdfast run held.yaml --jobs 2 --out out --resume" in errors
        wait_until(
            lambda: not any(is_alive(pid) for pid in held_run.workers()), "the end of the workers"
        )
        kept = decided(workplace / "out")
        assert 0 < len(kept) < 16
        assert summary_of(workplace / "out")["finished"] == len(kept)

        held_run.let_go()
        resumed = holdfast(workplace, "run", "held.yaml", "--out", "out", "--resume")
        assert resumed.returncode == 0, resumed.stderr
        assert f"{len(kept)} finished before" in resumed.stderr
        whole = holdfast(workplace, "run", "held.yaml", "--out", "whole", "--jobs", "1")
        assert whole.returncode == 0, whole.stderr
        assert decided(workplace / "out") == decided(workplace / "whole")
        assert len(decided(workplace / "out")) == 16

    @pytest.mark.parametrize(
        ("ending", "group"),
        [
            (signal.SIGTERM, False),
            pytest.param(signal.SIGHUP, True, marks=pytest.mark.slow),
            pytest.param(signal.SIGTERM, True, marks=pytest.mark.slow),
            pytest.param(signal.SIGHUP, False, marks=pytest.mark.slow),
        ],
    )
    def test_other_signals_end_a_run_in_order(
        self, workplace: Path, held_run: HeldRun, ending: signal.Signals, group: bool
    ) -> None:
        held_run.wait_for_workers()
        if group:
            os.killpg(held_run.process.pid, ending)
        else:
            held_run.process.send_signal(ending)
        errors = held_run.end()
        assert held_run.process.returncode == 128 + ending
        assert "Traceback" not in errors
        assert f"Ended by {ending.name}." in errors
        wait_until(
            lambda: not any(is_alive(pid) for pid in held_run.workers()), "the end of the workers"
        )
        kept = len(decided(workplace / "out"))
        assert 0 < kept < 16
        assert summary_of(workplace / "out")["finished"] == kept

    def test_a_killed_worker_is_reported_with_its_trial(
        self, workplace: Path, held_run: HeldRun
    ) -> None:
        held_run.wait_for_workers()
        os.kill(held_run.workers()[0], signal.SIGKILL)
        errors = held_run.end()
        assert held_run.process.returncode == 4
        assert "Go on with: " in errors
        assert "Traceback" not in errors
        assert "a worker process was killed by SIGKILL while it ran trial " in errors
        kept = len(decided(workplace / "out"))
        assert 0 < kept < 16
        held_run.let_go()
        resumed = holdfast(workplace, "run", "held.yaml", "--out", "out", "--resume")
        assert resumed.returncode == 0, resumed.stderr
        assert summary_of(workplace / "out")["finished"] == 16

    def test_a_killed_parent_leaves_a_run_that_can_go_on(
        self, workplace: Path, held_run: HeldRun
    ) -> None:
        held_run.wait_for_workers()
        os.kill(held_run.process.pid, signal.SIGKILL)
        held_run.process.wait(timeout=120)
        wait_until(
            lambda: not any(is_alive(pid) for pid in held_run.workers()), "the end of the workers"
        )
        held_run.let_go()
        resumed = holdfast(workplace, "run", "held.yaml", "--out", "out", "--resume")
        assert resumed.returncode == 0, resumed.stderr
        assert "finished before" in resumed.stderr
        assert summary_of(workplace / "out")["finished"] == 16


class TestErrors:
    @staticmethod
    def fails(workplace: Path, *arguments: str, command: Sequence[str] = COMMAND) -> str:
        done = holdfast(workplace, *arguments, command=command)
        assert done.returncode == 2
        assert done.stdout == ""
        assert done.stderr.startswith("holdfast: error: ")
        assert "Traceback" not in done.stderr
        return done.stderr

    def test_the_exit_code_says_it_where_nothing_can_be_written(self, workplace: Path) -> None:
        for command, code in ((["run", "missing.yaml"], 2), (["run", "--bogus"], 2)):
            with Path("/dev/full").open("w") as full:
                done = subprocess.run([*COMMAND, *command], cwd=workplace, stderr=full, check=False)
            assert done.returncode == code

    @pytest.mark.parametrize("counts", [False, True])
    def test_with_log_json_the_error_says_how_to_go_on(self, workplace: Path, counts: bool) -> None:
        # One that counts its steps can say later whether the action was performed.
        counting = "    def steps_performed(self):\n        return 0\n" if counts else ""
        (workplace / "my_robot.py").write_text(f"{BROKEN_ROBOT.rstrip()}\n{counting}")
        arguments = ("run", "peg.yaml", "--environment", "my_robot:MyRobot", "--out", "out")
        done = holdfast(workplace, *arguments, "--log", "json")
        assert done.returncode == (4 if counts else 2)
        *_, last = map(json.loads, done.stderr.splitlines())
        assert last["event"] == "error"
        assert last["reason"].startswith("the robot holds still in trial 0, step 0, and ")
        assert f'File "{workplace / "my_robot.py"}", line ' in last["details"]
        command = last.get("resume_command", "")
        assert command.startswith("holdfast run peg.yaml --environment my_robot:MyRobot ") is counts
        assert command.endswith("--out out --resume") is counts
        again = holdfast(workplace, *arguments, "--resume")
        assert again.returncode == (4 if counts else 2)
        assert ("the gripper is stuck" in again.stderr) is counts

    def test_a_defect_of_ours_keeps_its_traceback_and_names_the_trial(
        self, workplace: Path
    ) -> None:
        (workplace / "defective.py").write_text(
            "from holdfast.problems.peg_in_hole_2d import PegInHole2D\n"
            "class Defective(PegInHole2D):\n"
            "    initial_states = 3\n"
        )
        done = holdfast(
            workplace, "run", "peg.yaml", "--problem", "defective:Defective", "--out", "out"
        )
        assert done.returncode == 1
        assert "Traceback" in done.stderr
        assert "in trial 0 (seed 3)" in done.stderr


def test_a_run_that_goes_on_with_other_services_says_so(workplace: Path) -> None:
    run = ["run", "peg.yaml", "--trials", "1", "--out", "other"]
    service = f"--service tcp/127.0.0.1:{free_port()}"
    assert holdfast(workplace, *run).returncode == 0
    said = holdfast(workplace, *run, "--resume", *service.split()).stderr
    assert f"the run had no service before, and goes on with {service}" in said
    assert "the run had" not in holdfast(workplace, *run, "--resume", *service.split()).stderr
    said = holdfast(workplace, *run, "--resume").stderr
    assert f"the run had {service} before, and goes on with no service" in said


@pytest.mark.slow
def test_of_two_runs_at_once_in_one_directory_one_is_done(tmp_path: Path) -> None:
    """And what lies there afterwards is that one's, the configuration too."""
    configuration = Path(__file__).parents[2] / "examples" / "peg_in_hole_2d.yaml"
    for attempt in range(4):
        directory = tmp_path / str(attempt)
        both = [
            subprocess.Popen(
                [
                    *(sys.executable, "-m", "holdfast", "run", str(configuration), "--trials", "2"),
                    *("--seed", str(seed), "--out", str(directory), "--quiet", "--jobs", "1"),
                ],
                stderr=subprocess.PIPE,
                text=True,
            )
            for seed in (1, 2)
        ]
        errors = [process.communicate(timeout=120)[1] for process in both]
        codes = [process.returncode for process in both]
        assert sorted(codes) == [0, 2], errors
        winner = 1 + codes.index(0)
        assert f"seed: {winner}\n" in (directory / "config.yaml").read_text(encoding="utf-8")
        assert f'"seed": {winner},' in (directory / "summary.json").read_text(encoding="utf-8")
