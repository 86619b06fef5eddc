"""A process whose event loop stands still ends itself; one that was only stopped does not."""

import os
import signal
import time
from pathlib import Path

import pytest
from tests.ports import free_port
from tests.processes import faults

from holdfast.runtime.watchdog import EXIT_STUCK

PEG = "peg_in_hole_2d"
LIMIT_S = 2.0
WATCHED = ("--watchdog-s", str(LIMIT_S))

# A handler of a signal runs on the main thread, which is the loop's.
STANDS_STILL = """
import signal, threading

def stand_still(*_):
    threading.Event().wait()

signal.signal(signal.SIGUSR1, stand_still)
"""


def stuck_by_signal(site: faults.Site) -> dict[str, str]:
    """Return the variables of a process that a signal makes stand still."""
    (site.directory / "sitecustomize.py").write_text(STANDS_STILL)
    return {"PYTHONPATH": str(site.directory)}


def children_of(pid: int) -> list[int]:
    return [int(each) for each in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def watched(site: faults.Site, *options: str) -> faults.Service:
    cloud = site.service(*WATCHED, "--health", f"127.0.0.1:{free_port()}", *options)
    cloud.variables = stuck_by_signal(site)
    return cloud.start()


@pytest.mark.parametrize("processes", [1, 2])
def test_a_service_that_is_stuck_ends_and_its_robot_goes_on(
    processes: int, site: faults.Site, references: faults.References
) -> None:
    cloud = watched(site, *(() if processes == 1 else ("--processes", str(processes))))
    (ready,) = cloud.process.matching("ready")
    story = faults.Story(site, references, faults.document_of(PEG))

    def stick() -> None:
        for each in [cloud.process.pid] if processes == 1 else children_of(cloud.process.pid):
            os.kill(each, signal.SIGUSR1)
        for _ in range(processes):
            found = cloud.process.wait_for("stuck", processes)
        assert found["reason"] == "the event loop has stood still for 2 s; this process ends"
        assert "stand_still (sitecustomize.py:" in found["where"]
        if processes == 1:
            assert cloud.process.wait() == EXIT_STUCK
        else:
            ended = cloud.process.wait_for("process_ended", processes)
            assert ended["reason"] == f"ended with exit code {EXIT_STUCK}"
            faults.wait_until(
                lambda: faults.page(ready["health"], "/readyz") == (200, "ok\n"), "it to serve"
            )

    story.at("perform", 20, stick, story.status(faults.LOCAL_RECOVERY))
    story.finish(site.run(story.file, services=[cloud]))


def test_a_robot_that_is_stuck_is_started_again(
    site: faults.Site, references: faults.References
) -> None:
    story = faults.Story(site, references, faults.document_of(PEG))

    def stick() -> None:
        (robot,) = children_of(story.running.pid)
        os.kill(robot, signal.SIGUSR1)

    story.at("perform", 20, stick)
    options = ("--rate", "2000", "--resume-if-begun", "--restart", *WATCHED)
    robot = site.run(story.file, *options, variables=stuck_by_signal(site))
    robot.wait()
    (ended,) = robot.matching("process_ended")
    assert ended["reason"] == f"ended with exit code {EXIT_STUCK}"
    assert len(robot.matching("stuck")) == 1
    story.finish(robot)


def test_what_was_stopped_for_longer_than_that_goes_on(site: faults.Site) -> None:
    """As on a machine that sleeps, and in a container that is paused."""
    cloud = watched(site)
    (ready,) = cloud.process.matching("ready")
    for _ in range(2):
        cloud.stop()
        time.sleep(2.0 * LIMIT_S)
        cloud.resume()
        assert faults.page(ready["health"], "/livez") == (200, "ok\n")
    assert cloud.process.matching("stuck") == []
    # And it still watches.
    cloud.process.signal(signal.SIGUSR1)
    assert cloud.process.wait() == EXIT_STUCK
