"""``holdfast tune``: its options, its files, and how it goes on."""

from pathlib import Path
from typing import Any

import pytest
from tests.command_line import run_here
from tests.unit.test_tuning_tune import RUN

from holdfast.errors import WorkerDiedError
from holdfast.tuning import tune as tuning
from holdfast.tuning.findings import Finding

WORDS = ("tune", "run.yaml", "--vary", "fixed", "--trials", "20", "-j", "1", "--no-check")


@pytest.fixture
def here(tmp_path: Path) -> Path:
    (tmp_path / "run.yaml").write_text(RUN)
    return tmp_path


@pytest.mark.parametrize("given", [(), ("--set", "particle_filter.num_particles=31")])
def test_it_says_what_to_do(
    here: Path, capsys: pytest.CaptureFixture[str], given: tuple[str, ...]
) -> None:
    said = run_here(capsys, here, *WORDS, *given)
    assert said.code == 0, said.stderr
    assert (here / "runs/run-tuned/tune.md").read_text() == said.stdout
    # Without it nothing is to be changed.
    kept = (here / "runs/run-tuned/tuned.yaml").read_text()
    assert ("num_particles: 31" in kept) == bool(given)
    assert ("Take it: holdfast run runs/run-tuned/tuned.yaml" in said.stderr) == bool(given)
    assert not (here / "runs/run-tuned/tune.png").exists()  # no matplotlib here
    more = ("--resume", "--out", "runs/run-tuned", "-q")
    again = run_here(capsys, here, *WORDS, *given, *more)
    assert again.stdout == said.stdout.splitlines(keepends=True)[0]


def test_an_interrupted_one_goes_on(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*arguments: Any, **more: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(tuning, "tune", interrupted)
    said = run_here(capsys, here, *WORDS, "--budget", "1.5m", "--out", "mine")
    assert said.code == 130
    command = "holdfast tune run.yaml --vary fixed --trials 20 --jobs 1 --no-check"
    command = command.replace("--trials", "--budget 1.5m --trials") + " --out mine --resume"
    assert said.stderr.endswith(f"Go on with: {command}\n")


def test_after_a_killed_worker_it_can_go_on(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(*arguments: Any, on_progress: Any, **more: Any) -> None:
        on_progress(tuning.Progress(0.1, 1, "5 candidates race"))
        raise WorkerDiedError("a worker process was killed")

    def warned(_: Any, __: float, warn: Any, check: str) -> None:
        warn(Finding("warning", "units", "an angle is in degrees", "Use radians."))

    monkeypatch.setattr(tuning, "tune", killed)
    monkeypatch.setattr("holdfast.tuning.check_process.require_right", warned)
    said = run_here(capsys, here, *WORDS[:-1], "--out", "mine")
    assert said.stderr.startswith("note: units: an angle is in degrees -> Use radians.\n")
    assert said.code == 4
    assert "holdfast: error: a worker process was killed\nGo on with: holdfast tune" in said.stderr
    assert said.stderr.endswith(" --out mine --resume\n")


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("--budget", "10"), "--budget is '10'; allowed are durations from 1s to 720h"),
        (
            ("--vary", "looks,methd"),
            "--vary is 'methd'; allowed are methods, looks, resolution, estimators, fixed, "
            "interval, particles, with commas between; did you mean methods?",
        ),
        (("--resume",), "--resume needs --out DIR"),
        (("--objective", "step"), "--objective is 'step'; allowed are reward, steps and success"),
    ],
)
def test_what_is_refused(
    here: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], complaint: str
) -> None:
    said = run_here(capsys, here, "tune", "run.yaml", *words)
    assert said.code == 2
    assert complaint in said.stderr
