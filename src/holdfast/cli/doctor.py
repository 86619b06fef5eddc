"""``holdfast doctor``: what works between this robot and its services, and what does not."""

from __future__ import annotations

import shutil
import sys
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from holdfast.cli.endings import EXIT_DIFFERENT
from holdfast.cli.options import location
from holdfast.errors import HoldfastError

if TYPE_CHECKING:
    from holdfast.runtime.doctor import Finding

__all__ = ["doctor"]

_COLORS = {"ok": "green", "warns": "yellow", "fails": "red"}
_INDENT = 22
_WIDEST = 110


def doctor(
    configuration_path: Annotated[
        Path | None,
        typer.Argument(
            metavar="CONFIG",
            parser=location("CONFIG"),
            show_default=False,
            help="Configuration of a run: its decisions are compared with the service's.",
        ),
    ] = None,
    service: Annotated[
        list[str] | None,
        typer.Option(
            "--service",
            "-s",
            metavar="ENDPOINT",
            help="The service (tls/cloud.example.org:7447), instead of CONFIG's; may be repeated.",
            show_default=False,
        ),
    ] = None,
    tls: Annotated[
        Path | None,
        typer.Option(
            "--tls",
            metavar="DIR",
            parser=location("--tls"),
            help="This robot's credentials, instead of CONFIG's.",
            show_default=False,
        ),
    ] = None,
    json: Annotated[
        bool, typer.Option("--json", help="Print each finding as a JSON object, one a line.")
    ] = False,
) -> None:
    """Say layer by layer what works between this robot and a service, and what to do.

    Name, route, port, TLS, certificate, protocol, datagrams (over udp), clock, problem (with
    CONFIG) and round trip: what is above the first layer that fails is not reached. It takes ten
    seconds for each service at most. Exit code 0: all layers work, perhaps with a warning. 1: one
    fails. 2: an option or CONFIG cannot be used.
    """
    import asyncio
    import functools

    import msgspec

    from holdfast.configuration import load
    from holdfast.runtime.doctor import OwnDecisions, RobotSetup, check, examine
    from holdfast.runtime.probe import in_thread
    from holdfast.settings import OffloadSettings

    configuration = None if configuration_path is None else load(configuration_path)
    offload = OffloadSettings() if configuration is None else configuration.offload
    if tls is None and offload.tls is not None:
        tls = Path(offload.tls)
    endpoints = [check(each, tls) for each in service or offload.services]
    if not endpoints:
        raise HoldfastError("no service is named: give --service ENDPOINT, or CONFIG one")
    decisions = None
    if configuration is not None:
        decisions = in_thread(functools.partial(OwnDecisions.of, configuration))
    robot = RobotSetup(offload.name or ("" if tls else "doctor"), tls, offload, decisions)
    fails = False
    for endpoint in endpoints:

        def tell(finding: Finding, service: str = str(endpoint)) -> None:
            nonlocal fails
            fails = fails or finding.state == "fails"
            if json:
                line = {"service": service, **finding._asdict()}
                sys.stdout.write(msgspec.json.encode(line).decode() + "\n")
            else:
                typer.echo(_as_text(finding))
            sys.stdout.flush()

        if not json:
            typer.echo(str(endpoint))
        asyncio.run(examine(endpoint, robot, tell))
    if fails:
        raise typer.Exit(EXIT_DIFFERENT)


def _as_text(finding: Finding) -> str:
    """Return the lines of a finding."""
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    begins = f"  {finding.layer:<12} {finding.state:<6} "
    where = f"{finding.address}: " if finding.address else ""
    lines = textwrap.wrap(
        f"{where}{finding.seen}", width, initial_indent=begins, subsequent_indent=" " * _INDENT
    )
    if finding.advice:
        lines += textwrap.wrap(
            finding.advice,
            width,
            initial_indent=f"{' ' * (_INDENT - 3)}-> ",
            subsequent_indent=" " * _INDENT,
        )
    state = typer.style(f" {finding.state:<6} ", fg=_COLORS.get(finding.state))
    lines[0] = lines[0].replace(f" {finding.state:<6} ", state, 1)
    return "\n".join(lines)
