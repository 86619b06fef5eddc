"""Plays robots that are not ready-made, and robots that misbehave; parameters say how.

It says on its standard output what a test must wait for.
"""

from __future__ import annotations

import math
import os
import threading
import time
from typing import Any

import nav_msgs.srv
import rclpy
import std_msgs.msg
import std_srvs.srv
from geometry_msgs.msg import PointStamped, PoseStamped
from geometry_msgs.msg import Vector3 as Unstamped
from holdfast_interfaces.action import Act
from holdfast_interfaces.srv import Sense, Trial
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile


def say(text: str) -> None:
    print(text, flush=True)


class OddRobot(Node):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__("odd_robot")
        self._sense = self.declare_parameter("sense", "well").value
        self._act = self.declare_parameter("act", "well").value
        self._topic = self.declare_parameter("topic", "").value
        self._done = self.declare_parameter("done", "").value
        self._steps = 0
        self._sensed = 0
        self._asked: list[float] = []
        self._released = threading.Event()
        group = ReentrantCallbackGroup()
        if self._sense != "absent":
            self.create_service(Sense, "robot/sense", self.sense, callback_group=group)
        self.create_service(Trial, "robot/trial", self.trial, callback_group=group)
        self._server = ActionServer(
            self,
            Act,
            "robot/act",
            self.act,
            callback_group=group,
            goal_callback=lambda _: (
                GoalResponse.REJECT if self._act == "reject" else GoalResponse.ACCEPT
            ),
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )
        # The same robot as somebody else would have made it.
        self.create_service(nav_msgs.srv.GetPlan, "arm/probe", self.probe, callback_group=group)
        self.create_service(nav_msgs.srv.GetPlan, "arm/move", self.move, callback_group=group)
        self.create_service(nav_msgs.srv.GetMap, "arm/count", self.count, callback_group=group)
        self.create_service(std_srvs.srv.Trigger, "arm/home", self.home, callback_group=group)
        self._touches = self.create_publisher(PointStamped, "arm/touch", 10)
        self._unstamped = self.create_publisher(Unstamped, "arm/force", 10)
        if self._topic in ("stale", "fresh", "unstamped"):
            self.create_timer(0.05, self.publish, callback_group=group)
        if self._done:
            latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self._dones = self.create_publisher(std_msgs.msg.Bool, "arm/done", latched)
            self._dones.publish(std_msgs.msg.Bool(data=self._done == "succeeded"))
        say("ready")

    # -- ready-made ------------------------------------------------------------------------------

    def sense(self, request: Any, response: Any) -> Any:
        say(f"sensing {request.sensing_action}")
        self._sensed += 1
        if self._sense == "silent":
            time.sleep(1000.0)
        if self._sense == "die":
            os._exit(1)
        if self._sense == "refuse":
            response.message = "the probe is not attached"
            return response
        response.success = True
        response.observation = {
            "well": [1.5],
            "size": [1.0, 2.0],
            "nothing": [],
            "not_a_number": [math.nan],
            "endless": [math.inf],
        }[self._sense]
        if self._topic == "during":
            self.publish()
            time.sleep(0.2)
        return response

    def trial(self, request: Any, response: Any) -> Any:
        if request.begin:
            self._steps = 0
        response.success = True
        response.steps = self._steps
        response.failed = self._done == "failed"
        response.message = "the arm has hit the table" if response.failed else ""
        return response

    def act(self, goal: Any) -> Any:
        result = Act.Result(reward=math.nan)
        say(f"moving {list(goal.request.task_action)}")
        if self._act == "die":
            os._exit(1)
        if self._act == "abort":
            result.message = "the arm has hit the table"
            goal.abort()
            return result
        if self._act == "unsuccessful":
            result.message = "the arm is locked"
            goal.succeed()
            return result
        if self._act == "slow":
            for _ in range(2000):
                if goal.is_cancel_requested:
                    say("cancelled")
                    goal.canceled()
                    result.message = "stopped"
                    return result
                time.sleep(0.05)
        if self._act == "long":
            time.sleep(2.0)
        self._steps += 1
        result.success = True
        result.reward = math.inf if self._act == "infinite" else -1.0
        goal.succeed()
        return result

    # -- of its own ------------------------------------------------------------------------------

    def probe(self, request: Any, response: Any) -> Any:
        # One pose for each coordinate, and the angle that was asked for in all of them.
        for number in range(3):
            pose = PoseStamped()
            pose.pose.position.x = 10.0 * number + request.tolerance
            pose.pose.position.y = request.start.pose.position.y
            response.plan.poses.append(pose)
        response.plan.header.frame_id = request.start.header.frame_id
        return response

    def move(self, request: Any, response: Any) -> Any:
        say(
            f"moving {request.goal.header.frame_id} {request.goal.pose.position.x:g} "
            f"{request.goal.pose.position.y:g} {request.goal.pose.orientation.z:g}"
        )
        if self._act == "silent":
            self._steps += 1
            time.sleep(1000.0)
        self._steps += 1
        response.plan.poses.append(PoseStamped())
        response.plan.poses[0].pose.position.z = -2.5
        return response

    def count(self, request: Any, response: Any) -> Any:
        response.map.info.width = self._steps
        return response

    def home(self, request: Any, response: Any) -> Any:
        self._steps = 0
        say("home")
        response.success = True
        if self._done == "succeeded":
            self._dones.publish(std_msgs.msg.Bool(data=False))
        return response

    def publish(self) -> None:
        message = PointStamped()
        now = self.get_clock().now().nanoseconds
        taken = now - 1_000_000_000_000 if self._topic == "stale" else now
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(taken, 1_000_000_000)
        message.point.x = float(self._sensed)
        self._touches.publish(message)
        self._unstamped.publish(Unstamped(x=float(self._sensed)))


def main() -> None:
    rclpy.init()
    try:
        executor = MultiThreadedExecutor(num_threads=6)
        executor.add_node(OddRobot())
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


if __name__ == "__main__":
    main()
