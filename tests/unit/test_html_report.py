"""The report of a run, a comparison, a tuning or a study."""

import html
import json
import re
import sys
from pathlib import Path
from typing import Any

import pytest
from tests.command_line import run_here
from tests.recordings import failed, result_of

from holdfast.errors import OutputError
from holdfast.reports import html_page
from holdfast.reports.html_report import comparison_page, results_page, run_page, worst_trials

PEG = """
problem: peg_in_hole_2d
particle_filter: {num_particles: 120}
active_sensing: {num_observation_samples: 3, num_cores: 1}
simulator: {num_trials: 3, max_steps: 70, seed: 3}
"""
HEAD = "trial,step,kind,service,status,waited_ms,round_trip_ms,computed_ms,time"


@pytest.fixture(autouse=True)
def _small_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(html_page, "_library", lambda: "let vegaEmbed;")


def recorded(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str = "out") -> Path:
    (tmp_path / "peg.yaml").write_text(PEG)
    command = ["run", "peg.yaml", "--out", name, "--set", f"selector.method={METHODS[name]}"]
    assert run_here(capsys, tmp_path, *command).code == 0
    return tmp_path / name


METHODS = {"out": "action_entropy", "other": "random"}


def charts_of(page: bytes) -> list[Any]:
    found = re.search(rb'id="charts">(.*?)</script>', page)
    assert found is not None
    charts: list[Any] = json.loads(found[1])
    return charts


def test_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = recorded(tmp_path, capsys)
    rows = [f"{trial},0,sensing,cloud,standard,{10 * trial}.5,1,1,2026-01-01T00:00:0{trial}Z"
            for trial in range(3)]  # fmt: skip
    (run / "timings.csv").write_text("\n".join([HEAD, *rows]) + "\n")
    event = {"time": "2026-01-01T00:00:01Z", "event": "service_suspected", "service": "cloud"}
    (run / "events.jsonl").write_text(json.dumps(event) + "\n")
    done: list[int] = []
    page, notes = run_page(run, worst=2, on_trial=done.append)
    assert (notes, done) == ([], [1, 2])
    text = page.decode()
    again = "config.yaml; then:</p>\n<pre>holdfast run config.yaml --out again\n"
    for words in ("of 3 trials succeeded", "success (%)", again, "NumPy"):
        assert words in text
    trials, timeline, *shown = charts_of(page)
    assert [each["trial"] for each in trials["data"]["values"]] == [0, 1, 2]
    assert [each["waited"] for each in timeline["datasets"]["decisions"]] == [20.5, 10.5, 0.5]
    (tick,) = timeline["datasets"]["events"]
    assert (tick["severity"], tick["text"]) == ("WARN", "cloud")
    assert len(shown) == 2
    for chart in shown:
        steps, beliefs, scores = (
            chart["datasets"][name] for name in ("steps", "beliefs", "entropies")
        )
        assert [row["k"] for row in steps] == [*range(len(steps))]
        assert {row["k"] for row in beliefs} == {row["k"] for row in steps}
        # What was chosen has the least score.
        for row in scores:
            assert row["c"].index("chosen") == row["e"].index(min(row["e"]))
        assert all(len(row["x0"]) == len(row["w"]) <= 80 for row in beliefs)
        assert steps[0]["by"] == "cloud"
        assert chart["params"][0]["views"] == ["pick0", "pick1", "pick2", "pick_sensed", "pick_by"]


def test_code_that_a_run_names_is_not_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "own.py").write_text("from holdfast.problems.peg_in_hole_2d import PegInHole2D\n"
                                     "class Own(PegInHole2D):\n    pass\n")  # fmt: skip
    (tmp_path / "own.yaml").write_text(PEG.replace("peg_in_hole_2d", "own:Own"))
    assert run_here(capsys, tmp_path, "run", "own.yaml", "--out", "out").code == 0
    page, (note,) = run_page(tmp_path / "out")
    assert "is not run unasked" in note
    assert len(charts_of(page)) == 1
    page, notes = run_page(tmp_path / "out", worst=1, problem_directory=tmp_path)
    assert (notes, len(charts_of(page))) == ([], 2)
    assert b"config.yaml, and beside it the module own; then:" in page
    assert b"holdfast run config.yaml --problem-directory . --out again" in page
    with (tmp_path / "own.py").open("a") as module:
        module.write("    def scene(self):\n        return 1 / 0\n")
    sys.modules.pop("own")
    page, (note,) = run_page(tmp_path / "out", worst=1, problem_directory=tmp_path)
    assert "ZeroDivisionError" in note
    assert len(charts_of(page)) == 1


def test_runs_a_sweep_and_a_study(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = [recorded(tmp_path, capsys, name) for name in METHODS]
    page, _ = comparison_page(runs)
    (reward,) = (each for each in charts_of(page) if "of reward" in str(each.get("title")))
    methods = "selector.method=action_entropy,random"
    sweep = ["sweep", "peg.yaml", "--set", methods, "--out", "swept", "--jobs", "1"]
    assert run_here(capsys, tmp_path, *sweep).code == 0
    page, _ = results_page(tmp_path / "swept")
    (swept,) = (each for each in charts_of(page) if each["title"] == reward["title"])
    (one,), (other,) = (each["data"]["values"] for each in (reward, swept))
    assert other == one | {"name": "method=random"}
    studied, _ = results_page(Path(__file__).parents[2] / "docs" / "results" / "parameters")
    assert b"data:image/svg+xml" in studied
    (tmp_path / "nothing" / "figure.svg").mkdir(parents=True)  # a directory is no figure
    with pytest.raises(OutputError, match="neither a run nor results"):
        results_page(tmp_path / "nothing")
    (tmp_path / "nothing" / "table.csv").write_text("run,measure,effect,low,high\na,x,1,0,2\n")
    (tmp_path / "nothing" / "sweep.json").write_text("{}")
    assert len(charts_of(results_page(tmp_path / "nothing")[0])) == 1


def test_a_report_replaces_a_report_and_nothing_else(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recorded(tmp_path, capsys)
    report = ["report", "out", "--out", "sent.html", "--worst"]
    assert run_here(capsys, tmp_path, *report, "0").code == 0
    first = (tmp_path / "sent.html").read_bytes()
    assert run_here(capsys, tmp_path, *report, "1").code == 0
    assert len((tmp_path / "sent.html").read_bytes()) > len(first)
    (tmp_path / "sent.html").rename(tmp_path / "real.html")
    (tmp_path / "sent.html").symlink_to("real.html")
    for _ in range(2):
        said = run_here(capsys, tmp_path, *report, "0")
        assert (said.code, "and holdfast did not write it; remove it" in said.stderr) == (2, True)
        (tmp_path / "sent.html").unlink()
        (tmp_path / "sent.html").write_text("my thesis")
    assert (tmp_path / "sent.html").read_text() == "my thesis"


def test_a_run_is_repeated_on_another_machine(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By the command that the report prints."""
    here, there = tmp_path / "here", tmp_path / "there"
    for place in (here, there):
        place.mkdir()
        (place / "copied.py").write_text(OWN)
    (here / "own.yaml").write_text(
        PEG.replace("peg_in_hole_2d", "copied:Own").replace("num_trials: 3", "num_trials: 1")
        + "environment: {object: 'copied:Robot'}\n"
    )
    assert run_here(capsys, here, "run", "own.yaml", "--out", "out").code == 0
    page, _ = run_page(here / "out")
    found = re.search("<pre>holdfast (run config.yaml .*)\n", page.decode())
    assert found is not None
    (there / "config.yaml").write_text((here / "out" / "config.yaml").read_text())
    (here / "copied.py").unlink()
    said = run_here(capsys, there, "run", "config.yaml", "--out", "again")
    assert (said.code, "this machine: --problem-directory DIR" in said.stderr) == (2, True)
    said = run_here(capsys, there, *html.unescape(found[1]).split())
    assert said.code == 0, said.stderr
    assert run_here(capsys, tmp_path, "compare", "here/out", "there/again").code == 0
    settings = (there / "again" / "config.yaml").read_text()
    assert f"problem_directory: {there}\n" in settings


OWN = """
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.robot.environment import SimulatedEnvironment

class Own(PegInHole2D):
    pass

class Robot(SimulatedEnvironment):
    pass
"""


def test_the_worst_come_first() -> None:
    results = [
        result_of(0), result_of(1, success=False, reward=-9.0), failed(result_of(2)),
        result_of(3, success=False, reward=-20.0), result_of(4, reward=-2.0),
    ]  # fmt: skip
    assert [each.trial for each in worst_trials(results, 4)] == [2, 3, 1, 4]
