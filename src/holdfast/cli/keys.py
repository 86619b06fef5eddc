"""``holdfast keys``: makes credentials, and says what goes where."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from holdfast.cli.options import location, whole_number
from holdfast.printable import printable

if TYPE_CHECKING:
    from holdfast.runtime.credentials import KeyRing

__all__ = ["keys"]

# Those of holdfast.runtime.credentials, which need not be imported for a --help.
_DEFAULT_DAYS = 365
_MAX_DAYS = 3650


def keys(
    directory: Annotated[
        Path,
        typer.Argument(
            metavar="DIR",
            parser=location("DIR"),
            show_default=False,
            help="Where they go; made if it is not there.",
        ),
    ],
    robot: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="A robot that gets a key; may be repeated."),
    ] = None,
    service: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="A service that gets a key; may be repeated."),
    ] = None,
    host: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME_OR_IP",
            help="Where robots reach the services, besides this machine; may be repeated.",
        ),
    ] = None,
    days: Annotated[
        int,
        typer.Option(
            metavar="N",
            parser=whole_number("--days", 1, _MAX_DAYS),
            help="How long they are valid.",
        ),
    ] = _DEFAULT_DAYS,
    renew: Annotated[
        bool,
        typer.Option("--renew", help="New certificates for keys that are there already."),
    ] = False,
) -> None:
    """Make keys by which robots and services know each other.

    Without names: one robot and one service. Again with other names: more of the same authority.
    What is there already stays as it is, unless --renew is said; then its certificate is replaced,
    and its key stays.
    """
    from holdfast.runtime.credentials import make_credentials

    ring = make_credentials(
        directory,
        robots=robot or (),
        services=service or (),
        hosts=host or (),
        days=days,
        renew=renew,
        warn=lambda text: typer.echo(f"warning: {printable(text)}", err=True),
    )
    sys.stdout.write(_account(ring))


def _account(ring: KeyRing) -> str:
    """Say what was made, and where it belongs."""
    lines = []
    for made in ring.made:
        path = made.directory / "certificate.pem" if made.renewed else f"{made.directory}/"
        reached = f", reached at {', '.join(made.hosts)}" if made.hosts else ""
        until = made.expires.strftime("%Y-%m-%d")
        lines.append(f"{path} for {made.role} {made.name!r}, valid until {until}{reached}")
    if any(made.renewed for made in ring.made):
        lines += [
            "",
            "Copy each certificate.pem over the old one. Services read it when they start.",
        ]
    examples = {made.role: made.directory for made in ring.made if not made.renewed}
    if examples:
        lines += [
            "",
            "Copy each directory to its machine, where only its owner can read it. There:",
        ]
    if "service" in examples:
        lines.append(f"  holdfast serve --listen tls/0.0.0.0:7447 --tls {examples['service']}")
    if "robot" in examples:
        lines.append(f"  holdfast run CONFIG --service tls/HOST:7447 --tls {examples['robot']}")
    until = ring.authority_expires.strftime("%Y-%m-%d")
    lines += [
        "",
        f"{ring.authority_key} stays here (valid until {until}): whoever has it can make more.",
    ]
    return "\n".join(lines) + "\n"
