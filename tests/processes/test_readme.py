"""The README's commands and programs, run as a newcomer would run them."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tests.ports import free_port

from holdfast.outcome import TrialResult
from holdfast.recording.tables import csv_lines

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```$", README, re.DOTALL | re.MULTILINE)
COMMANDS = [
    line.split("#")[0].strip()
    for language, text in BLOCKS
    if language == "sh"
    for line in text.splitlines()
    if line.strip()
]
PROGRAMS = [text for language, text in BLOCKS if language == "python"]
ALONE = [program for program in PROGRAMS if "runs/" not in program]
"""Programs that read nothing that a command has written."""


@pytest.fixture(scope="module")
def clone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with what a clone shows a command: the examples."""
    directory = tmp_path_factory.mktemp("clone")
    (directory / "examples").symlink_to(ROOT / "examples")
    return directory


ENVIRONMENT = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}


def run(
    command: list[str], directory: Path, *, figures: bool = True
) -> subprocess.CompletedProcess[str]:
    """Run a command, as if matplotlib were not installed unless figures are wanted."""
    environment = ENVIRONMENT
    if not figures:
        absent = directory / "absent"
        absent.mkdir(exist_ok=True)
        (absent / "matplotlib.py").write_text(
            "raise ModuleNotFoundError(\"No module named 'matplotlib'\", name='matplotlib')\n"
        )
        environment = {**environment, "PYTHONPATH": str(absent)}
    return subprocess.run(
        command, cwd=directory, env=environment, capture_output=True, text=True, timeout=240
    )


@contextlib.contextmanager
def in_background() -> Iterator[Callable[[list[str], Path], None]]:
    """Start what a command line ends in ``&`` for, wait until it has said something, and end it."""
    started: list[subprocess.Popen[str]] = []

    def start(command: list[str], directory: Path) -> None:
        process = subprocess.Popen(
            command, cwd=directory, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True
        )
        started.append(process)
        assert process.stdout is not None
        assert process.stdout.readline(), f"{command} ended without a word"

    try:
        yield start
    finally:
        for process in started:
            process.terminate()
            process.communicate(timeout=30)


def test_every_command_is_known() -> None:
    """So that a command of another kind gets a test of its own."""
    for command in COMMANDS:
        assert command.startswith(("holdfast ", "make ", "git clone ", "python ")), command
    assert sum(command.startswith("holdfast ") for command in COMMANDS) >= 3
    assert len(PROGRAMS) >= 2


SMALLER = {"--trials": "3", "--rate": "10000", "--seeds": "17:18"}
"""What takes less time and is the same command."""


def test_the_chaos_command(tmp_path: Path) -> None:
    """With one trial: they take seconds each, where others take fractions of one."""
    (command,) = (command for command in COMMANDS if command.startswith("holdfast chaos "))
    words = shlex.split(command)
    words[words.index("--trials") + 1] = "1"
    done = run(words, tmp_path)
    assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"


@pytest.mark.parametrize(
    "smaller",
    [
        pytest.param(SMALLER, id="made small"),
        pytest.param({}, marks=pytest.mark.slow, id="to the letter"),
    ],
)
def test_holdfast_commands(tmp_path: Path, smaller: dict[str, str]) -> None:
    clone = tmp_path
    (clone / "examples").symlink_to(ROOT / "examples")
    port = str(free_port())
    with in_background() as start:
        for written in COMMANDS:
            # Whatever else listens on this machine is not what the README has started.
            command = written.replace(":7447", f":{port}") if smaller else written
            if not command.startswith(("holdfast ", "python ")):
                continue
            if smaller and command.startswith("holdfast chaos "):
                continue
            words = shlex.split(command)
            for index, word in enumerate(words[:-1]):
                words[index + 1] = smaller.get(word, words[index + 1])
            if words[-1] == "&":
                start(words[:-1], clone)
                continue
            # Of the figures the first is enough.
            done = run(words, clone, figures=not smaller or "runs/first" in words)
            assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
    for program in PROGRAMS:
        if program not in ALONE:
            done = run([sys.executable, "-W", "error", "-c", program], clone)
            assert done.returncode == 0, done.stderr
            assert done.stdout.strip()
    for name in ("trials.csv", "summary.json", "config.yaml", "journal.sqlite", "trial.png"):
        assert (clone / "runs" / "first" / name).stat().st_size > 0


def test_the_robot_of_ones_own(clone: Path) -> None:
    """The class and its configuration run as they stand there."""
    for name in ("my_robot.py", "my_robot.yaml"):
        (text,) = (text for _, text in BLOCKS if text.startswith(f"# {name}"))
        (clone / name).write_text(text, encoding="utf-8")
    done = run(["holdfast", "run", "my_robot.yaml", "--trials", "1"], clone)
    assert done.returncode == 0, done.stderr
    assert "(1 of 1; " in done.stdout


def test_make_targets_exist() -> None:
    # The targets themselves are what .ci/run runs.
    for command in COMMANDS:
        if command.startswith("make "):
            done = run(["make", "--dry-run", *shlex.split(command)[1:]], ROOT)
            assert done.returncode == 0, f"{command}\n{done.stderr}"


def test_what_is_installed_keeps_the_editable_installation_and_suffices() -> None:
    """A plain ``pip install .`` would replace what ``make demo`` has installed."""
    installed = re.findall(r"pip install (-e )?'\.\[(.+?)\]'", README)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    known = set(project["optional-dependencies"])
    assert installed
    for editable, extras in installed:
        assert editable
        assert set(extras.split(",")) <= known
    # What `holdfast keys` needs is named before it is used, and the demo's environment has it.
    assert README.index("'.[service]'") < README.index("holdfast keys")
    assert '-e ".[figures,service]"' in (ROOT / "Makefile").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["README.md", "ARCHITECTURE.md"])
def test_nothing_is_left_to_fill_in(name: str) -> None:
    """Words in capitals with an underscore, but for names in code, wait for their text."""
    text = (ROOT / name).read_text(encoding="utf-8")
    prose = re.sub(r"^```.*?^```$|`[^`\n]+`", "", text, flags=re.DOTALL | re.MULTILINE)
    left = re.findall(r"\b[A-Z0-9]+(?:_[A-Z0-9]+)+\b|\b(?:TODO|FIXME|TBD|XXX)\b", prose)
    assert left == []


def test_the_comparison_of_two_runs_leaves_out_trials_without_a_step(tmp_path: Path) -> None:
    """A trial may begin in the goal; then it does so in both runs, and has no ratio."""
    (program,) = (program for program in PROGRAMS if "ttest_rel" in program)
    steps = {"room": [0, 50, 60, 0, 80], "room-random": [0, 100, 120, 0, 160]}
    for run_name, numbers in steps.items():
        results = [
            TrialResult(
                trial=trial,
                seed=0,
                success=True,
                steps=number,
                reward=None,
                sensing_decisions=number // 5,
                mean_sensing_ms=0.1,
                recoveries=0,
                unexplained_observations=0,
                digest="00" * 32,
                sensing_ms=(),
            )
            for trial, number in enumerate(numbers)
        ]
        directory = tmp_path / "runs" / run_name
        directory.mkdir(parents=True)
        (directory / "trials.csv").write_text("".join(csv_lines(results)))
    # The ratios are all the same, of which a test of their scatter has to say something, too.
    varied = tmp_path / "runs" / "room" / "trials.csv"
    varied.write_text(varied.read_text().replace(",80,", ",82,"))
    done = run([sys.executable, "-W", "error", "-c", program], tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "0.50 [0.49, 0.52] times the steps of random sensing\n"


@pytest.mark.parametrize("program", ALONE, ids=[f"program-{i}" for i in range(len(ALONE))])
def test_programs(program: str, clone: Path) -> None:
    done = run([sys.executable, "-W", "error", "-c", program], clone)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()
