"""What a ROS 1 master knows of three nodes."""

from ros1_master_guard.process import MasterState

ARM, BASE, LIDAR = "http://robot:1/", "http://robot:2/", "http://robot:3/"


def known() -> MasterState:
    state = MasterState()
    state.parameters = {"run_id": "x", "arm": {"speed": 1}}
    state.publishers = {"/joints": [("/arm", ARM)], "/scan": [("/lidar", LIDAR)]}
    state.subscribers = {"/scan": [("/base", BASE), ("/arm", ARM)]}
    state.services = {
        "/grip": ("/arm", ARM, "rosrpc://robot:11"),
        "/stop": ("/base", BASE, "rosrpc://robot:12"),
    }
    state.types = {"/joints": "sensor_msgs/JointState", "/scan": "sensor_msgs/LaserScan"}
    state.parameter_subscribers = {"/arm/speed/": [("/arm", ARM)]}
    return state
