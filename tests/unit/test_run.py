"""``holdfast run`` in the test's own process: what it writes and says, and what it refuses.

``tests/processes/test_run_command.py`` has what only a process of its own can show.
"""

import csv
import json
import os
import re
from pathlib import Path
from typing import Any

import msgspec
import pytest
from tests.command_line import PEG, Workplace
from tests.recordings import forget_steps, rewrite

from holdfast.errors import HeldError
from holdfast.journal import journal_file
from holdfast.journal.journal_file import Notes
from holdfast.robot.process import RobotProcess


@pytest.fixture
def workplace(workplace: Workplace) -> Workplace:
    workplace.write("peg.yaml", PEG)
    return workplace


def test_the_resolved_configuration_runs_again_to_the_same(workplace: Workplace) -> None:
    one = ("--jobs", "1", "--quiet", "--out")
    workplace.runs("run", "peg.yaml", "--seed", "8", "--trials", "3", *one, "first")
    said = workplace.runs("run", "first/config.yaml", *one, "second")
    assert (said.stdout, said.stderr) == ("", "")  # as it was told to be quiet
    assert workplace.decided("second") == workplace.decided("first")
    assert workplace.summary("second")["digest"] == workplace.summary("first")["digest"]
    assert workplace.summary("second")["seed"] == 8


class TestResumeIfBegun:
    ARGUMENTS = ("run", "peg.yaml", "--jobs", "1", "--out", "out", "--resume-if-begun")

    def test_it_begins_is_extended_and_has_ended(self, workplace: Workplace) -> None:
        (workplace.directory / "out").mkdir()  # as a volume is that was just mounted
        workplace.runs(*self.ARGUMENTS, "--trials", "2")
        said = workplace.runs(*self.ARGUMENTS, "--trials", "5")
        assert "2 finished before" in said.stderr
        tables = {path: path.stat().st_mtime_ns for path in workplace.directory.glob("out/*")}
        said = workplace.runs(*self.ARGUMENTS, "--trials", "5")
        out = workplace.directory / "out"
        assert (said.stdout, said.stderr) == ("", f"note: {out}: complete, with 5 trials\n")
        del tables[workplace.directory / "out" / "journal.bin"]
        assert {path: path.stat().st_mtime_ns for path in tables} == tables
        workplace.runs("run", "peg.yaml", "--jobs", "1", "--out", "whole", "--trials", "5")
        assert workplace.decided("out") == workplace.decided("whole")
        whole = workplace.directory / "whole" / "config.yaml"
        assert (out / "config.yaml").read_text() == whole.read_text()

    def test_tables_that_are_missing_or_old_are_made(self, workplace: Workplace) -> None:
        workplace.runs(*self.ARGUMENTS, "--trials", "2")
        old = (workplace.directory / "out" / "summary.json").read_bytes()
        workplace.runs(*self.ARGUMENTS, "--trials", "3")
        for content in (old, b"", None):
            summary = workplace.directory / "out" / "summary.json"
            summary.unlink()
            if content is not None:
                summary.write_bytes(content)
            workplace.runs(*self.ARGUMENTS, "--trials", "3")
            assert workplace.summary("out")["finished"] == 3

    def test_another_configuration_is_an_error(self, workplace: Workplace) -> None:
        workplace.runs(*self.ARGUMENTS, "--trials", "2")
        for trials in ("2", "3"):
            said = workplace.fails(*self.ARGUMENTS, "--trials", trials, "--seed", "4")
            assert "out: that run has another configuration: simulator.seed is 3 there" in said

    def test_what_was_killed_while_it_was_made_counts_as_not_begun(
        self, workplace: Workplace
    ) -> None:
        out = workplace.directory / "out"
        workplace.runs("run", "peg.yaml", "--trials", "1", "--out", "other")
        out.mkdir()
        # Whoever made it had this process's number, as all that a container starts have.
        (out / f".journal.bin.{os.getpid()}").write_bytes(b"half of it")
        workplace.runs(*self.ARGUMENTS, "--trials", "1", "--seed", "7")
        # A journal without a trial, of another run, and no configuration beside it.
        rewrite(out / "journal.bin", lambda entry: entry if isinstance(entry, Notes) else None)
        for path in out.iterdir():
            if path.name != "journal.bin":
                path.unlink()
        workplace.runs(*self.ARGUMENTS, "--trials", "1")
        assert workplace.decided("out") == workplace.decided("other")

    def test_what_is_no_journal_is_an_error(self, workplace: Workplace) -> None:
        out = workplace.directory / "out"
        out.mkdir()
        (out / "journal.bin").write_bytes(b"no journal" * 100)
        assert "journal.bin: " in workplace.fails(*self.ARGUMENTS)
        (out / "journal.bin").unlink()
        (out / "trials.csv").write_bytes(b"")
        assert "out: holds trials.csv already" in workplace.fails(*self.ARGUMENTS)

    def test_what_does_not_go_together(self, workplace: Workplace) -> None:
        needs = workplace.fails("run", "peg.yaml", "--resume-if-begun")
        assert "--resume-if-begun needs --out DIR" in needs
        assert "leave one of them out" in workplace.fails(*self.ARGUMENTS, "--resume")
        assert workplace.names() == {"peg.yaml"}


def test_a_robot_without_services_tells_of_none(workplace: Workplace) -> None:
    options = ("--trials", "1", "--rate", "10000", "--log", "json")
    said = workplace.runs("run", "peg.yaml", "--out", "out", *options)
    told = [json.loads(line) for line in said.stderr.splitlines()]
    assert "trial" in [each["event"] for each in told]
    assert not [each for each in told if "service" in each]


MY_WORLD = """
from holdfast.robot.environment import SimulatedEnvironment


class MyWorld:
    def __init__(self, problem, seed, trial):
        self.world = SimulatedEnvironment(problem, seed, trial)

    def perform_sensing(self, sensing_action):
        return self.world.perform_sensing(sensing_action)

    def perform(self, task_action):
        self.world.perform(task_action)  # and no reward

    def is_done(self):
        return self.world.is_done()
"""


def test_a_world_of_ones_own_has_a_figure_of_the_belief(workplace: Workplace) -> None:
    workplace.write("my_world.py", MY_WORLD)
    arguments = ("run", "peg.yaml", "--environment", "my_world:MyWorld", "--out", "out")
    said = workplace.runs(*arguments, "--trials", "1", figures=True)
    assert "figure" not in said.stderr
    # It reports no reward, which is not a reward of 0.
    assert "reward" not in said.stdout
    assert workplace.summary("out")["mean_reward"] is None
    assert workplace.summary("out")["mean_reward_of_successes"] is None
    with (workplace.directory / "out" / "trials.csv").open() as table:
        assert [row["reward"] for row in csv.DictReader(table)] == [""]
    figure = workplace.directory / "out" / "trial.png"
    assert figure.read_bytes().startswith(b"\x89PNG\r\n")
    # It is there already: the figure stays as it is.
    before = figure.stat().st_mtime_ns
    said = workplace.runs(*arguments, "--trials", "2", "--resume", figures=True)
    assert "figure" not in said.stderr
    assert figure.stat().st_mtime_ns == before
    figure.unlink()
    said = workplace.runs(*arguments, "--trials", "2", "--resume", figures=True)
    assert "figure" not in said.stderr
    assert figure.read_bytes().startswith(b"\x89PNG\r\n")
    # Runs of earlier versions have kept no observations.
    figure.unlink()
    rewrite(workplace.directory / "out" / "journal.bin", forget_steps)
    said = workplace.runs(*arguments, "--trials", "2", "--resume", figures=True)
    assert "note: no figure, because trial 0 ended in an earlier part of the run" in said.stderr


@pytest.mark.parametrize(("moment", "out"), [("import", ("--out", "out")), ("sensing", ())])
def test_a_robot_that_changes_the_directory_writes_where_it_was_started(
    workplace: Workplace, moment: str, out: tuple[str, ...]
) -> None:
    """Simulators do; another run of the same name may lie there."""
    other = workplace.directory / "simulator"
    there = other / (out[1] if out else "runs/peg-seed3")
    there.mkdir(parents=True)
    for name in ("trials.csv", "summary.json", "events.jsonl", "trial.png", "config.yaml"):
        (there / name).write_text("another run's")
    chdir = f"import os; os.chdir({str(other)!r})"
    workplace.write(
        "arm.py",
        f"{chdir if moment == 'import' else ''}\n"
        "from holdfast.problems.peg_in_hole_2d import PegInHole2D\n"
        "from holdfast.robot.environment import SimulatedEnvironment\n"
        "class Own(PegInHole2D):\n"
        "    pass\n"
        "class Arm(SimulatedEnvironment):\n"
        "    def __init__(self, problem, seed, trial):\n"
        "        super().__init__(problem, seed, trial)\n"
        "    def perform_sensing(self, sensing_action):\n"
        f"        {chdir if moment == 'sensing' else ''}\n"
        "        return super().perform_sensing(sensing_action)\n",
    )
    command = ("run", "peg.yaml", "--problem", "arm:Own", "--environment", "arm:Arm", *out)
    workplace.runs(*command, "--trials", "1", figures=True)
    workplace.runs(*command, "--trials", "2", "--resume")
    assert {path.read_text() for path in there.iterdir()} == {"another run's"}
    mine = workplace.directory / there.relative_to(other)
    assert len(workplace.decided(str(mine))) == 2
    assert (mine / "trial.png").is_file()


@pytest.mark.parametrize(
    ("line", "raised"), [("{}['scene']", "KeyError: 'scene'"), ("exit(0)", "SystemExit: 0")]
)
def test_a_figure_that_a_problem_fails_to_describe(
    workplace: Workplace, line: str, raised: str
) -> None:
    workplace.write(
        "unseen.py",
        "from holdfast.problems.peg_in_hole_2d import PegInHole2D\n"
        "class Unseen(PegInHole2D):\n"
        "    def scene(self):\n"
        f"        {line}\n",
    )
    arguments = ("peg.yaml", "--problem", "unseen:Unseen", "--out", "out", "--jobs", "1")
    said = workplace.runs("run", *arguments, figures=True)
    assert "note: no figure, because it cannot be drawn: unseen:Unseen raised" in said.stderr
    assert raised in said.stderr
    assert "Traceback" not in said.stderr
    assert workplace.summary("out")["finished"] == 6


@pytest.mark.parametrize(
    ("function", "says"),
    [
        ("holdfast.reports.figure.trial_figure", "figure, because it cannot be drawn: "),
        ("holdfast.cli.run.print_summary", "summary, because of "),
        ("holdfast.reports.belief_remarks.belief_remarks", "remarks on the beliefs, because of "),
    ],
)
def test_what_a_finished_run_can_do_without_may_fail(
    workplace: Workplace, monkeypatch: pytest.MonkeyPatch, function: str, says: str
) -> None:
    def fail(*_: object) -> None:
        raise KeyError("a")

    monkeypatch.setattr(function, fail)
    words = ("run", "peg.yaml", "--out", "out", "--trials", "1")
    said = workplace.runs(*words, figures=function.endswith("trial_figure"))
    assert f"note: no {says}" in said.stderr
    assert workplace.summary("out")["finished"] == 1


def test_how_many_trials_ended_sure_of_a_wrong_value(workplace: Workplace) -> None:
    workplace.write("bits.py", "from tests.unit.test_lost_values import Bit\n")
    bit = PEG.replace("peg_in_hole_2d", "bits:Bit")
    workplace.write("bit.yaml", f"{bit}\nselector: {{method: random}}\n")
    said = workplace.runs("run", "bit.yaml", "--trials", "20", "--out", "out")
    own = r"note: \d+ of 20 trials ended sure .* \(\d+ of these did .* bit\. Resampling loses"
    assert re.search(own, said.stderr)
    assert "in trial 0" not in said.stderr
    said = workplace.runs("run", "bit.yaml", "--trials", "40", "--out", "out", "--resume")
    assert re.search(own.replace("trials", "trials of this part"), said.stderr)


def test_values_instead_of_the_files_are_a_part_of_what_must_be_the_same_to_go_on(
    workplace: Workplace,
) -> None:
    run = ("run", "peg.yaml", "--jobs", "1", "--trials", "1", "--out", "random")
    chosen = ["--set", "selector.method=random", "--set", "model.init_mean=[3, 1, 0]"]
    assert workplace.run(*run, "--quiet", *chosen).code == 0
    assert workplace.run(*run, "--quiet", "--resume", *chosen).code == 0
    error = workplace.fails(*run, "--resume")
    assert "model.init_mean[0] is 3.0 there and 4.0 here" in error


def test_what_is_nearly_a_file_is_suggested(workplace: Workplace) -> None:
    assert workplace.fails("run", "pegg.yaml").endswith("no such file; did you mean peg.yaml?\n")
    for name in ("lamps:Room", "capsule_robot"):
        error = workplace.fails("run", name)
        assert f"{name}: there is no such file; {name} is a problem" in error
        assert f"'problem: {name}' is enough" in error
    workplace.write("lamps.py", "")
    error = workplace.fails("run", "lamps.py")
    assert "lamps.py: is Python; lamps:CLASS is a problem, and a run needs" in error
    workplace.write("lamps.py", "class Room: pass\n")
    error = workplace.fails("run", "peg.yaml", "--out", "out", "--problem", "lamps")
    assert "did you mean lamps:Room?" in error


LICENSED = """
from pathlib import Path
from holdfast.problems.peg_in_hole_2d import PegInHole2D

class Licensed(PegInHole2D):
    def __init__(self, *settings):
        if not Path("licence").exists():
            raise RuntimeError("no licence")
        super().__init__(*settings)
"""


@pytest.mark.parametrize(
    "command", [["run", "--trials", "2"], ["sweep", "--set", "selector.method=random,fixed"]]
)
def test_a_constructor_that_fails_in_what_is_resumed_ends_with_the_command(
    command: list[str], workplace: Workplace
) -> None:
    workplace.write("licensed.py", LICENSED)
    workplace.write("own.yaml", PEG.replace("peg_in_hole_2d", "licensed:Licensed"))
    licence = workplace.directory / "licence"
    name, *options = command
    words = [name, "own.yaml", *options, "--out", "out"]
    said = workplace.run(*words)
    assert (said.code, "no licence" in said.stderr, "Go on" in said.stderr) == (2, True, False)
    licence.touch()
    assert workplace.run(*words, "--quiet").code == 0
    licence.unlink()
    said = workplace.run(*words, "--resume", "--quiet")
    again = said.stderr.rpartition("\nGo on with: holdfast ")[2].split()
    assert (said.code, sorted(again)) == (4, sorted([*words, "--resume"])), said.stderr
    # Another mistake than the code's would be made again.
    said = workplace.run(*words, "--resume", "--set", "selector.actions=none")
    assert (said.code, "Go on" in said.stderr) == (2, False)
    licence.touch()
    assert workplace.run(*again).code == 0


def test_too_few_particles_are_noted(workplace: Workplace) -> None:
    options = ("--trials", "2", "--set", "particle_filter.num_particles=10")
    said = workplace.runs("run", "peg.yaml", "--out", "few", *options)
    assert workplace.summary("few")["unexplained_observations"]
    assert "take more particles (particle_filter.num_particles)" in " ".join(said.stdout.split())


MY_ROBOT = ("--environment", "my_robot:MyRobot")


@pytest.mark.parametrize(
    ("options", "text", "expected"),
    [
        (("-e", "my_robot:Robot"), "class MyRobot: pass\n", "did you mean MyRobot?"),
        (("-e", "my_robt:MyRobot"), "class MyRobot: pass\n", "No module named 'my_robt'"),
        (MY_ROBOT, "import math\nmath.sqrt(-1)\n", 'my_robot.py", line 2'),
        (MY_ROBOT, "import sys\nsys.exit(0)\n", "raised SystemExit: 0"),
        (("--service", "tls/a:7", "--tls", "nowhere"), "", "nowhere/authority.pem: cannot be read"),
        (("--service", "tls/127.0.0.1:7"), "", "tls needs credentials"),
    ],
)
@pytest.mark.parametrize("out", [("--out", "out"), ()])
def test_what_is_not_there_claims_no_directory(
    workplace: Workplace, options: tuple[str, ...], text: str, expected: str, out: tuple[str, ...]
) -> None:
    workplace.write("my_robot.py", text)
    assert expected in workplace.fails("run", "peg.yaml", *options, *out)
    assert workplace.names() == {"peg.yaml", "my_robot.py"}


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        (["run", "missing.yaml"], "missing.yaml: there is no such file"),
        (["run", "peg.yaml", "--trials", "x"], "--trials is 'x'; allowed are"),
        (["run", "peg.yaml", "--recovery", "sometimes"], "recovery.launch, given instead of"),
        (["run", "peg.yaml"], "--log json needs --service, --environment or --rate"),
        (["serve", "--listen", "tcp/nowhere"], "--listen: endpoint 'tcp/nowhere'"),
        (["serve", "--lease-ms", "1"], "--lease-ms is '1'; allowed are numbers from 50"),
    ],
)
def test_with_log_json_the_error_is_an_event(
    workplace: Workplace, command: list[str], expected: str
) -> None:
    said = workplace.run(*command, "--log=json")
    assert said.code == 2
    (event,) = map(json.loads, said.stderr.splitlines())
    assert event["event"] == "error"
    assert event["reason"].startswith(expected), event
    assert event["component"] == ("service" if command[0] == "serve" else "robot")


class TestAfterAReboot:
    """A robot goes on in another boot of its machine only if a person says so."""

    ROBOT = ("run", "peg.yaml", "--rate", "10000", "--quiet", "--jobs", "1", "--out", "out")

    @pytest.fixture
    def boot(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
        boot = tmp_path / "boot_id"
        boot.write_text("1f\n")
        monkeypatch.setattr(journal_file, "_BOOT_ID", boot)
        return boot

    def refused(self, workplace: Workplace, *options: str) -> str:
        said = workplace.run(*self.ROBOT, *options)
        assert said.code == 5, said
        return said.stderr

    @pytest.mark.parametrize("resume", ["--resume", "--resume-if-begun"])
    def test_it_goes_on_only_in_the_same_boot_or_if_told_to(
        self, workplace: Workplace, boot: Path, resume: str
    ) -> None:
        workplace.runs(*self.ROBOT, "--trials", "1")
        workplace.runs(*self.ROBOT, "--trials", "2", resume)
        boot.write_text("2e\n")
        for _ in range(2):  # to be refused changes nothing
            error = self.refused(workplace, "--trials", "3", resume)
            assert "out: this machine was rebooted since the robot of this run last moved" in error
            assert error.rstrip().endswith(" --out out --resume --after-reboot")
        assert workplace.summary("out")["finished"] == 2
        workplace.runs(*self.ROBOT, "--trials", "3", resume, "--after-reboot")
        # A crash in this boot changes nothing.
        workplace.runs(*self.ROBOT, "--trials", "4", resume)
        workplace.runs("run", "peg.yaml", "--quiet", "--out", "whole", "--trials", "4")
        assert workplace.decided("out") == workplace.decided("whole")

    @pytest.mark.parametrize("unknown", ["before", "now", "both"])
    def test_an_unknown_boot_is_another_one(
        self, workplace: Workplace, boot: Path, unknown: str
    ) -> None:
        known = boot.read_text()
        if unknown != "now":
            boot.unlink()
        workplace.runs(*self.ROBOT, "--trials", "1")
        boot.write_text(known)
        if unknown != "before":
            boot.write_text("")
        error = self.refused(workplace, "--trials", "2", "--resume-if-begun")
        assert "nobody knows whether this machine was rebooted" in error
        workplace.runs(*self.ROBOT, "--trials", "2", "--resume-if-begun", "--after-reboot")

    def test_one_that_ended_before_its_first_step_does_not_begin_either(
        self, workplace: Workplace, boot: Path
    ) -> None:
        def run(*_: object) -> None:
            raise HeldError("its environment is not there yet")

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(RobotProcess, "run", run)
            assert workplace.run(*self.ROBOT, "--trials", "1").code == 2
        boot.write_text("2e\n")
        for _ in range(2):
            self.refused(workplace, "--trials", "1", "--resume-if-begun")
        workplace.runs(*self.ROBOT, "--trials", "1", "--resume-if-begun", "--after-reboot")

    def test_a_run_of_the_release_before_knows_the_boot_of_its_last_steps(
        self, workplace: Workplace, boot: Path
    ) -> None:
        workplace.runs(*self.ROBOT, "--trials", "1")

        def forget_boot(entry: Any) -> Any:
            if isinstance(entry, Notes):
                kept = {key: value for key, value in entry.notes.items() if key != "boot"}
                return msgspec.structs.replace(entry, notes=kept)
            return entry

        rewrite(workplace.directory / "out" / "journal.bin", forget_boot)
        workplace.runs(*self.ROBOT, "--trials", "2", "--resume")
        rewrite(workplace.directory / "out" / "journal.bin", forget_boot)
        boot.write_text("2e\n")
        self.refused(workplace, "--trials", "3", "--resume")

    def test_where_nothing_moves_nobody_is_asked(self, workplace: Workplace, boot: Path) -> None:
        batch = ("run", "peg.yaml", "--jobs", "1", "--quiet", "--out", "batch")
        workplace.runs(*batch, "--trials", "1")
        workplace.runs(*self.ROBOT, "--trials", "1")
        boot.write_text("2e\n")
        workplace.runs(*batch, "--trials", "2", "--resume")
        for resume in ("--resume", "--resume-if-begun"):  # it is complete
            workplace.runs(*self.ROBOT, "--trials", "1", resume)

    @pytest.mark.parametrize("option", ["--after-reboot", "--restart"])
    def test_what_has_no_effect_is_refused(self, workplace: Workplace, option: str) -> None:
        assert f"{option} needs " in workplace.fails(*self.ROBOT, option)
        assert not (workplace.directory / "out").exists()
