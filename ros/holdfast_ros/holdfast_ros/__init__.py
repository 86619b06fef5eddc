"""holdfast in ROS 1 and ROS 2: the node, the robot behind ROS, the typed service and its client.

holdfast itself imports none of it, and importing this package imports no ROS.
"""
