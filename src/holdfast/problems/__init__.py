"""The problems: what the robot is to do, as plain objects of NumPy functions.

:mod:`holdfast.problems.problem` says what a problem is, :mod:`holdfast.config.registry` finds one
by its name, and each other public module is one problem or what several have in common.
"""
