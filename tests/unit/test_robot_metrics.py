"""A robot's metrics are what its machine has counted, in the text format of Prometheus."""

import re
from pathlib import Path

import pytest
from tests.robot_world import Misleading, World
from tests.unit.test_service_metrics import Samples, samples_of
from tests.unit.test_verification import lie, other_actions

from holdfast.planning.settings import SimulatorSettings
from holdfast.protocol.robot_events import Timing
from holdfast.robot.metrics import RobotMetrics

RULES = Path(__file__).parents[2] / "deploy" / "prometheus" / "rules.yaml"


def told(metrics: RobotMetrics, world: World, *, is_deciding: bool = True) -> Samples:
    return samples_of(metrics.text(world.robot, is_deciding=is_deciding).decode())


class Lying(Misleading):
    lies = frozenset(range(40))


def world_of(environment_class: type[Misleading] = Misleading) -> World:
    world = World(
        simulator=SimulatorSettings(num_trials=2, max_steps=44, seed=11), on_lost="reinitialise"
    )
    world.environment_class = environment_class
    return world


def test_a_run_in_numbers() -> None:
    world, metrics = world_of(), RobotMetrics()
    world.start_and_run()
    timings = [effect for _, effect in world.trace if isinstance(effect, Timing)]
    for timing in timings:
        metrics.timed(timing)
    for result in world.results:
        metrics.ended(result)
    samples = told(metrics, world)
    for kind in ("task", "sensing"):
        count = sum(timing.kind == kind for timing in timings)
        labels = (("kind", kind), ("service", "cloud"))
        assert samples["holdfast_robot_decisions_total", labels] == count > 0
    assert samples["holdfast_robot_wait_seconds_count", ()] == len(timings)
    waited_s = sum(timing.waited_ms for timing in timings) / 1e3
    assert samples["holdfast_robot_wait_seconds_sum", ()] == pytest.approx(waited_s)
    outcomes = [result.outcome for result in world.results]
    assert samples["holdfast_robot_trials_total", (("outcome", outcomes[0]),)] == outcomes.count(
        outcomes[0]
    )
    steps = sum(result.steps for result in world.results)
    assert samples["holdfast_robot_steps_total", ()] == steps == 88
    assert samples["holdfast_robot_status", (("status", "standard"),)] == 1
    assert samples["holdfast_robot_status", (("status", "keep_alive"),)] == 0
    assert samples["holdfast_robot_holding", ()] == 0
    assert samples["holdfast_robot_deciding", ()] == 1
    # The run is over: there is no current trial.
    assert ("holdfast_robot_trial", ()) not in samples


def test_what_the_observations_have_shown() -> None:
    world, metrics = world_of(Lying), RobotMetrics()
    world.start_and_run()
    samples = told(metrics, world)
    for name, column in (
        ("unexplained_observations", "unexplained_observations"),
        ("lost", "lost"),
        ("reinitialisations", "lost"),
        ("sensor_suspects", "suspect_sensors"),
    ):
        expected = sum(getattr(result, column) for result in world.results)
        assert samples[f"holdfast_robot_{name}_total", ()] == expected, name
    assert samples["holdfast_robot_lost_total", ()] > 0


def test_a_wrong_answer() -> None:
    world = World(verify_share=0.0)
    lie(world, "cloud", other_actions(77.7), after=2)
    world.complete()
    assert told(RobotMetrics(), world)["holdfast_robot_wrong_answers_total", ()] == 1


def test_a_robot_in_a_trial_that_nobody_decides_for() -> None:
    world, metrics = World(launch="never"), RobotMetrics()
    world.start(present=False)
    world.after(3.0, list)
    world.run(until_s=2.0)
    samples = told(metrics, world, is_deciding=False)
    assert samples["holdfast_robot_holding", ()] == 1
    assert samples["holdfast_robot_deciding", ()] == 0
    assert samples["holdfast_robot_trial", ()] == samples["holdfast_robot_step", ()] == 0
    assert samples["holdfast_robot_wait_seconds_count", ()] == 0


def test_the_alerts_watch_what_is_told() -> None:
    watched = set(re.findall(r"\bholdfast_robot_\w+", RULES.read_text(encoding="utf-8")))
    assert len(watched) == 6
    assert watched <= {name for name, _ in told(RobotMetrics(), world_of())}
