"""The example of a robot of one's own under faults: its controller has counted every move.

The controller is another process with another program, and its log is the witness: whatever dies,
each step was performed once, in order, and as in a run in which nothing died.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from tests.processes.faults import (
    LOST,
    PATIENT,
    RESTORED,
    Site,
    assert_identical,
    wait_until,
)
from tests.processes.test_own_robot import EXAMPLE, Controller


def configuration_for(controller: Controller, site: Site, timeout_ms: float = 60_000.0) -> Path:
    document: dict[str, Any] = yaml.safe_load((EXAMPLE / "own_robot.yaml").read_text())
    document["particle_filter"] = {"num_particles": 60}
    document["simulator"] |= {"max_steps": 90, "seed": 4}
    document["environment"] = {
        "object": "environment:SocketRobot",
        "directory": str(EXAMPLE),
        "arguments": {"port": controller.port},
        "timeout_ms": timeout_ms,
    }
    return site.configure(document, offload=PATIENT)


def lines_of(controller: Controller) -> int:
    log = controller.directory / "performed.log"
    return log.read_bytes().count(b"\n") if log.exists() else 0


def wait_for_move(controller: Controller, number: int) -> None:
    # The first line is of the start.
    wait_until(lambda: lines_of(controller) > number, f"move {number}")


@pytest.fixture
def controller(site: Site) -> Iterator[Controller]:
    directory = site.directory / "controller"
    directory.mkdir()
    controller = Controller(directory)
    yield controller
    controller.kill()


class Undisturbed:
    """The run in which nothing dies, and what its controller has noted."""

    def __init__(self, directory: Path) -> None:
        controller = Controller(directory)
        try:
            controller.start()
            with Site(directory) as site:
                robot = site.run(configuration_for(controller, site))
                robot.finish()
        finally:
            controller.kill()
        self.out = robot.out
        self.moves = controller.moves()

    def assert_same(self, out: Path, controller: Controller) -> None:
        moves = controller.moves()
        assert not [move for move in moves if "error" in move]
        assert [move["step"] for move in moves] == list(range(len(self.moves)))
        assert moves == self.moves
        assert_identical(out, self.out)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Undisturbed:
    return Undisturbed(tmp_path_factory.mktemp("undisturbed"))


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 6))]
)
def test_robot_killed_at_random_moments(
    seed: int, controller: Controller, site: Site, undisturbed: Undisturbed
) -> None:
    random = np.random.default_rng([13, seed])
    controller.start("--delay-ms", "4")
    file = configuration_for(controller, site)
    cloud = site.service().start()
    robot = site.run(file, services=[cloud])
    last = len(undisturbed.moves) - 5
    for number in np.sort(random.choice(np.arange(1, last), 4, replace=False)).tolist():
        wait_for_move(controller, number)
        time.sleep(random.uniform(0.0, 0.01))  # anywhere within a move, or between two
        robot.kill()
        if random.random() < 0.5:
            cloud.kill()
            cloud.start()
        robot = site.run(file, services=[cloud], resume=True)
    robot.finish()
    undisturbed.assert_same(robot.out, controller)


def test_controller_killed_and_started_again(
    controller: Controller, site: Site, undisturbed: Undisturbed
) -> None:
    controller.start("--delay-ms", "3")
    file = configuration_for(controller, site)
    cloud = site.service().start()
    robot = site.run(file, services=[cloud])
    for number in (10, 25, 40):
        wait_for_move(controller, number)
        controller.kill()
        if number == 25:
            cloud.kill()
            robot.wait_for("status", to="local_recovery")
        if number == 40:
            cloud.start()
        controller.start("--delay-ms", "3")
    robot.wait_for("status", to="keep_alive")
    robot.finish()
    assert robot.statuses() == [LOST, RESTORED]
    undisturbed.assert_same(robot.out, controller)


@pytest.mark.slow
def test_controller_that_falls_silent(
    controller: Controller, site: Site, undisturbed: Undisturbed
) -> None:
    controller.start("--silent-at", "20", "--silent-s", "4")
    cloud = site.service().start()
    robot = site.run(configuration_for(controller, site, timeout_ms=1500.0), services=[cloud])
    assert robot.wait() == 4
    assert "the robot holds still in trial 0, step 20" in robot.output
    assert "environment.timeout_ms" in robot.output
    assert "Go on with: " in robot.output
    # It speaks again by itself, and then tells that it has moved all the same.
    robot = site.run(configuration_for(controller, site), services=[cloud], resume=True)
    robot.finish()
    assert robot.matching("performed_unseen", step=20)
    undisturbed.assert_same(robot.out, controller)
