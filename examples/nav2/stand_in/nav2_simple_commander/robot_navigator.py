"""Stands for Nav2's ``BasicNavigator`` where there is ROS 2 with ``nav2_msgs``, and no Nav2.

It is a real node with a simulated robot. It has the calls that ``navigate.py`` makes, with Nav2's
names and defaults, and publishes what AMCL would: its particles, best effort::

    PYTHONPATH=examples/nav2/stand_in:$PYTHONPATH python examples/nav2/navigate.py

It prints each call as a line of JSON.
"""

import enum
import json
import math
import sys
from pathlib import Path

import rclpy
from geometry_msgs.msg import Point, Pose, Quaternion
from nav2_msgs.msg import Particle, ParticleCloud
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data

import holdfast as hf

TRIAL = 3


class TaskResult(enum.Enum):
    """How a task ended, as Nav2 counts."""

    UNKNOWN = 0
    SUCCEEDED = 1
    CANCELED = 2
    FAILED = 3


class BasicNavigator(Node):
    """The calls of Nav2's; each task succeeds after three polls."""

    def __init__(self, node_name="basic_navigator", namespace=""):
        super().__init__(node_name, namespace=namespace)
        read = hf.load_configuration(Path(__file__).parents[2] / "door.yaml")
        self._problem, seed = read.problem, read.simulator.seed
        self._planner = hf.Planner(read.problem, read.planning)
        self._state = self._planner.init(seed, TRIAL)
        self._world = hf.SimulatedEnvironment(read.problem, seed, TRIAL)
        _tell("robot", self._world.state.tolist())
        self._publisher = self.create_publisher(
            ParticleCloud, "particle_cloud", qos_profile_sensor_data
        )
        self.create_timer(0.05, self._publish)
        self._polls = 0

    def _publish(self):
        cloud = ParticleCloud()
        cloud.header.frame_id = "map"
        for (x, y, yaw), weight in zip(*self._state.belief, strict=True):
            turn = Quaternion(z=math.sin(yaw / 2), w=math.cos(yaw / 2))
            pose = Pose(position=Point(x=x, y=y), orientation=turn)
            cloud.particles.append(Particle(pose=pose, weight=weight))
        self._publisher.publish(cloud)

    def waitUntilNav2Active(self, navigator="bt_navigator", localizer="amcl"):  # noqa: N802
        """Nav2 is active at once."""
        _tell("active", [navigator, localizer])

    def spin(self, spin_dist=1.57, time_allowance=10):
        """Turn, look, and turn back: the pose stays, and AMCL has taken the scan."""

        def away(sensing_action):
            turn = self._problem.turn_of(sensing_action) - spin_dist
            return abs(math.remainder(turn, 2.0 * math.pi))

        chosen = min(range(len(self._problem.sensing_actions)), key=away)
        _tell("spin", [chosen, time_allowance])
        seen = self._world.perform_sensing(chosen)
        state, _ = self._planner.observe(self._state, chosen, seen)
        self._state = state._replace(sensed=False, step=state.step + 1)
        self._polls = 3
        return True

    def goToPose(self, pose, behavior_tree=""):  # noqa: N802
        """Say where the robot is sent."""
        place, turn = pose.pose.position, pose.pose.orientation
        _tell("pose", [pose.header.frame_id, place.x, place.y, turn.w, behavior_tree])
        self._polls = 3
        return True

    def isTaskComplete(self):  # noqa: N802
        """Wait a tenth of a second, as Nav2's does."""
        rclpy.spin_once(self, timeout_sec=0.1)
        self._polls -= 1
        return self._polls <= 0

    def getResult(self):  # noqa: N802
        """Return how the last task ended."""
        return TaskResult.SUCCEEDED


def _tell(what, value):
    sys.stdout.write(json.dumps([what, value]) + "\n")
