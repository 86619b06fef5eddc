"""The public face, ``import holdfast as hf``: its names, and what importing it costs."""

import ast
import importlib.metadata
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from tests.programs import said_by

import holdfast as hf
from holdfast.errors import InvalidValueError, ProblemError, UnknownProblemError

SOURCE = Path(hf.__file__)


def test_every_name_is_there_and_typed() -> None:
    """The names, the imports that type checkers read and what is imported are the same."""
    assert hf.__all__ == sorted(
        hf.__all__, key=lambda name: (not name.isupper(), name.islower(), name)
    )
    tree = ast.parse(SOURCE.read_text(encoding="utf-8"))
    typed = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("holdfast."):
            for alias in node.names:
                typed[alias.asname or alias.name] = f"{node.module}.{alias.name}"
    places = hf._PLACES
    assert {name: f"holdfast.{place}" for name, place in places.items()} == typed
    assert {*places, *hf._MODULES} == set(hf.__all__) == set(dir(hf)) - {"__version__"}
    assert hf.numerics.exp(0.0) == 1.0
    assert hf.errors.ProblemError is hf.ProblemError
    for name, place in places.items():
        found = getattr(hf, name)
        assert getattr(found, "__name__", name) == place.rpartition(".")[2]


def test_no_other_name() -> None:
    with pytest.raises(AttributeError, match=r"module 'holdfast' has no attribute 'planer'"):
        _ = hf.planer  # type: ignore[attr-defined]


def test_no_name_is_also_a_module() -> None:
    """Importing a module sets it as an attribute of its package, in the place of the name."""
    modules = {path.stem for path in SOURCE.parent.iterdir()} - {*hf._MODULES}
    assert modules.isdisjoint(hf.__all__)


def test_importing_it_imports_nothing_else() -> None:
    program = (
        "import sys; before = set(sys.modules); import holdfast; "
        "print(sorted(name for name in set(sys.modules) - before if '.' in name or 'num' in name))"
    )
    found = said_by(f"import sys; sys.path[:] = {sys.path!r}; {program}", flags=["-S"])
    assert "holdfast." not in found
    assert "numpy" not in found


def test_it_is_typed() -> None:
    assert (SOURCE.parent / "py.typed").is_file()
    about = importlib.metadata.metadata("holdfast-sensing")
    assert "Typing :: Typed" in about.get_all("Classifier", [])


class TestMake:
    def test_settings_of_both_sections(self) -> None:
        problem = hf.make_problem("peg_in_hole_2d", peg_width=0.5, rotation_step_size=0.2)
        assert problem.limit_action(np.full(3, 9.0)).tolist() == [0.1, 0.1, 0.2]
        assert problem.model.peg_width == 0.5  # type: ignore[attr-defined]

    @pytest.mark.parametrize(
        ("name", "settings", "error", "message"),
        [
            ("peg", {}, UnknownProblemError, "peg is not a registered name"),
            (None, {}, InvalidValueError, "name is None; expected a text: one of capsule_robot"),
            ("peg_in_hole_2d", {"peg_width": -1}, InvalidValueError, "peg_in_hole_2d: .*> 0"),
            (
                "peg_in_hole_2d",
                {"peg_width": "wide"},
                InvalidValueError,
                'peg_width is "wide"; expected a number > 0',
            ),
            (
                "peg_in_hole_2d",
                {"rotation_step_size": []},
                InvalidValueError,
                "rotation_step_size is .*; expected a number",
            ),
            ("peg_in_hole_2d", {"width": 1}, InvalidValueError, "no setting .width."),
            ("studies.busy_room:BusyRoom", {"width": 1}, ProblemError, "BusyRoom cannot be built"),
        ],
    )
    def test_refusals(
        self, name: Any, settings: dict[str, Any], error: type[Exception], message: str
    ) -> None:
        with pytest.raises(error, match=message):
            hf.make_problem(name, **settings)


def test_the_loop_and_run_trial_decide_the_same() -> None:
    problem = hf.make_problem("peg_in_hole_2d")
    planner = hf.Planner(problem, particles=50)
    assert planner.settings.particle_filter.num_particles == 50
    world = hf.SimulatedEnvironment(problem, seed=3)
    state = planner.init(seed=3)
    while not world.is_done() and state.step < 40:
        if planner.needs_sensing(state):
            sensing_action, _ = planner.choose_sensing_action(state)
            observation = world.perform_sensing(sensing_action)
            state, _ = planner.observe(state, sensing_action, observation)
        task_action, _ = planner.choose_task_action(state)
        world.perform(task_action)
        state = planner.advance(planner.decode(planner.encode(state)), task_action)
    result = hf.run_trial(planner, seed=3, max_steps=40)
    assert result.decisions is not None
    assert result.decisions.log.endswith(planner.digest(state))


@pytest.mark.parametrize(
    ("make_it", "message"),
    [
        (
            lambda: hf.Planner(cast("Any", "peg_in_hole_2d")),
            r"problem is the name 'peg_in_hole_2d'",
        ),
        (lambda: planner_of(method="rnd"), r"selector\.method is \"rnd\"; expected one of"),
        (
            lambda: hf.PlanningSettings(sensing_intervals=8),  # type: ignore[call-arg]
            r"PlanningSettings has no sensing_intervals; did you mean sensing_interval\?; allowed",
        ),
        (
            lambda: hf.SelectorSettings(metod="random"),  # type: ignore[call-arg]
            r"SelectorSettings has no metod; did you mean method\?; allowed: method, sensing_act",
        ),
        (
            lambda: hf.run_trial(cast("Any", hf.make_problem("peg_in_hole_2d"))),
            r"planner is a PegInHole2D: run_trial takes a planner, as in run_trial\(Planner\(probl",
        ),
        (
            lambda: hf.entropy(np.zeros((9, 1)), None, cast("Any", "nearest")),
            r"estimator is 'nearest'",
        ),
        (
            lambda: hf.make_problem("peg_in_hole_2d", hole_tolernce=0.2),
            r"no setting 'hole_tolernce'; did you mean hole_tolerance.; allowed: .*hole_tolerance",
        ),
    ],
)
def test_a_wrong_argument_is_named(make_it: Callable[[], object], message: str) -> None:
    with pytest.raises(InvalidValueError, match=message):
        make_it()


def planner_of(*arguments: Any, **keywords: Any) -> hf.Planner:
    return hf.Planner(hf.make_problem("peg_in_hole_2d"), *arguments, **keywords)
