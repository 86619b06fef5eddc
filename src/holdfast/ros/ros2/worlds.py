"""The environment of the node's robot: simulated, an executive's, or a robot behind ROS."""

from __future__ import annotations

import functools
from typing import Any

from holdfast.config.loader import Configuration
from holdfast.robot.environment import EnvironmentMaker, load_environment
from holdfast.ros.executive import DecideCode, DecisionHandover, ExecutiveMaker
from holdfast.ros.ros2.parameters import NodeParameters
from holdfast.ros.ros2.run_segment import World

__all__ = ["make_world"]


def make_world(node: Any, parameters: NodeParameters) -> World:
    """Make what the parameters name, for one segment of a run.

    Raises
    ------
    HoldfastError
        If that cannot be; the message names the parameter.
    """
    configuration = parameters.configuration
    if parameters.environment == "configuration":
        return World(load_environment(configuration), lambda _: None)
    # Other threads than the robot's use it.
    problem = Configuration.from_plain(configuration.plain()).problem
    timeout_ms = configuration.environment.timeout_ms
    if parameters.environment == "executive":
        handover = DecisionHandover(problem, configuration.planning.sensing_interval)
        return World(
            ExecutiveMaker(handover, configuration.problem, timeout_ms),
            functools.partial(handover.end, DecideCode.ENDED),
            interrupt_at_once=True,
            handover=handover,
        )
    from holdfast.ros.robot_interface import RobotInterface
    from holdfast.ros.ros2_environment import cancel_ros_environments, make_ros_environment

    # Invalid parameters are reported now, not when a trial begins.
    RobotInterface(parameters.mapping, problem.sensing_actions, problem.action_size)
    make: Any = functools.partial(make_ros_environment, node, parameters.mapping)
    maker = EnvironmentMaker("the robot", problem, configuration.simulator.seed, timeout_ms, make)

    return World(maker, lambda _: cancel_ros_environments(node))
