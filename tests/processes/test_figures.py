"""A finished run whose figure cannot be drawn here: it ends with 0 and a remark."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from tests.processes.test_streams import CONFIGURATION
from tests.programs import completed


def run(directory: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    (directory / "capsule.yaml").write_text(CONFIGURATION)
    return completed(
        [sys.executable, "-m", "holdfast", "run", "capsule.yaml", "--out", "out"],
        cwd=directory,
        env={**os.environ, **environment},
        timeout=120,
    )


@pytest.mark.parametrize("backend", ["module://matplotlib_inline.backend_inline", "nonsense"])
def test_the_backend_of_a_notebook(tmp_path: Path, backend: str) -> None:
    """A terminal of Jupyter hands it on, where its module need not be installed."""
    done = run(tmp_path, MPLBACKEND=backend)
    assert (done.returncode, "figure" in done.stderr) == (0, False), done.stderr
    assert (tmp_path / "out" / "trial.png").read_bytes().startswith(b"\x89PNG\r\n")


def test_a_matplotlib_that_does_not_import(tmp_path: Path) -> None:
    """As after an update of NumPy."""
    (tmp_path / "matplotlib.py").write_text("raise AttributeError('_ARRAY_API not found')\n")
    done = run(tmp_path, PYTHONPATH=str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert "note: no figure, because it cannot be drawn: " in done.stderr
    assert "AttributeError: _ARRAY_API not found" in done.stderr
    assert (tmp_path / "out" / "summary.json").is_file()
