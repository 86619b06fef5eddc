"""What the node's robot acts on."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

from holdfast.configuration import Configuration
from holdfast.ros.executive import Code, Executive, ExecutiveMaker
from holdfast.ros.ros2.parameters import Parameters
from holdfast.runtime.environment import EnvironmentMaker, load_environment

__all__ = ["World", "make_world"]


class World(NamedTuple):
    """What one part of a run acts on.

    Attributes
    ----------
    maker : EnvironmentMaker
    interrupt : callable
        Ends the call of the environment that goes on, if that can be; given the reason.
    interrupt_at_once : bool
        Whether that costs nothing, because what was interrupted is asked for again.
    executive : Executive or None
        Where calls of ``~/decide`` meet the run; None where the node itself performs.
    """

    maker: EnvironmentMaker
    interrupt: Callable[[str], None]
    interrupt_at_once: bool = False
    executive: Executive | None = None


def make_world(node: Any, parameters: Parameters) -> World:
    """Make what the parameters name, for one part of a run.

    Parameters
    ----------
    node : rclpy.node.Node
    parameters : Parameters

    Raises
    ------
    HoldfastError
        If that cannot be; the message names the parameter.
    """
    configuration = parameters.configuration
    if parameters.environment == "configuration":
        return World(load_environment(configuration), _nothing)
    # Other threads than the robot's use it.
    problem = Configuration.from_plain(configuration.plain()).problem
    timeout_ms = configuration.environment.timeout_ms
    if parameters.environment == "executive":
        executive = Executive(problem, configuration.planning.sensing_interval)
        return World(
            ExecutiveMaker(executive, configuration.problem, timeout_ms),
            functools.partial(executive.end, Code.ENDED),
            interrupt_at_once=True,
            executive=executive,
        )
    from holdfast.ros.robot_interface import RobotInterface
    from holdfast.ros.ros2_environment import cancel_ros_environments, make_ros_environment

    # What is wrong with the parameters is to be said now, not when a trial begins.
    RobotInterface(parameters.mapping, problem.sensing_actions, problem.action_size)
    make: Any = functools.partial(make_ros_environment, node, parameters.mapping)
    maker = EnvironmentMaker("the robot", problem, configuration.simulator.seed, timeout_ms, make)

    def interrupt(why: str) -> None:
        del why
        cancel_ros_environments(node)

    return World(maker, interrupt)


def _nothing(why: str) -> None:
    pass
