"""Checks credentials before a link is opened.

TLS libraries report late, and in few words, why they refuse a certificate. So when a robot or a
service starts, it performs the handshake of both ends in memory. If the peer would refuse these
credentials, the error names the file and the reason.

:mod:`holdfast.transport.key_ring` makes credentials.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from holdfast.errors import CredentialsError, TransportError
from holdfast.transport.endpoints import AUTHORITY_FILE, Role, TlsFiles
from holdfast.transport.revocation import REVOKED_FILE, refuse_revoked

if TYPE_CHECKING:
    import ssl

__all__ = [
    "EXPIRES_SOON_DAYS",
    "LoadedCredentials",
    "date_text",
    "file_versions",
    "load_credentials",
    "warn_if_open",
]

EXPIRES_SOON_DAYS = 14
"""With fewer days left, loading a certificate warns."""

_OPEN_TO_OTHERS = 0o077
_GROUP_READS = 0o040


class LoadedCredentials(NamedTuple):
    """Checked credentials, the certificate's name, and its end in seconds since 1970."""

    files: TlsFiles
    name: str
    expires_s: float


def load_credentials(
    directory: Path | str, role: Role, *, warn: Callable[[str], object] = warnings.warn
) -> LoadedCredentials:
    """Check a robot's or a service's credentials.

    Parameters
    ----------
    directory : Path or str
        With ``authority.pem``, ``certificate.pem`` and ``key.pem``.
    warn : callable
        Takes warnings as text: others can read the key, or the certificate expires soon.

    Raises
    ------
    CredentialsError
        If the peer would refuse them: a file is missing, unreadable or malformed, the key belongs
        to another certificate, the certificate is not valid now, was signed by another authority,
        is for the other role, or has not exactly one common name.
    """
    directory = Path(directory)
    files = TlsFiles.of(directory)
    for path in (files.authority, files.certificate, files.key):
        try:
            with path.open("rb"):
                pass
        except OSError as error:
            raise CredentialsError(_unreadable(directory, path, role, error)) from error
    warn_if_open(files.key, warn)
    name, expires_s = _check_handshake(files, role)
    days_left = (expires_s - datetime.now(UTC).timestamp()) / 86_400.0
    if days_left < EXPIRES_SOON_DAYS:
        warn(f"{files.certificate}: expires in {days_left:.1f} days, on {date_text(expires_s)}")
    return LoadedCredentials(files, name, expires_s)


def file_versions(files: TlsFiles) -> list[tuple[int, int, int] | None]:
    """Return inode, change time and size of each file and of the revocation list.

    Not the modification time: a copied file may keep that of its original.
    """
    found: list[tuple[int, int, int] | None] = []
    revoked = files.authority.with_name(REVOKED_FILE)
    for path in (files.authority, files.certificate, files.key, revoked):
        try:
            status = path.stat()
        except OSError:
            found.append(None)
        else:
            found.append((status.st_ino, status.st_ctime_ns, status.st_size))
    return found


def _unreadable(directory: Path, path: Path, role: Role, error: OSError) -> str:
    text = f"{path}: cannot be read: {error.strerror}"
    if isinstance(error, PermissionError):
        return f"{text}; this process is user {os.geteuid()}"
    if TlsFiles.of(directory / role).certificate.exists():
        return f"{text}; did you mean {directory / role}?"
    if directory.with_name(f".{directory.name}.old").exists():
        return f'{text}; "holdfast keys {directory.parent} --list" brings back what was broken off'
    if isinstance(error, FileNotFoundError):
        return f'{text}; "holdfast keys DIR" makes such files'
    return text


def warn_if_open(key: Path, warn: Callable[[str], object]) -> None:
    """Warn of a key that others can read.

    The group may read a key of another owner: systemd and Kubernetes provide credentials that way.
    """
    status = key.stat()
    mode = status.st_mode
    allowed = 0 if os.geteuid() in (0, status.st_uid) else _GROUP_READS
    if mode & _OPEN_TO_OTHERS & ~allowed:
        warn(f"{key}: others can read this key (mode {mode & 0o777:03o}); chmod 600 {key}")


def _check_handshake(files: TlsFiles, role: Role) -> tuple[str, float]:
    """Perform both ends' handshake in memory; return the certificate's name and end."""
    import ssl

    from holdfast.transport.tls import common_name, describe_certificate_error

    authority, certificate, key = files.authority, files.certificate, files.key
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
    # A server needs some certificate; it is not checked here.
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
        shown = far.getpeercert() or {}
    except ssl.SSLCertVerificationError as error:
        if error.verify_code in _CRL_ERRORS:
            reason = _CRL_ERRORS[error.verify_code]
            raise CredentialsError(f"{authority.with_name(REVOKED_FILE)}: {reason}") from error
        reason = describe_certificate_error(error, role)
        raise CredentialsError(
            f"{certificate}: {reason}{_renewal_hint(certificate, role, error.verify_code)}"
        ) from error
    except (ssl.SSLError, ValueError) as error:
        raise CredentialsError(f"{certificate}: does not work for TLS: {error}") from error
    try:
        name = common_name(shown)
    except ValueError as error:
        raise CredentialsError(f"{certificate}: {error}") from error
    return name, float(ssl.cert_time_to_seconds(str(shown["notAfter"])))


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


_CRL_ERRORS = {
    3: f"is not of the authority beside it, {AUTHORITY_FILE}",
    8: f"was not signed by the authority beside it, {AUTHORITY_FILE}",
    11: "is not valid yet; is this machine's clock right?",
    12: "has expired",
}
"""Faults of a revocation list, by OpenSSL's error numbers."""


def _renewal_hint(certificate: Path, role: Role, verify_code: int) -> str:
    """Return the validity of a certificate, or how to get another one."""
    if verify_code == 23:
        return f"; 'holdfast keys DIR --rotate --{role} NAME' makes new ones"
    if verify_code not in (9, 10):
        return ""
    renew = (
        f"; 'holdfast keys DIR --renew --{role} NAME' makes another" if verify_code == 10 else ""
    )
    try:
        from cryptography import x509
    except ImportError:
        return renew
    read = x509.load_pem_x509_certificate(certificate.read_bytes())
    return (
        f" (valid from {date_text(read.not_valid_before_utc.timestamp())}"
        f" to {date_text(read.not_valid_after_utc.timestamp())}){renew}"
    )


def date_text(time_s: float) -> str:
    """Return a time, in seconds since 1970, as text."""
    return datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%d %H:%M UTC")
