"""A service whose copy of the problem, or whose holdfast, is not the robot's."""

import shutil
from pathlib import Path

import pytest
from tests.processes import faults

EXAMPLE = Path(__file__).parents[2] / "examples" / "light_dark_room.py"
NAME = "light_dark_room:LightDarkRoom"
DOCUMENT = {
    "problem": NAME,
    "particle_filter": {"num_particles": 60},
    "simulator": {"num_trials": 1, "max_steps": 60, "seed": 3, "sensing_intervals": 3},
}
CONSTANT, OLDER_CONSTANT = "0.0001 + 0.02 * (x * x", "0.0001 + 0.03 * (x * x"


def older_copy(site: faults.Site) -> faults.Service:
    """Return a service that is given the example as it was before one constant was changed."""
    older = site.directory / "older"
    older.mkdir()
    text = EXAMPLE.read_text()
    assert text.count(CONSTANT) == 1
    (older / EXAMPLE.name).write_text(text.replace(CONSTANT, OLDER_CONSTANT))
    return site.service("--problem", NAME, "--problem-directory", str(older))


def digests_in(reason: str) -> tuple[str, str]:
    """Return the digests of the service and of the robot that a refusal names."""
    assert reason.startswith(f"problem {NAME}: the digest of the problem's code is ")
    words = reason.replace(",", "").replace(";", "").split()
    here, there = words[words.index("service") - 3], words[words.index("robot") - 3]
    assert len(here) == len(there) == 16
    return here, there


class TestOlderCopyOfTheProblem:
    def test_it_is_refused_and_the_local_service_decides(self, site: faults.Site) -> None:
        shutil.copy(EXAMPLE, site.directory)
        file = site.configure(DOCUMENT, offload=faults.PATIENT)
        alone = site.holdfast("run", file, "--out", site.directory / "alone", "--jobs", "1", "-q")
        assert alone.process.returncode == 0, alone.account()
        cloud = older_copy(site).start()
        robot = site.run(file, services=[cloud])
        robot.finish()
        faults.assert_identical(robot.out, site.directory / "alone")
        assert robot.statuses() == [faults.LOST]
        assert set(faults.services_in_order(robot)) == {faults.RECOVERY}
        (refused,) = robot.matching("refused")
        assert refused["service"] == cloud.endpoint
        assert refused["code"] == "other_code"
        assert refused["final"] is True
        here, there = digests_in(refused["reason"])
        assert here != there
        assert "deploy the same version" in refused["reason"]
        said = f"{cloud.endpoint} was asked no more: other_code: {refused['reason']}"
        assert robot.matching("note", reason=said)


IMPLEMENTED = """
from holdfast.problems.peg_in_hole_2d import PegInHole2D

class P(PegInHole2D):
    name = "p"
    GAIN = 1.0
    def limit_action(self, actions):
        return self.GAIN * super().limit_action(actions)

def make(gain):
    class Made(P):
        name = "made"
        GAIN = gain
    return Made
"""
WRITTEN_BY_A_USER = {
    "made by a function": (
        "mine:P",
        {"impl.py": IMPLEMENTED, "mine.py": "from impl import make\nP = make(1.0)\n"},
        "make(1.0)",
    ),
    "changed after it was imported": (
        "mine:P",
        {"impl.py": IMPLEMENTED, "mine.py": "from impl import P\nP.GAIN = 1.0\n"},
        "P.GAIN = 1.0",
    ),
    "from a folder put on the path": (
        "mine:P",
        {
            "lib/helper.py": IMPLEMENTED + "\nSIZE = 1.0\n",
            "mine.py": "import pathlib, sys\n"
            "sys.path.insert(0, str(pathlib.Path(__file__).parent / 'lib'))\n"
            "import helper\nfrom holdfast.problems.peg_in_hole_2d import PegInHole2D\n"
            "class P(PegInHole2D):\n    name = 'p'\n    GAIN = helper.SIZE\n",
        },
        "SIZE = 1.0",
    ),
}


class TestWhereTheCodeIsWritten:
    @pytest.mark.parametrize(
        "written",
        [
            # What is a part of the digest, its own tests say; one of these shows that it is sent.
            pytest.param(written, marks=[pytest.mark.slow] if number else [])
            for number, written in enumerate(WRITTEN_BY_A_USER)
        ],
    )
    def test_a_change_is_refused_and_a_copy_is_not(self, site: faults.Site, written: str) -> None:
        name, sources, constant = WRITTEN_BY_A_USER[written]
        services = []
        for place, value in (("older", "0.5"), ("same", "1.0"), ("", "1.0")):
            for file, text in sources.items():
                path = site.directory / place / file
                path.parent.mkdir(exist_ok=True, parents=True)
                path.write_text(text.replace(constant, constant.replace("1.0", value)))
            if place:
                folder = str(site.directory / place)
                services.append(site.service("--problem", name, "--problem-directory", folder))
        older, same = (service.start() for service in services)
        document = {**DOCUMENT, "problem": name}
        robot = site.run(site.configure(document, offload=faults.PATIENT), services=[older, same])
        robot.finish()
        (refused,) = robot.matching("refused")
        assert (refused["service"], refused["code"]) == (older.endpoint, "other_code")
        assert faults.services_in_order(robot) == [same.endpoint]
