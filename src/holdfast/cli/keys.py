"""``holdfast keys``: makes and revokes credentials, and says what goes where."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from holdfast.errors import CredentialsError
from holdfast.printable import printable
from holdfast.runtime.addresses import host_and_port
from holdfast.runtime.command_line import (
    Options,
    argument,
    bad_value,
    flag,
    location,
    option,
    whole_number,
)

if TYPE_CHECKING:
    from holdfast.transport.key_ring import Issued, KeyRing


# Those of holdfast.transport.key_ring, which need not be imported for a --help.
_DEFAULT_DAYS = 365
_MAX_DAYS = 3650


def _serial(text: str) -> int:
    try:
        return int(text.replace(":", ""), 16)
    except ValueError:
        raise bad_value(text, "hexadecimal numbers; --list shows them") from None


class KeysOptions(Options):
    """Make keys by which robots and services know each other, and revoke them.

    Without names: one robot and one service. Again with other names: more of the same authority.
    What exists stays as it is. --renew replaces its certificate, --rotate its key as well.

    --revoke writes revoked.pem into each directory. Copied to a service it takes effect within
    seconds (with the signal SIGHUP at once), copied to a robot with its next connection. Together
    with --rotate it revokes the certificates of before.
    """

    needs_arguments = True

    directory: Path = argument("DIR", "Where they go; made if it is missing.", location)
    robot: tuple[str, ...] = option(metavar="NAME", many=True, help="A robot that gets a key.")
    service: tuple[str, ...] = option(metavar="NAME", many=True, help="A service that gets a key.")
    host: tuple[str, ...] = option(
        metavar="NAME_OR_IP",
        many=True,
        help="Where robots reach the services, besides this machine.",
    )
    days: int = option(
        metavar="N",
        read=whole_number(1, _MAX_DAYS),
        default=_DEFAULT_DAYS,
        help="How long they are valid.",
    )
    renew: bool = flag(help="New certificates for existing keys.")
    rotate: bool = flag(help="New keys and certificates for those that have some.")
    revoke: tuple[str, ...] = option(
        metavar="NAME", many=True, help="A robot or service whose certificates are no longer valid."
    )
    revoke_serial: tuple[int, ...] = option(
        metavar="HEX",
        read=_serial,
        many=True,
        help="The number of one certificate that is no longer valid.",
    )
    list: bool = flag(help="List what was ever made, and what is revoked.")


def main(arguments: Sequence[str]) -> int:
    """Make, revoke or list credentials, and return the exit code."""
    options = KeysOptions.parse("keys", arguments)
    from holdfast.transport import key_ring

    def warn(text: str) -> None:
        sys.stderr.write(f"warning: {printable(text)}\n")

    directory = options.directory
    revokes = bool(options.revoke or options.revoke_serial)
    makes = options.robot or options.service or options.renew or options.rotate
    makes = makes or not (revokes or options.list)
    if options.host and not makes:
        raise CredentialsError(
            f"--host {options.host[0]}: stands in a service's certificate, and --revoke and --list "
            "make none; leave it out, or add --renew --service NAME"
        )
    with key_ring.alone_in(directory, warn=warn):
        if revokes:
            revoked = key_ring.revoke_credentials(
                directory, names=options.revoke, serials=options.revoke_serial, warn=warn
            )
            sys.stdout.write(_account_of_revocation(directory, revoked))
        if makes:
            ring = key_ring.make_credentials(
                directory,
                robots=options.robot,
                services=options.service,
                hosts=options.host,
                days=options.days,
                renew=options.renew,
                rotate=options.rotate,
                warn=warn,
            )
            sys.stdout.write(_account(ring, *options.host[:1]))
        if options.list:
            listed = key_ring.list_credentials(directory)
            sys.stdout.write("".join(f"{_line_of(each)}\n" for each in listed))
    return 0


def _account_of_revocation(directory: Path, revoked: Sequence[Issued]) -> str:
    """Return what was revoked, where the list must be, and from when on it holds."""
    lines = [f"revoked: certificate {_line_of(each)}" for each in revoked]
    lines = lines or ["All of these were revoked before; the list stays as it is."]
    lines += [
        "",
        f"An end that lacks {directory / 'authority' / 'revoked.pem'} still admits them: copy it "
        "beside the certificate.pem of each service; if a service is revoked, of each robot too.",
        "'holdfast serve' reads it within seconds, at SIGHUP at once (under systemd: systemctl "
        "reload holdfast-cloud), and logs 'credentials reloaded'; their links end, others go on.",
        f"For a new key: holdfast keys {directory} --rotate --robot NAME (or --service NAME)",
    ]
    return "\n".join(lines) + "\n"


def _line_of(issued: Issued) -> str:
    """Describe a certificate on one line."""
    parts = [f"{issued.serial:040x}"]
    if issued.role is not None:
        parts.append(f"{issued.role} {issued.name!r}")
    if issued.expires is not None:
        parts.append(f"valid until {issued.expires:%Y-%m-%d}")
    if issued.revoked is not None:
        parts.append(f"revoked on {issued.revoked:%Y-%m-%d}")
    return ", ".join(parts)


def _account(ring: KeyRing, host: str = "HOST") -> str:
    """Return what was made, and where it belongs; robots call the services at a host."""
    lines = []
    for made in ring.made:
        path = made.directory / "certificate.pem" if made.renewed else f"{made.directory}/"
        reached = f", reached at {', '.join(made.hosts)}" if made.hosts else ""
        until = made.expires.strftime("%Y-%m-%d")
        lines.append(f"made: {path} for {made.role} {made.name!r}, valid until {until}{reached}")
    if any(made.renewed for made in ring.made):
        lines += [
            "",
            "Copy each certificate.pem over the old one. Services read it within "
            "seconds, and at once with the signal SIGHUP.",
        ]
    endpoint = f"tls/{host_and_port(host, 7447)}"
    commands = [
        f"  holdfast serve --listen tls/0.0.0.0:7447 --tls {made.directory}"
        if made.role == "service"
        else f"  holdfast run CONFIG --service {endpoint} --tls {made.directory}"
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
        f"{ring.authority_key} stays here (valid until {until}): it makes keys for anyone.",
    ]
    return "\n".join(lines) + "\n"
