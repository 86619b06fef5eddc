"""The example of a robot of one's own under faults: its controller has counted every move.

The controller is another process with another program, and its log is the witness: whatever dies,
each step was performed once, in order, and as in a run in which nothing died.
"""

import importlib.util
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from tests.processes.faults import LOST, PATIENT, RESTORED, Site, assert_identical, wait_until
from tests.unit.test_trial import one

from holdfast.config.loader import load
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.robot.environment_maker import load_environment

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_robot"
PATIENCE_S = 120.0


class Controller:
    """The example's controller in a directory of its own; it may be killed and started again."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.port = 0
        self.process: subprocess.Popen[str] | None = None

    def start(self, *options: str) -> None:
        self.process = subprocess.Popen(
            [
                sys.executable,
                str(EXAMPLE / "controller.py"),
                *("--port", str(self.port), "--directory", str(self.directory)),
                *("--delay-ms", "0", *options),
            ],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line.startswith("listening on 127.0.0.1:"), line
        self.port = int(line.rpartition(":")[2])

    def kill(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait(PATIENCE_S)
            assert self.process.stdout is not None
            self.process.stdout.close()
            self.process = None

    def moves(self) -> list[dict[str, Any]]:
        """Return what it has noted of each move."""
        lines = (self.directory / "performed.log").read_text().splitlines()
        return [note for note in map(json.loads, lines) if "step" in note]


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


def test_its_peg_collides_where_holdfast_says() -> None:
    problem = PegInHole2D()
    drawn = np.random.default_rng(1).uniform([-2, -0.5, -3.2], [2, 2.5, 3.2], (4000, 3))
    # Many in the slot, upright, where it is tight.
    drawn[2000:] *= [0.06, 1.0, 0.02]
    expected = problem.world.collides(drawn)
    assert 500 < expected[:2000].sum() < 1900
    assert 200 < expected[2000:].sum() < 1900
    spec = importlib.util.spec_from_file_location("own_controller", EXAMPLE / "controller.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert [module.collides(tuple(pose)) for pose in drawn.tolist()] == expected.tolist()


def test_the_simulation_has_the_same_file() -> None:
    """Without the name of the class, the same configuration is simulated."""
    configuration = load(EXAMPLE / "own_robot.yaml")
    maker = load_environment(configuration)
    assert maker.simulated
    result = one(configuration, environment=maker(0))
    assert result.success
