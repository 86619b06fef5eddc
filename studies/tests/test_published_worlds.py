"""What the study of published worlds makes of results that are known beforehand."""

import pandas as pd
import pytest

from holdfast.errors import InvalidValueError
from studies.errors import TaskError
from studies.published_worlds import BEST, COLUMNS, PublishedWorlds, published_planners, run_vdp_tag
from studies.study import TRIALS, Report, Scale
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


def test_published_figures() -> None:
    planners = published_planners()
    names = ["trials", "mean_discounted_reward", "standard_error"]
    assert planners.loc["pomcpow", names].tolist() == [1000, 29.3428, 0.8249]
    assert len(planners) == 7


def test_other_trials_are_refused(made_up: Report) -> None:
    with pytest.raises(InvalidValueError, match="published_worlds: these are trials of something"):
        PublishedWorlds().report_of({TRIALS: pd.DataFrame({"way": []})})


def test_the_figure_can_be_drawn(made_up: Report) -> None:
    pytest.importorskip("matplotlib")
    assert made_up.figures["vdp_tag"]().axes


def test_tasks_do_not_depend_on_how_they_are_cut() -> None:
    whole = run_vdp_tag("to_next", 5, 0, 3)
    parts = [run_vdp_tag("to_next", 5, first, 1) for first in range(3)]
    for name in COLUMNS[:-1]:
        assert whole[name].tolist() == [part[name][0] for part in parts]


def test_an_unknown_way_is_refused() -> None:
    with pytest.raises(TaskError, match="way 'guess': there are to_next"):
        run_vdp_tag("guess", 1, 0, 1)
