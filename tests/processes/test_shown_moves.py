"""Moves that show something, looks that come late or show nothing, through services and crashes.

The decisions are those of a run in process that nothing disturbs.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from tests.processes.faults import LOST, Service, Site, assert_identical, events_of, summary_of
from tests.processes.rover import NO_READING, NOT_LATE_EITHER

from holdfast.reports.reading import open_run

ROVER = Path(__file__).parent / "rover.py"
STEPS = 40


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the run that nothing disturbs."""
    directory = tmp_path_factory.mktemp("reference")
    with Site(directory) as site:
        robot = site.run(configure(directory))
        robot.finish()
        return robot.out


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with Site(tmp_path) as site:
        yield site


def configure(directory: Path, kill_at: tuple[int, ...] = ()) -> Path:
    (directory / "rover.py").write_text(ROVER.read_text())
    path = directory / "rover.yaml"
    document = {
        "problem": "rover:Rover",
        "particle_filter": {"num_particles": 40},
        "simulator": {"num_trials": 2, "max_steps": STEPS, "sensing_intervals": 2, "seed": 5},
        "environment": {"object": "rover:Robot", "arguments": {"kill_at": list(kill_at)}},
    }
    path.write_text(yaml.safe_dump(document))
    return path


def service_of(site: Site) -> Service:
    options = ("--problem", "rover:Rover", "--problem-directory", str(site.directory))
    return site.service(*options).start()


def test_in_process(reference: Path) -> None:
    """All of it is in the run, and it mattered."""
    run = open_run(reference, problem_directory=reference.parent)
    assert list(run.results["outcome"]) == ["truncated", "truncated"]
    for trial in run.read():
        assert [motion.size for motion in trial.motions] == [1] * STEPS
        assert [shown.size for shown in trial.move_observations] == [1] * STEPS
        sizes = [shown.size for shown in trial.observations]
        assert trial.sensing_steps.tolist() == list(range(0, STEPS, 3))
        # That of the last sensing step, 39, would come after the end.
        without = {*NO_READING, *NOT_LATE_EITHER, 39}
        assert sizes == [int(step not in without) for step in range(0, STEPS, 3)]
        assert trial.result is not None
        assert trial.result.missing_observations == len(without)
    told = [event for event in events_of(reference) if event["event"] == "no_reading"]
    assert [event.get("taken", event["step"]) for event in told] == [6, 12, 15, 21] * 2
    assert summary_of(reference)["missing_observations"] == 10


def test_a_service_that_is_killed(site: Site, reference: Path) -> None:
    path = configure(site.directory, (7, 22))
    service = service_of(site)
    (site.directory / "victim").write_text(str(service.process.pid))
    robot = site.run(path, services=[service])
    robot.finish()
    assert robot.statuses() == [LOST]
    assert_identical(robot.out, reference)


@pytest.mark.parametrize("with_service", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_robot_that_is_killed_in_mid_move(
    site: Site, reference: Path, with_service: bool
) -> None:
    """What the move has shown is asked for again."""
    kill_at = (6, STEPS - 1)
    path = configure(site.directory, kill_at)
    (site.directory / "victim").write_text("")
    services = [service_of(site)] if with_service else []
    for number in range(2 * len(kill_at)):
        robot = site.run(path, services=services, resume=number > 0)
        assert robot.wait() == -9
    robot = site.run(path, services=services, resume=True)
    robot.finish()
    assert "performed_unseen" in {event["event"] for event in events_of(robot.out)}
    assert_identical(robot.out, reference)
