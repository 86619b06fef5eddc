"""A recorded run as an MCAP file: messages by topic, read back by rosbags."""

from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader

from holdfast.config.loader import load
from holdfast.planning.belief import Belief
from holdfast.reports.facts import EventFact, TrialBeginFact, TrialEndFact
from holdfast.reports.mcap_export import McapSink

EXAMPLE = Path(__file__).parents[2] / "examples" / "peg_in_hole_2d.yaml"


def test_facts_become_messages_in_their_order(tmp_path: Path) -> None:
    belief = Belief(np.array([[1.0, 2.0, 0.1], [3.0, 2.0, 0.1]]), np.array([0.25, 0.75]))
    estimate = np.array([2.5, 2.0, 0.1])
    with McapSink(tmp_path / "run", load(EXAMPLE), {"seed": "9"}) as sink:
        assert sink.has_poses
        sink.trial_begins(TrialBeginFact(0, 10))
        sink.happened(EventFact(15, "holding", {"reason": "no answer"}))
        sink.trial_ends(TrialEndFact(0, 20, 3, None, belief, estimate))
    assert sink.file.exists()
    with AnyReader([tmp_path / "run"]) as reader:
        found: list[tuple[str, int, Any]] = [
            (connection.topic, time_ns, reader.deserialize(data, connection.msgtype))
            for connection, time_ns, data in reader.messages()
        ]
    by_topic = {topic: message for topic, _, message in found}
    assert by_topic["/holdfast/step"].data == 3
    assert by_topic["/holdfast/belief"].data.tolist() == [1.0, 2.0, 0.1, 0.25, 3.0, 2.0, 0.1, 0.75]
    assert by_topic["/holdfast/state_estimate"].data.tolist() == estimate.tolist()
    assert by_topic["/holdfast/particle_cloud"].poses[1].position.x == 3.0
    logged = [(message.level, message.msg) for topic, _, message in found if topic == "/rosout"]
    assert (30, "holding: reason no answer") in logged
    assert {time_ns for _, time_ns, _ in found} == {10, 15, 20}
