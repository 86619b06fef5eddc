"""The executive for Nav2 with real messages and topics; Nav2 itself has no wheels.

``nav2_msgs`` is built of its definitions; the example's stand-in plays ``BasicNavigator`` and AMCL.
"""

import json

import numpy as np
from tests.programs import completed
from tests.ros.conftest import ROOT, Ros2
from tests.ros.domains import own_domain


def test_it_looks_until_the_particles_agree_and_goes_through_the_door(ros2: Ros2) -> None:
    stand_in = ROOT / "examples" / "nav2" / "stand_in"
    with own_domain() as domain:
        done = completed(
            [str(ros2.python), "examples/nav2/navigate.py"],
            cwd=ROOT,
            env={
                **ros2.environment,
                "ROS_DOMAIN_ID": str(domain),
                "PYTHONPATH": f"{stand_in}:{ros2.environment['PYTHONPATH']}",
            },
            timeout=300,
        )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    told = [json.loads(line) for line in lines if line.startswith("[")]
    kinds = [what for what, _ in told]
    assert kinds[:2] == ["robot", "active"]
    assert kinds[2:] == ["spin"] * (len(kinds) - 4) + ["pose"] * 2
    assert "spin" in kinds
    assert told[1][1] == ["bt_navigator", "amcl"]
    poses = np.array([value[1:4] for what, value in told if what == "pose"])
    np.testing.assert_allclose(poses, [[5.2, 1.2, 1.0], [6.6, 1.2, 1.0]])
    assert {value[0] for what, value in told if what == "pose"} == {"map"}
    assert any(line.endswith("agree on the drive: through the door") for line in lines)
