"""A ROS 1 master that may die.

:mod:`~ros1_master_guard.guard` watches and replaces it, :mod:`~ros1_master_guard.process` is
the master, which tells its guard of every change, and :mod:`~ros1_master_guard.command` is the
command.
"""
