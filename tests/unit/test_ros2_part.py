"""A part of a run on a thread of its own: how it ends, and that the next one goes on."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from holdfast.configuration import Configuration, load
from holdfast.ros.ros2.part import Ending, Part, PartOfRun
from holdfast.runtime.environment import EnvironmentMaker, SimulatedEnvironment, load_environment
from holdfast.runtime.logs import NullEventLog
from holdfast.runtime.trial import run_trial

PATIENCE_S = 60.0


@pytest.fixture
def configuration(tmp_path: Path) -> Configuration:
    path = tmp_path / "robot.yaml"
    path.write_text(
        "problem: peg_in_hole_2d\n"
        "particle_filter: {num_particles: 50}\n"
        "simulator: {num_trials: 2, max_steps: 60, sensing_intervals: 8, seed: 3}\n"
    )
    return load(path)


class Parts:
    """Makes parts of one run, one after another."""

    def __init__(self, configuration: Configuration, path: Path) -> None:
        self.configuration = configuration
        self.path = path
        self.maker = load_environment(configuration)
        self.on_order: Callable[[PartOfRun, int], None] = lambda _, __: None
        self.orders = 0

    def make(self) -> PartOfRun:
        def order(state: object, effect: object) -> None:
            self.orders += 1
            self.on_order(part, self.orders)

        part = PartOfRun(
            self.configuration,
            self.path,
            self.maker,
            rate_hz=None,
            sink=NullEventLog(),
            on_order=order,
            on_timing=lambda _: None,
            on_end=lambda _: None,
            interrupt=lambda _: None,
        )
        return part

    def run(self) -> Part:
        part = self.make()
        part.start()
        assert part.ended.wait(PATIENCE_S)
        assert part.came_to is not None
        return part.came_to


@pytest.fixture
def parts(configuration: Configuration, tmp_path: Path) -> Parts:
    return Parts(configuration, tmp_path / "run")


def digests(configuration: Configuration) -> list[str]:
    return [
        run_trial(
            configuration.problem, configuration.planning, configuration.simulator, trial
        ).digest
        for trial in range(configuration.simulator.num_trials)
    ]


def test_all_trials(parts: Parts) -> None:
    came_to = parts.run()
    assert (came_to.ending, came_to.message) == (Ending.FINISHED, "2 trials")
    assert [trial.digest for trial in came_to.trials] == digests(parts.configuration)
    assert (parts.path / "summary.json").exists()
    orders = parts.orders
    assert (came_to.status, came_to.num_finished) == ("standard", 2)
    # Nobody decides in a part that has nothing to do.
    assert parts.run() == came_to._replace(status="")
    assert parts.orders == orders


def test_parts_that_are_paused(parts: Parts) -> None:
    parts.on_order = lambda part, count: (
        part.pause(f"order {count}", PATIENCE_S) if count % 7 == 1 else None
    )
    reasons = []
    while (came_to := parts.run()).ending == Ending.PAUSED:
        reasons.append(came_to.message)
    assert reasons[0] == "order 1"
    assert len(reasons) > 5
    assert came_to.ending == Ending.FINISHED
    assert [trial.digest for trial in came_to.trials] == digests(parts.configuration)


def test_paused_before_it_began(parts: Parts) -> None:
    part = parts.make()
    part.pause("at once", PATIENCE_S)
    part.start()
    assert part.ended.wait(PATIENCE_S)
    assert part.came_to is not None
    assert part.came_to[:3] == (Ending.PAUSED, "at once", ())
    assert parts.orders == 0


def test_a_robot_that_moves_is_interrupted_when_it_takes_too_long(parts: Parts) -> None:
    stopped = threading.Event()

    class Slow(SimulatedEnvironment):
        def perform(self, task_action: Any) -> Any:
            part.pause("enough", 0.0)
            assert stopped.wait(PATIENCE_S)
            raise OSError("stopped")

    parts.maker = EnvironmentMaker("robot", parts.configuration.problem, 3, 60_000.0, Slow)
    part = parts.make()
    part._interrupt = lambda _: stopped.set()
    part.start()
    assert part.ended.wait(PATIENCE_S)
    assert part.came_to is not None
    assert part.came_to[:2] == (Ending.PAUSED, "enough")


class Failing(SimulatedEnvironment):
    """Fails until it is mended."""

    broken = threading.Event()

    def __init__(self, problem: Any, seed: int, trial: int) -> None:
        super().__init__(problem, seed, trial)

    def perform_sensing(self, sensing_action: int) -> Any:
        if self.broken.is_set():
            raise OSError("no camera")
        return super().perform_sensing(sensing_action)


def test_an_error_whose_reason_can_go_away(parts: Parts) -> None:
    configuration = parts.configuration
    parts.maker = EnvironmentMaker("robot", configuration.problem, 3, 60_000.0, Failing)
    Failing.broken.set()
    came_to = parts.run()
    assert came_to.ending == Ending.HELD
    assert "OSError: no camera" in came_to.message
    Failing.broken.clear()
    came_to = parts.run()
    assert came_to.ending == Ending.FINISHED
    assert [trial.digest for trial in came_to.trials] == digests(configuration)


def test_an_error_that_ends_the_run_for_good(parts: Parts) -> None:
    class NoCount:
        def __init__(self) -> None:
            self.is_done = lambda: False
            self.perform_sensing = lambda _: [4.0]

        def perform(self, task_action: object) -> None:
            raise OSError("no motor")

    parts.maker = EnvironmentMaker("robot", parts.configuration.problem, 3, 60_000.0, NoCount)
    came_to = parts.run()
    assert came_to.ending == Ending.FAILED
    assert "nobody can say whether its task action was performed" in came_to.message


def test_a_directory_that_is_none(parts: Parts) -> None:
    parts.path.write_text("")
    came_to = parts.run()
    assert came_to.ending == Ending.HELD
    assert came_to.message.startswith(str(parts.path))


def test_a_defect_is_told_whole(parts: Parts, monkeypatch: pytest.MonkeyPatch) -> None:
    def break_down(*_: object, **__: object) -> None:
        raise RuntimeError("a defect")

    monkeypatch.setattr("holdfast.ros.ros2.part.perform_trials", break_down)
    came_to = parts.run()
    assert came_to.ending == Ending.FAILED
    assert "Traceback" in came_to.message
    assert "RuntimeError: a defect" in came_to.message
