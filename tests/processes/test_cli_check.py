"""``holdfast check``: what it prints, its exit codes, and problems that end or hang its process."""

import json
import shlex
from pathlib import Path

import pytest
from tests.command_line import run_here

import holdfast as hf
from holdfast.cli.check import main
from holdfast.errors import HoldfastError, ProblemError
from holdfast.tuning import check_process

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
RAISES = 'raise KeyError("wheel")'
LOOPS = "while stream is not None: pass"
ENDS = "__import__('os')._exit(0)"
CRASHES = "__import__('ctypes').string_at(0)"
SLOW = f"""for _ in range(300_000): pass
        {RIGHT}"""
THREAD = f"""import threading
        for each in threading.enumerate()[1:2] or [threading.Thread(target=threading.Event().wait)]:
            each.is_alive() or each.start()
        {RIGHT}"""


def written(directory: Path, name: str, move: str) -> str:
    (directory / f"check_{name.lower()}.py").write_text(SOURCE.format(name=name, move=move))
    return f"check_{name.lower()}:{name}"


def test_a_right_problem(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    name = written(tmp_path, "Right", RIGHT)
    assert main([name, "--budget", "1000", "--trials", "12"]) == 0
    shown = capsys.readouterr()
    assert "the policy comes to the goal in 64 of 64 trials" in " ".join(shown.out.split())
    assert shown.out.endswith("0 errors, 0 warnings\n")
    assert shown.err.startswith(f"checking {name}\n")
    assert "beside random sensing in 12 paired trials: " in " ".join(shown.out.split())
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


@pytest.mark.parametrize(
    ("kind", "move", "code", "seen"),
    [
        ("Loops", LOOPS, 1, "move raised TimeoutError: it has not returned in 0.9 s"),
        ("Ends", ENDS, 1, "move raised ProcessEndError: os._exit(0) would end the process"),
        ("Crashes", CRASHES, 1, "ended the process of the check: it was killed by SIGSEGV in the"),
        ("Slow", SLOW, 0, "0 errors, 0 warnings; too little time for "),
        ("Thread", THREAD, 0, "0 errors, 0 warnings"),
    ],
)
def test_what_ends_or_hangs_the_process(
    kind: str,
    move: str,
    code: int,
    seen: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(check_process, "PATIENCE_S", 0.9 if kind == "Loops" else 2.0)
    name, budget = written(tmp_path, kind, move), "0.1" if kind == "Slow" else "1000"
    assert main([name, "--problem-directory", str(tmp_path), "-q", "--budget", budget]) == code
    shown = " ".join(capsys.readouterr().out.split())
    assert seen in shown
    assert shown.count("TimeoutError") == (kind == "Loops")


def test_a_wrong_problem_is_not_tuned(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = written(tmp_path, "Raised", RAISES)
    (tmp_path / "run.yaml").write_text("problem: peg_in_hole_2d\n")
    words = ("run.yaml", "--set", "particle_filter.num_particles=40", "--problem", name)
    said = run_here(capsys, tmp_path, "tune", *words, "--budget", "10s")
    assert said.code == 2
    command = shlex.join(["holdfast", "check", *words])
    assert f"contract: move raised KeyError: 'wheel'. {command} says more of 1 er" in said.stderr
    assert "--no-check (check=False) tunes all the same" in said.stderr
    assert not (tmp_path / "runs").exists()
    again = run_here(capsys, tmp_path, "check", *words, "--budget", "1")
    assert (again.code, "KeyError: 'wheel'" in again.stdout) == (1, True)
    assert run_here(capsys, tmp_path, "check", name, *words[-2:]).code == 2
    with pytest.raises(ProblemError, match=r"move raised KeyError.*holdfast\.check_problem says"):
        hf.tune(hf.load_configuration(tmp_path / "run.yaml", problem=name), budget_s=10.0)


def test_what_is_no_problem(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("a.yaml").write_text("problem: capsule_robot\n")
    only = "only a problem that is named module:Class has one"
    both = ["a.yaml", "--problem-directory", ".", "--set", "problem_directory=.."]
    for words, says in (
        (["pegs"], "^problem: pegs is not a registered name"),
        (["nowhere:Pegs"], "No module named"),
        (["none.yaml"], "there is no such file"),
        (both[:3], only),
        (both, "both say what problem_directory is"),
        (["capsule_robot", "--set", "problem_directory=."], only),
    ):
        with pytest.raises(HoldfastError, match=says):
            main(words)
