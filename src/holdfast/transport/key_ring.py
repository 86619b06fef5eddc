"""Makes, renews, rotates and revokes the credentials of robots and services.

Each end of a link shows a certificate, and accepts only those of its authority. The authority is
one key file in the operator's directory. A certificate is for a robot or for a service (X.509's
extended key usage), so a stolen robot cannot pose as a service. A certificate whose key is lost or
stolen is revoked: its serial number goes into a signed list beside all credentials. Each signed
certificate is recorded, so revoking a name revokes its older certificates, too.

Only this module needs the package ``cryptography``; without it, importing raises
:class:`~holdfast.errors.CredentialsError`. Using credentials takes only
:mod:`holdfast.transport.credentials`.
"""

from __future__ import annotations

import contextlib
import csv
import fcntl
import os
import re
import socket
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from holdfast.errors import CredentialsError, OutputError
from holdfast.runtime.files import (
    NewFile,
    create_directory_atomically,
    remove_unfinished_of,
    replace_file,
    write_atomically,
)
from holdfast.transport.authority import (
    AUTHORITY_DAYS,
    AUTHORITY_KEY_FILE,
    Authority,
    certificate_pem,
    common_name_of,
    hosts_of,
    is_host,
    is_signed_by,
    key_belongs_to,
    key_pem,
    new_key,
    normal_host,
    read_certificate,
    read_file,
    read_revocations,
    role_of,
)
from holdfast.transport.endpoints import (
    AUTHORITY_FILE,
    CERTIFICATE_FILE,
    KEY_FILE,
    NEXT_KEY_FILE,
    REVOKED_FILE,
    Role,
)

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec

DEFAULT_DAYS = 365
"""Days for which a certificate is valid unless said otherwise."""

MAX_PARTIES = 1000
"""Bound on the names of one call."""

_AUTHORITY = "authority"
_ISSUED = "issued.csv"
_ISSUED_FIELDS = ("serial", "name", "role", "expires")
_MAX_SERIAL = 2**159

# A name becomes a directory and the certificate's common name, which has 64 characters at most.
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")

_PRIVATE_FILE = 0o600
_PUBLIC_FILE = 0o644


class MadeCredentials(NamedTuple):
    """The credentials of one robot or service."""

    name: str
    role: Role
    directory: Path  # to be copied to its machine
    hosts: tuple[str, ...]  # under which robots may call a service; empty for a robot
    expires: datetime
    renewed: bool  # whether the key is the old one


class Issued(NamedTuple):
    """A certificate that the authority has signed; the name is empty if unknown."""

    serial: int
    name: str
    role: Role | None
    expires: datetime | None
    revoked: datetime | None = None


class KeyRing(NamedTuple):
    """The result of :func:`make_credentials`."""

    authority_key: Path
    authority_expires: datetime
    made: tuple[MadeCredentials, ...]


@contextlib.contextmanager
def alone_in(directory: Path, *, warn: Callable[[str], object] = warnings.warn) -> Iterator[None]:
    """Lock a directory against other processes, and complete what a killed one left unfinished.

    Takes and raises the same as :func:`make_credentials`.
    """
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
        names = {each.name for each in _recorded(directory).values()}
        for name in filter(_NAME.fullmatch, names - {_AUTHORITY}):
            _complete_rotation(directory / name)
        yield
    finally:
        if is_new:
            with contextlib.suppress(OSError):
                directory.rmdir()  # only if it is empty
        os.close(lock)


def make_credentials(
    directory: Path,
    *,
    # robots, services: their names; none at all means one robot ``robot`` and one service
    # ``service``, or with ``renew`` or ``rotate`` all that are there.
    robots: Sequence[str] = (),
    services: Sequence[str] = (),
    # Names and addresses under which robots call the services, besides those of this machine.
    hosts: Sequence[str] = (),
    # For which the certificates are valid; never longer than the authority.
    days: int = DEFAULT_DAYS,
    # renew, rotate: whether to replace existing certificates, except revoked ones; or keys as well.
    renew: bool = False,
    rotate: bool = False,
    now: datetime | None = None,
    warn: Callable[[str], object] = warnings.warn,
) -> KeyRing:
    """Make keys for robots and services, and their authority if there is none yet.

    Each party gets a directory of its name with ``authority.pem``, ``certificate.pem`` and
    ``key.pem``, which appears atomically. Another call adds parties of the same authority. Existing
    files stay, unless ``renew`` or ``rotate`` is set: then a new certificate replaces the old one,
    for the same key or a new one, and for at least the same hosts. The old one stays valid until it
    expires or is revoked (:func:`revoke_credentials`). The directory stays the same one, because a
    container may have mounted it, and can be used at every moment. The caller holds the lock
    (:func:`alone_in`).

    Raises CredentialsError if a name, host or number is out of bounds, or a file is in the way or
    missing; OutputError if a file cannot be written.
    """
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
    authority = Authority.new(now) if authority_is_new else Authority.read(home, now, warn)

    # All refusals come before the first file is written.
    revoked = None if authority_is_new else read_revocations(home, authority.certificate)
    numbers = frozenset(entry.serial_number for entry in revoked or ())
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
    trusted = {AUTHORITY_FILE: NewFile(certificate_pem(authority.certificate), _PUBLIC_FILE)}
    if authority_is_new:
        key = NewFile(key_pem(authority.key), _PRIVATE_FILE)
        create_directory_atomically(home, {**trusted, AUTHORITY_KEY_FILE: key})
    # Recorded first: a certificate without a record could not be revoked by its name.
    issued = _read_issued(directory, authority.certificate)
    _write_issued(home, [*issued, *(_issued(each.certificate) for each in parties)])
    for party in parties:
        place = party.made.directory
        files = {CERTIFICATE_FILE: NewFile(certificate_pem(party.certificate), _PUBLIC_FILE)}
        if party.key is None:
            replace_file(place / CERTIFICATE_FILE, *files[CERTIFICATE_FILE])
            continue
        files |= {**trusted, KEY_FILE: NewFile(key_pem(party.key), _PRIVATE_FILE)}
        if (home / REVOKED_FILE).exists():
            files[REVOKED_FILE] = NewFile(read_file(home / REVOKED_FILE), _PUBLIC_FILE)
        if _first_file_of(place) is None:
            create_directory_atomically(place, files)
        else:
            _rotate(place, files)
    return KeyRing(
        home / AUTHORITY_KEY_FILE,
        authority.certificate.not_valid_after_utc,
        tuple(party.made for party in parties),
    )


def revoke_credentials(
    directory: Path,
    *,
    names: Sequence[str] = (),
    serials: Sequence[int] = (),
    now: datetime | None = None,
    warn: Callable[[str], object] = warnings.warn,
) -> tuple[Issued, ...]:
    """Revoke certificates, and return those that were not revoked before.

    An end that has the new list refuses them: all certificates of these robots and services, and
    single ones by their numbers. The list is written to the authority and beside each party's
    credentials. Entries are never removed.

    Raises CredentialsError if a name never had a certificate, a number cannot be one, or a file is
    missing or malformed; OutputError if a file cannot be written.
    """
    now = (now or datetime.now(UTC)).replace(microsecond=0)
    home = directory / _AUTHORITY
    authority = Authority.read(home, now, warn)
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
    listed = read_revocations(home, authority.certificate)
    numbers = {entry.serial_number for entry in listed or ()}
    new = [each._replace(revoked=now) for each in wanted.values() if each.serial not in numbers]
    if new:
        content = authority.revoke(listed, [each.serial for each in new], now)
        write_atomically(home / REVOKED_FILE, content)
    if new or numbers:
        content = read_file(home / REVOKED_FILE)
        for certificate in _certificates_in(directory):
            # Even without a new entry: an earlier call may have been killed before it copied.
            replace_file(certificate.with_name(REVOKED_FILE), content, _PUBLIC_FILE)
    return tuple(new)


def list_credentials(directory: Path) -> tuple[Issued, ...]:
    """Return all certificates that an authority has signed or revoked.

    Raises CredentialsError if there is no authority, or a file is malformed.
    """
    home = directory / _AUTHORITY
    certificate = read_certificate(home / AUTHORITY_FILE)
    listed = {
        entry.serial_number: entry.revocation_date_utc
        for entry in read_revocations(home, certificate) or ()
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
            f"host {hosts[0]!r}: stands in services' certificates, and only robots are to be made; "
            f"name the service too (--service NAME; with --renew one that exists), or leave the "
            f"host out"
        )
    for host in hosts:
        if not is_host(host):
            raise CredentialsError(
                f"host {host!r}: is no host name and no IP address; for a service at "
                f"tls/10.0.0.7:7447 it is 10.0.0.7"
            )


def _first_file_of(place: Path) -> Path | None:
    """Return a file that a new directory would replace, if any."""
    if not place.is_dir():
        return place if place.exists() else None
    if (place / CERTIFICATE_FILE).exists():
        return place / CERTIFICATE_FILE
    return min(place.iterdir(), default=None)


class _Party(NamedTuple):
    made: MadeCredentials
    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey | None  # None: renewed, its key stays as it is


def _present(directory: Path) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of all robots and services that have a certificate here."""
    found = {
        each.parent.name: role_of(read_certificate(each)) for each in _certificates_in(directory)
    }
    if not found:
        raise CredentialsError(f"{directory}: has no certificates to renew")
    robots = [name for name, role in found.items() if role != "service"]
    return tuple(robots), tuple(name for name in found if name not in robots)


def _old_certificate(place: Path, role: Role, authority: Authority) -> x509.Certificate:
    """Return the certificate that is to be replaced, if it is one of ours."""
    path = place / CERTIFICATE_FILE
    old = read_certificate(path)
    if not is_signed_by(authority.certificate, old):
        raise CredentialsError(f"{path}: is not of the authority in {place.parent}")
    if role_of(old) != role:
        raise CredentialsError(f"{path}: is not a {role}'s certificate, so it is left alone")
    return old


def _party(
    place: Path,
    role: Role,
    hosts: Sequence[str],
    authority: Authority,
    now: datetime,
    end: datetime,
    old: x509.Certificate | None = None,
    *,
    rotate: bool = False,
) -> _Party:
    """Certify a new party, or one that has a certificate: with its key or with a new one."""
    key = new_key() if old is None or rotate else None
    certified = key or old
    assert certified is not None
    reached_at: tuple[str, ...] = ()
    if role == "service":
        before = _hosts_of_this_machine() if old is None else hosts_of(old)
        reached_at = tuple(dict.fromkeys(map(normal_host, (*before, *hosts))))
    certificate = authority.certify(place.name, role, reached_at, certified.public_key(), now, end)
    made = MadeCredentials(place.name, role, place, reached_at, end, key is None)
    return _Party(made, certificate, key)


def _rotate(place: Path, files: dict[str, NewFile]) -> None:
    """Replace a party's files one by one; the certificate decides which of the two keys is used."""
    authority = place / AUTHORITY_FILE
    if authority.exists() and files[AUTHORITY_FILE].content in read_file(authority):
        del files[AUTHORITY_FILE]  # it may have a second one, while robots move to that
    key = files.pop(KEY_FILE)
    certificate = files.pop(CERTIFICATE_FILE)
    for name, new in files.items():
        replace_file(place / name, *new)
    replace_file(place / NEXT_KEY_FILE, *key, like=place / KEY_FILE)
    replace_file(place / CERTIFICATE_FILE, *certificate)
    _complete_rotation(place)


def _complete_rotation(place: Path) -> None:
    """Let the next key take its place if its certificate is there already; else remove it."""
    remove_unfinished_of(place)
    next_key = place / NEXT_KEY_FILE
    if not next_key.exists():
        return
    try:
        if key_belongs_to(next_key, read_certificate(place / CERTIFICATE_FILE)):
            next_key.replace(place / KEY_FILE)
        else:
            next_key.unlink()
    except OSError as error:
        raise OutputError(f"{next_key}: cannot be moved: {error.strerror}") from error


def _issued(certificate: x509.Certificate) -> Issued:
    return Issued(
        certificate.serial_number,
        common_name_of(certificate),
        role_of(certificate),
        certificate.not_valid_after_utc,
    )


def _read_issued(directory: Path, authority: x509.Certificate) -> list[Issued]:
    """Return all signed certificates: the recorded ones, and others that lie here."""
    issued = _recorded(directory)
    for place in _certificates_in(directory):
        # Anything may lie here; a certificate of another authority is ignored.
        with contextlib.suppress(CredentialsError, ValueError):
            certificate = read_certificate(place)
            if is_signed_by(authority, certificate):
                issued.setdefault(certificate.serial_number, _issued(certificate))
    return list(issued.values())


def _recorded(directory: Path) -> dict[int, Issued]:
    """Return the record of signed certificates, by serial number."""
    path = directory / _AUTHORITY / _ISSUED
    issued: dict[int, Issued] = {}
    if path.exists():
        try:
            for serial, name, role, expires in _rows_of(read_file(path).decode()):
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


def _hosts_of_this_machine() -> list[str]:
    own = socket.gethostname()
    return ["localhost", "127.0.0.1", "::1", *([own] if is_host(own) else [])]
