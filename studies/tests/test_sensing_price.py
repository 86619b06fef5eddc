"""What the study of sensing at a price makes of results that are known beforehand."""

from holdfast.planning.inputs import Sensed
from holdfast.planning.planner import Planner
from holdfast.planning.settings import PlanningSettings, SelectorSettings
from holdfast.robot.trial import run_trial
from studies.priced_problems import Boat
from studies.sensing_price import NATS, SensingPrice
from studies.study import CHOICE, Scale
from studies.trial_batches import problem_of

SCALE = Scale(seed=5)


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
