"""Start holdfast's node and, unless told otherwise, a simulated robot and a service that decides.

    ros2 launch holdfast_bringup holdfast.launch.py
    ros2 action send_goal /holdfast/run holdfast_interfaces/action/Run '{}'

A robot of one's own, with services that run elsewhere:

    ros2 launch holdfast_bringup holdfast.launch.py robot:=false service:=false \
        configuration:=$PWD/my_robot.yaml parameters:=$PWD/my_parameters.yaml
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

PACKAGE = "holdfast_bringup"


def share(*parts):
    """Return a file of this package."""
    return PathJoinSubstitution([FindPackageShare(PACKAGE), *parts])


def argument(name, default, description):
    """Return an argument of the launch file."""
    return DeclareLaunchArgument(name, default_value=default, description=description)


def generate_launch_description():
    """Return what is started."""
    configuration = {"configuration": LaunchConfiguration("configuration")}
    parameters = LaunchConfiguration("parameters")
    return LaunchDescription(
        [
            argument(
                "configuration",
                share("config", "peg_in_hole_2d.yaml"),
                "file with problem and settings",
            ),
            argument("parameters", share("config", "holdfast.yaml"), "parameters of the nodes"),
            argument("autostart", "true", "configure and activate the node"),
            argument("robot", "true", "start the simulated robot"),
            argument("service", "true", "start a service that decides"),
            argument("listen", "tcp/127.0.0.1:7447", "where that service is reached"),
            argument("rviz", "false", "show the belief"),
            Node(
                package="holdfast_ros",
                executable="node",
                name="holdfast",
                parameters=[
                    parameters,
                    configuration,
                    {"autostart": LaunchConfiguration("autostart")},
                ],
                output="screen",
            ),
            Node(
                package=PACKAGE,
                executable="simulated_robot",
                name="simulated_robot",
                parameters=[parameters, configuration],
                output="screen",
                condition=IfCondition(LaunchConfiguration("robot")),
            ),
            ExecuteProcess(
                cmd=["holdfast", "serve", "--listen", LaunchConfiguration("listen")],
                output="screen",
                condition=IfCondition(LaunchConfiguration("service")),
            ),
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["-d", share("rviz", "holdfast.rviz")],
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
        ]
    )
