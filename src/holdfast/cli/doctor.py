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


_COLORS = {"ok": 32, "warns": 33, "fails": 31}
"""Colours of a terminal: green, yellow, red; else its own."""

_WIDEST = 110
_ADVICE = f"{' ' * 19}-> "


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
        metavar="DIR", read=location, help="This robot's credentials, instead of CONFIG's."
    )
    json: bool = flag(help="Print each finding as a JSON object, one a line.")


def main(arguments: Sequence[str]) -> int:
    """Check the layers and return the exit code."""
    options = DoctorOptions.parse("doctor", arguments)
    import asyncio
    import functools

    import msgspec

    from holdfast.config.loader import load
    from holdfast.planning.settings import OffloadSettings
    from holdfast.robot.doctor import Examination
    from holdfast.robot.probe import in_thread
    from holdfast.robot.reference_decisions import reference_decisions
    from holdfast.transport.endpoints import TlsFiles, check_credentials, check_endpoint

    configuration = None if options.configuration is None else load(options.configuration)
    offload = OffloadSettings() if configuration is None else configuration.offload
    if options.tls is not None:
        offload = msgspec.structs.replace(offload, tls=str(options.tls))
    services = options.service or offload.services
    endpoints = [check_endpoint(service, "robot") for service in services]
    if offload.tls is not None:
        for endpoint in endpoints:
            check_credentials(endpoint, TlsFiles.of(Path(offload.tls)))
    if not endpoints:
        raise HoldfastError("no service is named: give --service ENDPOINT, or CONFIG one")
    decisions, problem = None, ""
    if configuration is not None:
        problem = configuration.problem_name
        decisions = in_thread(functools.partial(reference_decisions, configuration))
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
        asyncio.run(Examination(endpoint, offload, decisions, show, problem).run())
    return EXIT_DIFFERENT if fails else 0


def _as_text(finding: LayerFinding) -> str:
    """Return the lines of a finding."""
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    where = f"{finding.address}: " if finding.address else ""
    begins = f"  {finding.layer:<12} {finding.state:<6} "
    lines = []
    for text, indent in ((f"{where}{finding.seen}", begins), (finding.advice, _ADVICE)):
        lines += textwrap.wrap(
            text, width, initial_indent=indent, subsequent_indent=" " * len(begins)
        )
    if sys.stdout.isatty():
        state = f" {finding.state:<6} "
        colored = f"\x1b[{_COLORS.get(finding.state, 0)}m{state}\x1b[0m"
        lines[0] = lines[0].replace(state, colored, 1)
    return "\n".join(lines)
