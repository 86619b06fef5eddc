"""Plays robots that misbehave; parameters say how.

It says on its standard output what a test must wait for.
"""

from __future__ import annotations

import math
import os
import threading
import time
from typing import Any

import rclpy
from holdfast_interfaces.action import Act
from holdfast_interfaces.srv import Sense, Trial
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node


def say(text: str) -> None:
    print(text, flush=True)


class OddRobot(Node):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__("odd_robot")
        self._sense = self.declare_parameter("sense", "well").value
        self._act = self.declare_parameter("act", "well").value
        self._done = self.declare_parameter("done", "").value
        self._steps = 0
        self._moving = threading.Lock()
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
        say("ready")

    def sense(self, request: Any, response: Any) -> Any:
        say(f"sensing {request.sensing_action}")
        if self._sense == "silent":
            time.sleep(1000.0)
        if self._sense == "die":
            os._exit(1)
        if self._sense == "refuse":
            response.message = "the probe is not attached"
            return response
        response.success = True
        response.observation = [1.5]
        return response

    def trial(self, request: Any, response: Any) -> Any:
        if request.begin:
            self._steps = 0
        response.success = True
        with self._moving:
            response.steps = self._steps
        response.failed = self._done == "failed"
        response.message = "the arm has hit the table" if response.failed else ""
        return response

    def act(self, goal: Any) -> Any:
        result = Act.Result(reward=math.nan)
        if self._act != "long":
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
        with self._moving:
            if self._act == "long":
                say("moving, and whoever asks waits")
                time.sleep(2.0)
            self._steps += 1
        result.success = True
        result.reward = -1.0
        goal.succeed()
        return result


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
