"""What the studies of ways and parameters make of results that are known beforehand."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import msgspec
import pytest
from tests.experiments.made_up import noise, results_of

from holdfast.experiments import parameters, selectors
from holdfast.experiments.cases import CASES
from holdfast.experiments.study import Report, Scale, Study
from holdfast.experiments.tables import number_of
from holdfast.experiments.tasks import Task
from holdfast.experiments.trial_batches import run_trials_of
from holdfast.problems.problem import Problem
from holdfast.runtime import trial as trial_runner
from holdfast.runtime.environment import SimulatedEnvironment

SCALE = Scale(seed=5)
PEG_IN_HOLE = "peg_in_hole_2d"
PEG_IN_SPACE = "peg_in_hole_3d"
THREE_PLATES = "multitier_peg_in_hole_2d"
DEFAULT = msgspec.to_builtins(selectors.WAYS[selectors._DEFAULT])


def selector_of(task: Task) -> dict[str, object]:
    found: dict[str, object] = task.parameters["planning"]["selector"]
    return found


@pytest.fixture(scope="module")
def compared() -> Iterator[Report]:
    """Worlds differ by a factor; whoever asks for the mixture of actions takes four fifths.

    Whoever asks for the mixture of states fails in every second trial, and so does the default with
    the three plates.
    """

    def trial(task: Task, number: int) -> tuple[bool, int, float]:
        world = math.exp(0.3 * noise(task, number, ["problem", "model"]))
        own = math.exp(0.05 * noise(task, number, ["problem", "model", "planning"]))
        chosen = selector_of(task)
        factor = 1.0
        if chosen["method"] == "action_entropy" and chosen["estimator"] != "nearest_neighbor":
            factor = 0.8
        if chosen["method"] == "fixed":
            factor = 3.0
        steps = round(10_000 * world * own * factor)
        fails = chosen["method"] == "state_entropy" and chosen["estimator"] != "nearest_neighbor"
        if task.parameters["problem"] == THREE_PLATES:
            fails |= chosen == DEFAULT
        success = chosen["method"] != "fixed" and not (fails and number % 2 == 0)
        return success, steps, -0.01 * steps

    study = selectors.Selectors()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(selectors, "_TRIALS", 40)
        yield study.report(SCALE, results_of(study, SCALE, trial))


def test_every_cell_is_there(compared: Report) -> None:
    summary = compared.summary["selectors"]
    assert summary.num_rows == len(CASES) * len(selectors.INTERVALS) * len(selectors.WAYS)
    assert compared.raw["selectors"].num_rows == sum(
        task.units for task in selectors.Selectors().tasks(SCALE)
    )


def test_a_known_ratio_is_found(compared: Report) -> None:
    for row in compared.summary["relative_steps"].rows():
        expected = {"fixed": 3.0}.get(str(row["way"]), 1.0)
        if str(row["way"]).startswith("action entropy, mixture"):
            expected = 0.8
        # The mean over four intervals of differences of deviation 0.07, over 20 trials or more:
        # 0.04 are five deviations.
        assert row["steps_ratio"] == pytest.approx(expected, rel=0.04)
        low, high = row["steps_ratio_low"], row["steps_ratio_high"]
        assert isinstance(low, float)
        assert isinstance(high, float)
        assert low < float(row["steps_ratio"] or 0.0) < high
        assert high / low < 1.1
        level = float(row["adjusted_p_value"] or 0.0)
        assert (level < selectors.LEVEL) == (expected != 1.0)


def test_rivals_and_sentences(compared: Report) -> None:
    better = {
        (row["way"], row["rival"])
        for row in compared.summary["rivals"].rows()
        if row["problem"] == "all problems"
        and float(row["adjusted_p_value"] or 0.0) < selectors.LEVEL
    }
    mixtures = {"action entropy, mixture", "action entropy, mixture, executed"}
    assert better
    assert all(len(mixtures & set(pair)) == 1 for pair in better)
    # The two mixtures against the five others that choose.
    assert len(better) == 10
    for begin, inside in (
        ("all problems (mean), fixed: ", "times the steps of random"),
        ("busy room, action entropy, mixture against action entropy, neighbours: 0.", "paired"),
        ("tight hole, action entropy, mixture against state entropy, mixture: +50", "of success"),
    ):
        found = [told for told in compared.findings if told.startswith(begin)]
        assert any(inside in told for told in found), begin
    # Where nothing differs but by chance nothing is said, except of the default.
    assert any(
        told.startswith("all problems (mean), action covariance against action entropy, n")
        for told in compared.findings
    )
    assert not [told for told in compared.findings if "covariance against state entropy, n" in told]


def test_random_is_a_rival_of_the_default_in_success(compared: Report) -> None:
    rows = list(compared.summary["rivals_in_success"].rows())
    places = [*(case.name for case in CASES), *selectors._GROUPS]
    against_random = [row for row in rows if row["rival"] == selectors.BASELINE]
    assert [row["problem"] for row in against_random] == places
    assert {row["way"] for row in against_random} == {selectors._DEFAULT}
    assert len(rows) == len(places) * (1 + 21)
    gains = {"three plates": -0.5, "all problems": -0.5 / 8, "without distractions": -0.5 / 6}
    for row in against_random:
        assert row["success_gain"] == pytest.approx(gains.get(str(row["problem"]), 0.0))
    # It is told of each place, whether or not a difference was found.
    for place, told in (("three plates", "-50.0"), ("busy room", "+0.0")):
        begin = f"{place}, action entropy, neighbours against random: {told} points of success ["
        assert any(finding.startswith(begin) for finding in compared.findings)


def test_how_each_problem_is_posed(compared: Report) -> None:
    rows = list(compared.summary["cases"].rows())
    assert [row["problem"] for row in rows] == [case.name for case in CASES]
    assert rows[1]["model"] == "hole_tolerance 0.05"
    assert {row["M"] for row in rows} == {10}
    assert [row["trials"] for row in rows] == [round(case.share * 40) for case in CASES]


def test_groups_of_problems() -> None:
    groups = selectors._GROUPS
    assert len(groups["all problems"]) == len(CASES)
    missing = set(groups["all problems"]) - set(groups["without distractions"])
    assert missing == {"busy room", "passer-by"}


def test_costs_of_looks(compared: Report) -> None:
    costs = compared.summary["costs_of_looks"]
    free = [row for row in costs.rows() if row["cost_of_a_look"] == 0.0]
    dear = [row for row in costs.rows() if row["cost_of_a_look"] == 1.0]
    assert len(free) == len(dear) == len(CASES) * 4
    for cheap, expensive in zip(free, dear, strict=True):
        assert float(expensive["net_reward"] or 0.0) < float(cheap["net_reward"] or 0.0)
        # One half of the trials chooses the interval, the other half judges it.
        case = next(case for case in CASES if case.name == cheap["problem"])
        assert cheap["trials"] == round(case.share * 40) // 2


def begins_in_the_goal(task: Task, number: int) -> bool:
    return number == 3 and task.parameters["model"] == {"hole_tolerance": 0.05}


def test_a_trial_that_begins_in_the_goal_says_nothing_of_steps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It takes no step, whatever is sensed; every other trial is compared as ever."""

    def trial(task: Task, number: int) -> tuple[bool, int, float]:
        steps = round(10_000 * math.exp(0.3 * noise(task, number, ["problem", "planning"])))
        return True, 0 if begins_in_the_goal(task, number) else steps, 0.0

    def without_it(task: Task, number: int) -> tuple[bool, int, float]:
        success, steps, reward = trial(task, number)
        return success, steps or 10_000, reward

    for study, module, tables in (
        (selectors.Selectors(), selectors, ("selectors", "relative_steps", "rivals")),
        (parameters.Parameters(), parameters, ("parameters", "together")),
    ):
        monkeypatch.setattr(module, "_TRIALS", 40)
        report, other = (
            study.report(SCALE, results_of(study, SCALE, each)) for each in (trial, without_it)
        )
        for name in tables:
            rows = zip(report.summary[name].rows(), other.summary[name].rows(), strict=True)
            for row, whole in rows:
                ratio = number_of(row["steps_ratio"])
                assert math.isfinite(ratio), row
                levels = [number_of(row[each]) for each in row if each.endswith("p_value")]
                assert all(0.0 <= level <= 1.0 for level in levels), row
                if "problem" in row and row["problem"] not in (*selectors._GROUPS, "tight hole"):
                    assert ratio == whole["steps_ratio"]
        for finding in report.findings:
            assert "nan" not in finding
        if name == "rivals":
            assert {row["trials"] for row in report.summary[name].rows()} == {19, 20, 39, 40}


def test_what_a_parameter_does(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parameters, "_TRIALS", 40)

    def trial(task: Task, number: int) -> tuple[bool, int, float]:
        world = math.exp(0.3 * noise(task, number, ["problem", "model"]))
        own = math.exp(0.05 * noise(task, number, ["problem", "model", "planning"]))
        sensing = task.parameters["planning"]["active_sensing"]
        factor = 0.5 if sensing["horizon"] == 3 else 1.0
        if sensing["num_nearest_neighbors"] == 20 and task.parameters["problem"] == PEG_IN_SPACE:
            factor = 0.25
        if selector_of(task)["estimator"] != "nearest_neighbor":
            factor = 2.0
        # Ten times what the problem has; the fewest are 100.
        particles = task.parameters["planning"]["particle_filter"]["num_particles"]
        if factor == 1.0 and particles in (1000, 2000, 5000):
            factor = 0.9
        return True, round(10_000 * world * own * factor), 0.0

    study = parameters.Parameters()
    report = study.report(SCALE, results_of(study, SCALE, trial))
    for row in report.summary["parameters"].rows():
        expected = 1.0
        if (row["parameter"], row["value"]) == ("horizon", "3"):
            expected = 0.5
        if (row["problem"], row["parameter"], row["value"]) == ("peg in space", "k", "20"):
            expected = 0.25
        if row["value"] == "x 10" and row["parameter"] == "particles":
            expected = {"neighbours": 0.9}.get(str(row["estimator"]), 1.0)
        assert row["steps_ratio"] == pytest.approx(expected, rel=0.08)
    # In each problem, and over all of them, each with the same weight.
    told = [finding for finding in report.findings if "horizon 3:" in finding]
    assert len(told) == len(parameters._CASES) + 1
    together = {
        (row["estimator"], row["parameter"], row["value"], row["reference"]): row["steps_ratio"]
        for row in report.summary["together"].rows()
    }
    assert together["neighbours", "horizon", "3", "neighbours"] == pytest.approx(0.5, rel=0.04)
    fifth_root = 0.25 ** (1 / len(parameters._CASES))
    assert together["neighbours", "k", "20", "neighbours"] == pytest.approx(fifth_root, rel=0.04)
    assert together["mixture", "", "", "neighbours"] == pytest.approx(2.0, rel=0.04)
    assert together["mixture", "resolution", "x 3", "mixture"] == pytest.approx(1.0, rel=0.04)
    (said,) = [each for each in report.findings if "(mean), mixture, reference" in each]
    assert (
        "points of success of the reference of the neighbours (geometric mean and mean, n = 20"
        in said
    )
    more = list(report.summary["more_particles"].rows())
    assert [row["problem"] for row in more] == [*parameters._CASES, parameters._TOGETHER]
    assert {(row["from"], row["to"]) for row in more} == {("x 3", "x 10")}
    for row in more:
        assert row["steps_ratio"] == pytest.approx(0.9, rel=0.08)
    assert any("particles x 10 instead of x 3: 0.9" in each for each in report.findings)
    assert report.findings[-1].startswith("no difference in steps beyond noise")
    assert "horizon (neighbours)" not in report.findings[-1]
    assert "M (neighbours) (least p" in report.findings[-1]


@pytest.mark.parametrize("study", [selectors.Selectors(), parameters.Parameters()])
def test_whatever_is_compared_meets_the_same_worlds(study: Study) -> None:
    """Trials are compared pair by pair: of one problem they differ in how it is planned alone."""
    runs: dict[str, set[tuple[str, str]]] = {}
    for task in study.tasks(SCALE):
        assert task.parameters["seed"] == SCALE.seed
        posed = {name: value for name, value in task.parameters.items() if name != "planning"}
        problem = str((posed["problem"], posed["model"]))
        runs.setdefault(problem, set()).add((str(task.parameters["planning"]), str(posed)))
    assert len(runs) > 1
    for found in runs.values():
        ways, batches = ({run[part] for run in found} for part in (0, 1))
        assert len(ways) > 1
        # Every way has every batch: the same seed, numbers of trials and length.
        assert found == set(itertools.product(ways, batches))


def test_the_trials_of_every_way_begin_in_the_same_states(monkeypatch: pytest.MonkeyPatch) -> None:
    began: list[bytes] = []

    class Noted(SimulatedEnvironment):
        def __init__(self, problem: Problem, seed: int, trial: int) -> None:
            super().__init__(problem, seed, trial)
            began.append(self.state.tobytes())

    monkeypatch.setattr(trial_runner, "SimulatedEnvironment", Noted)
    worlds = {}
    for task in selectors.Selectors().tasks(SCALE):
        if task.parameters["problem"] != PEG_IN_HOLE or task.parameters["first_trial"] != 0:
            continue
        began.clear()
        run_trials_of(**{**task.parameters, "num_trials": 3, "max_steps": 1})
        worlds[str(task.parameters)] = tuple(began)
    # Two cases are this problem.
    assert len(worlds) == 2 * len(selectors.WAYS) * len(selectors.INTERVALS)
    assert len(set(worlds.values())) == 1
    assert len(set(began)) == 3


def test_each_variant_differs_in_one_thing() -> None:
    reference = parameters.Variant()
    references = 0
    for variant in parameters.variants():
        if not variant.parameter:
            reference = variant
            references += 1
            continue
        changed = [
            name
            for name in set(variant._fields) - {"parameter", "value"}
            if getattr(variant, name) != getattr(reference, name)
        ]
        assert len(changed) == 1
        assert variant.value
    assert references == 2
