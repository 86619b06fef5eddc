"""A robot of your own in ROS 2: a class with three methods that publishes and waits for messages.

This arm takes its commands on topics and knows nothing of holdfast. `topic_arm.py` plays it::

    python examples/ros2/topic_arm.py --ros-args -p configuration:=examples/peg_in_hole_2d.yaml &
    holdfast run examples/peg_in_hole_2d.yaml --environment topic_robot:TopicRobot
        --set environment.directory=examples/ros2 --trials 1 --out runs/topics

The same class serves holdfast's node (parameters `environment.object`, `environment.directory`).
"""

import time

import numpy as np
import rclpy
from geometry_msgs.msg import PointStamped, Vector3
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Int32MultiArray, UInt32


class TopicRobot:
    """The arm: commands on `arm/home`, `arm/probe` and `arm/move`.

    It shows what it feels on `arm/touch`, and on the latched topic `arm/state` which trial it is
    in, how many moves that has had, and whether the peg is in.
    """

    def __init__(self, trial, resumed, timeout_s=10.0):
        # A context of its own: whoever else uses ROS in this process is not concerned.
        self._context = rclpy.Context()
        self._context.init(args=[])
        node = self._node = rclpy.create_node("topic_robot", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(node)
        self._trial, self._timeout_s = trial, timeout_s
        self._state = self._touch = None
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._states = node.create_subscription(
            Int32MultiArray, "arm/state", self._take_state, latched
        )
        self._touches = node.create_subscription(PointStamped, "arm/touch", self._take_touch, 1)
        self._home = node.create_publisher(UInt32, "arm/home", 1)
        self._probe = node.create_publisher(UInt32, "arm/probe", 1)
        self._move = node.create_publisher(Vector3, "arm/move", 1)
        # What is published before the arm listens is lost.
        for publisher in (self._home, self._probe, self._move):
            listeners = f"listener on {publisher.topic_name}"
            self._wait_for(listeners, None, publisher.get_subscription_count)
        if resumed:
            # An arm whose moves take time must also say here that it has come to a stop.
            self._wait_for(f"state of trial {trial}", self._states, self._is_in_trial)
        else:
            self._home.publish(UInt32(data=trial))
            self._wait_for(
                f"begin of trial {trial}", self._states, lambda: self._is_in_trial(moves=0)
            )

    def perform_sensing(self, sensing_action):
        """Have the arm touch along an axis, and return what it felt after it was asked."""
        asked = self._node.get_clock().now().nanoseconds
        self._touch = None
        self._probe.publish(UInt32(data=sensing_action))
        self._wait_for(
            "touch", self._touches, lambda: self._touch is not None and _taken(self._touch) >= asked
        )
        return np.array([self._touch.point.x])

    def perform(self, task_action):
        """Move, and wait until the arm counts the move; it has no reward to show."""
        moves = self._state[1]
        x, y, angle = map(float, task_action)
        self._move.publish(Vector3(x=x, y=y, z=angle))
        # A command that is not answered is not sent again: the arm may have moved all the same.
        self._wait_for(
            f"end of move {moves + 1}", self._states, lambda: self._is_in_trial(moves=moves + 1)
        )

    def is_done(self):
        """Return whether the peg was in after the last move."""
        return bool(self._state[2])

    def steps_performed(self):
        """Return the arm's own count: after a crash it says whether the last move was made."""
        return self._state[1]

    def close(self):
        """Leave ROS; the arm stays where it is."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.shutdown()

    def _take_state(self, message):
        self._state = list(message.data)

    def _take_touch(self, message):
        self._touch = message

    def _is_in_trial(self, moves=None):
        state = self._state
        return state is not None and state[0] == self._trial and moves in (None, state[1])

    def _wait_for(self, what, topic, is_there):
        deadline = time.monotonic() + self._timeout_s
        while not is_there():
            if time.monotonic() > deadline:
                if topic is not None:
                    what += f" on {topic.topic_name} ({topic.get_publisher_count()} publishers)"
                raise TimeoutError(f"no {what} within {self._timeout_s:g} s (timeout_s)")
            self._executor.spin_once(timeout_sec=0.1)


def _taken(message):
    stamp = message.header.stamp
    return 1_000_000_000 * stamp.sec + stamp.nanosec
