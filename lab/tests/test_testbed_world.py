"""The world that is a file: it outlives whoever acts on it, and tells of every wrong."""

from pathlib import Path

import numpy as np
import pytest

from holdfast.errors import EnvironmentFailedError
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.robot.environment import SimulatedEnvironment
from holdfast_lab.testbed.world import WitnessedWorld, difference_of_performances, performances

ACTIONS = [np.array([-0.1 * step, 0.2, 1.0 / 3.0]) for step in range(5)]


def world(path: Path, trial: int = 0, *, resumed: bool = False) -> WitnessedWorld:
    return WitnessedWorld(str(path), PegInHole2D(), seed=3, trial=trial, resumed=resumed)


def perform(path: Path, trial: int, actions: list[np.ndarray], *, resumed: bool = False) -> None:
    acted_on = world(path, trial, resumed=resumed)
    for action in actions:
        acted_on.perform(action)
    acted_on.close()


def test_it_is_the_simulated_world(tmp_path: Path) -> None:
    simulated = SimulatedEnvironment(PegInHole2D(), seed=3, trial=1)
    witnessed = world(tmp_path / "performed.txt", trial=1)
    for action in ACTIONS:
        assert witnessed.perform_sensing(1) == simulated.perform_sensing(1)
        assert witnessed.perform(action) == simulated.perform(action)
        assert witnessed.is_done() == simulated.is_done()
    assert witnessed.steps_performed() == len(ACTIONS)
    witnessed.close()


def test_it_outlives_whoever_acted_on_it(tmp_path: Path) -> None:
    path = tmp_path / "performed.txt"
    perform(path, 0, ACTIONS)
    perform(path, 1, ACTIONS[:3])
    # Without a close, as a process that is killed leaves it.
    again = world(path, 1, resumed=True)
    assert again.steps_performed() == 3
    whole = SimulatedEnvironment.after(PegInHole2D(), 3, 1, ACTIONS[:3])
    assert again.perform_sensing(0) == whole.perform_sensing(0)
    again.perform(ACTIONS[3])
    again.close()
    found = list(performances(path))
    assert [(each.trial, each.step) for each in found] == [
        *((0, step) for step in range(5)),
        *((1, step) for step in range(4)),
    ]
    assert np.frombuffer(bytes.fromhex(found[2].action)).tolist() == ACTIONS[2].tolist()


class TestDifference:
    @pytest.fixture
    def expected(self, tmp_path: Path) -> Path:
        path = tmp_path / "expected.txt"
        perform(path, 0, ACTIONS)
        return path

    @pytest.fixture
    def found(self, tmp_path: Path) -> Path:
        return tmp_path / "found.txt"

    def test_one_was_left_out(self, expected: Path, found: Path) -> None:
        perform(found, 0, [*ACTIONS[:2], *ACTIONS[3:]])
        difference = difference_of_performances(expected, found)
        assert difference is not None
        assert "performance 2: expected trial 0, step 2, [-0.2, 0.2," in difference

    def test_two_robots_acted_in_turns(self, expected: Path, found: Path) -> None:
        perform(found, 0, ACTIONS)
        lines = found.read_text().splitlines()
        for index, process in enumerate(("1", "1", "2", "1", "2")):
            fields = lines[index].split(" ")
            fields[3] = process
            lines[index] = " ".join(fields)
        found.write_text("".join(f"{line}\n" for line in lines))
        assert difference_of_performances(expected, found) == (
            "trial 0, step 3: process 1 acts again after process 2 has acted"
        )


@pytest.mark.parametrize("line", ["", "0 1 zz", "0 one 00 1 1.0", "0 1 00 1 1.0 more"])
def test_a_line_that_is_none(tmp_path: Path, line: str) -> None:
    path = tmp_path / "performed.txt"
    path.write_text(f"0 0 00 1 1.0\n{line}\n")
    with pytest.raises(EnvironmentFailedError, match=r"performed.txt, line 2: is no performance"):
        list(performances(path))
