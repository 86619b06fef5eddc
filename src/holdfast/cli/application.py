"""All commands together, as ``holdfast --help`` lists them.

A command is a function in a module of its own; this one gives it its name and nothing else.
"""

from __future__ import annotations

import shlex
import sys
from typing import Annotated

import typer

from holdfast.cli.chaos import chaos
from holdfast.cli.compare import compare
from holdfast.cli.demo import demo
from holdfast.cli.doctor import doctor
from holdfast.cli.endings import EXIT_ERROR
from holdfast.cli.experiment import experiment
from holdfast.cli.export import export
from holdfast.cli.keys import keys
from holdfast.cli.ros1_guard import ros1_guard
from holdfast.cli.run import run
from holdfast.cli.serve import serve
from holdfast.cli.simulate import simulate
from holdfast.errors import HoldfastError

__all__ = ["app", "run_application"]

app = typer.Typer(
    name="holdfast",
    help=(
        "Action-entropy active sensing: choose what to sense by how much it decides what to do, "
        "and decide the same, bit for bit, on every machine."
    ),
    epilog="Start with: holdfast run examples/peg_in_hole_2d.yaml",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # its tables give flags a value and take a third of the columns
    context_settings={"help_option_names": ["-h", "--help"]},
)

app.command(no_args_is_help=True, short_help="Run the trials of a configuration.")(run)
app.command(
    short_help="Decide for robots, as a service.",
    # It reads its own arguments, the one for help as well.
    context_settings={
        "allow_extra_args": True,
        "ignore_unknown_options": True,
        "help_option_names": [],
    },
)(serve)
app.command(no_args_is_help=True, short_help="Say what works on the way to a service.")(doctor)
app.command(short_help="See a cloud and a robot killed, and no decision change.")(demo)
app.command(short_help="Strike real runs with real faults, and compare them.")(chaos)
app.command(no_args_is_help=True, short_help="Regenerate the tables and figures.")(experiment)
app.command(no_args_is_help=True, short_help="Tell whether two runs decided the same.")(compare)
app.command(no_args_is_help=True, short_help="Write a run for RViz, Foxglove, or as tables.")(
    export
)
app.command(short_help="Search for faults that change a decision.")(simulate)
app.command(no_args_is_help=True, short_help="Make keys for robots and services.")(keys)
app.command("ros1-guard", short_help="Have a ROS 1 master that may die.")(ros1_guard)


def run_application(arguments: list[str]) -> None:
    """Run one command and exit.

    Parameters
    ----------
    arguments : list of str
        What stands after ``holdfast``.

    Raises
    ------
    HoldfastError
        If the command fails in a way that is no defect.
    SystemExit
        Else, with the exit code.
    """
    first = arguments[0] if arguments else ""
    if first.endswith((".yaml", ".yml")):
        command = shlex.join(["holdfast", "run", *arguments])
        raise HoldfastError(f"{first} is no command; did you mean: {command}")
    try:
        code = app(args=arguments, prog_name="holdfast", standalone_mode=False)
    except typer.Abort as error:
        raise KeyboardInterrupt from error
    except Exception as error:
        # Typer has had more than one place for the classes of what it has to say of options.
        message = getattr(error, "format_message", None)
        if not callable(message):
            raise
        if type(error).__name__ == "NoArgsIsHelpError":
            typer.echo(message(), err=True)
            sys.exit(EXIT_ERROR)
        raise HoldfastError(message()) from error
    sys.exit(code)


def _print_version(wanted: bool) -> None:
    if wanted:
        from holdfast.recording.machine import machines
        from holdfast.source_digest import core_version

        typer.echo(f"holdfast {core_version()} ({machines()} state machines)")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool,
        typer.Option(
            "--version",
            callback=_print_version,
            is_eager=True,
            help="Show the version and exit.",
        ),
    ] = False,
) -> None:
    del version
