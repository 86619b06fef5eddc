"""``holdfast serve``, so that the list of commands has it; :func:`holdfast.cli.main` runs it."""

from __future__ import annotations

import typer

__all__ = ["serve"]


def serve(context: typer.Context) -> None:
    """Decide for robots, as a service; see holdfast serve --help."""
    from holdfast.cli.ros_services import make_ros_services
    from holdfast.service.process import main

    raise typer.Exit(main(context.args, make_ros_services))
