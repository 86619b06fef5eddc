#!/usr/bin/env python3
"""Plays a robot in ROS 2: a node of its own, to try things with and to copy from.

It offers what holdfast's node calls when it is told nothing else:

- ``robot/sense`` (service ``holdfast_interfaces/srv/Sense``),
- ``robot/act`` (action ``holdfast_interfaces/action/Act``; with ``act: service`` the service of the
  same name),
- ``robot/trial`` (service ``holdfast_interfaces/srv/Trial``).

Replace what is marked with `your robot` by yours. The world is the problem's own simulation, with
the noise of (seed, trial, step), so a run decides as it does without ROS. Parameters:

- ``configuration``: path of the file that says problem and seed;
- ``motion_s``: how long a task action takes;
- ``act``: ``action`` or ``service``;
- ``log``: file that remembers the task actions performed, so that the robot may be killed and
  started again; empty: they are forgotten.

    python simulated_robot.py --ros-args -p configuration:=peg_in_hole_2d.yaml -p motion_s:=0.1
"""

import json
import math
import threading
import time
from pathlib import Path

import numpy as np
import rclpy
from holdfast_interfaces.action import Act
from holdfast_interfaces.srv import Act as ActService
from holdfast_interfaces.srv import Sense, Trial
from rclpy.action import ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node

from holdfast.config.loader import load
from holdfast.errors import HoldfastError
from holdfast.robot.environment import SimulatedEnvironment


class SimulatedRobot(Node):
    """A robot whose world is simulated."""

    def __init__(self, name="simulated_robot", **options):
        super().__init__(name, **options)
        configuration = load(self.declare_parameter("configuration", "").value)
        self.motion_s = self.declare_parameter("motion_s", 0.0).value
        act = self.declare_parameter("act", "action").value
        log = self.declare_parameter("log", "").value
        self._log = Path(log) if log else None
        self._problem, self._seed = configuration.problem, configuration.simulator.seed
        # One thing at a time: whoever asks while the robot moves is answered when it stands.
        self._moving = threading.Lock()
        self._restore()
        group = ReentrantCallbackGroup()
        self.create_service(Sense, "robot/sense", self.sense, callback_group=group)
        self.create_service(Trial, "robot/trial", self.tell, callback_group=group)
        if act == "service":
            self.create_service(ActService, "robot/act", self.act_service, callback_group=group)
        else:
            self._server = ActionServer(
                self,
                Act,
                "robot/act",
                self.act_action,
                callback_group=group,
                cancel_callback=lambda _: CancelResponse.ACCEPT,
            )

    def sense(self, request, response):
        """Perform a sensing action."""
        with self._moving:
            response.message = self._unfit(request)
            response.success = not response.message
            if response.success:
                # Your robot: touch, measure, and return what was measured.
                response.observation = self._world.perform_sensing(request.sensing_action).tolist()
        return response

    def tell(self, request, response):
        """Begin a trial if that is wanted, and tell how far it is."""
        with self._moving:
            if request.begin:
                # Your robot: move to the start.
                self._trial, self._world = (
                    request.trial,
                    SimulatedEnvironment(self._problem, self._seed, request.trial),
                )
                self._remember([])
            elif request.trial != self._trial:
                response.message = f"the robot is in trial {self._trial}, not in {request.trial}"
                return response
            response.success = True
            response.steps = self._world.step
            response.done = self._world.is_done() is True  # your robot: has the task succeeded?
        return response

    def act_service(self, request, response):
        """Perform a task action, as a service."""
        with self._moving:
            response.message = self._unfit(request)
            response.success = not response.message
            response.reward = math.nan
            if response.success:
                time.sleep(self.motion_s)
                response.reward = self._perform(request.task_action)
        return response

    def act_action(self, goal):
        """Perform a task action, as an action: it can be cancelled."""
        result = Act.Result(reward=math.nan)
        with self._moving:
            result.message = self._unfit(goal.request)
            if result.message:
                goal.abort()
                return result
            # Your robot: move, and look now and then whether it shall stop.
            begun = time.monotonic()
            while (gone := time.monotonic() - begun) < self.motion_s:
                if goal.is_cancel_requested:
                    # This one has not moved yet. One that has must count the action.
                    result.message = "cancelled before the robot moved"
                    goal.canceled()
                    return result
                goal.publish_feedback(Act.Feedback(part=gone / self.motion_s))
                time.sleep(min(0.05, self.motion_s - gone))
            result.reward = self._perform(goal.request.task_action)
            result.success = True
            goal.succeed()
        return result

    def _perform(self, action):
        reward = self._world.perform(np.array(action))
        self._remember([*self._performed, list(action)])
        return math.nan if reward is None else reward

    def _unfit(self, request):
        """Return why a request does not belong here; empty if it does."""
        if (request.trial, request.step) != (self._trial, self._world.step):
            return (
                f"the robot is in trial {self._trial}, step {self._world.step}; the request is for "
                f"trial {request.trial}, step {request.step}"
            )
        return ""

    def _restore(self):
        known = {"trial": 0, "performed": []}
        if self._log is not None and self._log.exists():
            known = json.loads(self._log.read_text())
        self._trial, self._performed = known["trial"], known["performed"]
        actions = [np.array(action) for action in self._performed]
        self._world = SimulatedEnvironment.after(self._problem, self._seed, self._trial, actions)

    def _remember(self, performed):
        self._performed = performed
        if self._log is not None:
            # The old file or the new one, whenever this is killed.
            new = self._log.with_suffix(".new")
            new.write_text(json.dumps({"trial": self._trial, "performed": performed}))
            new.replace(self._log)


def main():
    """Run the robot until it is interrupted."""
    rclpy.init()
    try:
        executor = MultiThreadedExecutor(num_threads=4)
        executor.add_node(SimulatedRobot())
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except HoldfastError as error:
        raise SystemExit(f"simulated_robot: {error}") from error


if __name__ == "__main__":
    main()
