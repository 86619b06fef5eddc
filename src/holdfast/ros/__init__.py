"""holdfast for robots that speak ROS, 1 and 2, and for those who look at their recordings.

Nothing outside this package and the commands imports it, and importing it imports no ROS.
"""
