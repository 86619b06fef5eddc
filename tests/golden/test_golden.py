"""Every kind of run decides what it has decided before; ``table.py`` says what is pinned."""

from __future__ import annotations

import csv
import json
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from tests.golden.table import COLUMNS, REWRITE, ROOT, TABLE, Run, pinned, runs

RUNS = {run.name: run for run in runs()}


@pytest.mark.parametrize("run", RUNS.values(), ids=RUNS.keys())
def test_a_run_decides_as_before(run: Run) -> None:
    command, before = pinned().get(run.name, ("", ""))
    if not before:
        pytest.fail(
            f"{run.name}: has no row in {TABLE.relative_to(ROOT)}; a run that is new gets one by "
            f"`{REWRITE}`",
            pytrace=False,
        )
    if command != run.command():
        pytest.fail(
            f"{run.name}: the table has another command; write it anew with `{REWRITE}`\n"
            f"  command before: {command}\n"
            f"  command now:    {run.command()}",
            pytrace=False,
        )
    now = run.digest()
    if now != before:
        pytest.fail(
            f"{run.name}: decides otherwise than before\n"
            f"  {command}\n"
            f"  digest before: {before}\n"
            f"  digest now:    {now}\n"
            "If nobody meant to change a decision, this is a defect: `holdfast compare` shows the "
            "first decision that differs from that of an older version. If the change is meant, "
            f"write the table anew with `{REWRITE}` and the reason into CHANGELOG.md.",
            pytrace=False,
        )


def test_the_table_is_in_order() -> None:
    """Nothing is pinned twice or without a run, and every row pins something of its own."""
    with TABLE.open(encoding="utf-8", newline="") as file:
        head, *rows = csv.reader(file)
    assert tuple(head) == COLUMNS
    left = [name for name, *_ in rows if name not in RUNS]
    assert not left, f"rows of runs that are no more: {left}; write the table anew: {REWRITE}"
    assert [name for name, *_ in rows] == [name for name in RUNS if name in pinned()]
    # Three examples are the same run; of the others each sees what the rest does not.
    digests = [digest for name, _, digest in rows if not name.startswith("examples/")]
    assert len(set(digests)) == len(digests)


def test_a_digest_is_that_of_the_command(tmp_path: Path) -> None:
    """The commands that the table names lead to its digests, in ``summary.json``."""
    name = "general likelihood, few resamplings"
    command, digest = pinned()[name]
    words = shlex.split(command)[1:]
    subprocess.run(
        [sys.executable, "-m", "holdfast", *words, "--quiet", "--out", str(tmp_path / "out")],
        cwd=ROOT,
        capture_output=True,
        timeout=300,
        check=True,
    )
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["digest"] == digest
