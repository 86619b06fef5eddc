#!/usr/bin/env python3
"""Plays an arm that takes its commands on topics: the other end of `topic_robot.py`.

Its world is the problem's own simulation, so a run decides as it does without ROS.
"""

import contextlib

import numpy as np
import rclpy
from geometry_msgs.msg import PointStamped, Vector3
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Int32MultiArray, UInt32

from holdfast.config.loader import load
from holdfast.robot.environment import SimulatedEnvironment


class TopicArm(Node):
    """An arm whose world is simulated."""

    def __init__(self):
        super().__init__("topic_arm")
        configuration = load(self.declare_parameter("configuration", "").value)
        self._problem, self._seed = configuration.problem, configuration.simulator.seed
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._state = self.create_publisher(Int32MultiArray, "arm/state", latched)
        self._touch = self.create_publisher(PointStamped, "arm/touch", 1)
        self.create_subscription(UInt32, "arm/home", self.go_home, 1)
        self.create_subscription(UInt32, "arm/probe", self.probe, 1)
        self.create_subscription(Vector3, "arm/move", self.move, 1)

    def go_home(self, trial):
        """Begin a trial. Until the first one there is no state to tell."""
        self._trial = trial.data
        self._world = SimulatedEnvironment(self._problem, self._seed, self._trial)
        self._tell()

    def probe(self, axis):
        """Touch along an axis, and publish what was felt."""
        message = PointStamped()
        message.point.x = float(self._world.perform_sensing(axis.data)[0])
        message.header.stamp = self.get_clock().now().to_msg()
        self._touch.publish(message)

    def move(self, by):
        """Move, and count that."""
        self._world.perform(np.array([by.x, by.y, by.z]))
        self._tell()

    def _tell(self):
        state = [self._trial, self._world.step, int(self._world.is_done() is True)]
        self._state.publish(Int32MultiArray(data=state))
        self.get_logger().debug(f"trial {self._trial}, move {self._world.step}")


def main():
    """Run the arm until it is interrupted."""
    rclpy.init()
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(TopicArm())


if __name__ == "__main__":
    main()
