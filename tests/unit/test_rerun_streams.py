"""What is logged goes to each sink; a viewer that takes nothing is given up, a file goes on."""

import subprocess
from pathlib import Path

import pytest
import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import RrdReader

from holdfast.errors import ViewError
from holdfast.reports import rerun_streams
from holdfast.reports.rerun_streams import RerunStreams
from holdfast.reports.view_target import ViewTarget

URL = "rerun+http://127.0.0.1:9876/proxy"


class Viewer:
    """Stands for a stream to a viewer, which is closed or stands still after some time."""

    def __init__(self, error: str) -> None:
        self.error: str | None = error
        self.logged: list[object] = []

    def set_time(self, timeline: str, **moment: object) -> None:
        pass

    def log(self, entity: object, *shapes: object, static: bool) -> None:
        self.logged.append(entity)

    def flush(self, timeout_sec: float) -> None:
        if self.error is not None and len(self.logged) > 1:
            raise RuntimeError(self.error)


@pytest.mark.parametrize(
    ("error", "why"),
    [
        ("Flush timed out - not all log messages were sent", "took nothing for 5 s"),
        ("gRPC connection severed", "was closed, or the connection was lost"),
    ],
)
def test_a_viewer_is_given_up_and_the_file_goes_on(error: str, why: str, tmp_path: Path) -> None:
    file = tmp_path / "run.rrd"
    streams = RerunStreams(ViewTarget(None, str(file)))
    streams.open(rrb.Blueprint())
    viewer = Viewer(error)
    streams._streams["viewer"] = viewer  # type: ignore[assignment]
    for number in range(4):
        streams.set_time("step", sequence=number)
        streams.log("log", rr.TextLog(f"line {number}"))
        streams._next_flush = 0.0
        streams.flush()
    assert streams.is_open
    assert streams.lost == why
    assert len(viewer.logged) == 2
    streams.close()
    chunks = RrdReader(file).stream().to_chunks()
    assert sum(chunk.num_rows for chunk in chunks if chunk.entity_path == "/log") == 4


def test_a_viewer_elsewhere_is_not_started(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rerun_streams, "_listens", lambda _: False)
    with pytest.raises(ViewError, match="no Rerun viewer listens at rerun"):
        RerunStreams(ViewTarget(URL)).open(rrb.Blueprint())


def test_a_viewer_that_cannot_be_started(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rerun_streams, "_listens", lambda _: False)
    started: list[list[str]] = []

    class Ended:
        returncode = 101

        def __init__(self, words: list[str], **how: object) -> None:
            started.append(words)

        def poll(self) -> int:
            return self.returncode

    monkeypatch.setattr(subprocess, "Popen", Ended)
    with pytest.raises(ViewError, match="exit code 101"):
        RerunStreams(ViewTarget("")).open(rrb.Blueprint())
    # Nobody else can reach it.
    assert started[0][1:5] == ["--bind", "127.0.0.1", "--port", "9876"]


def test_a_file_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(ViewError, match="cannot be written"):
        RerunStreams(ViewTarget(None, str(tmp_path / "none" / "run.rrd"))).open(rrb.Blueprint())
