"""What a problem returns is checked where it is used, by name, shape and value."""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np
import pytest

from holdfast import contract, planning
from holdfast.errors import InvalidValueError, ProblemError
from holdfast.problems.problem import (
    BatchedMotionProblem,
    ExpectedMotionProblem,
    FloatArray,
    GeneralObservationProblem,
    IntArray,
    KnownStateReturnProblem,
    Problem,
    ProblemBase,
)
from holdfast.randomness import Stream
from holdfast.runtime.environment import SimulatedEnvironment
from holdfast.settings import (
    ActiveSensingSettings,
    ParticleFilterSettings,
    PlanningSettings,
    SelectorSettings,
    check_settings,
)

SETTINGS = PlanningSettings(particle_filter=ParticleFilterSettings(num_particles=30))


class Line(ProblemBase):
    """A point on a line with two coordinates, of which each sensing action shows one."""

    name = "line"
    state_size = 2
    action_size = 1
    sensing_actions: Any = ("first", "second")
    motion_variance = np.array([0.01])

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        return stream.normal((count, 2))

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        return states + actions + 0.1 * stream.normal(states.shape)

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return states[..., sensing_action : sensing_action + 1]

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return np.array([0.01])

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        return -states[..., :1]

    def is_goal(self, states: FloatArray) -> Any:
        return np.abs(states[..., 0]) < 0.1


def run_a_step(problem: Any) -> None:
    environment = SimulatedEnvironment(problem, 0, 0)
    state = planning.initial_state(problem, SETTINGS, 0, 0)
    action, _ = planning.choose_sensing_action(problem, SETTINGS, state)
    state, _ = planning.observe(
        problem, SETTINGS, state, action, environment.perform_sensing(action)
    )
    task_action, _ = planning.choose_task_action(problem, SETTINGS, state)
    environment.perform(task_action)
    environment.is_done()
    planning.advance(problem, SETTINGS, state, task_action)


def test_a_problem_that_keeps_the_contract_runs() -> None:
    run_a_step(Line())


MISFITS: dict[str, tuple[str, Any, str]] = {
    "mean without its axis": (
        "observation_mean",
        lambda _self, states, action: states[..., action],
        r"observation_mean of sensing action 0 of line returned float64 of shape \(.*\): need",
    ),
    "constant mean": (
        "observation_mean",
        lambda _self, _states, _action: np.zeros(1),
        "observation_mean of sensing action 0 of line returned float64 of shape",
    ),
    "variance as a number": (
        "observation_variance",
        lambda _self, _states, _action: 0.01,
        r"observation_variance of sensing action 0 of line returned float \(0.01\): need",
    ),
    "variance of another size": (
        "observation_variance",
        lambda _self, _states, _action: np.array([0.01, 0.01]),
        r"observation_variance of sensing action 0 of line returned float64 of shape \(2,\)",
    ),
    "policy of another width": (
        "policy",
        lambda _self, states, _stage: -states,
        r"policy of line returned float64 of shape \(30, 2\): need .* \(30, 1\)",
    ),
    "policy as a list": (
        "policy",
        lambda _self, states, _stage: [[0.0]] * len(states),
        "policy of line returned list",
    ),
    "move without return": ("move", lambda *_: None, "move of line returned NoneType"),
    "stage out of range": (
        "next_stage",
        lambda *_: 7,
        "next_stage of line is 7: allowed are 0 to 0",
    ),
    "several rewards": (
        "reward",
        lambda *_: np.zeros(3),
        r"reward of line returned float64 of shape \(3,\): need one number",
    ),
    "several goals": ("is_goal", lambda *_: np.array([True]), "is_goal of line returned bool"),
    "a distance as goal": (
        "is_goal",
        lambda *_: np.float64(5.3),
        r"is_goal of line is .*5\.3.*: must be True or False",
    ),
    "integer states": (
        "initial_states",
        lambda _self, _stream, count: np.zeros((count, 2), np.int64),
        "initial_states of line returned int64",
    ),
}


@pytest.mark.parametrize("case", MISFITS)
def test_a_misfit_is_named(case: str) -> None:
    function, replacement, message = MISFITS[case]
    with pytest.raises(ProblemError, match=message):
        run_a_step(type("Misfit", (Line,), {function: replacement})())


@pytest.mark.parametrize(
    ("attribute", "value", "message"),
    [
        ("name", "", "name of .* is ''"),
        ("state_size", 0, "state_size of line is 0"),
        ("sensing_actions", "abcd", "sensing_actions of line is 'abcd'"),
        ("sensing_actions", (), "sensing_actions of line"),
        ("state_labels", ("x",), "state_labels of line has 1 labels: must have 2"),
        ("resolution", 0.0, "resolution of line is 0.0"),
        ("resolution", np.inf, "resolution of line is inf"),
        ("resolution", None, "resolution of line is None: must be one number or 1, one for each"),
        ("resolution", np.array([0.1, 0.1]), r"line is \[0.1 0.1\]: must be one number or 1, one"),
        ("resolution", np.array([np.nan]), r"line is \[nan\].* coordinate of an action, positive"),
        ("resolution", np.array(["x"]), r"resolution of line is \['x'\]: must be one number"),
        ("state_resolution", -1.0, "state_resolution of line is -1.0: must be positive and finite"),
        (
            "state_resolution",
            (0.1, 0.0),
            r"state_resolution of line is \[0.1 0. \]: must be one number or 2, one for each "
            "coordinate of a state",
        ),
        ("state_resolution", np.array([0.1]), "state_resolution of line"),
        (
            "resolution",
            [[1], [1, 2]],
            r"^resolution of line is \[\[1\], \[1, 2\]\]: must be one num",
        ),
        ("state_resolution", [[1], [1, 2]], r"^state_resolution of line is .*: must be one num"),
        ("sensing_costs", [[1], [1, 2]], r"sensing_costs of line is .*: must be 2 numbers"),
        ("motion_variance", [[1], [1, 2]], r"motion_variance of line is .*: must be 1 numbers"),
        ("resolution", True, "resolution of line is True: must be one number"),
        ("resolution", np.array(0.0), "resolution of line is 0.0: must be positive and finite"),
        ("motion_variance", np.array([0.1, 0.1]), "motion_variance of line"),
        ("log_likelihood", lambda *_: 0.0, "log_likelihood alone"),
        ("sample_observation", lambda *_: 0.0, "sample_observation alone"),
    ],
)
def test_an_attribute_is_named(attribute: str, value: object, message: str) -> None:
    broken: Any = type("Broken", (Line,), {attribute: value})()
    with pytest.raises(ProblemError, match=message):
        planning.initial_state(broken, SETTINGS, 0, 0)


@pytest.mark.parametrize(
    ("found", "need"),
    [
        ([np.zeros((1, 4, 2)), np.zeros((1, 4), np.int64)], "need a tuple of two arrays$"),
        ((np.zeros((1, 4)), None), r"need a float64 array of shape \(1, 4, 2\)$"),
        ((np.zeros((1, 4, 2)), np.zeros((1, 4))), r"need an array of integers of shape \(1, 4\)$"),
    ],
)
def test_what_a_path_must_be(found: object, need: str) -> None:
    problem: Any = type("Wrong", (Line,), {"expected_path": lambda *_: found})()
    with pytest.raises(ProblemError, match=f"^expected_path of line returned .*: {need}"):
        contract.expected_path(problem, np.zeros((4, 2)), 0, (3,), 1)


class TestResolution:
    """Which resolution the points have whose entropy counts."""

    @staticmethod
    def of(
        given: float | tuple[float, ...] | None, *, of_states: bool, **attributes: object
    ) -> object:
        problem = type("Resolved", (Line,), attributes)()
        found = contract.resolution_of(problem, given, of_states=of_states)
        return found if isinstance(found, float) else found.tolist()

    def test_one_number_is_for_actions_and_states(self) -> None:
        for of_states in (False, True):
            assert self.of(None, of_states=of_states, resolution=0.3) == 0.3
            assert self.of(0.2, of_states=of_states, resolution=np.array([0.3])) == 0.2

    @pytest.mark.parametrize("number", [np.float32(0.5), np.array(0.5), np.float64(0.5)])
    def test_a_number_of_numpy_is_one_number(self, number: Any) -> None:
        for name, of_states in (("resolution", False), ("state_resolution", True)):
            assert self.of(None, of_states=of_states, **{name: number}) == 0.5
            problem: Any = type("Resolved", (Line,), {name: number})()
            contract.check_problem(problem)
        problem = type("Whole", (Line,), {"resolution": np.int64(1)})()
        contract.check_problem(problem)
        assert contract.resolution_of(problem, None, of_states=False) == 1.0

    @pytest.mark.parametrize("own", [[[1], [1, 2]], "x", True])
    @pytest.mark.parametrize("name", ["resolution", "state_resolution"])
    def test_what_is_no_number_is_named(self, name: str, own: object) -> None:
        with pytest.raises(ProblemError, match=f"^{name} of line is .*: must be numbers"):
            self.of(None, of_states=name == "state_resolution", **{name: own})

    def test_what_is_given_comes_first(self) -> None:
        own = {"resolution": np.array([0.3]), "state_resolution": np.array([0.1, 0.2])}
        assert self.of((0.5,), of_states=False, **own) == [0.5]
        assert self.of((0.5, 0.6), of_states=True, **own) == [0.5, 0.6]

    def test_states_have_their_own(self) -> None:
        own = {"resolution": np.array([0.3]), "state_resolution": np.array([0.1, 0.2])}
        assert self.of(None, of_states=False, **own) == [0.3]
        assert self.of(None, of_states=True, **own) == [0.1, 0.2]
        assert self.of(None, of_states=True, resolution=(0.3,), state_resolution=0.4) == 0.4

    def test_states_of_as_many_coordinates_have_the_actions(self) -> None:
        found = self.of(None, of_states=True, resolution=np.array([0.3, 0.4]), action_size=2)
        assert found == [0.3, 0.4]

    def test_states_of_another_number_of_coordinates_need_one(self) -> None:
        with pytest.raises(
            InvalidValueError,
            match=r"selector.method is state_entropy, but the resolution of .* 1 n.*and a state "
            "has 2; give the problem a state_resolution, one number or 2, or write",
        ):
            self.of(None, of_states=True, resolution=np.array([0.3]))

    def test_another_number_of_numbers(self) -> None:
        with pytest.raises(
            InvalidValueError,
            match=r"selector.resolution is \[0.5, 0.6\], 2 numbers; need one number, or 1 for "
            "line, one for each coordinate of an action",
        ):
            self.of((0.5, 0.6), of_states=False)
        with pytest.raises(InvalidValueError, match="2 for line, one for each coordinate of a sta"):
            self.of((0.5,), of_states=True)


@pytest.mark.parametrize("function", ["policy", "move", "observation_mean"])
def test_a_function_cannot_change_the_belief(function: str) -> None:
    def in_place(_self: Line, states: FloatArray, *_: object) -> FloatArray:
        states += 1.0
        return states

    broken: Any = type("InPlace", (Line,), {function: in_place})()
    with pytest.raises(ValueError, match="read-only"):
        run_a_step(broken)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (PlanningSettings(selector=SelectorSettings(method="entropy")), r"selector\.method"),  # type: ignore[arg-type]
        (PlanningSettings(selector=SelectorSettings(estimator="knn")), r"selector\.estimator"),  # type: ignore[arg-type]
        (PlanningSettings(active_sensing=ActiveSensingSettings(horizon=0)), "horizon"),
        (PlanningSettings(active_sensing=ActiveSensingSettings(discount=5.0)), "discount"),
        (PlanningSettings(sensing_interval=-1), "sensing_interval"),
        (
            PlanningSettings(
                active_sensing=ActiveSensingSettings(num_observation_samples=41),
                selector=SelectorSettings(method="expected_return"),
            ),
            r"max_observation_samples is 40; .*num_observation_samples, which is 41",
        ),
        (PlanningSettings(selector=SelectorSettings(sensing_action=-1)), "sensing_action"),
    ],
)
def test_settings_made_in_python_are_checked(settings: PlanningSettings, message: str) -> None:
    with pytest.raises(InvalidValueError, match=message):
        check_settings(settings)
    with pytest.raises(InvalidValueError, match=message):
        planning.initial_state(Line(), settings, 0, 0)


@pytest.mark.parametrize(
    ("function", "own", "message"),
    [
        (
            "policy",
            Line.is_goal,
            r"takes \(self, states: .*: it is called as policy\(states, stage\)",
        ),
        (
            "move",
            Line.policy,
            r"move of line takes .*it is called as move\(states, actions, stream\)",
        ),
        ("is_goal", 1.0, r"is_goal of line is 1.0: must be a function, is_goal\(states\)"),
    ],
)
def test_a_function_that_takes_something_else_is_named(
    function: str, own: object, message: str
) -> None:
    broken: Any = type("Broken", (Line,), {function: own})()
    with pytest.raises(ProblemError, match=message):
        planning.initial_state(broken, SETTINGS, 0, 0)


def test_the_parameters_are_those_of_the_contract() -> None:
    protocols = (
        Problem,
        GeneralObservationProblem,
        ExpectedMotionProblem,
        KnownStateReturnProblem,
        BatchedMotionProblem,
    )
    members = {name: own for protocol in protocols for name, own in vars(protocol).items()}
    functions = {
        name: tuple(inspect.signature(member).parameters)[1:]
        for name, member in members.items()
        if inspect.isfunction(member) and not name.startswith("_")
    }
    assert functions == contract.PARAMETERS


def huge(value: float) -> np.ndarray:
    return np.full(4000, value)


@pytest.mark.parametrize(
    ("attribute", "value", "message"),
    [
        (
            "motion_variance",
            huge(-1.0),
            r"is \[-1\. -1\. -1\. -1\. \.\.\. -1\. -1\. -1\. -1\.\]: must",
        ),
        ("motion_variance", ["a", "b"], r"is \['a' 'b'\]: must be 1 numbers >= 0"),
        ("sensing_actions", "x" * 4000, "is 'xxx.*: must be a sequence of labels"),
        ("sensing_actions", [1, 2], "has 1: labels must be text"),
        ("next_stage", lambda *_: 1e300, r"next_stage of .* is 1e\+300: allowed are 0 to 0"),
        ("next_stage", lambda *_: float("nan"), "next_stage of .* is nan: allowed are 0 to 0"),
        ("reward", lambda *_: object(), "reward of .* returned object .*: need one number"),
        ("is_goal", lambda *_: huge(1.0), r"is_goal of .* shape \(4000,\): need one number"),
        (
            "policy",
            lambda states, _: np.full((*states.shape[:-1], 1), np.nan),
            r"returned \[nan nan\] in|policy of line .*\[nan",
        ),
        ("observation_mean", lambda s, _: np.full((*s.shape[:-1], 900), np.nan), r"is nan at \(0"),
        ("observation_variance", lambda *_: -np.ones(1), r"is -1\.0 at \(0,\) of shape \(1,\)"),
        ("sample_observation", lambda *_: "no", r"returned str \('no'\): need a float64 array"),
        ("sample_observation", lambda *_: huge(0.0), "returned .* of 4000 coordinates: need 1 to"),
        ("sample_observation", lambda *_: np.full(900, np.nan), r"\[nan nan nan nan \.\.\. nan"),
        ("log_likelihood", lambda s, *_: np.full(len(s), np.nan), "is NaN or plus infinity for a"),
    ],
)
def test_an_account_of_what_is_wrong_is_short(attribute: str, value: object, message: str) -> None:
    """It names the function, the value and where it stands, on one line, however large all is."""
    own = staticmethod(value) if callable(value) else value
    problem: Any = type("Wrong", (Line,), {attribute: own})()
    if attribute == "log_likelihood":
        problem.sample_observation = lambda *_: np.zeros(900)
    if attribute == "sample_observation":
        problem.log_likelihood = lambda states, *_: np.zeros(len(states))
    if attribute == "observation_mean":
        problem.observation_variance = lambda *_: np.ones(900)
    with pytest.raises(ProblemError, match=message) as refused:
        run_a_step(problem)
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 300
