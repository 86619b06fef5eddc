"""Stands for Nav2's ``BasicNavigator``, which has no wheel: a real node, a simulated robot.

It has the calls that the example makes, with the names and defaults that Nav2 documents, and
publishes what AMCL would: its particles, best effort.
"""

from __future__ import annotations

import enum
import json
import math
import sys
from typing import Any

import rclpy
from geometry_msgs.msg import Point, Pose, Quaternion
from nav2_msgs.msg import Particle, ParticleCloud
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data

import holdfast as hf


class TaskResult(enum.Enum):
    UNKNOWN = 0
    SUCCEEDED = 1
    CANCELED = 2
    FAILED = 3


class BasicNavigator(Node):  # type: ignore[misc]
    def __init__(self, node_name: str = "basic_navigator", namespace: str = "") -> None:
        super().__init__(node_name, namespace=namespace)
        read = hf.load_configuration("examples/nav2/door.yaml")
        self._problem: Any = read.problem
        self._planner = hf.Planner(read.problem, read.planning)
        self._state = self._planner.init(read.simulator.seed, 3)
        self._world = hf.SimulatedEnvironment(read.problem, read.simulator.seed, 3)
        self._tell("robot", self._world.state.tolist())
        self._publisher = self.create_publisher(
            ParticleCloud, "particle_cloud", qos_profile_sensor_data
        )
        self.create_timer(0.05, self._publish)
        self._polls = 0

    @staticmethod
    def _tell(what: str, value: Any) -> None:
        sys.stdout.write(json.dumps([what, value]) + "\n")

    def _publish(self) -> None:
        cloud = ParticleCloud()
        cloud.header.frame_id = "map"
        for (x, y, yaw), weight in zip(*self._state.belief, strict=True):
            turn = Quaternion(z=math.sin(yaw / 2), w=math.cos(yaw / 2))
            pose = Pose(position=Point(x=x, y=y), orientation=turn)
            cloud.particles.append(Particle(pose=pose, weight=weight))
        self._publisher.publish(cloud)

    def waitUntilNav2Active(self, navigator: str = "bt_navigator", localizer: str = "amcl") -> None:  # noqa: N802
        self._tell("active", [navigator, localizer])

    def spin(self, spin_dist: float = 1.57, time_allowance: int = 10) -> bool:
        """AMCL takes the scan after the turn; the simulation turns back, so its pose stays."""
        (chosen,) = (
            number
            for number in range(len(self._problem.sensing_actions))
            if math.isclose(
                math.remainder(self._problem.turn_of(number) - spin_dist, math.tau), 0, abs_tol=1e-9
            )
        )
        self._tell("spin", chosen)
        observation = self._world.perform_sensing(chosen)
        state, _ = self._planner.observe(self._state, chosen, observation)
        self._state = state._replace(sensed=False, step=state.step + 1)
        self._polls = 3
        return True

    def goToPose(self, pose: Any, behavior_tree: str = "") -> bool:  # noqa: N802
        place, turn = pose.pose.position, pose.pose.orientation
        self._tell("pose", [pose.header.frame_id, place.x, place.y, turn.w, behavior_tree])
        self._polls = 3
        return True

    def isTaskComplete(self) -> bool:  # noqa: N802
        rclpy.spin_once(self, timeout_sec=0.1)
        self._polls -= 1
        return self._polls <= 0

    def getResult(self) -> TaskResult:  # noqa: N802
        return TaskResult.SUCCEEDED
