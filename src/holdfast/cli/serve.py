"""``holdfast serve``: brings the service and what it may offer to ROS together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from holdfast.service import process

if TYPE_CHECKING:
    from holdfast.service.options import ServeOptions
    from holdfast.service.process import Extension

__all__ = ["main"]


def main(arguments: Sequence[str]) -> int:
    """Serve until a signal ends it, and return the exit code."""
    return process.main(arguments, _make_extensions)


def _make_extensions(options: ServeOptions) -> Sequence[Extension]:
    from holdfast.cli.ros_services import make_ros_services

    return make_ros_services(options)
