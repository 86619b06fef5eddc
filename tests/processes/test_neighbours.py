"""What else comes to a service's port disturbs no robot that is there.

How long robots wait meanwhile is measured by ``python benchmarks/run.py --only neighbours``.
"""

import sys
from pathlib import Path

import pytest
from tests.processes.faults import Process, References, Site, Story, document_of
from tests.processes.test_tls import secure

DOCUMENT = document_of("peg_in_hole_2d")
ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("kind", "protocol"),
    [
        ("deaf", "tcp"),
        ("greetings", "tcp"),
        # Most of the robot's own are dropped by the system; it is answered over the stream.
        ("flood", "udp"),
        *(
            pytest.param(kind, "tcp", marks=pytest.mark.slow)
            for kind in ("slow", "scanner", "silent")
        ),
    ],
)
def test_a_robot_at_work_notices_nothing(
    kind: str, protocol: str, keys: Path, site: Site, references: References
) -> None:
    """Nor is a new one kept out, as contracts/test_listener.py shows."""
    cloud = (site.service() if protocol == "tcp" else secure(site, keys, protocol)).start()
    options = () if protocol == "tcp" else ("--tls", str(keys / "ours" / "robot"))
    story = Story(site, references, DOCUMENT)
    neighbours: list[Process] = []
    come = ("-m", "tests.fuzz.neighbours", kind, cloud.endpoint, "--seconds", "1")
    root = {"PYTHONPATH": str(ROOT)}
    story.at(
        *("perform", 10),
        lambda: neighbours.append(site.process(sys.executable, *come, variables=root)),
    )
    # The robot goes on beside it; and is not through before it.
    story.at("perform", 78, lambda: neighbours[0].wait())
    robot = story.run(cloud, options=options)
    assert neighbours[0].wait() == 0, neighbours[0].account()
    assert int(neighbours[0].output.splitlines()[-1]) > 0
    assert robot.statuses() == []
    assert len(robot.matching("service_appeared", service=cloud.endpoint)) == 1
    assert not robot.matching("service_vanished")
    assert "Traceback" not in cloud.process.output
