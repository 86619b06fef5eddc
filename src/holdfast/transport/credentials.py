"""Credentials before a link is opened: they are checked.

TLS libraries report late, and in few words, why they refuse a certificate. So when a robot or a
service starts, it performs the handshake of both ends in memory. If the peer would refuse these
credentials, the error names the file and the reason.

All this needs only the standard library; :mod:`holdfast.transport.key_ring` makes credentials.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from holdfast.errors import CredentialsError, CredentialsGoneError, TransportError
from holdfast.transport.endpoints import AUTHORITY_FILE, REVOKED_FILE, Role, TlsFiles
from holdfast.transport.revocation import refuse_revoked

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
    """Check the credentials in a robot's or a service's directory.

    It warns if others can read the key, or the certificate expires soon.

    Raises CredentialsError if the peer would refuse them: a file is missing, unreadable or
    malformed, the key belongs to another certificate, the certificate is not valid now, was signed
    by another authority, is for the other role, or has not exactly one common name. The kind is
    CredentialsGoneError for what is missing, unreadable, expired or revoked.
    """
    directory = Path(directory)
    files = TlsFiles.of(directory)
    for path in (files.authority, files.certificate, files.key):
        try:
            with path.open("rb"):
                pass
        except OSError as error:
            raise CredentialsGoneError(_unreadable(directory, path, role, error)) from error
    warn_if_open(files.key, warn)
    name, expires_s = _check_handshake(files, role)
    days_left = (expires_s - datetime.now(UTC).timestamp()) / 86_400.0
    if days_left < EXPIRES_SOON_DAYS:
        left = f"{days_left:.1f} days" if days_left >= 1.0 else f"{24 * days_left:.1f} hours"
        warn(f"{files.certificate}: expires in {left}, on {date_text(expires_s)}")
    return LoadedCredentials(files, name, expires_s)


def _unreadable(directory: Path, path: Path, role: Role, error: OSError) -> str:
    text = f"{path}: cannot be read: {error.strerror}"
    if isinstance(error, PermissionError):
        return f"{text}; this process is user {os.geteuid()}"
    if TlsFiles.of(directory / role).certificate.exists():
        return f"{text}; did you mean {directory / role}?"
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

    from holdfast.transport.tls import common_name, describe_certificate_error, make_context

    authority, certificate = files.authority, files.certificate
    serving = role == "service"
    protocols = ssl.PROTOCOL_TLS_SERVER, ssl.PROTOCOL_TLS_CLIENT
    try:
        ours, theirs = (make_context(each, files) for each in protocols[:: 1 if serving else -1])
        refuse_revoked(theirs, authority.parent)
    except TransportError as error:
        raise CredentialsError(str(error)) from error
    ours.check_hostname = theirs.check_hostname = False
    ours.verify_mode = ssl.CERT_NONE  # the other end's stands for any

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
        kind = CredentialsGoneError if error.verify_code in _GONE else CredentialsError
        raise kind(
            f"{certificate}: {reason}{_renewal_hint(certificate, role, error.verify_code)}"
        ) from error
    except (ssl.SSLError, ValueError) as error:
        raise CredentialsError(f"{certificate}: does not work for TLS: {error}") from error
    try:
        name = common_name(shown)
    except ValueError as error:
        raise CredentialsError(f"{certificate}: {error}") from error
    return name, float(ssl.cert_time_to_seconds(str(shown["notAfter"])))


_CRL_ERRORS = {
    3: f"is not of the authority beside it, {AUTHORITY_FILE}",
    8: f"was not signed by the authority beside it, {AUTHORITY_FILE}",
    11: "is not valid yet; is this machine's clock right?",
    12: "has expired",
}
"""Faults of a revocation list, by OpenSSL's error numbers."""

_GONE = (10, 23)
"""OpenSSL's numbers for a certificate that has expired or was revoked."""


def _renewal_hint(certificate: Path, role: Role, verify_code: int) -> str:
    """Return the validity of a certificate, or how to get another one."""
    from holdfast.transport.tls import REMEDIES

    remedy = REMEDIES.get(verify_code, "").format(role=role)
    if verify_code not in (9, 10):
        return remedy
    try:
        from cryptography import x509
    except ImportError:
        return remedy
    read = x509.load_pem_x509_certificate(certificate.read_bytes())
    return (
        f" (valid from {date_text(read.not_valid_before_utc.timestamp())}"
        f" to {date_text(read.not_valid_after_utc.timestamp())}){remedy}"
    )


def date_text(time_s: float) -> str:
    """Return a time, in seconds since 1970, as text."""
    return datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%d %H:%M UTC")
