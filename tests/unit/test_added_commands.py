"""Commands of other packages, as entry points."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from tests.programs import completed

from holdfast.cli import added_commands
from holdfast.cli.application import find_command
from holdfast.errors import OptionError

GREET = """\
import sys

SUMMARY = "Greet someone."


def main(arguments):
    sys.stdout.write(f"hello {' '.join(arguments)}\\n")
    return 7
"""


@pytest.fixture
def packages(tmp_path: Path) -> Path:
    """A directory in which a package with four commands is installed, two of them broken."""
    metadata = tmp_path / "greetings-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: greetings\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(
        "[holdfast.commands]\n"
        "greet = greetings_command\n"
        "run = greetings_command\n"
        "raises = greetings_raises\n"
        "empty = greetings_empty\n"
    )
    (tmp_path / "greetings_command.py").write_text(GREET)
    (tmp_path / "greetings_raises.py").write_text("raise ZeroDivisionError('one by\\nnothing')\n")
    (tmp_path / "greetings_empty.py").write_text("")
    return tmp_path


def holdfast(packages: Path | None, *arguments: str) -> subprocess.CompletedProcess[str]:
    return completed(
        [sys.executable, "-c", "import holdfast.cli; holdfast.cli.main()", *arguments],
        env={**os.environ, "PYTHONPATH": "" if packages is None else str(packages)},
        timeout=60,
    )


def test_a_package_adds_a_command(packages: Path) -> None:
    done = holdfast(packages, "greet", "--loudly", "world")
    assert (done.returncode, done.stdout) == (7, "hello --loudly world\n")


def test_a_service_says_that_it_is_one(packages: Path) -> None:
    """Else its log would end it, once nobody reads it."""
    services = [find_command([name]).is_service for name in ("serve", "ros1-serve", "ros1-guard")]
    assert services == [True, True, True]
    assert not find_command(["run"]).is_service


def test_the_help_lists_it_and_says_what_is_broken(packages: Path) -> None:
    done = holdfast(packages, "--help")
    assert done.returncode == 0
    assert "  greet       Greet someone.\n" in done.stdout
    reason = "(the command raises of greetings cannot be loaded: ZeroDivisionError: one by"
    assert reason in done.stdout
    assert done.stdout.count("  run  ") == 1


def test_a_broken_command_is_one_message_and_breaks_no_other(packages: Path) -> None:
    done = holdfast(packages, "raises")
    assert done.returncode == 2
    assert done.stderr.startswith(
        "holdfast: error: the command raises of greetings cannot be loaded: ZeroDivisionError"
    )
    assert "Traceback" not in done.stderr
    done = holdfast(packages, "empty")
    assert done.stderr == (
        "holdfast: error: the command empty of greetings cannot be loaded: greetings_empty has no "
        "function main\n"
    )
    assert holdfast(packages, "greet").returncode == 7


def test_holdfasts_own_command_goes_first(packages: Path) -> None:
    assert "usage: holdfast run" in holdfast(packages, "run", "--help").stdout


def test_an_unknown_command_is_compared_with_all(packages: Path) -> None:
    done = holdfast(packages, "gret")
    assert done.stderr == "holdfast: error: 'gret' is no command; did you mean greet?\n"


@pytest.mark.parametrize(
    ("command", "folder"),
    [("demo", "./lab"), ("simulate", "./lab"), ("ros1-guard", "./ros/ros1_master_guard")],
)
def test_without_its_package_a_command_says_what_to_install(
    command: str, folder: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(added_commands, "added_commands", dict)
    with pytest.raises(OptionError, match=f"{command} is in .*: pip install {folder}"):
        find_command([command, "--quick"])


def test_own_commands_read_no_metadata(packages: Path) -> None:
    """It takes some ten milliseconds, and start-up time is recovery time."""
    program = (
        "import sys, holdfast.cli\n"
        "try:\n"
        "    holdfast.cli.main()\n"
        "finally:\n"
        "    print('importlib.metadata' in sys.modules)\n"
    )
    for arguments, reads in ((["keys", "--help"], False), (["--help"], True)):
        done = subprocess.run(
            [sys.executable, "-c", program, *arguments],
            env={**os.environ, "PYTHONPATH": str(packages)},
            capture_output=True,
            text=True,
            timeout=60,
            check=True,
        )
        assert done.stdout.endswith(f"\n{reads}\n")
