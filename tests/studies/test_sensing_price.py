"""What the study of sensing at a price makes of results that are known beforehand."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest
from tests.studies.made_up import noise, report_on

from holdfast.lab.studies import sensing_price
from holdfast.lab.studies.priced_problems import Boat
from holdfast.lab.studies.sensing_price import FIXED, NATS, PRICES, PROBLEMS, SensingPrice
from holdfast.lab.studies.study import CHOICE, CLAIM, Report, Scale
from holdfast.lab.studies.tasks import Task
from holdfast.lab.studies.trial_batches import problem_of
from holdfast.planning.outcome import SensingDecision
from holdfast.planning.planner import Planner
from holdfast.planning.settings import PlanningSettings, SelectorSettings
from holdfast.robot.trial import run_trial

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


def test_each_way_chooses_its_number(known: Report) -> None:
    when = known.summary["when_to_sense"]
    assert len(when) == sum(len(each.prices) * len(each.ways) for each in PROBLEMS.values())
    chosen = when.groupby("way")["number"].agg(["min", "max"])
    for way, number in ((FIXED, 8.0), ("nats", 0.8), ("nats, executed", 0.8)):
        assert chosen.loc[way].tolist() == [number, number]


def test_what_is_saved(known: Report) -> None:
    """A look in every second step: the cost is steps times 1 + price / 2, of which a fifth."""
    when = known.summary["when_to_sense"]
    for price in PRICES:
        rows = when[when["price"] == price]
        for row in rows.to_dict("records"):
            fixed = rows[(rows["problem"] == row["problem"]) & (rows["way"] == FIXED)]
            cost = float(fixed["cost"].iloc[0])
            share = 0.2 if row["way"] == "nats" else 0.0
            assert row["saved"] == pytest.approx(share * cost, abs=0.02 * cost)
            assert row["saved_low"] <= row["saved"] <= row["saved_high"]


def test_what_choosing_when_saves_alone(known: Report) -> None:
    """The return takes as many steps of the made-up trials, whether it chooses or not."""
    alone = known.summary["when_alone"]
    assert alone["problem"].tolist() == ["dock", "dock", "boat", "boat"]
    assert (alone["saved_low"] < 0.0).all()
    assert (alone["saved_high"] > 0.0).all()


def test_the_resolution_of_the_boat(known: Report) -> None:
    weak = known.summary["weak_sensor"]
    path = weak[weak["way"] == "path entropy"]
    assert path["resolution"].tolist() == list(sensing_price.RESOLUTIONS)
    assert path["gain"].tolist() == [-0.5, -0.5, -0.5, 0.0, 0.0]
    assert (weak[weak["way"] != "path entropy"]["gain"] == 0.0).all()


def test_numbers_are_those_of_the_tables(known: Report) -> None:
    shown = {number.name: number.interval.value for number in known.numbers}
    assert shown["boat: path entropy, resolution 0.3 m, against random sensing"] == -50.0
    assert len(shown) == len(known.numbers)


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
            if isinstance(decision, SensingDecision)
        ]
        shares.append(sum(looks) / len(looks))
    assert shares[0] < 0.1
    assert shares[1] > 0.4
