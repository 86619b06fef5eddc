"""A user's problem that fails in one part of an answer alone, on every service."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.processes.faults import PATIENT, RECOVERY, Site, assert_identical

MODULE = '''
"""A room that cannot be looked at beyond a line while a file lies beside this one."""

from pathlib import Path

from light_dark_room import LightDarkRoom

FAILS = Path(__file__).with_name("fails")


class Room(LightDarkRoom):
    name = "room"

    def observation_mean(self, states, sensing_action):
        if states[..., 0].mean() > 2.6 and FAILS.exists():
            if FAILS.read_text() == "MemoryError":
                raise MemoryError("Unable to allocate 7 GiB")
            raise ValueError("the map ends here")
        return super().observation_mean(states, sensing_action)
'''
EXAMPLE = Path(__file__).parents[2] / "examples" / "light_dark_room.py"
DOCUMENT = {
    "problem": "room:Room",
    "particle_filter": {"num_particles": 60},
    "simulator": {"num_trials": 1, "max_steps": 60, "seed": 3, "sensing_intervals": 3},
}


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        ("ValueError", "failed", "ValueError: the map ends here"),
        # Of the machines: unit/test_dispatcher.py.
        pytest.param(
            *("MemoryError", "out_of_memory", "MemoryError: Unable to allocate 7 GiB"),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_sensing_part_that_fails_after_its_task_part_ends_the_run_resumably(
    error: str, code: str, text: str, site: Site
) -> None:
    (site.directory / "room.py").write_text(MODULE)
    (site.directory / "light_dark_room.py").write_bytes(EXAMPLE.read_bytes())
    file = site.configure(DOCUMENT, offload=PATIENT)
    alone = site.holdfast("run", file, "--out", site.directory / "alone", "--jobs", "1", "-q")
    assert alone.process.returncode == 0, alone.account()
    fails = site.directory / "fails"
    fails.write_text(error)
    cloud = site.service("--problem", "room:Room", "--problem-directory", str(site.directory))
    cloud.start()
    robot = site.run(file, services=[cloud])
    assert robot.wait() == 4, robot.account()
    for name in (cloud.endpoint, RECOVERY):
        assert f"{name}: {code}: " in robot.output
        refused = robot.matching("refused", service=name)
        assert [event["final"] for event in refused] == [False] * (len(refused) - 1) + [True]
        assert len(refused) <= 5
        assert all(event["code"] == code for event in refused)
        assert all(text in event["reason"] for event in refused)
        assert all("in observation_mean" in event["reason"] for event in refused)
    assert ("particle_filter.num_particles 60" in robot.output) == (error == "MemoryError")
    assert len(robot.events) < 200, robot.account()
    # Whatever was wrong is mended: it goes on, and has decided as if nothing had happened.
    fails.unlink()
    robot = site.run(file, services=[cloud], resume=True)
    robot.finish()
    assert_identical(robot.out, site.directory / "alone")
