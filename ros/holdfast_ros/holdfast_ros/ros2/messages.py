"""ROS 2's messages of what the node shows."""

from __future__ import annotations

import array
import struct
from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion, Transform, TransformStamped
from holdfast_interfaces.msg import Decision, TrialOutcome
from std_msgs.msg import Float64MultiArray, Header, MultiArrayDimension, MultiArrayLayout

from holdfast.numerics.arrays import FloatArray
from holdfast.planning.belief import Belief
from holdfast.planning.outcome import TrialResult
from holdfast.problems.attributes import sensing_labels
from holdfast.problems.problem import Problem
from holdfast.reports.csv_export import state_labels
from holdfast_ros.ros2.telemetry import PublishedDecision


def floats(values: npt.ArrayLike) -> array.array[float]:
    """Return numbers as rclpy takes them fastest."""
    return array.array("d", np.ascontiguousarray(values, dtype=np.float64).tobytes())


def belief_message(belief: Belief, problem: Problem) -> Any:
    """Return a belief as it is exported: a row for each particle, its state and its weight."""
    table = np.column_stack([belief.states, belief.weights])
    columns = "; ".join([*state_labels(problem), "weight"])
    (rows, width), dimension = table.shape, MultiArrayDimension
    dimensions = [dimension(label="particle", size=rows, stride=table.size),
                  dimension(label=columns, size=width, stride=width)]  # fmt: skip
    return Float64MultiArray(layout=MultiArrayLayout(dim=dimensions), data=floats(table.ravel()))


def frame_message(parent: str, child: str, turn: Iterable[float], stamp: Time) -> Any:
    """Return the transform of a frame that is only turned in its parent, as ``tf2`` has it."""
    from tf2_msgs.msg import TFMessage

    x, y, z, w = turn
    transform = Transform(rotation=Quaternion(x=x, y=y, z=z, w=w))
    header = Header(frame_id=parent, stamp=stamp)
    return TFMessage(
        transforms=[TransformStamped(header=header, child_frame_id=child, transform=transform)]
    )


def decision_message(shown: PublishedDecision, problem: Problem, frame_id: str, stamp: Time) -> Any:
    """Return an order as a message."""
    sensing = shown.sensing_action
    return Decision(
        header=Header(frame_id=frame_id, stamp=stamp),
        kind=Decision.ACT if sensing is None else Decision.SENSE,
        sensing_action=sensing or 0,
        sensing_action_name="" if sensing is None else sensing_labels(problem)[sensing],
        entropies=floats(shown.entropies),
        task_action=floats(shown.task_action),
        **_copied(shown, "trial", "step", "stage", "status", "decided_by"),
    )


def outcome_message(result: TrialResult) -> Any:
    """Return a trial's result as a message."""
    return TrialOutcome(
        has_reward=result.reward is not None,
        reward=float(result.reward or 0.0),
        **_copied(result, "trial", "outcome", "steps", "recoveries", "digest"),
        unexplained_observations=result.unexplained_observations,
    )


def _copied(source: object, *fields: str) -> dict[str, Any]:
    return {field: getattr(source, field) for field in fields}


def pose_array(poses: FloatArray, frame_id: str, stamp: Time) -> bytes:
    """Return a serialised ``geometry_msgs/PoseArray`` of positions and quaternions (x, y, z, w).

    As objects, three hundred poses take rclpy milliseconds, in which no other thread of Python
    runs. CDR is what all of ROS 2's middlewares send, and of poses it is an array of numbers.
    """
    name = frame_id.encode() + b"\0"
    body = struct.pack("<iII", stamp.sec, stamp.nanosec, len(name)) + name
    body += bytes(-len(body) % 4) + struct.pack("<I", len(poses))
    if len(poses):
        body += bytes(-len(body) % 8)
    return b"\0\1\0\0" + body + np.ascontiguousarray(poses, dtype="<f8").tobytes()
