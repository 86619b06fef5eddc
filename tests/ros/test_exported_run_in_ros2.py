"""An exported run in a real ROS 2: it reads each message as rosbags does, and writes it alike."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from tests.command_line import run_here
from tests.programs import completed

if TYPE_CHECKING:
    import pytest
    from tests.ros.conftest import Ros2

RUN = """\
problem: peg_in_hole_3d
particle_filter: {num_particles: 40}
simulator: {num_trials: 2, max_steps: 30, sensing_intervals: 3, seed: 5}
"""

READER = """
import base64, importlib, json, sys
from rclpy.serialization import deserialize_message, serialize_message

for line in sys.stdin:
    kind, data = json.loads(line)
    package, _, name = kind.split("/")
    cls = getattr(importlib.import_module(package + ".msg"), name)
    message = deserialize_message(base64.b64decode(data), cls)
    again = base64.b64encode(serialize_message(message)).decode()
    numbers = []
    if name == "PoseArray":
        for pose in message.poses:
            p, q = pose.position, pose.orientation
            numbers.append([v.hex() for v in (p.x, p.y, p.z, q.x, q.y, q.z, q.w)])
    print(json.dumps([again, numbers]))
"""


def poses_of(kind: str, message: Any) -> list[list[float]]:
    return [
        [p.x, p.y, p.z, q.x, q.y, q.z, q.w]
        for p, q in (
            (pose.position, pose.orientation)
            for pose in (message.poses if kind.endswith("/PoseArray") else [])
        )
    ]


def test_every_message(ros2: Ros2, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "run.yaml").write_text(RUN)
    for words in (
        ("run", "run.yaml", "--out", "run", "-q"),
        ("export", "run", "--mcap", "run.mcap", "-q"),
    ):
        assert run_here(capsys, tmp_path, *words).code == 0
    with AnyReader([tmp_path / "run.mcap"]) as reader:
        messages = [
            (connection.msgtype, raw, reader.deserialize(raw, connection.msgtype))
            for connection, _, raw in reader.messages()
        ]
    done = completed(
        [ros2.python, "-c", READER],
        input="\n".join(
            json.dumps([kind, base64.b64encode(raw).decode()]) for kind, raw, _ in messages
        ),
        env=ros2.environment,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    store = get_typestore(Stores.ROS2_KILTED)
    known, num_poses = set(), 0
    for (kind, raw, message), line in zip(messages, done.stdout.splitlines(), strict=True):
        again, numbers = json.loads(line)
        known.add(kind)
        # Fast CDR leaves in the gaps between fields what was there before; rosbags writes zeros.
        written = store.deserialize_cdr(base64.b64decode(again), kind)
        assert bytes(store.serialize_cdr(written, kind)) == bytes(raw), kind
        values = [[float.fromhex(number) for number in pose] for pose in numbers]
        assert values == poses_of(kind, message)
        num_poses += len(values)
    assert {"tf2_msgs/msg/TFMessage", "visualization_msgs/msg/MarkerArray"} <= known
    assert len(known) >= 11
    assert num_poses > 2000
