"""What the study of sensing at a price makes of results that are known beforehand."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest

from holdfast.planning.inputs import Sensed
from holdfast.planning.planner import Planner
from holdfast.planning.settings import PlanningSettings, SelectorSettings
from holdfast.robot.trial import run_trial
from studies.priced_problems import Boat
from studies.sensing_price import NATS, SensingPrice
from studies.study import CHOICE, CLAIM, Report, Scale
from studies.tasks import Task
from studies.tests.made_up import noise, report_on
from studies.trial_batches import problem_of

SCALE = Scale(seed=5)


@pytest.fixture(scope="module")
def known() -> Iterator[Report]:
    """Looking for 0.8 nats takes four fifths of the steps of all else; 8 is the best interval.

    Of the boat's trials path entropy alone fails, every second one, at less than 0.6 m.
    """

    def trial(task: Task, number: int) -> tuple[bool, int, float]:
        selector = task.parameters["planning"]["selector"]
        world = math.exp(0.2 * noise(task, number, ["problem"]))
        own = math.exp(0.02 * noise(task, number, ["problem", "model", "planning"]))
        best = task.parameters["planning"]["sensing_interval"] == 8
        if selector["sensing_is_optional"]:
            best = selector["nats_per_cost"] in (0.0, 0.8)
        factor = 1.0 if best else 1.5
        if selector["nats_per_cost"] > 0.0 and selector["actions"] == "commanded":
            factor *= 0.8
        fails = selector["method"] == "path_entropy"
        fails &= task.parameters["model"].get("resolution", 1.0) < 0.6
        fails &= task.parameters["max_steps"] == 80
        steps = round(10_000 * world * own * factor)
        return not (fails and number % 2 == 0), steps, 0.0

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SensingPrice, "num_trials", {CHOICE: 10, CLAIM: 40})
        yield report_on(SensingPrice(), SCALE, trial)


def test_the_figures_can_be_drawn(known: Report) -> None:
    for draw in known.figures.values():
        assert draw().axes


def test_settings_of_cells() -> None:
    study = SensingPrice()
    for cell in study.cells(SCALE):
        series = study.series(cell, CHOICE, SCALE, 2)
        selector = series.planning.selector
        if cell.way.startswith("nats"):
            assert selector.sensing_is_optional
            assert selector.nats_per_cost == cell.number in NATS
            assert series.planning.sensing_interval == 0
        problem = problem_of(series.problem, series.model)
        price = 1.0 if cell.way.startswith("nats") else cell.price
        assert set(problem.sensing_costs) == {price}  # type: ignore[attr-defined]


def test_below_its_resolution_the_sharp_sensor_is_worth_nothing() -> None:
    """Entropy counts factors: the boat measures x from 0.15 m to 0.02 m, and y never."""
    shares = []
    for resolution in (None, 1.2):
        planner = Planner(
            Boat(resolution=resolution),
            PlanningSettings(selector=SelectorSettings()),
            particles=300,
        )
        looks = [
            decision.sensing_action
            for trial in range(5)
            for decision in run_trial(planner, 3, trial, max_steps=60).decisions or ()
            if isinstance(decision, Sensed)
        ]
        shares.append(sum(looks) / len(looks))
    assert shares[0] < 0.1
    assert shares[1] > 0.4
