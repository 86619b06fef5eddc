"""``holdfast ros1-serve``: ``holdfast serve``, which offers the typed service of ROS 1 as well."""

from __future__ import annotations

from collections.abc import Sequence

SUMMARY = "Decide for robots in ROS 1, as a service."
IS_SERVICE = True


def main(arguments: Sequence[str]) -> int:
    """Serve until a signal ends it, and return the exit code."""
    from holdfast_ros.ros1_process import main

    return main(arguments)
