"""Who may talk to whom: a private authority, and keys for robots and services.

Both ends of a link show a certificate, and each accepts only those that its authority has signed.
The authority is one key file, made here, which stays at home; whoever holds it decides who belongs.
A certificate also says what its owner is: a robot's is good for asking only and a service's for
answering only (the field that X.509 calls the extended key usage), so a stolen robot cannot pretend
to be a service to the others. A certificate whose key is lost or stolen is revoked: its number goes
into a list that the authority signs and that lies beside everybody's credentials. What was ever
signed is written down, so that no older certificate of a name is forgotten then.

:func:`make_credentials` makes them, with the package ``cryptography``. :func:`load_credentials`
finds out before a link is opened whether they will work, because a TLS library later only says
that they did not: it plays the handshake of both ends through in memory, with the ``ssl`` module
of the standard library, which is there on every robot and imports in a fraction of the time.
"""

from __future__ import annotations

import contextlib
import csv
import re
import warnings
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

from holdfast.errors import HoldfastError, TransportError
from holdfast.files import (
    NewFile,
    create_directory_atomically,
    replace_directory,
    write_atomically,
)
from holdfast.transport.endpoints import TlsFiles
from holdfast.transport.revocation import REVOKED_FILE, refuse_revoked

if TYPE_CHECKING:
    import ssl

    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric.ec import (
        EllipticCurvePrivateKey,
        EllipticCurvePublicKey,
    )

__all__ = [
    "AUTHORITY_DAYS",
    "DEFAULT_DAYS",
    "CredentialsError",
    "CredentialsWarning",
    "Issued",
    "KeyRing",
    "MadeCredentials",
    "Revocation",
    "Role",
    "list_credentials",
    "load_credentials",
    "make_credentials",
    "revoke_credentials",
]

Role: TypeAlias = Literal["robot", "service"]

DEFAULT_DAYS = 365
"""Days for which a certificate is valid unless said otherwise."""

AUTHORITY_DAYS = 3650
"""Days for which a new authority is valid; no certificate outlives its authority."""

EXPIRES_SOON_DAYS = 14
"""A certificate with fewer days left is warned of when it is loaded."""

MAX_PARTIES = 1000
"""Bound on the names of one call."""

_AUTHORITY = "authority"
_AUTHORITY_CERTIFICATE = "authority.pem"
_AUTHORITY_KEY = "authority.key"
_CERTIFICATE = "certificate.pem"
_KEY = "key.pem"
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
_OPEN_TO_OTHERS = 0o077


class CredentialsError(HoldfastError):
    """Credentials cannot be made or used; the message names the file and the reason."""


class CredentialsWarning(UserWarning):
    """Credentials work, but somebody should look at them."""


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
    until its time is up or it is revoked (:func:`revoke_credentials`).

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
        If a name, host or number is out of bounds, a file is in the way or missing, or
        ``cryptography`` is not installed.
    OutputError
        If a file cannot be written.
    """
    _require_cryptography()
    warn = warn or _give_to_warnings
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
    parties = []
    for name, role in roles:
        place = directory / name
        occupied = _first_file_of(place)
        if occupied is None:
            parties.append(_new_party(name, role, hosts, authority, now, end))
        elif renew or rotate:
            old = _old_certificate(place, role, authority)
            if renew and old.serial_number in numbers:
                raise CredentialsError(
                    f"{place / _CERTIFICATE}: is revoked, so its key gets no new certificate; "
                    f"make a new key (--rotate)"
                )
            parties.append(_renewed_party(place, old, role, hosts, authority, now, end, rotate))
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
                _AUTHORITY_CERTIFICATE: NewFile(_pem(authority.certificate), _PUBLIC_FILE),
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
            write_atomically(place / _CERTIFICATE, _pem(party.certificate))
        else:
            files = {
                _AUTHORITY_CERTIFICATE: NewFile(_pem(authority.certificate), _PUBLIC_FILE),
                _CERTIFICATE: NewFile(_pem(party.certificate), _PUBLIC_FILE),
                _KEY: NewFile(_key_pem(party.key), _PRIVATE_FILE),
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
        If a name never had a certificate, a number cannot be one, a file is missing or malformed,
        or ``cryptography`` is not installed.
    OutputError
        If a file cannot be written.
    """
    _require_cryptography()
    now = (now or datetime.now(UTC)).replace(microsecond=0)
    home = directory / _AUTHORITY
    authority = _read_authority(home, now, warn or _give_to_warnings)
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
        If there is no authority, a file is malformed, or ``cryptography`` is not installed.
    """
    _require_cryptography()
    home = directory / _AUTHORITY
    certificate = _read_certificate(home / _AUTHORITY_CERTIFICATE)
    listed = {
        entry.serial_number: entry.revocation_date_utc for entry in _read_revoked(home, certificate)
    }
    issued = [
        each._replace(revoked=listed.pop(each.serial, None))
        for each in _read_issued(directory, certificate)
    ]
    return (*issued, *(Issued(serial, "", None, None, at) for serial, at in listed.items()))


def load_credentials(
    directory: Path | str, role: Role, *, warn: Callable[[str], None] | None = None
) -> TlsFiles:
    """Check a robot's or a service's credentials, and return where they are.

    Parameters
    ----------
    directory : Path or str
        With ``authority.pem``, ``certificate.pem`` and ``key.pem``.
    role : {"robot", "service"}
        Whose they must be.
    warn : callable or None
        Takes texts that somebody should read: a key that others can read, a certificate that
        expires soon. None gives them to :mod:`warnings`.

    Returns
    -------
    TlsFiles

    Raises
    ------
    CredentialsError
        If the other end would not accept them: a file is missing, unreadable or malformed, the key
        belongs to another certificate, the certificate is not valid now, was signed by another
        authority, or is for the other role.
    """
    warn = warn or _give_to_warnings
    directory = Path(directory)
    paths = [directory / name for name in (_AUTHORITY_CERTIFICATE, _CERTIFICATE, _KEY)]
    for path in paths:
        try:
            with path.open("rb"):
                pass
        except OSError as error:
            raise CredentialsError(_unreadable(directory, path, role, error)) from error
    authority, certificate, key = paths
    _warn_if_open(key, warn)
    expires_s = _rehearse(authority, certificate, key, role)
    days_left = (expires_s - datetime.now(UTC).timestamp()) / 86_400.0
    if days_left < EXPIRES_SOON_DAYS:
        warn(f"{certificate}: expires in {days_left:.1f} days, on {_date(expires_s)}")
    return TlsFiles(authority, certificate, key)


# Checking


def _give_to_warnings(text: str) -> None:
    warnings.warn(text, CredentialsWarning, stacklevel=3)


def _unreadable(directory: Path, path: Path, role: Role, error: OSError) -> str:
    text = f"{path}: cannot be read: {error.strerror}"
    if (directory / role / _CERTIFICATE).exists():
        return f"{text}; did you mean {directory / role}?"
    if isinstance(error, FileNotFoundError):
        return f'{text}; "holdfast keys DIR" makes such files'
    return text


def _warn_if_open(key: Path, warn: Callable[[str], None]) -> None:
    mode = key.stat().st_mode
    if mode & _OPEN_TO_OTHERS:
        warn(f"{key}: others can read this key (mode {mode & 0o777:03o}); chmod 600 {key}")


def _rehearse(authority: Path, certificate: Path, key: Path, role: Role) -> float:
    """Let both ends of a link shake hands in memory; return when the certificate expires."""
    import ssl

    serving = role == "service"
    ours = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if serving else ssl.PROTOCOL_TLS_CLIENT)
    theirs = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT if serving else ssl.PROTOCOL_TLS_SERVER)
    for context in (ours, theirs):
        context.minimum_version = ssl.TLSVersion.TLSv1_3
        context.check_hostname = False
    ours.verify_mode = ssl.CERT_NONE
    theirs.verify_mode = ssl.CERT_REQUIRED
    try:
        theirs.load_verify_locations(cafile=authority)
    except ssl.SSLError as error:
        raise CredentialsError(f"{authority}: is no certificate in PEM form") from error
    try:
        refuse_revoked(theirs, authority.parent)
    except TransportError as error:
        raise CredentialsError(str(error)) from error
    # A server needs a certificate of its own; nobody looks at it here.
    for context in (ours,) if serving else (ours, theirs):
        try:
            # Without the empty password, an encrypted key would ask for one on the terminal.
            context.load_cert_chain(certificate, key, password="")
        except ssl.SSLError as error:
            raise CredentialsError(_unusable_pair(certificate, key, error)) from error

    to_ours, to_theirs = ssl.MemoryBIO(), ssl.MemoryBIO()
    near = ours.wrap_bio(to_ours, to_theirs, server_side=serving)
    far = theirs.wrap_bio(to_theirs, to_ours, server_side=not serving)
    try:
        for _ in range(4):  # more flights than TLS 1.3 has
            for end in (near, far):
                try:
                    end.do_handshake()
                except ssl.SSLWantReadError:
                    continue
        shown = far.getpeercert()
    except ssl.SSLCertVerificationError as error:
        if error.verify_code in _LIST_IS_WRONG:
            reason = _LIST_IS_WRONG[error.verify_code]
            raise CredentialsError(f"{authority.with_name(REVOKED_FILE)}: {reason}") from error
        reason = _refusal(certificate, role, error)
        raise CredentialsError(f"{certificate}: {reason}") from error
    except (ssl.SSLError, ValueError) as error:
        raise CredentialsError(f"{certificate}: does not work for TLS: {error}") from error
    return float(ssl.cert_time_to_seconds(str(shown["notAfter"]))) if shown else 0.0


def _unusable_pair(certificate: Path, key: Path, error: ssl.SSLError) -> str:
    if error.reason == "KEY_VALUES_MISMATCH":
        return f"{key}: is not the key of {certificate}"
    if b"PRIVATE KEY" not in key.read_bytes():
        return f"{key}: is no private key in PEM form"
    if b"ENCRYPTED" in key.read_bytes():
        return f"{key}: is encrypted; a key that a program reads by itself must not be"
    if b"BEGIN CERTIFICATE" not in certificate.read_bytes():
        return f"{certificate}: is no certificate in PEM form"
    return f"{certificate} and {key} cannot be used: {error.reason or error}"


_LIST_IS_WRONG = {
    3: f"is not of the authority beside it, {_AUTHORITY_CERTIFICATE}",
    8: f"was not signed by the authority beside it, {_AUTHORITY_CERTIFICATE}",
    11: "is not valid yet; is this machine's clock right?",
    12: "has expired",
}
"""By OpenSSL's numbers: what can be wrong with a revocation list."""


def _refusal(certificate: Path, role: Role, error: ssl.SSLCertVerificationError) -> str:
    """Say why the other end refuses the certificate, by OpenSSL's number of the reason."""
    other: Role = "robot" if role == "service" else "service"
    match error.verify_code:
        case 9:
            return f"is not valid yet{_validity(certificate)}; is this machine's clock right?"
        case 10:
            return f"has expired{_validity(certificate)}"
        case 23:
            return "has been revoked; 'holdfast keys DIR --rotate' makes new ones"
        case 26:
            return f"is not for a {role} but for a {other}"
        case 7 | 18 | 19 | 20 | 21:
            return f"was not signed by the authority beside it, {_AUTHORITY_CERTIFICATE}"
        case _:
            return f"is refused: {error.verify_message}"


def _validity(certificate: Path) -> str:
    """Return when a certificate is valid, if the package that can read it is installed."""
    try:
        from cryptography import x509
    except ImportError:
        return ""
    read = x509.load_pem_x509_certificate(certificate.read_bytes())
    return (
        f" (valid from {_date(read.not_valid_before_utc.timestamp())}"
        f" to {_date(read.not_valid_after_utc.timestamp())})"
    )


def _date(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%d %H:%M UTC")


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
    if (place / _CERTIFICATE).exists():
        return place / _CERTIFICATE
    return min(place.iterdir(), default=None)


# Making


class _Authority(NamedTuple):
    certificate: x509.Certificate
    key: EllipticCurvePrivateKey


class _Party(NamedTuple):
    name: str
    role: Role
    hosts: tuple[str, ...]
    certificate: x509.Certificate
    key: EllipticCurvePrivateKey | None  # None: renewed, its key stays as it is


def _require_cryptography() -> None:
    try:
        import cryptography  # noqa: F401
    except ImportError as error:
        raise CredentialsError(
            'making keys needs the package cryptography: pip install "holdfast[service]"'
        ) from error


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
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec

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
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    certificate = _read_certificate(home / _AUTHORITY_CERTIFICATE)
    path = home / _AUTHORITY_KEY
    try:
        key = serialization.load_pem_private_key(_read(path), password=None)
    except (ValueError, TypeError) as error:
        raise CredentialsError(f"{path}: is no private key in PEM form: {error}") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise CredentialsError(f"{path}: is no elliptic-curve key, as this program makes them")
    if key.public_key() != certificate.public_key():
        raise CredentialsError(f"{path}: is not the key of {home / _AUTHORITY_CERTIFICATE}")
    _warn_if_open(path, warn)
    if certificate.not_valid_after_utc <= now:
        raise CredentialsError(
            f"{home / _AUTHORITY_CERTIFICATE}: has expired on "
            f"{_date(certificate.not_valid_after_utc.timestamp())}; make keys with a new "
            f"authority in another directory"
        )
    return _Authority(certificate, key)


def _new_party(
    name: str,
    role: Role,
    hosts: Sequence[str],
    authority: _Authority,
    now: datetime,
    end: datetime,
) -> _Party:
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    reached_at = _hosts_of_this_machine(hosts) if role == "service" else ()
    certificate = _sign(name, role, reached_at, key.public_key(), authority, now, end)
    return _Party(name, role, reached_at, certificate, key)


def _old_certificate(place: Path, role: Role, authority: _Authority) -> x509.Certificate:
    """Return the certificate that is to be replaced, if it is one of ours."""
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives.asymmetric import ec

    path = place / _CERTIFICATE
    old = _read_certificate(path)
    try:
        old.verify_directly_issued_by(authority.certificate)
    except (ValueError, TypeError, InvalidSignature) as error:
        raise CredentialsError(f"{path}: is not of the authority in {place.parent}") from error
    if _role_of(old) != role or not isinstance(old.public_key(), ec.EllipticCurvePublicKey):
        raise CredentialsError(f"{path}: is not a {role}'s certificate, so it is left alone")
    return old


def _renewed_party(
    place: Path,
    old: x509.Certificate,
    role: Role,
    hosts: Sequence[str],
    authority: _Authority,
    now: datetime,
    end: datetime,
    rotate: bool,
) -> _Party:
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1()) if rotate else None
    public_key = old.public_key() if key is None else key.public_key()
    assert isinstance(public_key, ec.EllipticCurvePublicKey)
    reached_at = tuple(dict.fromkeys((*_hosts_of(old), *map(_normal, hosts))))
    reached_at = reached_at if role == "service" else ()
    certificate = _sign(place.name, role, reached_at, public_key, authority, now, end)
    return _Party(place.name, role, reached_at, certificate, key)


def _sign(
    name: str,
    role: Role,
    hosts: Sequence[str],
    public_key: EllipticCurvePublicKey,
    authority: _Authority,
    now: datetime,
    end: datetime,
) -> x509.Certificate:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes

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
    from cryptography.x509.oid import NameOID

    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return Issued(
        certificate.serial_number,
        str(names[0].value) if names else "",
        _role_of(certificate),
        certificate.not_valid_after_utc,
    )


def _read_issued(directory: Path, authority: x509.Certificate) -> list[Issued]:
    """Return what was signed: what is written down, and what is there besides."""
    from cryptography.exceptions import InvalidSignature

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
    for place in _certificates_in(directory):
        # Anything may lie here; what our authority has not signed is no certificate of ours.
        with contextlib.suppress(CredentialsError, ValueError, TypeError, InvalidSignature):
            certificate = _read_certificate(place)
            certificate.verify_directly_issued_by(authority)
            issued.setdefault(certificate.serial_number, _issued(certificate))
    return list(issued.values())


def _rows_of(text: str) -> list[list[str]]:
    """Return the rows below the header."""
    rows = list(csv.reader(text.splitlines()))
    if not rows or tuple(rows[0]) != _ISSUED_FIELDS:
        raise ValueError(f"its first line is not {','.join(_ISSUED_FIELDS)}")
    return rows[1:]


def _certificates_in(directory: Path) -> list[Path]:
    """Return the certificates of all parties that have a directory here."""
    found = sorted(directory.glob(f"*/{_CERTIFICATE}"))
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
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec

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
        raise CredentialsError(f"{path}: was not signed by {home / _AUTHORITY_CERTIFICATE}")
    return revoked


def _sign_revoked(
    home: Path,
    listed: Iterable[x509.RevokedCertificate],
    new: Iterable[Issued],
    authority: _Authority,
    now: datetime,
) -> bytes:
    """Return the next list, in PEM."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.serialization import Encoding

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


def _hosts_of_this_machine(hosts: Sequence[str]) -> tuple[str, ...]:
    import socket

    own = socket.gethostname()
    every = ["localhost", "127.0.0.1", "::1", *([own] if _is_host(own) else []), *hosts]
    return tuple(dict.fromkeys(map(_normal, every)))


def _normal(host: str) -> str:
    try:
        return str(ip_address(host))
    except ValueError:
        return host.lower()


def _general_name(host: str) -> x509.GeneralName:
    from cryptography import x509

    try:
        return x509.IPAddress(ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _hosts_of(certificate: x509.Certificate) -> tuple[str, ...]:
    from cryptography import x509

    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ()
    return tuple(str(name.value) for name in names)


def _role_of(certificate: x509.Certificate) -> Role | None:
    from cryptography import x509

    try:
        usages = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    except x509.ExtensionNotFound:
        return None
    roles: tuple[Role, ...] = ("robot", "service")
    return next((role for role in roles if list(usages) == [_usage_of(role)]), None)


def _usage_of(role: Role) -> x509.ObjectIdentifier:
    from cryptography.x509.oid import ExtendedKeyUsageOID

    if role == "service":
        return ExtendedKeyUsageOID.SERVER_AUTH
    return ExtendedKeyUsageOID.CLIENT_AUTH


def _key_usage(*, signs_certificates: bool) -> x509.KeyUsage:
    from cryptography import x509

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
    from cryptography import x509
    from cryptography.x509.oid import NameOID

    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _read_certificate(path: Path) -> x509.Certificate:
    from cryptography import x509

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
    from cryptography.hazmat.primitives.serialization import Encoding

    return certificate.public_bytes(Encoding.PEM)


def _key_pem(key: EllipticCurvePrivateKey) -> bytes:
    from cryptography.hazmat.primitives.serialization import (
        Encoding,
        NoEncryption,
        PrivateFormat,
    )

    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
