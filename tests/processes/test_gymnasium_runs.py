"""Runs in environments of gymnasium: how crashes are told, and what happens after a kill."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from tests.processes.faults import events_of, holdfast, rows_of, summary_of

import holdfast as hf
from holdfast.recording.journal import Journal

EXAMPLES = Path(__file__).parents[2] / "examples"

ENGINES_OFF = """
import numpy as np

from lunar_lander import landed

def off(environment, task_action):
    return np.zeros(2, dtype=np.float32)
"""


def test_a_crash_is_a_failure_in_every_table_and_truncated_is_neither(tmp_path: Path) -> None:
    pytest.importorskip("Box2D", reason="there is no wheel of Box2D for this Python")
    text = (EXAMPLES / "lunar_lander.yaml").read_text()
    (tmp_path / "lunar_lander.py").write_text((EXAMPLES / "lunar_lander.py").read_text())
    (tmp_path / "broken.py").write_text(ENGINES_OFF)
    crash = text.replace("observation:", "action: broken:off\n    observation:")
    cut = text.replace("{continuous: true}", "{continuous: true, max_episode_steps: 20}")
    assert crash != text != cut
    for name, configuration in (("crash", crash), ("cut", cut)):
        (tmp_path / f"{name}.yaml").write_text(configuration)
        ended = holdfast(tmp_path, "run", f"{name}.yaml", "--trials", "4", "--out", name)
        assert ended.returncode == 0, ended.stderr
        (tmp_path / f"{name}.txt").write_text(ended.stdout)

    crashed, truncated = (rows_of(tmp_path / name) for name in ("crash", "cut"))
    assert {row["outcome"] for row in crashed} == {"failed"}
    assert {row["outcome"] for row in truncated} == {"truncated"}
    assert all(row["reason"].startswith("crashed at vx ") for row in crashed)
    assert {row["reason"] for row in truncated} == {"LunarLander-v3 truncated after 20 steps"}

    said = {name: (tmp_path / f"{name}.txt").read_text() for name in ("crash", "cut")}
    assert "failed        4 of 4 trials" in said["crash"]
    assert "failed" not in said["cut"]
    for name, successes, failures in (("crash", 0, 4), ("cut", 0, 0)):
        summary = summary_of(tmp_path / name)
        assert (summary["successes"], summary["failures"]) == (successes, failures)
    told = [each for each in events_of(tmp_path / "crash") if each["event"] == "trial"]
    assert [each["outcome"] for each in told] == ["failed"] * 4
    assert [each["reason"] for each in told] == [row["reason"] for row in crashed]

    opened = hf.open_run(tmp_path / "crash", problem_directory=tmp_path)
    assert opened.results["outcome"].tolist() == ["failed"] * 4
    assert opened.results["reason"].tolist() == [row["reason"] for row in crashed]
    refused = holdfast(tmp_path, "compare", "--outcomes", "cut", "crash")
    assert refused.returncode == 2
    assert "env_arguments.max_episode_steps is not given here and 20 there" in refused.stderr
    # As if both had had the same world.
    journals = [Journal.open(tmp_path / name / "journal.sqlite") for name in ("cut", "crash")]
    journals[0].set_meta(configuration=journals[1].meta()["configuration"])
    for journal in journals:
        journal.close()
    compared = holdfast(tmp_path, "compare", "--outcomes", "cut", "crash")
    (line,) = (line for line in compared.stdout.splitlines() if line.startswith("  failed"))
    assert line.split()[1:4] == ["0.0%", "100.0%", "+100.0"]


CAR = """
problem: car:Car
particle_filter: {num_particles: 30}
active_sensing: {num_observation_samples: 2, num_cores: 1}
simulator: {num_trials: 2, max_steps: 200, seed: 3, sensing_intervals: 2}
environment:
  object: gymnasium
  arguments:
    env_id: MountainCarContinuous-v0
    sensing: [[0], [1]]
    sensing_noise: [0.05, 0.01]
    success: car:at_the_top
"""

CAR_MODULE = """
import os
import signal
from pathlib import Path

import numpy as np
import holdfast as hf


class Car(hf.ProblemBase):
    name = "car"
    state_size, action_size = 2, 1
    sensing_actions = ("position", "speed")
    resolution = 0.1
    motion_variance = np.zeros(1)

    def initial_states(self, stream, count):
        return np.array([-0.5, 0.0]) + np.array([0.05, 0.0]) * stream.normal((count, 2))

    def move(self, states, actions, stream):
        return states + np.array([0.01, 0.002]) * stream.normal(states.shape)

    def observation_mean(self, states, sensing_action):
        return states[..., sensing_action : sensing_action + 1]

    def observation_variance(self, states, sensing_action):
        return np.array([(0.05, 0.01)[sensing_action] ** 2])

    def policy(self, states, stage):
        return np.where(states[..., 1:] >= 0.0, 1.0, -1.0)

    def is_goal(self, states):
        return states[..., 0] > 0.45


def at_the_top(environment, observation, info):
    # The robot's process is killed once in each of these moves.
    count = environment.get_wrapper_attr("_elapsed_steps")
    killed = Path(f"killed-{count}")
    if count in (17, 40) and Path("kills").exists() and not killed.exists():
        killed.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return observation[0] >= 0.45
"""


def test_after_a_kill_the_episode_is_where_it_was(tmp_path: Path) -> None:
    """It has died with the process, and its task actions are performed again."""
    (tmp_path / "car.py").write_text(CAR_MODULE)
    (tmp_path / "car.yaml").write_text(CAR)
    calm = holdfast(tmp_path, "run", "car.yaml", "--out", "calm")
    assert calm.returncode == 0, calm.stderr
    (tmp_path / "kills").touch()
    ended = holdfast(tmp_path, "run", "car.yaml", "--out", "killed")
    for _ in range(2):
        assert ended.returncode == -signal.SIGKILL, ended.stderr
        ended = holdfast(tmp_path, "run", "car.yaml", "--out", "killed", "--resume")
    assert ended.returncode == 0, ended.stderr
    found = [summary_of(tmp_path / name) for name in ("calm", "killed")]
    for key in ("digest", "successes", "mean_reward", "mean_steps"):
        assert found[0][key] == found[1][key], key
