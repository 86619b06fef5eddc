"""A ROS 1 master that may die.

:mod:`~holdfast.ros.master.guard` watches and replaces it, :mod:`~holdfast.ros.master.process` is
the master with a journal, and :mod:`~holdfast.ros.master.plan` merges the journal with the nodes'
answers. ``holdfast ros1-guard`` is the command.
"""
