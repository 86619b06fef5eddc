"""Every command and program of README and the pages under docs, run as a newcomer would run them.

docs/deploy.md and docs/ros.md need machines of their own: tests/deploy/test_deploy_page.py and
tests/processes/test_ros_page_commands.py run theirs.
"""

import contextlib
import os
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from tests.ports import free_port

ROOT = Path(__file__).parents[2]
ELSEWHERE = {"deploy.md", "ros.md"}
ENVIRONMENT = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}


class Page(NamedTuple):
    name: str
    text: str
    commands: list[str]
    programs: list[str]
    files: dict[str, str]


def read_page(path: Path) -> Page:
    text = path.read_text(encoding="utf-8")
    blocks = re.findall(r"^```(\w+)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    commands = [
        line.split("#")[0].strip()
        for language, block in blocks
        if language == "sh"
        for line in block.splitlines()
        if line.split("#")[0].strip()
    ]
    programs = [block for language, block in blocks if language == "python"]
    named = {
        match[1]: block
        for _, block in blocks
        if (match := re.match(r"# ([\w/]+\.(?:py|yaml))\b", block))
    }
    return Page(str(path.relative_to(ROOT)), text, commands, programs, named)


PAGES = [
    page
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
    if path.name not in ELSEWHERE
    for page in [read_page(path)]
    if page.commands or page.programs
]
NAMED = {page.name: page for page in PAGES}
README, ROBOTS = NAMED["README.md"], NAMED["docs/robots.md"]

SMALLER = {"--trials": "2", "--rate": "10000", "--seeds": "17:18", "--budget": "1s"}
"""What takes less time and is the same command."""

HERE = {
    "cloud.example.org": "localhost",
    "CONFIG": "examples/peg_in_hole_2d.yaml --trials 3",
    "--tls /keys": "--tls keys/robot",
    "/runs/today": "runs/today",
}
"""What stands for the reader's own, and what it is here."""


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """A directory with what a clone shows a command: the examples."""
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    return tmp_path


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
        command, cwd=directory, env=environment, capture_output=True, text=True, timeout=1800
    )


@contextlib.contextmanager
def in_background() -> Iterator[Callable[[list[str], Path], None]]:
    """Start what a command line ends in ``&`` for, wait for its first line, and end it.

    A command that listens where an earlier one does ends that one first.
    """
    started: dict[str, subprocess.Popen[str]] = {}

    def end(process: subprocess.Popen[str]) -> None:
        process.terminate()
        process.communicate(timeout=120)

    def start(command: list[str], directory: Path) -> None:
        where = command[command.index("--listen") + 1] if "--listen" in command else str(command)
        if where in started:
            end(started.pop(where))
        process = subprocess.Popen(
            command, cwd=directory, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True
        )
        started[where] = process
        assert process.stdout is not None
        assert process.stdout.readline(), f"{command} ended without a word"

    try:
        yield start
    finally:
        for process in started.values():
            end(process)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_is_known(page: Page) -> None:
    """So that a command of another kind gets a test of its own."""
    for command in page.commands:
        assert command.startswith(("holdfast ", "make ", "git clone ", "python ")), command


@pytest.mark.parametrize(
    "smaller",
    [
        pytest.param(SMALLER, id="small"),
        pytest.param({}, marks=pytest.mark.slow, id="to-the-letter"),
    ],
)
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_and_programs(page: Page, smaller: dict[str, str], clone: Path) -> None:
    """In their order: a program may read what a command before it has written."""
    for name, text in page.files.items():
        (clone / name).write_text(text, encoding="utf-8")
    ports = {":7447": f":{free_port()}", "--metrics 9090": f"--metrics {free_port()}"}
    with in_background() as start:
        for written in page.commands:
            if not written.startswith(("holdfast ", "python ")):
                continue
            command = written
            # Whatever else listens on this machine is not what the page has started.
            for theirs, ours in {**HERE, **ports}.items():
                command = command.replace(theirs, ours)
            words = shlex.split(command)
            for index, word in enumerate(words[:-1]):
                words[index + 1] = smaller.get(word, words[index + 1])
            if smaller and words[1] == "chaos":
                words[words.index("--trials") + 1] = "1"  # they take seconds each
            if smaller and words[1] == "check":
                words += ["--budget", "0.3"]
            if smaller and words[1] == "run" and "--trials" not in words:
                words += ["--trials", "1"]  # and not all of the configuration's
            if words[-1] == "&":
                start(words[:-1], clone)
                continue
            # Of the figures that of the README, which looks for it, is enough.
            figures = not smaller or (page is README and "runs/first" in words)
            done = run(words, clone, figures=figures)
            assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
    for program in page.programs:
        done = run([sys.executable, "-W", "error", "-c", program], clone)
        assert done.returncode == 0, done.stderr
        assert done.stdout.strip()
    if page is README:
        for name in ("trials.csv", "summary.json", "config.yaml", "journal.bin", "trial.png"):
            assert (clone / "runs" / "first" / name).stat().st_size > 0


def test_the_robot_of_the_page(clone: Path) -> None:
    """The class and its configuration run as they stand there."""
    for name in ("my_robot.py", "my_robot.yaml"):
        (clone / name).write_text(ROBOTS.files[name], encoding="utf-8")
    done = run(["holdfast", "run", "my_robot.yaml", "--trials", "1"], clone, figures=False)
    assert done.returncode == 0, done.stderr
    assert "(1 of 1; " in done.stdout


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_make_targets_exist(page: Page) -> None:
    # The targets themselves are what .ci/run runs.
    for command in page.commands:
        if command.startswith("make "):
            done = run(["make", "--dry-run", *shlex.split(command)[1:]], ROOT)
            assert done.returncode == 0, f"{command}\n{done.stderr}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_extras_exist_and_keep_the_editable_installation(page: Page) -> None:
    """A plain ``pip install .`` would replace what ``make demo`` has installed."""
    installed = re.findall(r"pip install (-e )?'\.\[(.+?)\]'", page.text)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    known = set(project["optional-dependencies"])
    for editable, extras in installed:
        assert editable
        assert set(extras.split(",")) <= known
    if page is README:
        assert installed
        makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
        assert '"holdfast-sensing[figures,service]"' in makefile
        assert " -e .\n" in makefile


LINKING = sorted(
    {*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "examples").rglob("*.md")}
)


@pytest.mark.parametrize("path", LINKING, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(path: Path) -> None:
    """To files, and to headings in them, by GitHub's rule for anchors."""
    for link in re.findall(r"\]\(([^)\s]+)\)", path.read_text(encoding="utf-8")):
        if "://" in link or link.startswith("mailto:"):
            continue
        name, _, anchor = link.partition("#")
        target = (path.parent / name).resolve() if name else path
        assert target.exists(), link
        if anchor:
            headings = re.findall(r"^#+ (.*)$", target.read_text(encoding="utf-8"), re.MULTILINE)
            anchors = {
                re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings
            }
            assert anchor in anchors, link


@pytest.mark.parametrize("name", ["README.md", "ARCHITECTURE.md"])
def test_nothing_is_left_to_fill_in(name: str) -> None:
    """Words in capitals with an underscore, but for names in code, wait for their text."""
    text = (ROOT / name).read_text(encoding="utf-8")
    prose = re.sub(r"^```.*?^```$|`[^`\n]+`", "", text, flags=re.DOTALL | re.MULTILINE)
    left = re.findall(r"\b[A-Z0-9]+(?:_[A-Z0-9]+)+\b|\b(?:TODO|FIXME|TBD|XXX)\b", prose)
    assert not left and (name != "README.md" or text.count("\n") <= 160), left
