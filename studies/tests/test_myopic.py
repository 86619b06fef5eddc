"""The study of problems on which looking one step ahead fails, with results known beforehand."""

from typing import Any

import numpy as np
import pytest

from holdfast.numerics.randomness import Purpose, stream
from holdfast.planning.planner import Planner
from holdfast.problems import checked
from holdfast.problems.attributes import check_problem
from holdfast.robot.trial import run_trial
from studies.myopic import CASES, WAYS, Myopic
from studies.study import CHOICE, CLAIM, Scale
from studies.tasks import Task, run_task
from studies.tests.made_up import noise, report_on
from studies.trial_batches import problem_of, trial_tasks

SCALE = Scale(seed=5)


def test_what_is_chosen_on_one_seed_is_judged_on_another(monkeypatch: pytest.MonkeyPatch) -> None:
    """Covariance costs 10 steps less than random sensing; the default fails and costs 20 more."""

    def trial(task: Task, number: int) -> tuple[bool, int, float]:
        method = task.parameters["planning"]["selector"]["method"]
        differs = {"action_covariance": -10, "path_entropy": 20}.get(method, 0)
        own = noise(task, number, ["problem", "seed", "planning"])
        return method != "path_entropy", 1000 + differs + round(3.0 * own), 0.0

    monkeypatch.setattr(Myopic, "num_trials", {CHOICE: 20, CLAIM: 40})
    report = report_on(Myopic(), SCALE, trial)
    assert set(report.figures) == {"myopic"}
    rows = report.summary["outcomes"].to_dict("records")
    assert len(rows) == len(CASES) * (2 * len(WAYS) - 3)
    for row in rows:
        assert row["chosen"] == (row["way"] == "action covariance")
        against_default = row["rival"] == "default"
        expected = {"action covariance": -10.0, "default": 20.0}.get(str(row["way"]), 0.0)
        # Of 40 differences of deviation 4.2, four deviations.
        assert row["cost_difference"] == pytest.approx(expected - 20.0 * against_default, abs=2.7)
        assert row["success_gain"] == against_default - (row["way"] == "default")
        assert (row["success_adjusted_p_value"] < 0.01) == (row["success_gain"] != 0.0)


@pytest.mark.parametrize("name", CASES)
def test_a_robot_that_knows_its_state_succeeds(name: str) -> None:
    case, _ = CASES[name]
    problem: Any = problem_of(case.problem)
    check_problem(problem)
    states = problem.initial_states(stream(1, 0, 0, Purpose.INITIAL_BELIEF), 50)
    done, failed = np.zeros((2, 50), bool)
    for step in range(case.max_steps):
        actions = problem.limit_action(problem.policy(states, 0))
        states = problem.move(states, actions, stream(1, 0, step, Purpose.WORLD_MOTION))
        ended, failures = checked.ends(problem, states)
        if failures is not None:
            failed |= failures & ~done
        done |= ended
    assert done.all()
    assert not failed.any()


def test_a_trial_that_fails_costs_the_limit() -> None:
    case, interval = CASES["sorting"]
    series = case.series(WAYS["random"], interval, seed=2, num_trials=20)
    (task,) = trial_tasks(series, 20)
    steps = run_task(task)["steps"]
    planner = Planner(problem_of(case.problem), series.planning)
    found = [run_trial(planner, 2, trial, max_steps=case.max_steps) for trial in range(20)]
    failed = [result.failed for result in found]
    assert max(result.steps for result in found if result.failed) < case.max_steps
    assert steps.tolist() == [
        case.max_steps if fails else result.steps
        for fails, result in zip(failed, found, strict=True)
    ]
