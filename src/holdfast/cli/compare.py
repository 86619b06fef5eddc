"""``holdfast compare``: whether two runs decided the same."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from holdfast.cli.endings import EXIT_DIFFERENT
from holdfast.cli.options import location
from holdfast.printable import printable

__all__ = ["compare"]


def compare(
    first: Annotated[
        Path,
        typer.Argument(
            metavar="RUN",
            parser=location("RUN"),
            show_default=False,
            help="Directory of a run, or its journal.",
        ),
    ],
    second: Annotated[
        Path,
        typer.Argument(
            metavar="RUN",
            parser=location("RUN"),
            show_default=False,
            help="The other one, likewise.",
        ),
    ],
    json: Annotated[
        bool, typer.Option("--json", help="Print the finding as a JSON object.")
    ] = False,
) -> None:
    """Tell whether two runs decided the same, and where they first differ.

    All trials are compared: each sensing action, each task action bit for bit, and the digests of
    the states. Exit code 0: they decided the same. 1: they did not, or a trial of one is missing or
    unfinished in the other. 2: one of them cannot be read.
    """
    from holdfast.recording.compare import compare_runs

    found = compare_runs(first, second)
    sys.stdout.write(found.to_json() if json else f"{printable(found.describe())}\n")
    if not json:
        for note in found.notes:
            sys.stderr.write(f"note: {printable(note)}\n")
    if not found.identical:
        raise typer.Exit(EXIT_DIFFERENT)
