"""A segment of a run on a thread of its own: how it ends, and that the next one goes on."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.recordings import robot_configuration
from tests.unit.test_robot_process import plain_digests

from holdfast.config.loader import Configuration
from holdfast.journal import journal_file
from holdfast.robot.environment import SimulatedEnvironment
from holdfast.robot.environment_maker import EnvironmentMaker, load_environment
from holdfast.runtime.events import BoundedEventLog
from holdfast_ros.ros2.run_segment import Ending, RunSegment, SegmentResult, World

PATIENCE_S = 60.0


@pytest.fixture
def configuration(tmp_path: Path) -> Configuration:
    return robot_configuration(tmp_path, num_trials=2)


class Segments:
    """Makes segments of one run, one after another."""

    def __init__(self, configuration: Configuration, path: Path) -> None:
        self.configuration = configuration
        self.path = path
        self.maker = load_environment(configuration)
        self.on_order: Callable[[RunSegment, int], None] = lambda _, __: None
        self.orders = 0

    def make(self, *, after_reboot: bool = False) -> RunSegment:
        def order(state: object, effect: object) -> None:
            self.orders += 1
            self.on_order(segment, self.orders)

        segment = RunSegment(
            configuration=self.configuration,
            path=self.path,
            world=World(self.maker, lambda _: None),
            after_reboot=after_reboot,
            sink=BoundedEventLog(),
            on_order=order,
            on_timing=lambda _: None,
            on_end=lambda _: None,
        )
        return segment

    def run(
        self, segment: RunSegment | None = None, *, after_reboot: bool = False
    ) -> SegmentResult:
        segment = segment or self.make(after_reboot=after_reboot)
        segment.start()
        assert segment.ended.wait(PATIENCE_S)
        assert segment.outcome is not None
        return segment.outcome

    def require_whole(self, outcome: SegmentResult) -> None:
        assert outcome.ending == Ending.FINISHED
        assert [trial.digest for trial in outcome.trials] == plain_digests(self.configuration)


@pytest.fixture
def segments(configuration: Configuration, tmp_path: Path) -> Segments:
    return Segments(configuration, tmp_path / "run")


def test_all_trials(segments: Segments) -> None:
    outcome = segments.run()
    segments.require_whole(outcome)
    assert outcome.message == "2 trials"
    assert (segments.path / "summary.json").exists()
    orders = segments.orders
    assert (outcome.status, outcome.num_finished) == ("standard", 2)
    # Nobody decides in a segment that has nothing to do.
    assert segments.run() == outcome._replace(status="")
    assert segments.orders == orders


def test_parts_that_are_paused(segments: Segments) -> None:
    segments.on_order = lambda segment, count: (
        segment.pause(f"order {count}", PATIENCE_S) if count % 7 == 1 else None
    )
    reasons = []
    while (outcome := segments.run()).ending == Ending.PAUSED:
        reasons.append(outcome.message)
    assert reasons[0] == "order 1"
    assert len(reasons) > 5
    segments.require_whole(outcome)


def test_after_a_reboot_a_person_has_to_say_so(
    segments: Segments, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    segments.on_order = lambda segment, count: (
        segment.pause("for now", PATIENCE_S) if count == 20 else None
    )
    assert segments.run().ending == Ending.PAUSED
    (tmp_path / "boot_id").write_text("another")
    monkeypatch.setattr(journal_file, "_BOOT_ID", tmp_path / "boot_id")
    outcome = segments.run()
    assert (outcome.ending, segments.orders) == (Ending.HELD, 20)
    assert "no robot moves by itself" in outcome.message
    assert outcome.message.endswith("(after_reboot)")
    segments.require_whole(segments.run(after_reboot=True))


def test_paused_before_it_began(segments: Segments) -> None:
    segment = segments.make()
    segment.pause("at once", PATIENCE_S)
    assert segments.run(segment)[:3] == (Ending.PAUSED, "at once", ())
    assert segments.orders == 0


def test_a_robot_that_moves_is_interrupted_when_it_takes_too_long(segments: Segments) -> None:
    stopped = threading.Event()

    class Slow(SimulatedEnvironment):
        def perform(self, task_action: Any) -> Any:
            segment.pause("enough", 0.0)
            assert stopped.wait(PATIENCE_S)
            raise OSError("stopped")

    segments.maker = EnvironmentMaker("robot", segments.configuration.problem, 3, 60_000.0, Slow)
    segment = segments.make()
    segment.world = segment.world._replace(interrupt=lambda _: stopped.set())
    assert segments.run(segment)[:2] == (Ending.PAUSED, "enough")


class Failing(SimulatedEnvironment):
    """Fails until it is mended."""

    broken = threading.Event()

    def __init__(self, problem: Any, seed: int, trial: int) -> None:
        super().__init__(problem, seed, trial)

    def perform_sensing(self, sensing_action: int) -> Any:
        if self.broken.is_set():
            raise OSError("no camera")
        return super().perform_sensing(sensing_action)


def test_an_error_whose_reason_can_go_away(segments: Segments) -> None:
    configuration = segments.configuration
    segments.maker = EnvironmentMaker("robot", configuration.problem, 3, 60_000.0, Failing)
    Failing.broken.set()
    outcome = segments.run()
    assert outcome.ending == Ending.HELD
    assert "OSError: no camera" in outcome.message
    Failing.broken.clear()
    segments.require_whole(segments.run())


def test_an_error_that_ends_the_run_for_good(segments: Segments) -> None:
    class NoCount:
        def __init__(self) -> None:
            self.is_done = lambda: False
            self.perform_sensing = lambda _: [4.0]

        def perform(self, task_action: object) -> None:
            raise OSError("no motor")

    segments.maker = EnvironmentMaker("robot", segments.configuration.problem, 3, 60_000.0, NoCount)
    outcome = segments.run()
    assert outcome.ending == Ending.FAILED
    assert "nobody can say whether its task action was performed" in outcome.message


def test_a_directory_that_is_none(segments: Segments) -> None:
    segments.path.write_text("")
    outcome = segments.run()
    assert outcome.ending == Ending.HELD
    assert outcome.message.startswith(str(segments.path))


def test_a_defect_is_told_whole(segments: Segments, monkeypatch: pytest.MonkeyPatch) -> None:
    def break_down(*_: object, **__: object) -> None:
        raise RuntimeError("a defect")

    monkeypatch.setattr("holdfast_ros.ros2.run_segment.perform_trials", break_down)
    outcome = segments.run()
    assert outcome.ending == Ending.FAILED
    assert "Traceback" in outcome.message
    assert "RuntimeError: a defect" in outcome.message
