"""``holdfast view``, and ``holdfast run --view-file``: the same steps, and the same decisions."""

import json
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from rerun.chunk import RrdReader
from tests.command_line import Said, done_here, run_here

from holdfast.reports import live_follower, live_view, rerun_streams

RUN = """
problem: peg_in_hole_2d
particle_filter: {num_particles: 40}
active_sensing: {num_observation_samples: 3, num_cores: 1}
simulator: {num_trials: 3, max_steps: 20, seed: 3, sensing_intervals: 4}
"""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("recorded")
    (directory / "run.yaml").write_text(RUN)
    done_here(directory, ("run", "run.yaml", "--out", "run", "-q", "--jobs", "1"))
    return directory


@pytest.fixture
def here(tmp_path: Path, recorded: Path) -> Path:
    """Return a directory with a run."""
    shutil.copytree(recorded, tmp_path, dirs_exist_ok=True)
    return tmp_path


def done(said: Said) -> Said:
    assert said.code == 0, said.stderr
    return said


def rows(file: Path, path: str) -> list[dict[str, Any]]:
    chunks = RrdReader(file).stream().to_chunks()
    found = [
        row
        for chunk in chunks
        if chunk.entity_path == path and not chunk.is_static
        for row in chunk.to_record_batch().to_pylist()
    ]
    return sorted(found, key=lambda row: int(row["step"]))


def summary_of(run: Path) -> Any:
    return json.loads((run / "summary.json").read_text())


def follow_patiently(*arguments: Any) -> None:
    """Show all steps, however late a busy machine reads them."""
    vars(live_follower)["_LATE_NS"] = 10**18
    live_follower.follow(*arguments)


class TestARecordedRun:
    def test_as_a_file(self, here: Path, capsys: pytest.CaptureFixture[str]) -> None:
        said = done(run_here(capsys, here, "view", "run", "--save", "run.rrd"))
        assert said.stdout.startswith("run.rrd  ")
        assert "every step takes 0.1 s" in said.stderr
        log = [row["TextLog:text"][0] for row in rows(here / "run.rrd", "/log")]
        begun = [line for line in log if line.endswith("begins")]
        assert begun == [f"trial {trial} begins" for trial in range(3)]
        assert sorted(path.name for path in here.iterdir()) == ["run", "run.rrd", "run.yaml"]

    def test_some_trials(self, here: Path, capsys: pytest.CaptureFixture[str]) -> None:
        done(run_here(capsys, here, "view", "run", "--save", "run.rrd", "--trials", "1:2", "-q"))
        trials = {row["trial"] for row in rows(here / "run.rrd", "/world/belief")}
        assert trials == {1}
        assert rows(here / "run.rrd", "/world/estimate")[0]["step"] == 0

    def test_a_viewer_that_is_closed(
        self, here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def lose(streams: rerun_streams.RerunStreams, *, last: bool = False) -> None:
            streams.lost = "was closed, or the connection was lost"

        monkeypatch.setattr(rerun_streams.RerunStreams, "flush", lose)
        said = run_here(capsys, here, "view", "run", "--save", "run.rrd")
        assert said.code == 2
        assert "the viewer was closed" in said.stderr
        assert not (here / "run.rrd").exists()


class TestARunThatGoesOn:
    def test_the_same_decisions_and_steps(
        self, here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        patient = partial(live_view.LiveView, work=follow_patiently)
        monkeypatch.setattr(live_view, "LiveView", patient)
        monkeypatch.setattr(live_view, "_CLOSE_S", 600.0)
        monkeypatch.setattr(live_view, "_START_S", 600.0)
        words = ["run", "run.yaml", "--out", "live", "--view-file", "live.rrd"]
        said = done(run_here(capsys, here, *words))
        assert "the view" not in said.stderr
        assert summary_of(here / "live")["digest"] == summary_of(here / "run")["digest"]
        done(run_here(capsys, here, "view", "live", "--save", "again.rrd", "-q"))
        for path, column in [
            ("/world/estimate", "Transform3D:translation"),
            ("/world/truth", "Transform3D:translation"),
            ("/world/belief", "Points3D:positions"),
            ("/scores", "Scalars:scalars"),
            ("/decisions/sensing_action", "StateChange:state"),
        ]:
            live, again = (
                [(row["step"], row["trial"], row[column]) for row in rows(here / name, path)]
                for name in ("live.rrd", "again.rrd")
            )
            assert live == again, path
            assert live, path


RUN_AGAIN = ("run", "run.yaml", "--out", "live")


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("view", "run", "--save", "run.yaml"), "run.yaml: exists already"),
        (("view", "run", "--save", "run.rrd", "--trials", "7:9"), "has no trial from 7 to 8"),
        (("view", "run"), "write a file instead (view RUN --save FILE, "),
        (("view", "run", "--viewer", "127.0.0.1:1"), "no Rerun viewer listens at"),
        ((*RUN_AGAIN, "--view-file", "run.yaml"), "run.yaml: exists already"),
        ((*RUN_AGAIN, "--view-file", "live.rrd", "--jobs", "2"), "leave out --service"),
        ((*RUN_AGAIN, "--view", "rerun"), "there is no display for Rerun's viewer"),
        ((*RUN_AGAIN, "--view", "rerun=127.0.0.1:1"), "no Rerun viewer listens at"),
    ],
)
def test_what_cannot_be_shown(
    words: tuple[str, ...],
    why: str,
    here: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if words[0] == "view":
        monkeypatch.setattr(rerun_streams, "_listens", lambda _: False)
    monkeypatch.setattr(live_view, "_START_S", 600.0)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    said = run_here(capsys, here, *words)
    to_a_viewer = "rerun=" in words[-1]
    assert said.code == 2 or (to_a_viewer and said.code == 4)
    assert why in said.stderr
    if not to_a_viewer:
        made = {path.name for path in here.iterdir()} - {"run", "run.yaml"}
        assert made <= {"live"} and (words[0] == "run" or not made)
        assert not (here / "live" / "trials.csv").exists()
