"""The make targets' pip: silent but for one line, and as good as pip itself at failing."""

from pathlib import Path

from tests.programs import completed

PIP_INSTALL = Path(__file__).parents[2] / "cmake" / "pip_install"


def test_it_ends_as_pip_does_and_passes_its_complaint_on(tmp_path: Path) -> None:
    python = tmp_path / "python"
    python.write_text('#!/bin/sh\necho "$@"\necho "ERROR: no such package" >&2\nexit 3\n')
    python.chmod(0o755)
    log = tmp_path / "pip.log"
    done = completed([PIP_INSTALL, python, log, "-e", ".[dev]"], timeout=120)
    assert done.returncode == 3
    assert done.stderr == "ERROR: no such package\n"
    (line,) = done.stdout.splitlines()
    assert line.startswith(f"installing -e .[dev] with {python} (")
    assert str(log) in line
    assert log.exists()
