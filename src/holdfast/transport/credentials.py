"""Credentials before a link is opened: they are checked, and so is who has been revoked.

TLS libraries report late, and in few words, why they refuse a certificate. So when a robot or a
service starts, it performs the handshake of both ends in memory. If the peer would refuse these
credentials, the error names the file and the reason.

The authority's list of revoked certificates, ``revoked.pem`` beside the credentials, is an X.509
certificate revocation list, and optional. A robot passes it to the ``ssl`` module, which checks it
in each handshake. A service reads the serial numbers itself and checks them after each handshake,
so it knows the name of the refused robot, and can end existing links. That is safe because
:func:`load_credentials` has verified the signature in a handshake.

All this needs only the standard library; :mod:`holdfast.transport.key_ring` makes credentials.
"""

from __future__ import annotations

import base64
import binascii
import os
import re
import warnings
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from holdfast.errors import CredentialsError, CredentialsGoneError, TransportError
from holdfast.transport.endpoints import AUTHORITY_FILE, REVOKED_FILE, Role, TlsFiles

if TYPE_CHECKING:
    import ssl

__all__ = [
    "EXPIRES_SOON_DAYS",
    "LoadedCredentials",
    "date_text",
    "file_versions",
    "load_credentials",
    "refuse_revoked",
    "revoked_serials",
    "warn_if_open",
]

EXPIRES_SOON_DAYS = 14
"""With fewer days left, loading a certificate warns."""

_OPEN_TO_OTHERS = 0o077
_GROUP_READS = 0o040

_MAX_LIST_BYTES = 16 << 20
"""Of a list: about 400,000 certificates."""

_PEM_BLOCK = re.compile(rb"-----BEGIN ([A-Z0-9 ]+)-----(.*?)-----END \1-----", re.DOTALL)

_INTEGER, _SEQUENCE, _TIMES = 0x02, 0x30, (0x17, 0x18)
"""Tags of DER."""


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

    Raises
    ------
    CredentialsError
        If the peer would refuse them: a file is missing, unreadable or malformed, the key belongs
        to another certificate, the certificate is not valid now, was signed by another authority,
        is for the other role, or has not exactly one common name. The kind is
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


def refuse_revoked(context: ssl.SSLContext, directory: Path) -> None:
    """Make handshakes refuse the certificates in a directory's list, if there is one.

    Raises
    ------
    TransportError
        If the list cannot be read. Its signature is checked in a handshake.
    """
    import ssl

    path = directory / REVOKED_FILE
    if not path.exists():
        return
    revoked_serials(path)  # checks that the file has no certificate, which would be trusted
    try:
        context.load_verify_locations(cafile=path)
    except (OSError, ssl.SSLError) as error:
        raise TransportError(f"{path}: is no revocation list in PEM form: {error}") from error
    context.verify_flags |= ssl.VerifyFlags.VERIFY_CRL_CHECK_LEAF


def revoked_serials(path: Path) -> frozenset[int]:
    """Return the serial numbers in a list in PEM form; none if there is no such file.

    Raises
    ------
    TransportError
        If it cannot be read, or is no revocation list.
    """
    try:
        with path.open("rb") as file:
            content = file.read(_MAX_LIST_BYTES + 1)
    except FileNotFoundError:
        return frozenset()
    except OSError as error:
        raise TransportError(f"{path}: cannot be read: {error.strerror}") from error
    if len(content) > _MAX_LIST_BYTES:
        raise TransportError(f"{path}: is larger than {_MAX_LIST_BYTES} bytes")
    blocks = _PEM_BLOCK.findall(content)
    if [name for name, _ in blocks] != [b"X509 CRL"] or content.count(b"-----BEGIN") != 1:
        raise TransportError(f"{path}: is no revocation list in PEM form")
    try:
        return frozenset(_serials(base64.b64decode(b"".join(blocks[0][1].split()), validate=True)))
    except (binascii.Error, ValueError, IndexError) as error:
        raise TransportError(f"{path}: is a malformed revocation list: {error}") from error


def _serials(der: bytes) -> Iterator[int]:
    """Yield the serial numbers in a list (RFC 5280, section 5.1)."""
    ((tag, whole),) = _values(der)
    _expect(tag, _SEQUENCE)
    tag, signed = next(_values(whole))
    _expect(tag, _SEQUENCE)
    fields = list(_values(signed))
    tags = [tag for tag, _ in fields]
    # Version, algorithm, issuer, one or two times, then the entries if there are any.
    at = next(index for index, tag in enumerate([*tags, _TIMES[0]]) if tag in _TIMES)
    while at < len(fields) and tags[at] in _TIMES:
        at += 1
    if at < len(fields) and tags[at] == _SEQUENCE:
        for tag, entry in _values(fields[at][1]):
            _expect(tag, _SEQUENCE)
            tag, serial = next(_values(entry), (0, b""))
            _expect(tag, _INTEGER)
            yield int.from_bytes(serial, "big", signed=True)


def _values(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield tags and contents of consecutive DER values."""
    at = 0
    while at < len(data):
        tag, size = data[at], data[at + 1]
        at += 2
        if size & 0x80:
            count = size & 0x7F
            if not 1 <= count <= 4:
                raise ValueError(f"a length of {count} bytes")
            size = int.from_bytes(data[at : at + count], "big")
            at += count
        if at + size > len(data):
            raise ValueError(f"a value of {size} bytes where {len(data) - at} are left")
        yield tag, data[at : at + size]
        at += size


def _expect(tag: int, expected: int) -> None:
    if tag != expected:
        raise ValueError(f"a value with the tag {tag:#04x} where {expected:#04x} belongs")
