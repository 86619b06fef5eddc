"""A run is shown in a viewer of its own process: Rerun's server stands for the window."""

import contextlib
import json
import signal
import socket
import subprocess
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest
import rerun_cli
from rerun.chunk import RrdReader
from tests.ports import free_port
from tests.processes.faults import COMMAND

PATIENCE_S = 180.0

RUN = """
problem: peg_in_hole_2d
particle_filter: {num_particles: 40}
active_sensing: {num_observation_samples: 3, num_cores: 1}
simulator: {num_trials: 2, max_steps: 40, seed: 3, sensing_intervals: 4}
"""

# The run ends when the file is there: so that a viewer is closed while it goes on.
HELD = """
import time
from pathlib import Path

from holdfast.problems.peg_in_hole_2d import PegInHole2D

HERE = Path(__file__).parent


class Robot:
    def __init__(self, trial, resumed):
        self.trial, self.steps = trial, 0

    def perform_sensing(self, sensing_action):
        return [0.0]

    def perform(self, task_action):
        (HERE / f"step-{self.trial}-{self.steps}").touch()
        self.steps += 1
        time.sleep(0.02)

    def is_done(self):
        return (HERE / "go").exists()
"""


class Viewer:
    def __init__(self, file: Path) -> None:
        self.port = free_port()
        program = Path(rerun_cli.__file__).parent / "rerun"
        words = [str(program), "--bind", "127.0.0.1", "--port", str(self.port), "--save", str(file)]
        self.process = subprocess.Popen(
            words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, stdin=subprocess.DEVNULL
        )
        until = time.monotonic() + PATIENCE_S
        while True:
            with contextlib.suppress(OSError):
                socket.create_connection(("127.0.0.1", self.port), 1.0).close()
                return
            assert self.process.poll() is None
            assert time.monotonic() < until
            time.sleep(0.02)


@pytest.fixture
def viewer(tmp_path: Path) -> Iterator[Viewer]:
    started = Viewer(tmp_path / "seen.rrd")
    yield started
    started.process.kill()
    started.process.wait()


def log_of(file: Path) -> list[str]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a server that is killed writes no table of contents
        reader = RrdReader(file)
    rows = [
        row
        for chunk in reader.stream().to_chunks()
        if chunk.entity_path == "/log"
        for row in chunk.to_record_batch().to_pylist()
    ]
    return [row["TextLog:text"][0] for row in rows]


def test_what_happens_is_seen(tmp_path: Path, viewer: Viewer) -> None:
    (tmp_path / "run.yaml").write_text(RUN)
    words = ["run", "run.yaml", "--out", "run", "--view", f"rerun=127.0.0.1:{viewer.port}"]
    done = subprocess.run(
        [*COMMAND, *words], cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert done.returncode == 0, done.stderr
    assert "the view has ended" not in done.stderr
    viewer.process.send_signal(signal.SIGINT)
    viewer.process.wait(PATIENCE_S)
    log = log_of(tmp_path / "seen.rrd")
    assert [line for line in log if line.endswith("begins")] == ["trial 0 begins", "trial 1 begins"]


def test_a_viewer_that_is_closed_does_not_end_the_run(tmp_path: Path, viewer: Viewer) -> None:
    (tmp_path / "run.yaml").write_text(RUN.replace("max_steps: 40", "max_steps: 5000"))
    (tmp_path / "held.py").write_text(HELD)
    words = ["run", "run.yaml", "--out", "run", "--environment", "held:Robot", "--trials", "1"]
    view = ["--view", f"rerun=127.0.0.1:{viewer.port}", "--view-file", "tee.rrd"]
    with subprocess.Popen(
        [*COMMAND, *words, *view], cwd=tmp_path, stderr=subprocess.PIPE, text=True
    ) as run:
        until = time.monotonic() + PATIENCE_S
        while not (tmp_path / "step-0-5").exists():
            assert run.poll() is None
            assert time.monotonic() < until
            time.sleep(0.02)
        viewer.process.kill()
        viewer.process.wait()
        seen = len(list(tmp_path.glob("step-*")))
        while len(list(tmp_path.glob("step-*"))) < seen + 20:
            assert run.poll() is None
            assert time.monotonic() < until
            time.sleep(0.02)
        (tmp_path / "go").touch()
        _, said = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 0, said
    assert said.count("the view has ended: the viewer was closed") == 1
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["finished"] == 1
    assert log_of(tmp_path / "tee.rrd")[0] == "trial 0 begins"
