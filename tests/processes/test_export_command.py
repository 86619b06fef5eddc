"""What is exported of a run in a world of its own, whose cloud and robot were killed.

The world is the one that is simulated elsewhere, so all that the robot believed on the way must be
what the run without faults believed, bit for bit, though nobody has recorded a belief.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader
from tests.processes.faults import (
    KEEP_ALIVE,
    LOCAL_RECOVERY,
    References,
    Site,
    Story,
    document_of,
    sensing_steps,
)


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_a_killed_cloud_and_a_killed_robot(site: Site, references: References) -> None:
    document = document_of("peg_in_hole_2d")
    steps = sensing_steps(document)
    cloud = site.service().start()
    story = Story(site, references, document)
    story.at("sense", steps[1], cloud.kill)
    story.at("perform", steps[3], cloud.start, story.status(KEEP_ALIVE))
    story.at("perform", steps[4] + 2, site.kill_robot)
    story.at("sense", steps[5], site.kill_robot, afterwards=True)
    assert story.run_and_resume(cloud) == 2
    exported = site.directory / "exported"
    for run, name in ((story.running.out, "robot"), (story.reference, "reference")):
        said = site.holdfast("export", run, "--csv", f"{exported}-{name}", "-q")
        assert said.process.returncode == 0, said.account()
    file = site.directory / "run.mcap"
    said = site.holdfast("export", story.running.out, "--mcap", file)
    assert said.process.returncode == 0, said.account()
    assert "note:" not in said.account()

    beliefs = [Path(f"{exported}-{name}", "beliefs.csv") for name in ("robot", "reference")]
    assert beliefs[0].read_bytes() == beliefs[1].read_bytes()
    assert len(rows_of(beliefs[0])) > 60 * 20
    robot, reference = (
        rows_of(Path(f"{exported}-{name}", "steps.csv")) for name in ("robot", "reference")
    )
    for mine, theirs in zip(robot, reference, strict=True):
        for column in mine:
            known_to_both = not column.startswith("true ") and not column.endswith(
                ("reward", "_time", "_service", "_status", "_ms")
            )
            if known_to_both:
                assert mine[column] == theirs[column], column
    times = [float(row["action_time"]) for row in robot]
    assert times == sorted(times)

    with AnyReader([file]) as reader:
        messages: list[tuple[str, Any]] = [
            (connection.topic, reader.deserialize(data, connection.msgtype))
            for connection, _, data in reader.messages()
        ]
    statuses = [message.status[0] for topic, message in messages if topic == "/diagnostics"]
    logs = [message.msg for topic, message in messages if topic == "/rosout"]
    seen = {(status.message.split(";")[0], status.level, status.hardware_id) for status in statuses}
    assert ("standard", 0, cloud.endpoint) in seen
    assert (LOCAL_RECOVERY, 1, "cloud_active_sensing_recovery") in seen
    assert any(log.startswith(f"status: from standard, to {LOCAL_RECOVERY}") for log in logs)
