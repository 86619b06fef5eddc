"""The environment that a configuration names is found, and given what it asks for."""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.answers import answers_in

from holdfast.config.loader import load
from holdfast.errors import ConfigurationError, EnvironmentFailedError
from holdfast.robot.environment import Environment, SimulatedEnvironment
from holdfast.robot.environment_maker import EnvironmentMaker, load_environment

EXAMPLES = Path(__file__).parents[2] / "examples"

Loaded = Callable[[str], EnvironmentMaker]

ROBOTS = """\
class Robot:
    made = []

    def __init__(self, port=7500, *, places=(), trial, resumed, problem):
        self.port, self.places, self.trial = port, places, trial
        self.resumed, self.problem = resumed, problem
        self.made.append(self)

    def perform_sensing(self, sensing_action): return [0.0]
    def perform(self, task_action): return None
    def is_done(self): return False


class Plain:
    perform_sensing = perform = is_done = lambda self, *_: None


class AnyArguments(Plain):
    def __init__(self, **options): self.options = options


class Late:
    def __init__(self):
        self.perform_sensing = self.perform = self.is_done = print


class Half:
    is_done = True
    def perform(self, task_action): return None


class Needy(Plain):
    def __init__(self, port): pass


robot = Robot
number = 3
"""


class TestLoadEnvironment:
    @pytest.fixture
    def loaded(self, tmp_path: Path) -> Iterator[Loaded]:
        """Load what is named, beside a configuration file."""
        (tmp_path / "robots.py").write_text(ROBOTS)
        (tmp_path / "broken_robots.py").write_text("1 + 'one'\n")
        (tmp_path / "lonely_robots.py").write_text("import absent_library\n")

        def load_one(settings: str) -> EnvironmentMaker:
            (tmp_path / "run.yaml").write_text(
                f"problem: peg_in_hole_2d\nsimulator: {{seed: 5}}\nenvironment: {{{settings}}}\n"
            )
            return load_environment(load(tmp_path / "run.yaml"))

        yield load_one
        for name in ("robots", "broken_robots", "lonely_robots"):
            sys.modules.pop(name, None)

    def test_without_a_name_the_world_is_simulated(self) -> None:
        maker = load_environment(load(EXAMPLES / "peg_in_hole_2d.yaml", seed=8))
        assert maker.simulated
        first = maker(3)
        assert isinstance(first, SimulatedEnvironment)
        expected = SimulatedEnvironment(maker.problem, 8, 3)
        assert first.state.tobytes() == expected.state.tobytes()
        action = np.full(maker.problem.action_size, 1e-3)
        expected.perform(action)
        again = maker(3, resumed=True, performed=[action])
        assert isinstance(again, SimulatedEnvironment)
        assert again.state.tobytes() == expected.state.tobytes()

    def test_one_of_ones_own_is_made_anew_for_each_trial(self, loaded: Loaded) -> None:
        maker = loaded("object: robots:Robot, arguments: {port: 3, places: [1]}, timeout_ms: 20")
        assert not maker.simulated
        assert (maker.name, maker.timeout_ms) == ("robots:Robot", 20.0)
        first: Any = maker(0)
        first.places.append(2)
        second: Any = maker(1, resumed=True, performed=[np.zeros(3)])
        assert sys.modules["robots"].Robot.made == [first, second]
        assert (first.port, first.trial, first.resumed) == (3, 0, False)
        assert (second.port, second.trial, second.resumed) == (3, 1, True)
        assert second.places == [1]
        assert first.problem is second.problem is maker.problem

    def test_a_constructor_gets_only_what_it_names(self, loaded: Loaded) -> None:
        assert isinstance(loaded("object: robots:Plain")(0), Environment)
        environment: Any = loaded("object: robots:AnyArguments, arguments: {port: 3}")(0)
        assert environment.options == {"port": 3}

    def test_methods_may_be_made_by_the_constructor(self, loaded: Loaded) -> None:
        assert isinstance(loaded("object: robots:Late")(0), Environment)

    def test_a_package_may_register_one(self, tmp_path: Path, loaded: Loaded) -> None:
        package = tmp_path / "turtle_robots-1.0.dist-info"
        package.mkdir()
        (package / "METADATA").write_text("Metadata-Version: 2.1\nName: turtle-robots\n")
        (package / "entry_points.txt").write_text(
            "[holdfast.environments]\nturtle = robots:Plain\n"
        )
        sys.path.insert(0, str(tmp_path))
        assert type(loaded("object: turtle")(0)).__name__ == "Plain"

    def test_it_lacks_a_method(self, loaded: Loaded) -> None:
        maker = loaded("object: robots:Half")
        with pytest.raises(
            EnvironmentFailedError,
            match=r"robots:Half is no environment: it lacks perform_sensing and is_done; it needs",
        ):
            maker(0)

    @pytest.mark.parametrize(("text", "expected"), answers_in("environment_mistakes.txt"))
    def test_what_is_refused(self, text: str, expected: str, loaded: Loaded) -> None:
        with pytest.raises(ConfigurationError, match=expected) as caught:
            loaded(text)
        assert "run.yaml: environment." in str(caught.value)
