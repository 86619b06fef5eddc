"""A ROS 1 master that may die.

:mod:`~ros1_master_guard.guard` watches and replaces it, :mod:`~ros1_master_guard.process` is
the master with a journal, and :mod:`~ros1_master_guard.plan` merges the journal with the nodes'
answers. :mod:`~ros1_master_guard.command` is the command.
"""
