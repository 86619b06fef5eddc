"""``holdfast keys``: makes and revokes credentials, and says what goes where."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from holdfast.cli.options import location, whole_number
from holdfast.errors import InvalidValueError
from holdfast.printable import printable

if TYPE_CHECKING:
    from holdfast.transport.key_ring import Issued, KeyRing, Revocation

__all__ = ["keys"]

# Those of holdfast.transport.key_ring, which need not be imported for a --help.
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
    rotate: Annotated[
        bool,
        typer.Option("--rotate", help="New keys and certificates for those that have some."),
    ] = False,
    revoke: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="A robot or service whose certificates are valid no more; may be repeated.",
        ),
    ] = None,
    revoke_serial: Annotated[
        list[str] | None,
        typer.Option(
            metavar="HEX",
            help="The number of one certificate that is valid no more; may be repeated.",
        ),
    ] = None,
    list_: Annotated[
        bool,
        typer.Option("--list", help="Say what was ever made, and what is revoked."),
    ] = False,
) -> None:
    """Make keys by which robots and services know each other, and revoke them.

    Without names: one robot and one service. Again with other names: more of the same authority.
    What is there already stays as it is, unless --renew or --rotate is said; then its certificate
    is replaced, and its key stays or is replaced, too.

    --revoke writes revoked.pem into each directory. Copied to a service it takes effect within
    seconds (with the signal SIGHUP at once), copied to a robot with its next connection. Together
    with --rotate, what is revoked are the certificates of before.
    """
    from holdfast.transport.key_ring import (
        alone_in,
        list_credentials,
        make_credentials,
        revoke_credentials,
    )

    def warn(text: str) -> None:
        typer.echo(f"warning: {printable(text)}", err=True)

    revokes = bool(revoke or revoke_serial)
    with alone_in(directory, warn=warn):
        if revokes:
            done = revoke_credentials(
                directory, names=revoke or (), serials=_numbers(revoke_serial or ()), warn=warn
            )
            sys.stdout.write(_account_of_revocation(directory, done))
        if robot or service or renew or rotate or not (revokes or list_):
            ring = make_credentials(
                directory,
                robots=robot or (),
                services=service or (),
                hosts=host or (),
                days=days,
                renew=renew,
                rotate=rotate,
                warn=warn,
            )
            sys.stdout.write(_account(ring))
        if list_:
            listed = list_credentials(directory)
            sys.stdout.write("".join(f"{_line_of(each)}\n" for each in listed))


def _numbers(texts: Sequence[str]) -> list[int]:
    numbers = []
    for text in texts:
        try:
            numbers.append(int(text.replace(":", ""), 16))
        except ValueError:
            raise InvalidValueError(
                f"--revoke-serial: {text!r} is no hexadecimal number; --list shows them"
            ) from None
    return numbers


def _account_of_revocation(directory: Path, done: Revocation) -> str:
    """Say what was revoked, and what is to be done with the list."""
    lines = [f"revoked: {_line_of(each)}" for each in done.revoked]
    if not lines:
        return "All of these were revoked already; nothing was changed.\n"
    lines += [
        "",
        f"Copy {directory / 'NAME' / 'revoked.pem'} to each service and robot, beside its "
        "certificate.pem.",
        "Each 'holdfast serve' notices within seconds, and at once with the signal SIGHUP: links "
        "of what is revoked end, others go on.",
    ]
    return "\n".join(lines) + "\n"


def _line_of(issued: Issued) -> str:
    """Say what is known of a certificate, on one line."""
    parts = [f"{issued.serial:040x}"]
    if issued.role is not None:
        parts.append(f"{issued.role} {issued.name!r}")
    if issued.expires is not None:
        parts.append(f"valid until {issued.expires:%Y-%m-%d}")
    if issued.revoked is not None:
        parts.append(f"revoked on {issued.revoked:%Y-%m-%d}")
    return ", ".join(parts)


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
            "Copy each certificate.pem over the old one. Services read it within "
            "seconds, and at once with the signal SIGHUP.",
        ]
    commands = [
        f"  holdfast serve --listen tls/0.0.0.0:7447 --tls {made.directory}"
        if made.role == "service"
        else f"  holdfast run CONFIG --service tls/HOST:7447 --tls {made.directory}"
        for made in ring.made
        if not made.renewed
    ]
    if commands:
        lines += [
            "",
            "Copy each directory to its machine, where only its owner can read it. There:",
            *commands,
        ]
    until = ring.authority_expires.strftime("%Y-%m-%d")
    lines += [
        "",
        f"{ring.authority_key} stays here (valid until {until}): whoever has it can make more.",
    ]
    return "\n".join(lines) + "\n"
