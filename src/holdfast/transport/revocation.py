"""Who has been revoked: the authority's list, ``revoked.pem`` beside the credentials.

It is an X.509 certificate revocation list, and optional. A robot passes it to the ``ssl`` module,
which checks it in each handshake. A service reads the serial numbers itself and checks them after
each handshake, so it knows the name of the refused robot, and can end existing links. That is safe
because :func:`~holdfast.transport.credentials.load_credentials` has verified the signature in a
handshake.
"""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from holdfast.errors import TransportError
from holdfast.transport.endpoints import REVOKED_FILE

if TYPE_CHECKING:
    import ssl

_MAX_LIST_BYTES = 16 << 20
"""Size of a list: about 400,000 certificates."""

_PEM_BLOCK = re.compile(rb"-----BEGIN ([A-Z0-9 ]+)-----(.*?)-----END \1-----", re.DOTALL)

_INTEGER, _SEQUENCE, _TIMES = 0x02, 0x30, (0x17, 0x18)
"""Tags of DER."""


def refuse_revoked(context: ssl.SSLContext, directory: Path) -> None:
    """Make handshakes refuse the certificates in a directory's list, if there is one.

    Raises TransportError if the list cannot be read. Its signature is checked in a handshake.
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

    Raises TransportError if it cannot be read, or is no revocation list.
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
    ((_, whole),) = _values(der, _SEQUENCE)
    signed, *_ = _values(whole)
    # Version, algorithm, issuer, one or two times, then the entries if there are any.
    fields = list(_values(signed[1]))
    times = [index for index, (tag, _) in enumerate(fields) if tag in _TIMES]
    for tag, entries in fields[times[-1] + 1 :][:1]:
        for _, entry in _values(entries, _SEQUENCE) if tag == _SEQUENCE else ():
            (tag, serial), *_ = _values(entry)
            if tag != _INTEGER:
                raise ValueError(f"an entry that begins with the tag {tag:#04x}")
            yield int.from_bytes(serial, "big", signed=True)


def _values(data: bytes, expected: int | None = None) -> Iterator[tuple[int, bytes]]:
    """Yield tags and contents of consecutive DER values, which all have the expected tag."""
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
        if expected not in (None, tag):
            raise ValueError(f"a value with the tag {tag:#04x} where {expected:#04x} belongs")
        yield tag, data[at : at + size]
        at += size
