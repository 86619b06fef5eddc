"""The figure of trial 0, which is run again where this process did not run it.

Where the trial is first decided otherwise then, and which service had decided.
"""

import errno
import os
from pathlib import Path
from unittest.mock import Mock

import pytest
from tests.command_line import PEG, Workplace
from tests.recordings import configuration_of, decided, flipped

from holdfast.cli.run_figure import repeat, service_that_decided
from holdfast.errors import DecidedOtherwiseError
from holdfast.journal.run_directory import RunDirectory
from holdfast.journal.timings import EventTable
from holdfast.planning.outcome import TrialResult
from holdfast.planning.planner import Planner
from holdfast.protocol.question import OWN_PLANNER
from holdfast.protocol.robot_events import Timing
from holdfast.reports.recorder import Recorder


def test_the_figure_of_any_trial_in_three_formats(
    workplace: Workplace, monkeypatch: pytest.MonkeyPatch
) -> None:
    workplace.write("peg.yaml", PEG)
    assert (
        workplace.run("run", "peg.yaml", "--jobs", "1", "--trials", "3", "--out", "out").code == 0
    )
    drawn = {}
    begins = {"pdf": b"%PDF", "png": b"\x89PNG", "svg": b"<?xml"}
    names = {**{f"one.{kind}": "1" for kind in begins}, "two.svg": "2"}
    for name, trials in {**names, "again.svg": "1:3", "again.pdf": "1:3"}.items():
        words = ["export", "out", "--figure", name, "--trials", trials]
        said = workplace.run(*words, figures=True)
        assert (said.code, name in said.stdout) == (0, True), said.stderr
        drawn[name] = (workplace.directory / name).read_bytes()
        assert drawn[name].startswith(begins[name[-3:]])
    for kind in ("svg", "pdf"):  # the first of the trials, whenever it is drawn
        assert drawn[f"one.{kind}"] == drawn[f"again.{kind}"]
    assert drawn["one.svg"] != drawn["two.svg"]
    for words, message in (
        (["--figure", "new.png"], "matplotlib is not installed"),
        (["--figure", "one.pdf"], "one.pdf: exists already; remove it"),
        (["--figure", "x.svg", "--csv", "x.svg"], "x.svg is given twice; give two places"),
    ):
        said = workplace.run("export", "out", *words, figures="new.png" not in words)
        assert (said.code, message in said.stderr) == (2, True), said.stderr
    # Where it is written does not depend on what is in it.
    monkeypatch.setattr("holdfast.reports.figure.trial_figure", lambda *_: b"a figure")
    full = OSError(errno.ENOSPC, "No space left")
    for more, synchronized, name in (
        ([], [full], "new.pdf"),
        # No part of an export is put in place alone, whichever fails.
        (["--csv", "tables"], [None, full], "tables"),
        (["--csv", "tables"], [*[None] * 4, full], "new.pdf"),
    ):
        monkeypatch.setattr(os, "fsync", Mock(side_effect=synchronized))
        said = workplace.run("export", "out", "--figure", "new.pdf", *more, figures=True)
        assert f"error: {name}: cannot be written: No space left" in said.stderr
        assert not [each for each in ("new.pdf", "tables") if (workplace.directory / each).exists()]


def test_without_matplotlib_a_note_says_so(workplace: Workplace) -> None:
    workplace.write("peg.yaml", PEG)
    said = workplace.run("run", "peg.yaml", "--trials", "1", "--out", "out")
    assert said.code == 0
    assert "note: no figure, because matplotlib is not installed" in said.stderr


def repeated(tmp_path: Path, result: TrialResult) -> tuple[int, str | None] | None:
    """Return where and in which decision the trial differs."""
    configuration = configuration_of(tmp_path)
    recorder = Recorder(1, Planner(configuration.problem, configuration.planning))
    with RunDirectory.create(tmp_path / "run", configuration) as directory:
        try:
            assert repeat(configuration, directory.journal, result, recorder)
        except DecidedOtherwiseError as error:
            return error.step, error.kind
    assert recorder.record.result is not None
    return None


def test_the_same_trial_has_no_deviation(tmp_path: Path) -> None:
    assert repeated(tmp_path, decided(configuration_of(tmp_path))) is None


@pytest.mark.parametrize(
    ("byte", "differs"),
    [
        pytest.param(9, (0, "sensing"), id="the first sensing action"),
        pytest.param(13, (0, None), id="the state after it"),
        pytest.param(45 + 9, (0, "task"), id="the first task action"),
        pytest.param(-1, (30, None), id="the last state"),
    ],
)
def test_the_first_deviation_is_found(
    byte: int, differs: tuple[int, str | None], tmp_path: Path
) -> None:
    assert repeated(tmp_path, flipped(decided(configuration_of(tmp_path)), byte)) == differs


@pytest.mark.parametrize(
    ("service", "named"), [("tcp/cloud:7447", "tcp/cloud:7447"), (OWN_PLANNER, None)]
)
def test_the_service_that_decided_is_named(service: str, named: str | None, tmp_path: Path) -> None:
    """An answer has the task actions up to the next sensing step: that of step 0 has step 3."""
    table = EventTable(tmp_path / "timings.csv", Timing)
    table.add(Timing(1, 0, "task", service, "standard", 1.0, 1.0, 1.0))
    table.close()
    task, none = (DecidedOtherwiseError(1, 3, kind) for kind in ("task", None))
    assert service_that_decided(task, tmp_path / "timings.csv") == named
    assert service_that_decided(none, tmp_path / "timings.csv") is None
