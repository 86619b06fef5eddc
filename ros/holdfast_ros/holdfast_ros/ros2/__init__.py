"""The robot's part as a node of ROS 2: ``python -m holdfast_ros.ros2``.

It runs inside the user's own ROS 2, with any RMW, and needs rclpy and the package
``holdfast_interfaces`` from there. Only :mod:`holdfast_ros.ros2.node` imports them.
"""
