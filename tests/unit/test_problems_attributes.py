"""A problem's attributes and the parameters of its functions."""

import inspect
from typing import Any

import numpy as np
import pytest
from tests.line_problem import SETTINGS, Line

from holdfast.errors import InvalidValueError, ProblemError
from holdfast.planning.planner import Planner
from holdfast.problems import problem
from holdfast.problems.attributes import PARAMETERS, check_problem, resolution_of
from holdfast.problems.problem import ProblemBase


@pytest.mark.parametrize(
    ("attribute", "value", "message"),
    [
        ("name", "", "name of .* is ''"),
        ("state_size", 0, "state_size of line is 0"),
        ("sensing_actions", (), "sensing_actions of line"),
        ("state_labels", "xy", "state_labels of line is 'xy': must be a sequence of labels"),
        ("sensing_actions", "xy", "sensing_actions of line is 'xy': must be a sequence of labels"),
        ("state_labels", ("x",), "state_labels of line has 1 labels: must have 2"),
        ("resolution", 0.0, "resolution of line is 0.0"),
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
        (
            "resolution",
            [[1], [1, 2]],
            r"^resolution of line is \[\[1\], \[1, 2\]\]: must be one num",
        ),
        ("sensing_costs", [[1], [1, 2]], r"sensing_costs of line is .*: must be 2 numbers"),
        (
            "circular",
            (2,),
            r"circular of line is \(2,\): must be different indices .* from 0 to 1,",
        ),
        ("circular", (0, 0), "circular of line is .*: must be different indices"),
        ("circular", (True,), "circular of line"),
        ("circular", 0, "circular of line is 0: must be different indices"),
        (
            "static_parameters",
            (2,),
            r"static_parameters of line is \(2,\): .* coordinates that do not move, from 0 to 1,",
        ),
        ("circular_actions", (1,), "circular_actions of line is .* from 0 to 0, such as"),
        ("circular_observations", (0,), "circular_observations of line is .*: must be 2 sequences"),
        ("circular_observations", ((0,), 1), r"circular_observations\[1\] of line is 1: must be"),
        ("circular_observations", ((0,), (-1,)), r"circular_observations\[1\] of line is"),
        ("motion_variance", [[1], [1, 2]], r"motion_variance of line is .*: must be 1 numbers"),
        ("rank_test", "no", "rank_test of line is 'no': must be True or False"),
        ("resolution", True, "resolution of line is True: must be one number"),
        ("motion_variance", np.array([0.1, 0.1]), "motion_variance of line"),
        ("log_likelihood", lambda *_: 0.0, "log_likelihood alone"),
        ("sample_observation", lambda *_: 0.0, "sample_observation alone"),
    ],
)
def test_an_attribute_is_named(attribute: str, value: object, message: str) -> None:
    broken: Any = type("Broken", (Line,), {attribute: value})()
    with pytest.raises(ProblemError, match=message):
        Planner(broken, SETTINGS).init(0, 0)


EACH: dict[str, Any] = {"resolution": np.array([0.3]), "state_resolution": np.array([0.1, 0.2])}


class TestResolution:
    """Which resolution the points have whose entropy counts."""

    @staticmethod
    def of(
        given: float | tuple[float, ...] | None, *, of_states: bool, **attributes: object
    ) -> object:
        problem = type("Resolved", (Line,), attributes)()
        found = resolution_of(problem, given, of_states=of_states)
        return found if isinstance(found, float) else found.tolist()

    @pytest.mark.parametrize(
        ("given", "of_actions", "of_states", "own"),
        [
            (None, 0.3, 0.3, {"resolution": 0.3}),
            (0.2, 0.2, 0.2, {"resolution": np.array([0.3])}),
            (None, [0.3], [0.1, 0.2], EACH),
            (None, [0.3], 0.4, {"resolution": (0.3,), "state_resolution": 0.4}),
            # States of as many coordinates have the actions'.
            (None, [0.3, 0.4], [0.3, 0.4], {"resolution": np.array([0.3, 0.4]), "action_size": 2}),
        ],
    )
    def test_it_is_the_given_or_the_points_own(
        self, given: float | None, of_actions: object, of_states: object, own: dict[str, Any]
    ) -> None:
        assert self.of(given, of_states=False, **own) == of_actions
        assert self.of(given, of_states=True, **own) == of_states

    def test_what_is_given_for_each_coordinate_comes_first(self) -> None:
        assert self.of((0.5,), of_states=False, **EACH) == [0.5]
        assert self.of((0.5, 0.6), of_states=True, **EACH) == [0.5, 0.6]

    @pytest.mark.parametrize("number", [np.float32(0.5), np.array(0.5), np.float64(0.5)])
    def test_a_number_of_numpy_is_one_number(self, number: Any) -> None:
        for name, of_states in (("resolution", False), ("state_resolution", True)):
            assert self.of(None, of_states=of_states, **{name: number}) == 0.5
            problem: Any = type("Resolved", (Line,), {name: number})()
            check_problem(problem)
        problem = type("Whole", (Line,), {"resolution": np.int64(1)})()
        check_problem(problem)
        assert resolution_of(problem, None, of_states=False) == 1.0

    @pytest.mark.parametrize("own", [[[1], [1, 2]], "x", True])
    @pytest.mark.parametrize("name", ["resolution", "state_resolution"])
    def test_what_is_no_number_is_named(self, name: str, own: object) -> None:
        with pytest.raises(ProblemError, match=f"^{name} of line is .*: must be numbers"):
            self.of(None, of_states=name == "state_resolution", **{name: own})

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
        Planner(broken, SETTINGS).init(0, 0)


def test_the_parameters_are_those_of_the_contract() -> None:
    protocols = [kind for kind in vars(problem).values() if getattr(kind, "_is_protocol", False)]
    assert problem.Problem in protocols
    members = {name: own for protocol in protocols for name, own in vars(protocol).items()}
    functions = {
        name: tuple(inspect.signature(member).parameters)[1:]
        for name, member in members.items()
        if inspect.isfunction(member) and not name.startswith("_")
    }
    assert functions == PARAMETERS


class TestMisspelt:
    """A name that is nearly one that is asked for."""

    @staticmethod
    def of(**attributes: object) -> Any:
        return type("Misspelt", (Line,), attributes)()

    @pytest.mark.parametrize(
        ("name", "meant"),
        [
            ("log_likelyhood", "log_likelihood"),
            ("reinitial_state", "reinitial_states"),
            ("sensing_cost", "sensing_costs"),
            ("circular_observation", "circular_observations"),
            ("rewards", "reward"),
            ("is_failed", "is_failure"),
            ("knownStateReturn", "known_state_return"),
            *((f"{name}_", name) for name in PARAMETERS if not hasattr(Line, name)),
        ],
    )
    def test_one_that_would_be_ignored(self, name: str, meant: str) -> None:
        with pytest.warns(UserWarning, match=f"line; it has {name}: did you mean {meant}.$"):
            check_problem(self.of(**{name: lambda *_: 0.0}))
        of_instance = Line()
        setattr(of_instance, name, (1.0, 2.0))
        with pytest.warns(UserWarning, match=f"{name}: did you mean {meant}"):
            check_problem(of_instance)

    def test_names_that_mean_nothing_else(self) -> None:
        """A helper beside the function itself, and one of no known name."""
        check_problem(
            self.of(
                rewards=1, reward=Line.policy, my_helper=1, observation_size=2, _log_likelyhood=3
            )
        )

    def test_one_of_a_pair(self) -> None:
        broken = self.of(
            log_likelyhood=lambda *_: 0.0, sample_observation=lambda *arguments: arguments[1]
        )
        with pytest.raises(ProblemError, match="go together; it has log_likelyhood: did you mean"):
            check_problem(broken)
        with pytest.raises(ProblemError, match="line has log_likelihoods alone: log_likelihood "):
            check_problem(self.of(log_likelihoods=lambda *_: 0.0))

    def test_one_that_is_needed(self) -> None:
        class Bare(ProblemBase):
            name, state_size, action_size, sensing_actions = "bare", 1, 1, ("x",)
            polcy = Line.policy
            initial_states, move, is_goal = Line.initial_states, Line.move, Line.is_goal
            observation_mean = Line.observation_mean
            observation_variance = Line.observation_variance

        with pytest.raises(
            ProblemError, match=r"bare has no policy; it has polcy: did you mean pol"
        ):
            check_problem(Bare())
