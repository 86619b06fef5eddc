"""``holdfast check``: what it prints, and its exit codes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from holdfast.cli.check import main
from holdfast.errors import HoldfastError, InvalidValueError, UnknownProblemError

SOURCE = """
import numpy as np
import holdfast as hf

class {name}(hf.ProblemBase):
    name = "{name}"
    state_size = action_size = 1
    sensing_actions = ("x",)
    def __init__(self, width=0.2):
        self.width = width
    def initial_states(self, stream, count):
        return 2.0 + stream.normal((count, 1))
    def move(self, states, actions, stream):
        {move}
    def policy(self, states, stage):
        return -states
    def limit_action(self, actions):
        return np.clip(actions, -0.3, 0.3)
    def is_goal(self, states):
        return np.abs(states[..., 0]) < self.width
    def observation_mean(self, states, sensing_action):
        return states
    def observation_variance(self, states, sensing_action):
        return np.array([0.01])
"""
RIGHT = "return states + actions + 0.1 * stream.normal(states.shape)"
SHARED = "return states + actions + 0.1 * stream.normal((1,))"
RAISES = 'raise KeyError("wheel")'
LOOPS = "while stream is not None: pass"


def written(directory: Path, name: str, move: str) -> str:
    (directory / f"check_{name.lower()}.py").write_text(SOURCE.format(name=name, move=move))
    return f"check_{name.lower()}:{name}"


def test_a_right_problem(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    name = written(tmp_path, "Right", RIGHT)
    assert main([name, "--budget", "1000"]) == 0
    shown = capsys.readouterr()
    assert "the policy comes to the goal in 64 of 64 trials" in " ".join(shown.out.split())
    assert shown.out.endswith("0 errors, 0 warnings\n")
    assert shown.err.startswith(f"checking {name}\n")
    # A configuration, and values instead of its own.
    Path("right.yaml").write_text(f"problem: {name}\nmodel: {{width: 0.1}}\n")
    assert main(["right.yaml", "--set", "model.width=100.0", "-q", "--budget", "1000"]) == 1
    shown = capsys.readouterr()
    assert "all of 64 initial states are goals" in " ".join(shown.out.split())
    assert shown.err == ""
    assert main([name, "--set", "model.width=100.0", "-q", "--budget", "1000"]) == 1


def test_json_and_the_lines_of_the_user(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = written(tmp_path, "Raises", RAISES)
    assert main([name, "--problem-directory", str(tmp_path), "--json", "--budget", "1000"]) == 1
    shown = capsys.readouterr()
    findings = [json.loads(line) for line in shown.out.splitlines()]
    (error,) = [each for each in findings if each["severity"] == "error"]
    assert error["seen"] == "move raised KeyError: 'wheel'"
    assert 'raise KeyError("wheel")' in error["details"]
    assert shown.err == ""
    assert main([name, "--problem-directory", str(tmp_path), "-q"]) == 1
    assert '        raise KeyError("wheel")\n' in capsys.readouterr().out


def test_a_call_that_does_not_return_is_ended(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name = written(tmp_path, "Loops", LOOPS)
    assert main([name, "--problem-directory", str(tmp_path), "-q", "--budget", "0.1"]) == 1
    shown = " ".join(capsys.readouterr().out.split())
    assert "move raised TimeoutError: it was still running" in shown
    assert shown.count("TimeoutError") == 1


def test_what_is_no_problem(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(HoldfastError, match=r"^problem: pegs is not a registered name"):
        main(["pegs"])
    with pytest.raises(UnknownProblemError, match="No module named"):
        main(["nowhere:Pegs"])
    with pytest.raises(HoldfastError, match="there is no such file"):
        main(["none.yaml"])
    Path("a.yaml").write_text("problem: capsule_robot\n")
    with pytest.raises(InvalidValueError, match="--problem-directory goes with module:Class"):
        main(["a.yaml", "--problem-directory", "."])
