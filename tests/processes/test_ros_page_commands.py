"""What the page about ROS says of exported runs, typed as it stands there."""

import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
SECTION = (
    (ROOT / "docs" / "ros.md")
    .read_text(encoding="utf-8")
    .partition("## A run in Foxglove")[2]
    .partition("\n## ")[0]
)


def block(language: str) -> str:
    """Return the first block of the section in this language."""
    found = re.search(rf"^```{language}\n(.*?)^```", SECTION, re.MULTILINE | re.DOTALL)
    assert found is not None
    return found[1]


def test_a_run_is_exported_and_read(tmp_path: Path) -> None:
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}

    def run(*command: str) -> str:
        done = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    typed = block("sh").replace("--trials 5", "--trials 1")
    assert typed != block("sh")
    run("bash", "-euc", typed)
    assert sorted(path.name for path in (tmp_path / "tables").iterdir()) == [
        "beliefs.csv",
        "events.csv",
        "steps.csv",
        "trials.csv",
    ]
    lines = run("python", "-c", block("python")).splitlines()
    assert lines
    assert all(int(line.split()[1]) == 500 for line in lines)
