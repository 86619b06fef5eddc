"""How trials end with a robot of one's own: in success, in failure, or out of steps.

The commands are real; what a robot remembers that is killed in the step that ends a trial is in
unit/test_protocol_robot.py.
"""

import shutil
import signal
import subprocess
from pathlib import Path

from tests.processes.faults import events_of, holdfast, rows_of, summary_of

from holdfast.journal.journal import Journal

BEFORE_OUTCOMES = Path(__file__).parents[1] / "unit" / "data" / "journal_before_outcomes.sqlite"
"""A robot was killed at step 21 of trial 2, when results said only whether a trial succeeded."""

AS_BEFORE = "c8620a9f2dab01e3b944d3e864944901548b38b9229c531cbe512fff9a22123f"
"""The digest of that trial."""

# What was moved is in a file, which outlives the process, as a real robot does.
LANDER = """
from pathlib import Path

import numpy as np


class Lander:
    ending = {0: True, 1: "failed"}  # of trial 2: it goes on

    def __init__(self, trial, resumed):
        self.trial, self.moves = trial, Path(f"moves-{trial}")
        if not resumed:
            self.moves.write_text("")

    def perform_sensing(self, sensing_action):
        return np.array([SHOWN])

    def perform(self, task_action):
        with self.moves.open("a") as file:
            file.write(".")
        return -1.0

    def is_done(self):
        return self.ending.get(self.trial, False) if self.steps_performed() >= 6 else False

    def steps_performed(self):
        return len(self.moves.read_text())


class Absent(Lander):
    # Does not count, and at step 4 of trial 1 what it says is no answer until a person mends it.
    def __init__(self, trial, resumed):
        super().__init__(trial, resumed)
        self.steps_performed = None

    def is_done(self):
        num_moves = len(self.moves.read_text())
        if self.trial == 1 and num_moves == 5 and not Path("mended").exists():
            return "maybe"
        return self.ending.get(self.trial, False) if num_moves >= 6 else False
"""

CONFIGURATION = """
problem: peg_in_hole_2d
particle_filter: {num_particles: 20}
active_sensing: {num_observation_samples: 2, num_cores: 1}
simulator: {num_trials: 3, max_steps: 9, sensing_intervals: 0, seed: 3}
"""


class Command:
    """``holdfast run`` in a directory of its own."""

    def __init__(self, directory: Path, name: str, shown: float = 4.0) -> None:
        self.directory = directory
        self.out = directory / "run"
        (directory / "lander.py").write_text(LANDER.replace("SHOWN", str(shown)))
        (directory / "lander.yaml").write_text(CONFIGURATION)
        self._arguments = ("run", "lander.yaml", "-e", f"lander:{name}", "--out", "run")

    def run(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        return holdfast(self.directory, *self._arguments, *arguments)

    def assert_ended(self, ended: subprocess.CompletedProcess[str]) -> None:
        """Make sure that all three trials ended as they should."""
        assert ended.returncode == 0, ended.stderr
        rows = rows_of(self.out)
        assert [row["outcome"] for row in rows] == ["succeeded", "failed", "truncated"]
        assert [row["success"] for row in rows] == ["1", "0", "0"]
        assert [row["steps"] for row in rows] == ["6", "6", "9"]
        summary = summary_of(self.out)
        assert (summary["successes"], summary["failures"], summary["finished"]) == (1, 1, 3)
        assert "failed        1 of 3 trials" in ended.stdout
        told = [event for event in events_of(self.out) if event["event"] == "trial"]
        assert [event["outcome"] for event in told] == ["succeeded", "failed", "truncated"]
        assert len((self.directory / "moves-1").read_text()) == 6


def test_a_failed_task_is_no_success(tmp_path: Path) -> None:
    command = Command(tmp_path, "Lander")
    command.assert_ended(command.run())


def test_a_filter_that_has_lost_the_robot_is_told(tmp_path: Path) -> None:
    command = Command(tmp_path, "Lander", shown=1000.0)
    ended = command.run()
    assert ended.returncode == 0, ended.stderr
    rows = rows_of(command.out)
    for trial, row in enumerate(rows):
        assert row["unexplained_observations"] == row["sensing_decisions"] == row["steps"]
        told = [event for event in events_of(command.out) if event.get("trial") == trial]
        each = [event for event in told if event["event"] == "unexplained"]
        assert [event["step"] for event in each] == list(range(int(row["steps"])))
        assert all(event["deviations"] > 8.0 for event in each)
        (lost,) = [event for event in told if event["event"] == "lost"]
        assert lost["step"] == 4
        assert row["lost"] == "1"
    assert summary_of(command.out)["unexplained_observations"] == 21
    assert "unexplained" in ended.stdout
    assert "21 of 21 observations" in ended.stdout
    assert ended.stderr.count("lost") == 3


def test_a_lost_robot_that_holds_still_goes_on_as_it_is_told(tmp_path: Path) -> None:
    command = Command(tmp_path, "Lander", shown=1000.0)
    held = command.run("--set", "lost.on_lost=hold")
    assert held.returncode not in (0, -signal.SIGKILL)
    said = " ".join(held.stderr.split())
    assert "the robot is lost in trial 0, step 4, and holds still" in said
    assert command.run("--resume", "--set", "lost.on_lost=reinitialise").returncode == 0
    again = [each for each in events_of(command.out) if each["event"] == "reinitialised"]
    assert [(each["trial"], each["step"]) for each in again] == [(0, 4), (1, 4), (2, 4)]
    # Whoever replays the record comes to the same beliefs.
    exported = holdfast(tmp_path, "export", "run", "--csv", "csv")
    assert exported.returncode == 0


def test_a_run_from_before_trials_could_fail_goes_on(tmp_path: Path) -> None:
    """Its journal was made by that code; the digest is what that code came to, undisturbed."""
    out = tmp_path / "run"
    out.mkdir()
    with Journal.read(BEFORE_OUTCOMES) as journal:
        (tmp_path / "old.yaml").write_text(journal.meta()["configuration"])
    shutil.copyfile(BEFORE_OUTCOMES, out / "journal.sqlite")
    # It does not know the boot in which its robot moved.
    options = ("--rate=1000", "--out=run", "--resume", "--after-reboot")
    ended = holdfast(tmp_path, "run", "old.yaml", *options)
    assert ended.returncode == 0, ended.stderr
    rows = rows_of(out)
    assert [row["outcome"] for row in rows] == ["truncated", "succeeded", "truncated"]
    assert [row["success"] for row in rows] == ["0", "1", "0"]
    assert rows[2]["digest"] == AS_BEFORE
    assert [event["step"] for event in events_of(out) if event["event"] == "resumed_trial"] == [21]


def test_a_wrong_answer_after_a_move_is_mended_and_the_move_is_not_made_again(
    tmp_path: Path,
) -> None:
    command = Command(tmp_path, "Absent")
    done = command.run()
    assert done.returncode == 4
    assert "trial 1, step 4, whose task action was performed" in done.stderr
    assert "is_done returned 'maybe'; it must return True, False, None" in done.stderr
    assert "--resume" in done.stderr
    (tmp_path / "mended").touch()
    done = command.run("--resume")
    assert done.returncode == 0, done.stderr
    assert [len((tmp_path / f"moves-{trial}").read_text()) for trial in range(3)] == [6, 6, 9]
    rows = rows_of(command.out)
    assert [row["outcome"] for row in rows] == ["succeeded", "failed", "truncated"]
    assert [float(row["reward"]) for row in rows] == [-6.0, -6.0, -9.0]
