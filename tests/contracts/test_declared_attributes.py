"""A problem's attributes mean the same as list, tuple or array, of Python's numbers or NumPy's."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.line_problem import Line

import holdfast as hf
from holdfast.problems.attributes import check_problem
from holdfast.reports.belief_remarks import belief_remarks
from holdfast.reports.csv_export import state_labels
from holdfast.reports.poses import pose_layout
from holdfast.reports.recorder import Recorder
from holdfast.robot.problem_env import ProblemEnv

SETTINGS = hf.PlanningSettings(
    particle_filter=hf.ParticleFilterSettings(num_particles=30), sensing_interval=1
)


class Turning(Line):
    """A heading and a position; a sensing action shows one of them."""

    name = "turning"
    action_size = 2
    motion_variance: Any = (0.01, 0.04)

    def policy(self, states: Any, stage: Any) -> Any:
        return -0.5 * states

    def initial_states(self, stream: Any, count: int) -> Any:
        return stream.normal((count, 2)) + np.array([3.0, 1.0])  # about where angles wrap


PLAIN: dict[str, Any] = {
    "name": "turning",
    "state_size": 2,
    "action_size": 2,
    "num_stages": 1,
    "sensing_actions": ("heading", "place"),
    "state_labels": ("heading (rad)", "place (m)"),
    "circular": (0,),
    "circular_actions": (0,),
    "static_parameters": (1,),
    "circular_observations": ((0,), ()),
    "motion_variance": (0.01, 0.04),
    "resolution": (0.1, 0.2),
    "state_resolution": (0.2, 0.1),
    "sensing_costs": (1, 2),
    "pose": ("yaw", "x"),
    "up": "z",
    "rank_test": True,
}


def scalars(value: Any) -> Any:
    """Return the same of NumPy's scalars."""
    if isinstance(value, tuple):
        return tuple(map(scalars, value))
    return np.asarray(value)[()]


def array(value: Any) -> Any:
    """Return an array; of objects where the parts differ in length."""
    if value == PLAIN["circular_observations"]:
        made = np.empty(2, dtype=object)
        made[:] = value
        return made
    return np.array(value) if isinstance(value, tuple) else scalars(value)


def listed(value: Any) -> Any:
    return list(map(listed, value)) if isinstance(value, tuple) else value


def tuple_or_same(value: Any) -> Any:
    return value


FORMS: dict[str, Callable[[Any], Any]] = {"list": listed, "array": array, "scalars": scalars}


def problem_of(**attributes: Any) -> Any:
    return type("Declared", (Turning,), {**PLAIN, **attributes})()


def what_it_means(problem: Any) -> list[Any]:
    """Return what is decided, computed and drawn with a problem."""
    found: list[Any] = []
    for method in ("path_entropy", "state_entropy", "action_covariance", "expected_return"):
        selector = hf.SelectorSettings(method=method, nats_per_cost=0.1)
        planner = hf.Planner(problem, msgspec.structs.replace(SETTINGS, selector=selector))
        recorder = Recorder(0, planner)
        ended = hf.run_trial(planner, 4, max_steps=6, observer=recorder)
        timeless = msgspec.structs.replace(ended, sensing_ms=(), mean_sensing_ms=0.0)
        stored = msgspec.msgpack.encode(timeless)
        found += [ended.digest, stored, planner.encode(planner.init(1)), planner.num_choices]
        found.append(belief_remarks(problem, planner.settings, recorder.record))
    env = ProblemEnv(problem, settings=SETTINGS, max_steps=6)
    found += [env.observation_labels, env.reset(seed=4)[0].tolist(), state_labels(problem)]
    layout = pose_layout(problem)
    assert layout is not None
    return [*found, layout.indices, layout.circular]


EXPECTED = what_it_means(problem_of())


@pytest.mark.parametrize("form", FORMS)
def test_the_form_does_not_matter(form: str) -> None:
    problem = problem_of(**{name: FORMS[form](value) for name, value in PLAIN.items()})
    check_problem(problem)
    assert what_it_means(problem) == EXPECTED


@pytest.mark.parametrize(
    "attribute", ["circular", "circular_actions", "sensing_costs", "state_resolution"]
)
def test_the_attribute_has_a_meaning(attribute: str) -> None:
    """Else the test above could not fail."""
    without = {"state_resolution": None, "sensing_costs": None}.get(attribute, ())
    assert what_it_means(problem_of(**{attribute: without})) != EXPECTED


def test_no_labels_as_an_empty_array() -> None:
    nones: list[Any] = [(), [], np.array([])]
    for none in [*nones, None]:
        check_problem(problem_of(state_labels=none))
    for none in nones:
        check_problem(problem_of(circular=none, circular_observations=none, circular_actions=none))


def test_a_size_that_cannot_be_set() -> None:
    kind = type("Fixed", (Turning,), {"state_size": property(lambda _: np.int64(2))})
    with pytest.raises(hf.HoldfastError, match=r"state_size of turning is .*2.* and cannot be set"):
        hf.Planner(kind())


def test_a_figure() -> None:
    figure = pytest.importorskip("holdfast.reports.figure")
    example = Path(__file__).parents[2] / "examples" / "peg_in_hole_2d.yaml"
    configuration = hf.load_configuration(example)
    pictures = []
    forms: list[Callable[[Any], Any]] = [tuple_or_same, array]
    for form in forms:
        problem = problem_of(**{name: form(value) for name, value in PLAIN.items()})
        planner = hf.Planner(problem, SETTINGS)
        recorder = Recorder(0, planner)
        hf.run_trial(planner, 4, max_steps=6, observer=recorder)
        shown = dataclasses.replace(configuration, problem=problem, problem_name="turning")
        pictures.append(figure.trial_figure(shown, recorder.record))
    assert pictures[0] == pictures[1]
