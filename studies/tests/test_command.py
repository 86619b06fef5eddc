"""``python -m studies`` as a person or a program calls it."""

import signal
import subprocess
import sys
from pathlib import Path
from time import monotonic, sleep

import pytest
from tests.answers import answers_in

from holdfast.errors import InvalidValueError, OptionError
from studies.command import main, studies_of, study_names
from studies.errors import TrialFileError
from studies.published_2017 import published_rows, series_of
from studies.study import Scale
from studies.trial_batches import problem_of


def test_list(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--list"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == study_names()


@pytest.mark.parametrize(
    ("line", "message"), [*answers_in("study_mistakes.txt"), ("", "NAME is missing")]
)
def test_bad_arguments(line: str, message: str, tmp_path: Path) -> None:
    with pytest.raises((InvalidValueError, OptionError, TrialFileError), match=message):
        main([*line.split(), "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()


def test_names() -> None:
    assert [study.name for study in studies_of(["all"])] == study_names()
    assert [study.name for study in studies_of(["all", study_names()[0]])] == study_names()
    with pytest.raises(InvalidValueError, match=r"'al'.* did you mean all"):
        studies_of(["al"])


def test_the_rows_of_2017_are_ours() -> None:
    rows = published_rows()
    assert len(rows) == 45
    assert sum(row.covered for row in rows) == 42
    for row in rows:
        series = series_of(row, 1000, seed=1)
        problem = problem_of(series.problem, series.model)
        assert problem.name == series.problem
        assert series.planning.selector.method == row.selector
        assert series.planning.sensing_interval == row.sensing_interval


@pytest.mark.parametrize("name", study_names())
def test_quick_is_part_of_the_same_work(name: str) -> None:
    (study,) = studies_of([name])
    quick = sum(task.units for task in study.tasks(Scale(quick=True)))
    whole = sum(task.units for task in study.tasks(Scale()))
    assert 0 < quick < whole / 5


@pytest.mark.slow
def test_interrupted_and_gone_on_with(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "studies", "published_2017", "--quick"]
    command += ["--jobs", "2", "--out", str(tmp_path)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        began = monotonic()
        while not list(tmp_path.rglob("*.table")) and monotonic() < began + 60:
            sleep(0.1)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=30)
    assert process.returncode == 128 + signal.SIGINT
    kept = len(list(tmp_path.rglob("*.table")))
    assert kept >= 1
    assert "Interrupted; " in said
    assert "Go on with: python -m studies published_2017 --quick" in said
    done = subprocess.run(command, capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0, done.stderr
    assert "known before" in done.stderr
    names = {path.name for path in (tmp_path / "published_2017").iterdir()}
    assert names == {
        "published_2017.csv",
        "numbers.csv",
        "published_2017_trials.csv",
        "published_2017.png",
        "published_2017.svg",
        "origin.json",
    }
    assert "emulated less logged: the largest difference: " in done.stdout


@pytest.mark.slow
def test_quick_makes_every_figure_that_is_shown(tmp_path: Path) -> None:
    """Whatever docs/results.md shows is made by one command, from few trials."""
    command = [sys.executable, "-m", "studies", "all", "--quick"]
    command += ["--jobs", "2", "--out", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=2400)
    assert done.returncode == 0, done.stderr
    results = Path(__file__).parents[2] / "docs" / "results"
    shown = {str(path.relative_to(results)) for path in results.rglob("*.*")}
    made = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.*")}
    assert shown
    assert shown <= made
    assert {path.parent.name for path in tmp_path.glob("*/origin.json")} == set(study_names())
