"""Code that is not ours: whose a frame of a traceback is, and what is said of what it raises."""

from collections.abc import Callable
from pathlib import Path

import pytest
from tests.command_line import Workplace

from holdfast.config.loader import load
from holdfast.config.user_code import find_class, is_users_file
from holdfast.errors import ConfigurationError
from holdfast.planning import planner as planning
from holdfast.robot.trials import run_trials


@pytest.mark.parametrize("name", [planning.__file__, "holdfast/protocol/robot.py", "<string>"])
def test_ours(name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Also as compiled modules name themselves, wherever the process is."""
    monkeypatch.chdir(tmp_path)
    assert not is_users_file(name)


@pytest.mark.parametrize("name", ["holdfast/mine.py", "mine.py", "../holdfast/mine.py"])
def test_theirs(name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    assert is_users_file(name)
    assert is_users_file(str(tmp_path / name))


Ending = Callable[..., str]

EXITS = """
import sys

from holdfast.problems.peg_in_hole_2d import PegInHole2D

class InThePolicy(PegInHole2D):
    actions = 0

    def limit_action(self, actions):
        if actions.ndim == 1:
            InThePolicy.actions += 1
            if InThePolicy.actions > 45:  # in the second trial
                sys.exit(0)
        return super().limit_action(actions)

class InTheWorld(PegInHole2D):
    def move(self, states, actions, stream):
        if states.ndim == 1:
            sys.exit(0)
        return super().move(states, actions, stream)

class InTheConstructor(PegInHole2D):
    def __init__(self, *settings):
        sys.exit(0)

class WithoutException(PegInHole2D):
    def policy(self, states, stage):
        raise GeneratorExit("enough")

class Wordless(Exception):
    def __str__(self):
        sys.exit(0)

class WithoutWords(PegInHole2D):
    def policy(self, states, stage):
        raise Wordless

class WithManyWords(PegInHole2D):
    def policy(self, states, stage):
        raise ValueError("many\\n" * 100_000)

class Recursive(PegInHole2D):
    def policy(self, states, stage):
        return self.turn(states, stage)

    def turn(self, states, stage):
        return self.policy(states, stage)

class InPlace(PegInHole2D):
    def move(self, states, actions, stream):
        states += actions

class WithoutSetter(PegInHole2D):
    resolution = property(lambda self: 1.0)

class RobotThatExits:
    def __init__(self):
        sys.exit(0)

class SensorThatExits:
    def perform_sensing(self, sensing_action):
        sys.exit(0)

    def perform(self, task_action):
        return None

    def is_done(self):
        return False
"""

PEG = """
problem: peg_in_hole_2d
particle_filter: {num_particles: 20}
active_sensing: {num_observation_samples: 2, num_cores: 1}
simulator: {num_trials: 2, max_steps: 30, seed: 3}
"""


class TestWhateverItRaises:
    """A run ends with an error that names the code at fault, and never as if all were done."""

    @pytest.fixture
    def ending(self, workplace: Workplace) -> Ending:
        """Run a command, and return the error that it ends with."""
        workplace.write("exits.py", EXITS)
        workplace.write("exits_at_import.py", "import sys\n\nsys.exit(0)\n")
        workplace.write("peg.yaml", PEG)

        def run(*arguments: str) -> str:
            said = workplace.run(*arguments)
            assert said.code == (4 if "\nGo on with: " in said.stderr else 2), said
            assert "Traceback" not in said.stderr
            error = said.stderr.partition("holdfast: error: ")[2]
            assert 0 < error.count("\n") < 40
            assert len(error) < 6000
            return error

        return run

    @pytest.mark.parametrize(
        ("name", "what", "where"),
        [
            ("InThePolicy", "raised SystemExit: 0", "in limit_action"),
            ("InTheWorld", "raised SystemExit: 0", "in move"),
            ("InTheConstructor", "raised SystemExit: 0", "in __init__"),
            ("WithoutException", "raised GeneratorExit: enough", "in policy"),
            ("WithoutWords", "raised Wordless, which cannot be put into words", "in policy"),
            ("WithManyWords", "raised ValueError: many\n", "in policy"),
            ("Recursive", "raised RecursionError: maximum", "in policy"),
            ("InPlace", "is read-only\n", "in move\n    states += actions\nIf it changes an array"),
            ("WithoutSetter", "cannot be built: AttributeError: property", ""),
        ],
    )
    def test_a_problem(self, name: str, what: str, where: str, ending: Ending) -> None:
        command = ["run", "peg.yaml", "--problem", f"exits:{name}", "--out", "out"]
        error = ending(*command)
        assert what in error
        assert where in error
        if name == "InThePolicy":
            assert error.startswith("trial 1 (seed 3): ")
        if name in {"InThePolicy", "WithoutWords"}:  # a robot's loop says it as well
            command[-1:] = ["robot", "--rate", "10000"]
            error = ending(*command)
            assert what in error
            assert where in error

    @pytest.mark.parametrize(
        ("name", "where"), [("RobotThatExits", "in __init__"), ("SensorThatExits", "in perform_")]
    )
    def test_an_environment(self, name: str, where: str, ending: Ending) -> None:
        command = ["run", "peg.yaml", "--environment", f"exits:{name}", "--out", "out"]
        error = ending(*command)
        assert f"exits:{name}" in error
        assert "raised SystemExit: 0" in error
        assert where in error

    @pytest.mark.parametrize(
        "command",
        [
            ["run", "peg.yaml", "--problem", "exits_at_import:X"],
            ["run", "peg.yaml", "--environment", "exits_at_import:X"],
            ["serve", "--listen", "unix/nix", "--problem", "exits_at_import:X"],
        ],
        ids=lambda command: command[0] + command[-2],
    )
    def test_a_module(self, command: list[str], ending: Ending, workplace: Workplace) -> None:
        error = ending(*command)
        assert "exits_at_import:X raised SystemExit: 0\n" in error
        assert "line 3, in <module>" in error
        assert "runs" not in workplace.names()

    @pytest.mark.parametrize("name", ["collections:OrderedDict", "builtins:int", "enum:Enum"])
    def test_a_class_that_is_no_problem(self, name: str, ending: Ending) -> None:
        error = ending("run", "peg.yaml", "--problem", name)
        assert error.startswith(f"peg.yaml: {name} ")
        assert error.count("\n") == 1

    def test_ctrl_c_is_not_the_code_s(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / "peg.yaml").write_text(PEG)
        configuration = load(tmp_path / "peg.yaml")

        def policy(*_: object) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr(configuration.problem, "policy", policy)
        with pytest.raises(KeyboardInterrupt):
            run_trials(configuration, 1, (), lambda _: None)


def test_a_module_of_the_ros_package_under_its_old_name_is_named_anew() -> None:
    with pytest.raises(ConfigurationError, match=r"holdfast\.ros is the package holdfast_ros now"):
        find_class(
            "holdfast.ros.executive:ExecutiveEnvironment",
            what="environment.object",
            group="holdfast.environments",
            search_directory=None,
            error_type=ConfigurationError,
        )
