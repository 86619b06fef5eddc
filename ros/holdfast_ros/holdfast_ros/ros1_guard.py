"""``holdfast ros1-guard``: a ROS 1 master that may die (:mod:`ros1_master_guard`)."""

from __future__ import annotations

from collections.abc import Sequence

SUMMARY = "Keep a ROS 1 master alive."
IS_SERVICE = True


def main(arguments: Sequence[str]) -> int:
    """Guard until a signal comes, and return the exit code."""
    from ros1_master_guard.command import main

    return main(arguments, "holdfast ros1-guard")
