"""A private authority: makes the keys of robots and services, rotates and revokes them.

Both ends of a link show a certificate, and each accepts only those that its authority has signed.
The authority is one key file, made here, which stays at home; whoever holds it decides who belongs.
A certificate also says what its owner is: a robot's is good for asking only and a service's for
answering only (the field that X.509 calls the extended key usage), so a stolen robot cannot pretend
to be a service to the others. A certificate whose key is lost or stolen is revoked: its number goes
into a list that the authority signs and that lies beside everybody's credentials. What was ever
signed is written down, so that no older certificate of a name is forgotten then.

This module needs the package ``cryptography``; without it, importing raises
:class:`~holdfast.transport.credentials.CredentialsError`. To use what was made takes only
:mod:`holdfast.transport.credentials`.
"""

from __future__ import annotations

import contextlib
import csv
import fcntl
import os
import re
import socket
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from typing import NamedTuple

from holdfast.files import (
    NewFile,
    create_directory_atomically,
    replace_directory,
    restore_directory,
    write_atomically,
)
from holdfast.transport.credentials import (
    CredentialsError,
    Role,
    date_text,
    give_to_warnings,
    warn_if_open,
)
from holdfast.transport.endpoints import AUTHORITY_FILE, CERTIFICATE_FILE, KEY_FILE
from holdfast.transport.revocation import REVOKED_FILE

try:
    from cryptography import x509
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.hazmat.primitives.serialization import (
        Encoding,
        NoEncryption,
        PrivateFormat,
        load_pem_private_key,
    )
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
except ImportError as error:
    raise CredentialsError(
        "making keys needs the package cryptography: pip install cryptography"
    ) from error

__all__ = [
    "AUTHORITY_DAYS",
    "DEFAULT_DAYS",
    "Issued",
    "KeyRing",
    "MadeCredentials",
    "Revocation",
    "alone_in",
    "list_credentials",
    "make_credentials",
    "revoke_credentials",
]

DEFAULT_DAYS = 365
"""Days for which a certificate is valid unless said otherwise."""

AUTHORITY_DAYS = 3650
"""Days for which a new authority is valid; no certificate outlives its authority."""

MAX_PARTIES = 1000
"""Bound on the names of one call."""

_AUTHORITY = "authority"
_AUTHORITY_KEY = "authority.key"
_ISSUED = "issued.csv"
_ISSUED_FIELDS = ("serial", "name", "role", "expires")
_MAX_SERIAL = 2**159

# A robot whose clock is a little behind would refuse a certificate that begins now.
_BACKDATED = timedelta(days=1)

# A name becomes a directory and the certificate's common name, which has 64 characters at most.
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_HOST_LABEL = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?")

_PRIVATE_FILE = 0o600
_PUBLIC_FILE = 0o644


class MadeCredentials(NamedTuple):
    """What :func:`make_credentials` made for one robot or service.

    Attributes
    ----------
    name : str
    role : {"robot", "service"}
    directory : Path
        What to copy to its machine.
    hosts : tuple of str
        Names and addresses under which robots may call a service; empty for a robot.
    expires : datetime
    renewed : bool
        Whether only the certificate is new, for a key that was there.
    """

    name: str
    role: Role
    directory: Path
    hosts: tuple[str, ...]
    expires: datetime
    renewed: bool


class Issued(NamedTuple):
    """A certificate that the authority has signed.

    Attributes
    ----------
    serial : int
    name : str
        Empty if only the number is known.
    role : {"robot", "service"} or None
    expires : datetime or None
    revoked : datetime or None
        When; None if it is not.
    """

    serial: int
    name: str
    role: Role | None
    expires: datetime | None
    revoked: datetime | None = None


class Revocation(NamedTuple):
    """What :func:`revoke_credentials` did.

    Attributes
    ----------
    revoked : tuple of Issued
        What was not revoked before.
    before : int
        How many were.
    copies : tuple of Path
        The list in each directory of credentials.
    """

    revoked: tuple[Issued, ...]
    before: int
    copies: tuple[Path, ...]


class KeyRing(NamedTuple):
    """What :func:`make_credentials` did.

    Attributes
    ----------
    authority_key : Path
        The file that stays at home.
    authority_is_new : bool
    authority_expires : datetime
    made : tuple of MadeCredentials
    """

    authority_key: Path
    authority_is_new: bool
    authority_expires: datetime
    made: tuple[MadeCredentials, ...]


@contextlib.contextmanager
def alone_in(directory: Path, *, warn: Callable[[str], None] | None = None) -> Iterator[None]:
    """Keep others out of a directory meanwhile, and first finish what a killed one began.

    Parameters
    ----------
    directory : Path
        As for :func:`make_credentials`.
    warn : callable or None
        As for :func:`make_credentials`; told if somebody has to be waited for.

    Raises
    ------
    CredentialsError
        If it cannot be made or opened, or the record in it is malformed.
    OutputError
        If a file cannot be written.
    """
    warn = warn or give_to_warnings
    is_new = not directory.exists()
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        lock = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        what = "created" if is_new else "opened"
        raise CredentialsError(f"{directory}: cannot be {what}: {error.strerror}") from error
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            warn(f"{directory}: another 'holdfast keys' is at work; waiting until it has ended")
            fcntl.flock(lock, fcntl.LOCK_EX)
        except OSError as error:  # on some file systems of a network
            warn(f"{directory}: cannot be locked: {error.strerror}; run one command at a time")
        names = {each.name for each in _written_down(directory).values()}
        for name in filter(_NAME.fullmatch, names - {_AUTHORITY}):
            restore_directory(directory / name)
        yield
    finally:
        if is_new:
            with contextlib.suppress(OSError):
                directory.rmdir()  # if all was refused, and so it is empty
        os.close(lock)


def make_credentials(
    directory: Path,
    *,
    robots: Sequence[str] = (),
    services: Sequence[str] = (),
    hosts: Sequence[str] = (),
    days: int = DEFAULT_DAYS,
    renew: bool = False,
    rotate: bool = False,
    now: datetime | None = None,
    warn: Callable[[str], None] | None = None,
) -> KeyRing:
    """Make keys for robots and services, and their authority if there is none yet.

    Each gets a directory of its name with ``authority.pem``, ``certificate.pem`` and ``key.pem``,
    which appears whole or not at all. Another call adds keys of the same authority. Nothing that
    exists is changed, unless ``renew`` or ``rotate`` is set: then a new certificate replaces the
    old one, for the same key or a new one, and for at least the same hosts. The old one stays valid
    until its time is up or it is revoked (:func:`revoke_credentials`). Nobody else may be at work
    in the directory meanwhile (:func:`alone_in`).

    Parameters
    ----------
    directory : Path
        Where all of them go; it is made if it is not there.
    robots, services : sequence of str
        Their names; none at all means one robot ``robot`` and one service ``service``, or with
        ``renew`` or ``rotate`` all that are there.
    hosts : sequence of str
        Names and addresses under which robots call the services, besides those of this machine.
    days : int
        For which the certificates are valid; never longer than the authority.
    renew : bool
        Whether certificates that are there already are replaced. One that is revoked is not.
    rotate : bool
        Whether certificates and keys that are there already are replaced.
    now : datetime or None
        The time from which they are valid, with its time zone; None takes the clock's.
    warn : callable or None
        Takes texts that somebody should read; None gives them to :mod:`warnings`.

    Returns
    -------
    KeyRing

    Raises
    ------
    CredentialsError
        If a name, host or number is out of bounds, or a file is in the way or missing.
    OutputError
        If a file cannot be written.
    """
    warn = warn or give_to_warnings
    # Certificates have whole seconds.
    now = (now or datetime.now(UTC)).replace(microsecond=0)
    if not robots and not services:
        robots, services = _present(directory) if renew or rotate else (("robot",), ("service",))
    _check_arguments(robots, services, hosts, days)
    if renew and rotate:
        raise CredentialsError(
            "renew (--renew) keeps the keys and rotate (--rotate) makes new ones: choose one"
        )

    home = directory / _AUTHORITY
    authority_is_new = not home.exists()
    authority = _new_authority(now) if authority_is_new else _read_authority(home, now, warn)

    # All that can be refused is refused before the first file is written.
    revoked = () if authority_is_new else _read_revoked(home, authority.certificate)
    numbers = frozenset(entry.serial_number for entry in revoked)
    end = min(now + timedelta(days=days), authority.certificate.not_valid_after_utc)
    roles: list[tuple[str, Role]] = [(name, "service") for name in services]
    roles += [(name, "robot") for name in robots]
    parties: list[_Party] = []
    for name, role in roles:
        place = directory / name
        occupied = _first_file_of(place)
        if occupied is None:
            parties.append(_party(place, role, hosts, authority, now, end))
        elif renew or rotate:
            old = _old_certificate(place, role, authority)
            if renew and old.serial_number in numbers:
                raise CredentialsError(
                    f"{place / CERTIFICATE_FILE}: is revoked, so its key gets no new certificate; "
                    f"make a new key (--rotate)"
                )
            parties.append(_party(place, role, hosts, authority, now, end, old, rotate=rotate))
        else:
            raise CredentialsError(
                f"{occupied}: exists already, and nothing was changed; choose another name, or "
                f"renew it (--renew) to get a new certificate for the same key, or rotate it "
                f"(--rotate) to get a new key as well"
            )

    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise CredentialsError(f"{directory}: cannot be created: {error.strerror}") from error
    if authority_is_new:
        create_directory_atomically(
            home,
            {
                AUTHORITY_FILE: NewFile(_pem(authority.certificate), _PUBLIC_FILE),
                _AUTHORITY_KEY: NewFile(_key_pem(authority.key), _PRIVATE_FILE),
            },
        )
    # Before any of them is there: what was not written down could not be revoked by its name.
    issued = _read_issued(directory, authority.certificate)
    _write_issued(home, [*issued, *(_issued(each.certificate) for each in parties)])
    made = []
    for party in parties:
        place = directory / party.name
        if party.key is None:
            write_atomically(place / CERTIFICATE_FILE, _pem(party.certificate))
        else:
            files = {
                AUTHORITY_FILE: NewFile(_pem(authority.certificate), _PUBLIC_FILE),
                CERTIFICATE_FILE: NewFile(_pem(party.certificate), _PUBLIC_FILE),
                KEY_FILE: NewFile(_key_pem(party.key), _PRIVATE_FILE),
            }
            if (home / REVOKED_FILE).exists():
                files[REVOKED_FILE] = NewFile(_read(home / REVOKED_FILE), _PUBLIC_FILE)
            put = replace_directory if place.exists() else create_directory_atomically
            put(place, files)
        made.append(
            MadeCredentials(party.name, party.role, place, party.hosts, end, party.key is None)
        )
    return KeyRing(
        home / _AUTHORITY_KEY,
        authority_is_new,
        authority.certificate.not_valid_after_utc,
        tuple(made),
    )


def revoke_credentials(
    directory: Path,
    *,
    names: Sequence[str] = (),
    serials: Sequence[int] = (),
    now: datetime | None = None,
    warn: Callable[[str], None] | None = None,
) -> Revocation:
    """Revoke certificates: no service and no robot that has the new list accepts them any more.

    The list is written to the authority and beside each party's credentials. What is revoked
    already stays so, and nothing is ever taken off the list.

    Parameters
    ----------
    directory : Path
        As for :func:`make_credentials`.
    names : sequence of str
        Of robots and services: all certificates that they ever had.
    serials : sequence of int
        Numbers of single certificates.
    now : datetime or None
        When, with its time zone; None takes the clock's.
    warn : callable or None
        As for :func:`make_credentials`.

    Raises
    ------
    CredentialsError
        If a name never had a certificate, a number cannot be one, or a file is missing or
        malformed.
    OutputError
        If a file cannot be written.
    """
    now = (now or datetime.now(UTC)).replace(microsecond=0)
    home = directory / _AUTHORITY
    authority = _read_authority(home, now, warn or give_to_warnings)
    issued = _read_issued(directory, authority.certificate)
    wanted: dict[int, Issued] = {}
    for name in names:
        theirs = [each for each in issued if each.name == name]
        if not theirs:
            raise CredentialsError(f"name {name!r}: has no certificate of {home}")
        wanted |= {each.serial: each for each in theirs}
    for serial in serials:
        if not 0 < serial < _MAX_SERIAL:
            raise CredentialsError(f"serial number {serial:x}: is not between 1 and 2^159")
        known = next((each for each in issued if each.serial == serial), None)
        wanted[serial] = known or Issued(serial, "", None, None)
    listed = _read_revoked(home, authority.certificate)
    numbers = {entry.serial_number for entry in listed}
    new = [each._replace(revoked=now) for each in wanted.values() if each.serial not in numbers]
    if new:
        content = _sign_revoked(home, listed, new, authority, now)
        write_atomically(home / REVOKED_FILE, content)
    copies = []
    if new or listed:
        content = _read(home / REVOKED_FILE)
        for certificate in _certificates_in(directory):
            # Also if nothing is new: who wrote it may have been killed before the copies.
            copies.append(certificate.with_name(REVOKED_FILE))
            write_atomically(copies[-1], content)
    return Revocation(tuple(new), len(listed), tuple(copies))


def list_credentials(directory: Path) -> tuple[Issued, ...]:
    """Return all certificates that an authority has signed, and what is revoked.

    Raises
    ------
    CredentialsError
        If there is no authority, or a file is malformed.
    """
    home = directory / _AUTHORITY
    certificate = _read_certificate(home / AUTHORITY_FILE)
    listed = {
        entry.serial_number: entry.revocation_date_utc for entry in _read_revoked(home, certificate)
    }
    issued = [
        each._replace(revoked=listed.pop(each.serial, None))
        for each in _read_issued(directory, certificate)
    ]
    return (*issued, *(Issued(serial, "", None, None, at) for serial, at in listed.items()))


def _check_arguments(
    robots: Sequence[str], services: Sequence[str], hosts: Sequence[str], days: int
) -> None:
    if not 1 <= days <= AUTHORITY_DAYS:
        raise CredentialsError(f"days: {days} is not between 1 and {AUTHORITY_DAYS}")
    names = [*services, *robots]
    if len(names) > MAX_PARTIES:
        raise CredentialsError(f"{len(names)} names are more than {MAX_PARTIES} at once")
    for name in names:
        if not _NAME.fullmatch(name) or name == _AUTHORITY:
            raise CredentialsError(
                f"name {name!r}: must be of at most 64 letters, digits, '.', '_' and '-', begin "
                f"with a letter or digit, and not be {_AUTHORITY!r}"
            )
        if names.count(name) > 1:
            raise CredentialsError(f"name {name!r}: stands twice; each needs a directory")
    if hosts and not services:
        raise CredentialsError(
            f"host {hosts[0]!r}: only services are called by a host, and none is made"
        )
    for host in hosts:
        if not _is_host(host):
            raise CredentialsError(
                f"host {host!r}: is no host name and no IP address; for a service at "
                f"tls/10.0.0.7:7447 it is 10.0.0.7"
            )


def _is_host(host: str) -> bool:
    try:
        ip_address(host)
    except ValueError:
        labels = host.split(".")
        return len(host) <= 253 and all(_HOST_LABEL.fullmatch(label) for label in labels)
    return True


def _first_file_of(place: Path) -> Path | None:
    """Return what would be in the way of a new directory, if anything."""
    if not place.is_dir():
        return place if place.exists() else None
    if (place / CERTIFICATE_FILE).exists():
        return place / CERTIFICATE_FILE
    return min(place.iterdir(), default=None)


# Making


class _Authority(NamedTuple):
    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey


class _Party(NamedTuple):
    name: str
    role: Role
    hosts: tuple[str, ...]
    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey | None  # None: renewed, its key stays as it is


def _present(directory: Path) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of all robots and services that have a certificate here."""
    robots: list[str] = []
    services: list[str] = []
    for certificate in _certificates_in(directory):
        role = _role_of(_read_certificate(certificate))
        (services if role == "service" else robots).append(certificate.parent.name)
    if not robots and not services:
        raise CredentialsError(f"{directory}: has no certificates to renew")
    return tuple(robots), tuple(services)


def _new_authority(now: datetime) -> _Authority:
    key = ec.generate_private_key(ec.SECP256R1())
    serial = x509.random_serial_number()
    # Two authorities must not have the same name: a chain is looked up by it.
    name = _common_name(f"holdfast authority {serial:x}"[:40])
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(serial)
        .not_valid_before(now - _BACKDATED)
        .not_valid_after(now + timedelta(days=AUTHORITY_DAYS))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_key_usage(signs_certificates=True), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )
    return _Authority(certificate, key)


def _read_authority(home: Path, now: datetime, warn: Callable[[str], None]) -> _Authority:
    certificate = _read_certificate(home / AUTHORITY_FILE)
    path = home / _AUTHORITY_KEY
    try:
        key = load_pem_private_key(_read(path), password=None)
    except (ValueError, TypeError) as error:
        raise CredentialsError(f"{path}: is no private key in PEM form: {error}") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise CredentialsError(f"{path}: is no elliptic-curve key, as this program makes them")
    if key.public_key() != certificate.public_key():
        raise CredentialsError(f"{path}: is not the key of {home / AUTHORITY_FILE}")
    warn_if_open(path, warn)
    if certificate.not_valid_after_utc <= now:
        raise CredentialsError(
            f"{home / AUTHORITY_FILE}: has expired on "
            f"{date_text(certificate.not_valid_after_utc.timestamp())}; make keys with a new "
            f"authority in another directory"
        )
    return _Authority(certificate, key)


def _old_certificate(place: Path, role: Role, authority: _Authority) -> x509.Certificate:
    """Return the certificate that is to be replaced, if it is one of ours."""
    path = place / CERTIFICATE_FILE
    old = _read_certificate(path)
    try:
        old.verify_directly_issued_by(authority.certificate)
    except (ValueError, TypeError, InvalidSignature) as error:
        raise CredentialsError(f"{path}: is not of the authority in {place.parent}") from error
    if _role_of(old) != role or not isinstance(old.public_key(), ec.EllipticCurvePublicKey):
        raise CredentialsError(f"{path}: is not a {role}'s certificate, so it is left alone")
    return old


def _party(
    place: Path,
    role: Role,
    hosts: Sequence[str],
    authority: _Authority,
    now: datetime,
    end: datetime,
    old: x509.Certificate | None = None,
    *,
    rotate: bool = False,
) -> _Party:
    """Certify a new party, or one that has a certificate: with its key or with a new one."""
    key: ec.EllipticCurvePrivateKey | None = None
    if old is not None and not rotate:
        public_key: object = old.public_key()
    else:
        key = ec.generate_private_key(ec.SECP256R1())
        public_key = key.public_key()
    assert isinstance(public_key, ec.EllipticCurvePublicKey)
    reached_at: tuple[str, ...] = ()
    if role == "service":
        before = _hosts_of_this_machine() if old is None else _hosts_of(old)
        reached_at = tuple(dict.fromkeys(map(_normal, (*before, *hosts))))
    certificate = _sign(place.name, role, reached_at, public_key, authority, now, end)
    return _Party(place.name, role, reached_at, certificate, key)


def _sign(
    name: str,
    role: Role,
    hosts: Sequence[str],
    public_key: ec.EllipticCurvePublicKey,
    authority: _Authority,
    now: datetime,
    end: datetime,
) -> x509.Certificate:

    usage = _usage_of(role)
    builder = (
        x509.CertificateBuilder()
        .subject_name(_common_name(name))
        .issuer_name(authority.certificate.subject)
        .public_key(public_key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(max(now - _BACKDATED, authority.certificate.not_valid_before_utc))
        .not_valid_after(end)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_key_usage(signs_certificates=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage([usage]), critical=False)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(public_key), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.key.public_key()),
            critical=False,
        )
    )
    if hosts:
        names = [_general_name(host) for host in hosts]
        builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
    return builder.sign(authority.key, hashes.SHA256())


# What was signed, and what is revoked


def _issued(certificate: x509.Certificate) -> Issued:
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return Issued(
        certificate.serial_number,
        str(names[0].value) if names else "",
        _role_of(certificate),
        certificate.not_valid_after_utc,
    )


def _read_issued(directory: Path, authority: x509.Certificate) -> list[Issued]:
    """Return what was signed: what is written down, and what is there besides."""
    issued = _written_down(directory)
    for place in _certificates_in(directory):
        # Anything may lie here; what our authority has not signed is no certificate of ours.
        with contextlib.suppress(CredentialsError, ValueError, TypeError, InvalidSignature):
            certificate = _read_certificate(place)
            certificate.verify_directly_issued_by(authority)
            issued.setdefault(certificate.serial_number, _issued(certificate))
    return list(issued.values())


def _written_down(directory: Path) -> dict[int, Issued]:
    """Return the record of what was signed, by serial number."""
    path = directory / _AUTHORITY / _ISSUED
    issued: dict[int, Issued] = {}
    if path.exists():
        try:
            for serial, name, role, expires in _rows_of(_read(path).decode()):
                known: Role = "service" if role == "service" else "robot"
                end = datetime.fromisoformat(expires)
                issued[int(serial, 16)] = Issued(int(serial, 16), name, known, end)
        except ValueError as error:
            raise CredentialsError(f"{path}: is no record of certificates: {error}") from error
    return issued


def _rows_of(text: str) -> list[list[str]]:
    """Return the rows below the header."""
    rows = list(csv.reader(text.splitlines()))
    if not rows or tuple(rows[0]) != _ISSUED_FIELDS:
        raise ValueError(f"its first line is not {','.join(_ISSUED_FIELDS)}")
    return rows[1:]


def _certificates_in(directory: Path) -> list[Path]:
    """Return the certificates of all parties that have a directory here."""
    found = sorted(directory.glob(f"*/{CERTIFICATE_FILE}"))
    return [path for path in found if _NAME.fullmatch(path.parent.name)]


def _write_issued(home: Path, issued: Iterable[Issued]) -> None:
    rows = [
        (f"{each.serial:x}", each.name, each.role or "", each.expires.isoformat())
        for each in issued
        if each.expires is not None
    ]
    text = "".join(",".join(row) + "\n" for row in (_ISSUED_FIELDS, *rows))
    write_atomically(home / _ISSUED, text)


def _read_revoked(home: Path, authority: x509.Certificate) -> tuple[x509.RevokedCertificate, ...]:
    """Return the entries of the authority's list; none if there is none yet."""
    revoked = _load_revoked(home, authority)
    return () if revoked is None else tuple(revoked)


def _load_revoked(home: Path, authority: x509.Certificate) -> x509.CertificateRevocationList | None:
    path = home / REVOKED_FILE
    if not path.exists():
        return None
    try:
        revoked = x509.load_pem_x509_crl(_read(path))
    except ValueError as error:
        raise CredentialsError(f"{path}: is no revocation list in PEM form") from error
    key = authority.public_key()
    assert isinstance(key, ec.EllipticCurvePublicKey)
    if not revoked.is_signature_valid(key):
        raise CredentialsError(f"{path}: was not signed by {home / AUTHORITY_FILE}")
    return revoked


def _sign_revoked(
    home: Path,
    listed: Iterable[x509.RevokedCertificate],
    new: Iterable[Issued],
    authority: _Authority,
    now: datetime,
) -> bytes:
    """Return the next list, in PEM."""
    before = _load_revoked(home, authority.certificate)
    number = 1
    if before is not None:
        number += before.extensions.get_extension_for_class(x509.CRLNumber).value.crl_number
    builder = (
        x509.CertificateRevocationListBuilder()
        .issuer_name(authority.certificate.subject)
        .last_update(max(now - _BACKDATED, authority.certificate.not_valid_before_utc))
        # A list that expires would lock everybody out.
        .next_update(authority.certificate.not_valid_after_utc)
        .add_extension(x509.CRLNumber(number), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.key.public_key()),
            critical=False,
        )
    )
    for entry in listed:
        builder = builder.add_revoked_certificate(entry)
    for each in new:
        entry = x509.RevokedCertificateBuilder(each.serial, now).build()
        builder = builder.add_revoked_certificate(entry)
    return builder.sign(authority.key, hashes.SHA256()).public_bytes(Encoding.PEM)


def _hosts_of_this_machine() -> list[str]:
    own = socket.gethostname()
    return ["localhost", "127.0.0.1", "::1", *([own] if _is_host(own) else [])]


def _normal(host: str) -> str:
    try:
        return str(ip_address(host))
    except ValueError:
        return host.lower()


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _hosts_of(certificate: x509.Certificate) -> tuple[str, ...]:
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ()
    return tuple(str(name.value) for name in names)


def _role_of(certificate: x509.Certificate) -> Role | None:
    try:
        usages = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    except x509.ExtensionNotFound:
        return None
    roles: tuple[Role, ...] = ("robot", "service")
    return next((role for role in roles if list(usages) == [_usage_of(role)]), None)


def _usage_of(role: Role) -> x509.ObjectIdentifier:
    if role == "service":
        return ExtendedKeyUsageOID.SERVER_AUTH
    return ExtendedKeyUsageOID.CLIENT_AUTH


def _key_usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        encipher_only=False,
        decipher_only=False,
    )


def _common_name(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _read_certificate(path: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(_read(path))
    except ValueError as error:
        raise CredentialsError(f"{path}: is no certificate in PEM form") from error


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise CredentialsError(f"{path}: cannot be read: {error.strerror}") from error


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(Encoding.PEM)


def _key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
