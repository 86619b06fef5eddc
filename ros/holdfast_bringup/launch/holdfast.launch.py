"""Start holdfast's node and, unless told otherwise, a simulated robot and a service that decides.

    ros2 launch holdfast_bringup holdfast.launch.py
    ros2 action send_goal /holdfast/run holdfast_interfaces/action/Run '{}'

A robot of one's own, with services that run elsewhere:

    ros2 launch holdfast_bringup holdfast.launch.py robot:=false service:=false \
        configuration:=$PWD/my_robot.yaml parameters:=$PWD/my_parameters.yaml
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

PACKAGE = "holdfast_bringup"


def share(*parts):
    """Return a file of this package."""
    return PathJoinSubstitution([FindPackageShare(PACKAGE), *parts])


ARGUMENTS = {
    "configuration": (share("config", "peg_in_hole_2d.yaml"), "file with problem and settings"),
    "parameters": (share("config", "holdfast.yaml"), "parameters of the nodes"),
    "namespace": ("", "namespace of the nodes"),
    "use_sim_time": ("false", "take the time from /clock"),
    "log_level": ("info", "least level that the nodes log"),
    "respawn": ("false", "start the node again when its process ends; with autostart"),
    "autostart": ("true", "configure and activate the node"),
    "lifecycle_manager": ("false", "have Nav2's lifecycle manager do that, with a bond"),
    "robot": ("true", "start the simulated robot"),
    "service": ("true", "start a service that decides"),
    "listen": ("tcp/127.0.0.1:7447", "where that service is reached"),
    "rviz": ("false", "show the belief"),
}
"""Default and description."""


def generate_launch_description():
    """Return what is started."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=processes)])


def processes(context):
    """Return the processes, by the arguments' values."""
    text = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    flag = {name: value.lower() in ("true", "1") for name, value in text.items()}
    managed = flag["lifecycle_manager"]
    clock = {"use_sim_time": flag["use_sim_time"]}
    parameters = [text["parameters"], {"configuration": text["configuration"], **clock}]
    services = [{"offload.services": [text["listen"]]}] if flag["service"] else []

    def node(package, executable, name, parameters, **words):
        words |= {"namespace": text["namespace"], "output": "screen", "parameters": parameters}
        level = ["--ros-args", "--log-level", text["log_level"]]
        return Node(package=package, executable=executable, name=name, arguments=level, **words)

    ours = [*parameters, {"autostart": flag["autostart"] and not managed}, *services]
    started = [node("holdfast_ros", "node", "holdfast", ours, respawn=flag["respawn"])]
    if flag["robot"]:
        started.append(node(PACKAGE, "simulated_robot", "simulated_robot", parameters))
    if managed:
        managing = {
            "autostart": flag["autostart"],
            "node_names": ["holdfast"],
            "bond_timeout": 4.0,
            "attempt_respawn_reconnection": flag["respawn"],
            **clock,
        }
        manager = "nav2_lifecycle_manager", "lifecycle_manager", "lifecycle_manager_holdfast"
        started.append(node(*manager, [managing]))
    if flag["service"]:
        command = ["holdfast", "serve", "--listen", text["listen"]]
        started.append(ExecuteProcess(cmd=command, output="screen"))
    if flag["rviz"]:
        layout = share("rviz", "holdfast.rviz")
        started.append(Node(package="rviz2", executable="rviz2", arguments=["-d", layout]))
    return started
