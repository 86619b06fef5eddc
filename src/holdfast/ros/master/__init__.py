"""A ROS 1 master that may die.

:mod:`~holdfast.ros.master.guard` watches and replaces it, :mod:`~holdfast.ros.master.process` is
the master, which remembers, and :mod:`~holdfast.ros.master.plan` merges what it remembers with
what nodes say. ``holdfast ros1-guard`` is the command.
"""
