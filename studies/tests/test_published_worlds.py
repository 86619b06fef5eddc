"""What the study of published worlds makes of results that are known beforehand."""

from __future__ import annotations

import math

import pandas as pd
import pytest

from holdfast.errors import InvalidValueError
from studies.command import studies_of
from studies.errors import TaskError
from studies.published_worlds import (
    BEST,
    COLUMNS,
    WAYS,
    PublishedWorlds,
    published_planners,
    run_vdp_tag,
)
from studies.study import TRIALS, Report, Scale
from studies.tables import to_csv
from studies.tasks import Task

SCALE = Scale(seed=8101)


@pytest.fixture(scope="module")
def made_up() -> Report:
    """Published heuristics earn what was published; all others alternate, priced looks most."""
    means = published_planners()["mean_discounted_reward"]

    def result_of(task: Task) -> pd.DataFrame:
        way, first = task.parameters["way"], task.parameters["first_trial"]
        mean = means.get(way, 40.0 if way == BEST else 30.0)
        rows = [
            (trial, mean + 10.0 * (-1.0) ** trial, True, 10, 2, 7.0)
            for trial in range(first, first + task.parameters["num_trials"])
        ]
        return pd.DataFrame(rows, columns=list(COLUMNS))

    return PublishedWorlds().report(SCALE, result_of)


def test_it_is_registered() -> None:
    (study,) = studies_of(["published_worlds"])
    assert isinstance(study, PublishedWorlds)


def test_published_figures() -> None:
    planners = published_planners()
    names = ["trials", "mean_discounted_reward", "standard_error"]
    assert planners.loc["pomcpow", names].tolist() == [1000, 29.3428, 0.8249]
    assert len(planners) == 7


def test_the_table_has_ours_and_theirs(made_up: Report) -> None:
    rows = {row["way"]: row for row in made_up.summary["vdp_tag"].to_dict("records")}
    assert set(rows) == {*WAYS, *published_planners().index}
    ours = rows[BEST]
    assert ours["mean_discounted_reward"] == pytest.approx(40.0, rel=1e-6)
    assert ours["standard_error"] == pytest.approx(10.0 / 1000**0.5, rel=1e-3)
    assert math.isnan(ours["published_mean"])
    assert rows["to_next"]["standard_errors_apart"] == pytest.approx(0.0, abs=1e-5)
    assert math.isnan(rows["pomcpow"]["trials"])


def test_rules_are_compared_trial_by_trial(made_up: Report) -> None:
    rows = {row["rival"]: row for row in made_up.summary["looks"].to_dict("records")}
    assert set(rows) == {name for name, way in WAYS.items() if not way.published and name != BEST}
    assert all(row["reward_gain"] == pytest.approx(10.0) for row in rows.values())
    assert rows["action entropy"]["trials"] == WAYS["action entropy"].trials


def test_numbers_say_how_far_off_the_heuristics_are(made_up: Report) -> None:
    numbers = {number.name: number.interval for number in made_up.numbers}
    assert numbers["to_next, here less published"].value == pytest.approx(0.0, abs=1e-5)
    # 40 less the strongest planner's 29.3.
    assert numbers["priced looks less pomcpow, as published"].value == pytest.approx(
        10.66, abs=0.01
    )


def test_all_is_made_of_the_trials_that_are_kept(made_up: Report) -> None:
    trials = made_up.trials
    assert trials is not None
    assert len(trials) == sum(way.trials for way in WAYS.values())
    again = PublishedWorlds().report_of({TRIALS: trials})
    assert {name: to_csv(table) for name, table in again.tables.items()} == {
        name: to_csv(table) for name, table in made_up.tables.items()
    }


def test_other_trials_are_refused(made_up: Report) -> None:
    with pytest.raises(InvalidValueError, match="published_worlds: these are trials of something"):
        PublishedWorlds().report_of({TRIALS: pd.DataFrame({"way": []})})


def test_the_figure_can_be_drawn(made_up: Report) -> None:
    pytest.importorskip("matplotlib")
    assert made_up.figures["vdp_tag"]().axes


def test_quick_is_little() -> None:
    quick = PublishedWorlds().tasks(Scale(quick=True, seed=1))
    assert sum(task.units for task in quick) == 4 * len(WAYS)


def test_tasks_do_not_depend_on_how_they_are_cut() -> None:
    whole = run_vdp_tag("to_next", 5, 0, 3)
    parts = [run_vdp_tag("to_next", 5, first, 1) for first in range(3)]
    for name in COLUMNS[:-1]:
        assert whole[name].tolist() == [part[name][0] for part in parts]


def test_an_unknown_way_is_refused() -> None:
    with pytest.raises(TaskError, match="way 'guess': there are to_next"):
        run_vdp_tag("guess", 1, 0, 1)
