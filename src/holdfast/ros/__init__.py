"""holdfast in ROS 1 and ROS 2, and its recordings as files for ROS's tools.

Nothing outside this package and the commands imports it, and importing it imports no ROS.
"""
