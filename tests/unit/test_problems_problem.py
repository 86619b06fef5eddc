"""The defaults of a problem."""

from typing import Any

import numpy as np
import pytest

from holdfast.config.registry import make_problem
from holdfast.earlier_names import warn_of_earlier_name
from holdfast.errors import ProblemError
from holdfast.problems import checked
from holdfast.problems.attributes import know_earlier_names
from holdfast.problems.problem import ProblemBase, Scene


class Minimal(ProblemBase):
    def __init__(self, size: float = 1.0) -> None:
        self.size = size


class TestProblemBase:
    def test_settings_become_keyword_arguments(self) -> None:
        assert Minimal.from_settings({"size": 3.0}, {}).size == 3.0
        assert Minimal.from_settings({}, {"size": 4.0}).size == 4.0

    def test_unknown_and_double_keys(self) -> None:
        with pytest.raises(ProblemError, match="colour"):
            Minimal.from_settings({"colour": 1}, {})
        with pytest.raises(ProblemError, match="size: given in both"):
            Minimal.from_settings({"size": 1.0}, {"size": 2.0})

    def test_defaults(self) -> None:
        problem = Minimal()
        assert problem.next_stage(np.zeros(3), 0) == 0
        assert problem.reward(np.zeros((4, 3)), np.zeros((4, 2))).shape == (4,)
        assert problem.scene() is None
        actions = np.ones(2)
        np.testing.assert_array_equal(problem.limit_action(actions), actions)

    def test_the_earlier_name_of_limit_action(self) -> None:
        """``execute`` is the same function, in a class, a subclass, a mixin and a plain class."""

        warn_of_earlier_name.cache_clear()
        with pytest.warns(DeprecationWarning, match=r"limit_action now; execute goes with") as said:

            class Halves(Minimal):
                def execute(self, actions: Any) -> Any:
                    return super().execute(0.5 * actions)

        assert [each.filename for each in said] == [__file__]  # whose author can change it

        class Quarters(Halves):
            def limit_action(self, actions: Any) -> Any:
                return super().limit_action(0.5 * actions)

        class Limits:
            def execute(self, actions: Any) -> Any:
                return np.minimum(actions, 0.2)

        class Mixed(Limits, Minimal):
            """Takes its limits from a class that is no problem."""

        for kind, limited in ((Halves, 0.5), (Quarters, 0.25), (Mixed, 0.2)):
            problem: Any = kind()
            assert problem.execute(np.ones(1)) == problem.limit_action(np.ones(1)) == limited
            assert checked.executed_action(problem, np.ones(1)) == limited
        plain: Any = Limits()
        know_earlier_names(type(plain))
        assert checked.executed_action(plain, np.ones(1)) == 0.2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"body": [1, 2, 3]}, r"body of a Scene has the shape \(3,\): must be \(any number, 2\)"),
        ({"body": "boat"}, "body of a Scene is 'boat': must be numbers"),
        ({"body": -1.0}, "body of a Scene is -1.0: a radius must be above 0"),
        ({"goal": [1, 2, 3]}, r"goal of a Scene has the shape \(3,\): must be \(2\)"),
        ({"limits": (1, 2, 3)}, r"limits of a Scene has the shape \(3,\): must be \(4\)"),
        ({"obstacles": [1, 2, 3]}, r"obstacles of a Scene .* must be \(any number, 4\)"),
        ({"obstacles": [[1, 2, 3, 4], [1, 2]]}, "obstacles of a Scene is .*: must be numbers"),
        ({"body": [[1, 2], [3]]}, "body of a Scene is .*: must be numbers"),
        ({"limits": None}, r"limits of a Scene is None: must be numbers, of the shape \(4\)"),
        ({"limits": (0, 1, 2, 1)}, r"limits of a Scene is \(0, 1, 2, 1\): must be finite x_min"),
        ({"axes": None}, r"axes of a Scene is None: must be two coordinates of the state, such as"),
        ({"axes": (0, 1.5)}, r"axes of a Scene is \(0, 1.5\): must be two coordinates"),
        ({"angle": "yaw"}, "angle of a Scene is 'yaw': must be a coordinate of the state"),
        ({"targets": None}, r"targets of a Scene is None: must be pairs .* such as \[\(2, 3\)\]"),
        ({"targets": [(0, None)]}, r"targets of a Scene is \[\(0, None\)\]: must be pairs"),
        ({"walls": None}, "walls of a Scene is None: must be coordinates that move rectangles"),
        ({"walls": [(0, 1)]}, r"walls of a Scene is \[\(0, 1\)\]: must be coordinates that"),
    ],
)
def test_a_scene_says_what_does_not_fit(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(ProblemError, match=words):
        Scene(**{"axes": (0, 1), "limits": (0, 0, 1, 1)} | arguments)


def test_a_scene_without_points_or_obstacles() -> None:
    scene = Scene((0, 1), (0, 0, 1, 1), obstacles=[], points=[])
    assert scene.points is not None
    assert (scene.obstacles.shape, scene.points.shape) == ((0, 4), (0, 2))
    scene = Scene(np.array([0, 1]), (0, 0, 1, 1), angle=np.int64(2), targets=np.array([[0, 1]]))  # type: ignore[arg-type]
    assert (scene.axes, scene.angle, scene.targets) == ((0, 1), 2, [(0, 1)])


@pytest.mark.parametrize(
    "wrong",
    [{"axes": (0, 5)}, {"angle": 7}, {"targets": [(0, 3)]}, {"walls": [((None, 3), (0, 0, 1, 1))]}],
)
def test_a_scene_of_coordinates_that_no_state_has(
    wrong: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = make_problem("peg_in_hole_2d")
    drawn = Scene(**{"axes": (0, 1), "limits": (0, 0, 1, 1)} | wrong)
    monkeypatch.setattr(problem, "scene", lambda: drawn, raising=False)
    with pytest.raises(ProblemError, match=r"scene of peg_in_hole_2d has axes .* from 0 to 2"):
        checked.scene(problem)
    monkeypatch.setattr(problem, "scene", lambda: "a drawing", raising=False)
    with pytest.raises(ProblemError, match=r"scene of .* gives 'a drawing': need a Scene"):
        checked.scene(problem)
