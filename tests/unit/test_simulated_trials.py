"""Many trials as a table, and tables compared."""

import contextlib
import csv
import dataclasses
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from tests.unit.test_outcome_comparison import result_of, run_of
from tests.unit.test_trial import configuration_of, one

import holdfast as hf
from holdfast.errors import HoldfastError, InvalidValueError, OutputError
from holdfast.journal.tables import wilson_interval
from holdfast.planning.inputs import Sensed
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.reports.outcome_comparison import effects_of
from holdfast.tuning.simulated_trials import Trials

LIMIT = 60


class PricedPeg(PegInHole2D):
    sensing_costs = (0.5, 0.25, 0.0)


def trials_of(method: Any, n: int = 12, problem: hf.Problem | None = None, **more: Any) -> Trials:
    planner = hf.Planner(problem or PegInHole2D(), particles=30, method=method)
    return hf.run_trials(planner, n, **{"seed": 3, "max_steps": LIMIT, "jobs": 1, **more})


def test_a_row_for_each_trial(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    trials = trials_of("random", 3, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(1, 3), (2, 3), (3, 3)]
    planner = hf.Planner(PegInHole2D(), particles=30, method="random")
    alone = [hf.run_trial(planner, 3, trial, max_steps=LIMIT) for trial in range(3)]
    assert [result.digest for result in trials] == [result.digest for result in alone]
    assert trials.to_csv(tmp_path / "trials.csv") == (tmp_path / "trials.csv").read_text()
    rows = list(csv.DictReader(trials.to_csv().splitlines()))
    assert [float(row["reward"]) for row in rows] == [result.reward for result in alone]
    assert rows[0]["sensing_price"] == ""
    assert trials.to_pandas()["steps"].tolist() == [result.steps for result in alone]
    assert len(trials.to_markdown().splitlines()) == 2 + 3


def test_what_sensing_has_cost() -> None:
    problem = PricedPeg()
    trials = trials_of("random", 2, problem)
    planner = hf.Planner(problem, particles=30, method="random")
    decisions = hf.run_trial(planner, 3, 1, max_steps=LIMIT).decisions
    assert decisions is not None
    looks = [each.sensing_action for each in decisions if isinstance(each, Sensed)]
    assert trials.results[1].sensing_price == pytest.approx(np.take((0.5, 0.25, 0.0), looks).sum())
    assert trials.results[1].decisions is None
    assert "sensing price" in trials.to_markdown()


def test_a_configuration_is_run_as_it_says(tmp_path: Path) -> None:
    configuration = configuration_of(tmp_path)
    trials = hf.run_trials(configuration, 2, jobs=1)
    assert trials.results[1].digest == one(configuration, 1).digest
    assert (
        hf.run_trials(configuration, 1, seed=8, jobs=1).results[0].digest
        != one(configuration).digest
    )


def test_the_summary_has_intervals() -> None:
    trials = trials_of("random")
    estimates = {each.measure: each for each in trials.summary().estimates}
    successes = sum(result.success for result in trials)
    assert estimates["success_rate"].interval == wilson_interval(successes, 12)
    steps = [result.steps if result.success else LIMIT for result in trials]
    assert estimates["steps"].value == pytest.approx(np.exp(np.mean(np.log(steps))))
    low, high = estimates["reward"].interval or (0.0, 0.0)
    assert low < estimates["reward"].value < high
    assert "12 trials, seed 3\nrandom " in repr(trials)
    assert f"counts as {LIMIT} steps" in trials._repr_html_()


def test_comparison_against_the_named_baseline() -> None:
    first, second = trials_of("random"), trials_of("path_entropy")
    found = hf.compare({"ours": second, "chance": first}, baseline="chance")
    expected = effects_of(first.results, second.results, step_limit=LIMIT, paired=True)
    assert found.baseline == "chance"
    (run,) = found.runs
    assert (run.run, run.effects, run.notes) == ("ours", expected, ())
    frame = found.to_pandas().set_index("measure")
    assert frame["effect"]["steps"] == {each.measure: each for each in expected}["steps"].effect
    assert frame["low"]["reward"] <= frame["effect"]["reward"] <= frame["high"]["reward"]
    head, baseline, other = found.shown()
    assert head[:3] == ("", "success (%)", "steps")
    assert found.names()[1:] == ("success_rate", "steps", "reward", "decision_ms")
    latex = found.to_latex(columns=["reward", "success_rate"])
    assert latex.splitlines()[2] == r" & reward & success (\%) \\"
    assert r"\par decision" not in latex
    assert r"\par decision" in found.to_latex()
    with pytest.raises(InvalidValueError, match="columns has 'cost'; allowed are success_rate, st"):
        found.to_markdown(columns=["cost"])
    assert (baseline[0], other[0]) == ("chance (baseline)", "ours")
    assert "60 steps" in repr(found)
    longest = max(map(len, repr(found).splitlines()[:3]))
    assert found.fitting(longest) == repr(found)
    assert found.fitting(longest - 1) == found.describe()


def test_runs_on_the_disk_and_other_tasks(tmp_path: Path) -> None:
    run = run_of(tmp_path / "run", [result_of(each, 10 + each) for each in range(12)], seed=3)
    mine = trials_of("random", max_steps=100)
    found = hf.compare({"recorded": run, "mine": mine})
    assert found.runs[0].notes == (
        "problem is 'PegInHole2D' here and 'peg_in_hole_2d' there, "
        "so the trials are of different tasks",
    )
    with pytest.raises(OutputError, match=r"mine: .* the limit is 60 steps here and 100 there"):
        hf.compare({"recorded": run, "mine": trials_of("random", 2)})
    other = trials_of("random", seed=4, max_steps=100)
    with pytest.raises(OutputError, match="the seed is 4 here"):
        hf.compare({"mine": mine, "other": other})
    assert not hf.compare({"mine": mine, "other": other}, paired=False).paired


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: trials_of("random", 0), "n 0: allowed"),
        (lambda: trials_of("random", jobs=0), "jobs is 0"),
        (lambda: trials_of("random", jobs=1.5), "jobs is 1.5"),
        (lambda: trials_of("random", seed=-1), "seed -1"),
        (
            lambda: hf.run_trials(cast("Any", "peg.yaml"), 3),
            r"planner is 'peg.yaml': load_configuration\(path\)",
        ),
        (lambda: hf.compare({}), "runs is {}; compare takes a mapping of at least 2"),
        (
            lambda: hf.compare({"a": "x", "b": "y"}, baseline="c"),
            r"baseline is 'c'; it must be one of \['a', 'b'\]",
        ),
    ],
)
def test_a_wrong_argument_is_named(call: Any, message: str) -> None:
    with pytest.raises(InvalidValueError, match=message):
        call()


def test_wrong_types_are_errors_of_holdfast(tmp_path: Path) -> None:
    """Whatever one argument is, the function works or says what is wrong with it."""
    configuration = configuration_of(tmp_path)
    planner = hf.Planner(PegInHole2D(), particles=20, method="random")
    mine = hf.run_trials(planner, 3, max_steps=10, jobs=1)
    compared = hf.compare({"a": mine, "b": mine})
    calls: list[tuple[Any, dict[str, Any]]] = [
        (hf.run_trials, {"planner": planner, "n": 2, "seed": 0, "jobs": 1, "max_steps": 9}),
        (hf.run_trials, {"planner": planner, "n": 2, "jobs": 1, "lost": None, "progress": None}),
        (hf.compare, {"runs": {"a": mine, "b": mine}, "baseline": "a", "paired": True}),
        (lambda run: hf.compare({"a": mine, "b": run}), {"run": mine}),
        (compared.to_latex, {"path": None, "columns": None}),
        (
            hf.check_problem,
            {"problem": 3, "settings": None, "max_steps": 9, "seed": 0, "budget_s": 1e-6}
            | {"trials": 0, "on_check": print},
        ),
        (
            hf.tune,
            {"configuration": 3, "vary": ["fixed"], "objective": "steps", "budget_s": 1.0}
            | {"most": 2, "jobs": 1, "max_decision_ms": 1e9, "out": None, "on_progress": print},
        ),
    ]
    wrong = [-1, 2.5, np.nan, True, "", b"x", [], {}, object(), [1], {"a": 1}, 10**30, "\0"]
    for call, arguments in calls:
        for name in arguments:
            for value in wrong:
                given = {**arguments, name: value}
                if call is hf.tune and name != "configuration":
                    given["configuration"] = configuration
                    given["out"] = value if name == "out" else 3  # so that none begins
                with contextlib.suppress(HoldfastError):
                    call(**given)


def test_a_world_that_is_not_simulated_is_refused(tmp_path: Path) -> None:
    configuration = configuration_of(tmp_path)
    environment = msgspec.structs.replace(configuration.environment, object="gymnasium")
    with pytest.raises(InvalidValueError, match=r"run.yaml: environment.object is gymnasium"):
        hf.run_trials(dataclasses.replace(configuration, environment=environment), 2)
