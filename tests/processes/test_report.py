"""``holdfast report`` in a real browser without a network, of a run whose words are hostile."""

import json
from pathlib import Path

import pytest
from tests.browser import CHROMIUM, browser
from tests.command_line import run_here

ATTACK = "</script><script>pwned=1</script><img src=x onerror=pwned=1>{{7*7}}${pwned=1}"
PROBLEM = f"""
from holdfast.problems.peg_in_hole_2d import PegInHole2D

class Own(PegInHole2D):
    sensing_labels = ({ATTACK!r}, "y", "turn")
    state_labels = ("x", "y", {ATTACK!r})
"""
CONFIGURATION = f"""
problem: own:Own
particle_filter: {{num_particles: 100}}
active_sensing: {{num_observation_samples: 3, num_cores: 1}}
simulator: {{num_trials: 2, max_steps: 70, seed: 3}}
environment: {{arguments: {{}}}}
offload: {{name: null}}
# {ATTACK}
"""
MIDDLE = """(() => {
  const panel = document.querySelector(".concat_1_concat_0_group path.background");
  panel.scrollIntoView({block: "center"});
  const box = panel.getBoundingClientRect();
  return [box.x + box.width / 2, box.y + box.height / 2];
})()"""
"""Of the panel of the first coordinate: a step in the middle of the trial."""
HEAD = "trial,step,kind,service,status,waited_ms,round_trip_ms,computed_ms,time\n"


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_a_step_that_is_clicked_is_shown_and_nothing_else_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "own.py").write_text(PROBLEM)
    (tmp_path / "own.yaml").write_text(CONFIGURATION)
    assert run_here(capsys, tmp_path, "run", "own.yaml", "--out", "out").code == 0
    rows = [f"{trial},0,sensing,{ATTACK},{ATTACK},5.0,1,1,2026-01-01T00:00:0{trial}Z\n"
            for trial in (0, 1)]  # fmt: skip
    (tmp_path / "out" / "timings.csv").write_text("".join([HEAD, *rows]))
    event = {"time": "2026-01-01T00:00:01Z", "event": ATTACK, "service": ATTACK}
    (tmp_path / "out" / "events.jsonl").write_text(json.dumps(event) + "\n")
    command = ["report", "out", "--problem-directory", ".", "--out", "report.html", "--worst", "1"]
    said = run_here(capsys, tmp_path, *command)
    assert said.code == 0, said.stderr
    assert "report of out" in said.stderr
    assert run_here(capsys, tmp_path, *command).code == 0  # it replaces its own
    with browser(tmp_path / "profile") as page:
        for width in (390, 1280):
            page.open(tmp_path / "report.html", width)
            assert page.run("document.documentElement.scrollWidth") == width
        caption, cloud = (
            f"[...document.querySelectorAll('.{name}_marks')].map(e => e.innerHTML).join()"
            for name in ("caption", "particles0")
        )
        before = page.run(cloud)
        assert "Step 0" in page.run(caption)
        x, y = page.run(MIDDLE)
        page.click(x, y)
        page.run(
            f"new Promise(done => {{ const wait = () => {caption}.includes('Step 0')"
            " ? requestAnimationFrame(wait) : done(1); wait(); })"
        )
        assert page.run(cloud) != before
        assert page.run("typeof pwned") == "undefined"
        assert page.run("document.images.length") == 0
        assert page.said == []
