"""ROS 2's messages of what the node shows."""

from __future__ import annotations

import array
import struct
from typing import Any

import numpy as np
import numpy.typing as npt
from builtin_interfaces.msg import Time
from holdfast_interfaces.msg import (
    Belief,
    BeliefStamped,
    Decision,
    PlanningState,
    TrialOutcome,
)
from std_msgs.msg import Header

from holdfast.numerics.arrays import FloatArray
from holdfast.planning import planner as planning
from holdfast.planning.outcome import TrialResult
from holdfast.problems.attributes import sensing_labels
from holdfast.problems.problem import Problem
from holdfast.ros.ros2.telemetry import PublishedDecision

__all__ = ["belief_message", "decision_message", "floats", "outcome_message", "pose_array"]


def floats(values: npt.ArrayLike) -> array.array[float]:
    """Return numbers as rclpy takes them fastest."""
    return array.array("d", np.ascontiguousarray(values, dtype=np.float64).tobytes())


def belief_message(state: planning.PlanningState, frame_id: str, stamp: Time) -> Any:
    """Return a state as a message."""
    belief = Belief(
        state_size=state.belief.states.shape[1],
        states=floats(state.belief.states.ravel()),
        weights=floats(state.belief.weights),
    )
    return BeliefStamped(
        header=Header(frame_id=frame_id, stamp=stamp),
        state=PlanningState(
            seed=state.seed,
            trial=state.trial,
            step=state.step,
            stage=state.stage,
            sensed=state.sensed,
            belief=belief,
        ),
    )


def decision_message(shown: PublishedDecision, problem: Problem, frame_id: str, stamp: Time) -> Any:
    """Return an order as a message."""
    sensing_action = shown.sensing_action
    return Decision(
        header=Header(frame_id=frame_id, stamp=stamp),
        trial=shown.trial,
        step=shown.step,
        stage=shown.stage,
        kind=Decision.ACT if sensing_action is None else Decision.SENSE,
        sensing_action=sensing_action or 0,
        sensing_action_name=(
            "" if sensing_action is None else sensing_labels(problem)[sensing_action]
        ),
        entropies=floats(shown.entropies),
        task_action=floats(shown.task_action),
        status=shown.status,
        decided_by=shown.decided_by,
    )


def outcome_message(result: TrialResult) -> Any:
    """Return a trial's result as a message."""
    return TrialOutcome(
        trial=result.trial,
        outcome=result.outcome,
        steps=result.steps,
        has_reward=result.reward is not None,
        reward=float(result.reward or 0.0),
        recoveries=result.recoveries,
        unexplained_observations=result.unexplained_observations,
        digest=result.digest,
    )


def pose_array(poses: FloatArray, frame_id: str, stamp: Time) -> bytes:
    """Return a serialised ``geometry_msgs/PoseArray``.

    As objects, three hundred poses take rclpy milliseconds, in which no other thread of Python
    runs. CDR is what all of ROS 2's middlewares send, and of poses it is an array of numbers.

    Parameters
    ----------
    poses : array of shape (N, 7)
        Position and quaternion (x, y, z, w).
    """
    name = frame_id.encode() + b"\0"
    body = struct.pack("<iII", stamp.sec, stamp.nanosec, len(name)) + name
    body += bytes(-len(body) % 4) + struct.pack("<I", len(poses))
    if len(poses):
        body += bytes(-len(body) % 8)
    return b"\0\1\0\0" + body + np.ascontiguousarray(poses, dtype="<f8").tobytes()
