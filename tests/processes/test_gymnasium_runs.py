"""Runs in environments of gymnasium: how crashes are told, and what happens after a kill."""

import shutil
import signal
from pathlib import Path

import pytest
from tests import mountain_car
from tests.processes.faults import events_of, holdfast, rows_of, summary_of

import holdfast as hf
from holdfast.journal.journal import Journal

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
    journals = [Journal.open(tmp_path / name / "journal.bin") for name in ("cut", "crash")]
    journals[0].set_meta(configuration=journals[1].meta()["configuration"])
    for journal in journals:
        journal.close()
    compared = holdfast(tmp_path, "compare", "--outcomes", "cut", "crash")
    (line,) = (line for line in compared.stdout.splitlines() if line.startswith("  failed"))
    assert line.split()[1:5] == ["(%)", "0", "100", "+100"]


def test_after_a_kill_the_episode_is_where_it_was(tmp_path: Path) -> None:
    """It has died with the process, and its task actions are performed again."""
    shutil.copy(mountain_car.__file__, tmp_path)
    (tmp_path / "car.yaml").write_text(mountain_car.CONFIGURATION)
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
