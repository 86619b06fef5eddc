"""``holdfast demo`` as CI runs it: the whole story, and its end when something is in the way."""

import os
import re
import signal
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Self

import pytest
from tests.marked_command import MarkedCommand

from holdfast.reports.compare import compare_runs

ATTEMPTS = 3
STANDSTILL_S = 0.1
"""The shortest that is told from a machine that is merely busy; a service has 0.25 s."""


class Demo(MarkedCommand):
    """A demo that is going on."""

    def __init__(self, directory: Path) -> None:
        self.temporary = directory / "tmp"
        self.temporary.mkdir()
        super().__init__(directory, "demo", "--quick", TMPDIR=str(self.temporary))

    def read_until(self, text: str) -> None:
        """Read the lines of the story up to the first one with this text in it."""
        assert self.process.stderr is not None
        lines = ""
        for line in self.process.stderr:
            lines += line
            if text in line:
                return
        raise AssertionError(f"{text!r} is not in\n{lines}")


@pytest.fixture
def directory() -> Iterator[Path]:
    # A short one: there is a local socket in the directory for temporary files.
    with tempfile.TemporaryDirectory(prefix="hf") as path:
        yield Path(path)


class Standstill:
    """Finds out for how long the machine, or one of its processors, has stood still at most."""

    def __init__(self) -> None:
        self.longest_s = 0.0
        self._ended = threading.Event()
        self._threads = [
            threading.Thread(target=self._watch, args=[processor], daemon=True)
            for processor in os.sched_getaffinity(0)
        ]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._ended.set()
        for thread in self._threads:
            thread.join()

    def _watch(self, processor: int) -> None:
        # Of this thread alone: elsewhere it would go on while the processor is held back.
        os.sched_setaffinity(0, {processor})
        before = time.monotonic()
        while not self._ended.wait(0.005):
            now = time.monotonic()
            self.longest_s = max(self.longest_s, now - before)
            before = now


STATUSES = """
Statuses that the robot passed
  standard -> local_recovery -> keep_alive -> local_recovery -> keep_alive
  after its restart: standard
"""


def told(directory: Path) -> tuple[Demo, str, str]:
    """Return a demo that has ended well, and what it wrote."""
    for attempt in range(ATTEMPTS):
        place = directory / str(attempt)
        place.mkdir()
        with Standstill() as standstill:
            demo = Demo(place)
            try:
                output, story = demo.end()
                assert demo.process.returncode == 0, output + story
                demo.wait_until("", present=False)  # the local service ends after the robot
            finally:
                demo.close()
        # With the usual timeouts a machine that stands still is taken for a dead service.
        if STATUSES in output or standstill.longest_s < STANDSTILL_S:
            break
    return demo, output, story


@pytest.mark.slow
def test_the_whole_story(directory: Path) -> None:
    demo, output, story = told(directory)
    assert STATUSES in output
    rows = dict(re.findall(r"^  (\S.*?)   +(\S.*)$", output, re.MULTILINE))
    assert len(rows) == 7
    for label, times in rows.items():
        if "spawned -> up" in label:  # the second time it runs already
            assert re.fullmatch(r"\d+ ms +-", times)
        else:
            assert re.fullmatch(r"\d+ ms( +\d+ ms)?", times), label

    # What it says is what the runs say.
    again = compare_runs(demo.out / "undisturbed", demo.out / "killed")
    assert again.identical
    assert again.task_actions >= 240
    verdict = f"The decisions are those of the run without kills:\n{again.describe()}\n"
    assert verdict in output
    journal_of_robot = (demo.out / "killed" / "events.jsonl").read_text()
    changes = re.findall(r'"event":"status".*?"to":"(\w+)"', journal_of_robot)
    assert " -> ".join(["standard", *changes]) in STATUSES
    assert journal_of_robot.count('"event":"resumed_trial"') == 1

    # A line for each thing that happened, with the time, and the bars in plain characters.
    lines = story.splitlines()
    kills = [line for line in lines if re.fullmatch(r" *\d+\.\d\d s  demo   kill -9 \d+: .*", line)]
    assert len(kills) == 3
    assert sum("status local_recovery, " in line for line in lines) == 2
    assert sum("status keep_alive" in line for line in lines) == 2
    bars = {line.split()[0]: line for line in lines if re.match(r"(cloud|local|robot)  ", line)}
    assert bars["cloud"].count("X") == 2
    assert bars["cloud"].count("^") == 3
    assert bars["robot"].count("X") == 1
    assert re.search(r"C+[!L]+C+[!L]+C+.*X.*C", bars["robot"])
    assert "\x1b" not in output + story
    # What a killed process leaves in the directory for temporary files is removed.
    assert list(demo.temporary.iterdir()) == []


def test_an_interruption_ends_all_processes(directory: Path) -> None:
    demo = Demo(directory)
    try:
        demo.read_until("decides, from step")
        before = demo.others()
        assert sum(" run " in command for command in before.values()) == 1
        assert sum("recovery" in command for command in before.values()) == 1
        demo.process.send_signal(signal.SIGINT)
        _, rest = demo.end()
        assert demo.process.returncode == 130
        assert rest.endswith(f"Interrupted; all processes are ended. The logs are in {demo.out}\n")
        assert not demo.others()
        assert list(demo.temporary.iterdir()) == []
    finally:
        demo.close()


@pytest.mark.slow
def test_a_process_that_ends_by_itself_ends_the_demo(directory: Path) -> None:
    demo = Demo(directory)
    try:
        demo.read_until("sees the cloud service")
        robots = [pid for pid, command in demo.others().items() if " run " in command]
        assert len(robots) == 1
        os.kill(robots[0], signal.SIGKILL)
        output, rest = demo.end()
        assert demo.process.returncode == 2
        assert "holdfast: error: the robot ended with SIGKILL; see " in rest
        assert str(demo.out / "robot.log") in rest
        assert (demo.out / "robot.log").exists()
        assert "identical" not in output
        demo.wait_until("", present=False)  # the local service ends after the robot
    finally:
        demo.close()
