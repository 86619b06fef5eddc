"""``holdfast doctor``: what works between this robot and its services, and what does not."""

from __future__ import annotations

import shutil
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from holdfast.cli.exit_codes import EXIT_DIFFERENT
from holdfast.errors import HoldfastError
from holdfast.runtime.command_line import Options, argument, flag, location, option

if TYPE_CHECKING:
    from holdfast.robot.doctor import LayerFinding

__all__ = ["main"]

_COLORS = {"ok": 32, "warns": 33, "fails": 31}
"""Of a terminal: green, yellow, red."""

_INDENT = 22
_WIDEST = 110


class DoctorOptions(Options):
    """Check layer by layer what works between this robot and a service, and what to do.

    The layers: name, route, port, TLS, certificate, protocol, datagrams (over udp), clock, problem
    (with CONFIG) and round trip. Layers above the first one that fails are not reached. It takes at
    most ten seconds for each service.
    """

    exit_codes: ClassVar = {0: "all layers work, perhaps with a warning", 1: "a layer fails"}
    needs_arguments = True

    configuration: Path | None = argument(
        "CONFIG",
        "Configuration of a run: its decisions are compared with the service's.",
        location,
        least=0,
    )
    service: tuple[str, ...] = option(
        "-s",
        metavar="ENDPOINT",
        many=True,
        help="The service (tls/cloud.example.org:7447), instead of CONFIG's.",
    )
    tls: Path | None = option(
        metavar="DIR",
        read=location,
        help="This robot's credentials, instead of CONFIG's.",
    )
    json: bool = flag(help="Print each finding as a JSON object, one a line.")


def main(arguments: Sequence[str]) -> int:
    """Check the layers and return the exit code."""
    options = DoctorOptions.parse("doctor", arguments)
    import asyncio
    import functools

    import msgspec

    from holdfast.config.loader import load
    from holdfast.config.settings import OffloadSettings
    from holdfast.robot.doctor import RobotSetup, check, examine
    from holdfast.robot.probe import in_thread
    from holdfast.robot.reference_decisions import reference_decisions

    configuration = None if options.configuration is None else load(options.configuration)
    tls = options.tls
    offload = OffloadSettings() if configuration is None else configuration.offload
    if tls is None and offload.tls is not None:
        tls = Path(offload.tls)
    endpoints = [check(each, tls) for each in options.service or offload.services]
    if not endpoints:
        raise HoldfastError("no service is named: give --service ENDPOINT, or CONFIG one")
    decisions = None
    if configuration is not None:
        decisions = in_thread(functools.partial(reference_decisions, configuration))
    robot = RobotSetup(offload.name or ("" if tls else "doctor"), tls, offload, decisions)
    fails = False
    for endpoint in endpoints:

        def show(finding: LayerFinding, service: str = str(endpoint)) -> None:
            nonlocal fails
            fails = fails or finding.state == "fails"
            if options.json:
                line = {"service": service, **finding._asdict()}
                sys.stdout.write(msgspec.json.encode(line).decode() + "\n")
            else:
                sys.stdout.write(f"{_as_text(finding)}\n")
            sys.stdout.flush()

        if not options.json:
            sys.stdout.write(f"{endpoint}\n")
        asyncio.run(examine(endpoint, robot, show))
    return EXIT_DIFFERENT if fails else 0


def _as_text(finding: LayerFinding) -> str:
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
    if sys.stdout.isatty():
        state = f" {finding.state:<6} "
        colored = f"\x1b[{_COLORS[finding.state]}m{state}\x1b[0m"
        lines[0] = lines[0].replace(state, colored, 1)
    return "\n".join(lines)
