"""The X.509 of the authority: its certificate, those that it signs, and its revocation list.

:mod:`holdfast.transport.key_ring` makes and keeps the files. This module needs the package
``cryptography``; without it, importing raises :class:`~holdfast.errors.CredentialsError`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Sequence
from datetime import datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from typing import NamedTuple, Self

from holdfast.errors import CredentialsError, TransportError, how_to_install
from holdfast.transport.credentials import date_text, warn_if_open
from holdfast.transport.endpoints import AUTHORITY_FILE, REVOKED_FILE, Role, parse_host

try:
    from cryptography import x509
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.hazmat.primitives.asymmetric.types import CertificatePublicKeyTypes
    from cryptography.hazmat.primitives.serialization import (
        Encoding,
        NoEncryption,
        PrivateFormat,
        load_pem_private_key,
    )
    from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
except ImportError as error:
    advice = how_to_install("cryptography")
    raise CredentialsError(f"making keys needs the package cryptography: {advice}") from error

AUTHORITY_DAYS = 3650
"""Days for which a new authority is valid; no certificate outlives its authority."""

AUTHORITY_KEY_FILE = "authority.key"

# A robot whose clock is a little behind would refuse a certificate that begins now.
_BACKDATED = timedelta(days=1)

_USAGES: dict[Role, x509.ObjectIdentifier] = {
    "robot": ExtendedKeyUsageOID.CLIENT_AUTH,
    "service": ExtendedKeyUsageOID.SERVER_AUTH,
}


class Authority(NamedTuple):
    """The certificate that both ends trust, and its key."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey

    @classmethod
    def new(cls, now: datetime) -> Self:
        """Make a key and a self-signed certificate."""
        key = new_key()
        serial = x509.random_serial_number()
        # Two authorities must not have the same name: a chain is looked up by it.
        name = _common_name(f"holdfast authority {serial:x}"[:40])
        begin, end = now - _BACKDATED, now + timedelta(days=AUTHORITY_DAYS)
        builder = _builder(name, name, key.public_key(), begin, end, signs_certificates=True)
        return cls(builder.serial_number(serial).sign(key, hashes.SHA256()), key)

    @classmethod
    def read(cls, home: Path, now: datetime, warn: Callable[[str], object]) -> Self:
        """Read the authority's files; raise CredentialsError if one cannot be used."""
        certificate = read_certificate(home / AUTHORITY_FILE)
        path = home / AUTHORITY_KEY_FILE
        try:
            key = load_pem_private_key(read_file(path), password=None)
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
        return cls(certificate, key)

    def certify(
        self,
        name: str,
        role: Role,
        hosts: Sequence[str],
        public_key: CertificatePublicKeyTypes,
        now: datetime,
        end: datetime,
    ) -> x509.Certificate:
        """Certify a robot, or a service at some hosts, until ``end``."""
        builder = (
            _builder(
                _common_name(name), self.certificate.subject, public_key, self._begin(now), end
            )
            .serial_number(x509.random_serial_number())
            .add_extension(x509.ExtendedKeyUsage([_USAGES[role]]), critical=False)
            .add_extension(self._identifier, critical=False)
        )
        if hosts:
            names = [_general_name(host) for host in hosts]
            builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
        return builder.sign(self.key, hashes.SHA256())

    def revoke(
        self, before: x509.CertificateRevocationList | None, serials: Iterable[int], now: datetime
    ) -> bytes:
        """Return the next list in PEM: the entries of before, and these numbers as of now."""
        number = 1
        if before is not None:
            number += before.extensions.get_extension_for_class(x509.CRLNumber).value.crl_number
        builder = (
            x509.CertificateRevocationListBuilder()
            .issuer_name(self.certificate.subject)
            .last_update(self._begin(now))
            # A list that expires would lock everybody out.
            .next_update(self.certificate.not_valid_after_utc)
            .add_extension(x509.CRLNumber(number), critical=False)
            .add_extension(self._identifier, critical=False)
        )
        entries = [x509.RevokedCertificateBuilder(serial, now).build() for serial in serials]
        for entry in (*(before or ()), *entries):
            builder = builder.add_revoked_certificate(entry)
        return builder.sign(self.key, hashes.SHA256()).public_bytes(Encoding.PEM)

    def _begin(self, now: datetime) -> datetime:
        return max(now - _BACKDATED, self.certificate.not_valid_before_utc)

    @property
    def _identifier(self) -> x509.AuthorityKeyIdentifier:
        return x509.AuthorityKeyIdentifier.from_issuer_public_key(self.key.public_key())


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    public_key: CertificatePublicKeyTypes,
    begin: datetime,
    end: datetime,
    *,
    signs_certificates: bool = False,
) -> x509.CertificateBuilder:
    usage = x509.KeyUsage(
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
    path_length = 0 if signs_certificates else None
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(public_key)
        .not_valid_before(begin)
        .not_valid_after(end)
        .add_extension(x509.BasicConstraints(signs_certificates, path_length), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(public_key), critical=False)
    )


def is_signed_by(authority: x509.Certificate, certificate: x509.Certificate) -> bool:
    """Return whether an authority has signed a certificate."""
    with contextlib.suppress(ValueError, TypeError, InvalidSignature):
        certificate.verify_directly_issued_by(authority)
        return True
    return False


def read_revocations(
    home: Path, authority: x509.Certificate
) -> x509.CertificateRevocationList | None:
    """Return the authority's list, None without one; raise CredentialsError for another's."""
    path = home / REVOKED_FILE
    if not path.exists():
        return None
    try:
        revoked = x509.load_pem_x509_crl(read_file(path))
    except ValueError as error:
        raise CredentialsError(f"{path}: is no revocation list in PEM form") from error
    key = authority.public_key()
    assert isinstance(key, ec.EllipticCurvePublicKey)
    if not revoked.is_signature_valid(key):
        raise CredentialsError(f"{path}: was not signed by {home / AUTHORITY_FILE}")
    return revoked


def new_key() -> ec.EllipticCurvePrivateKey:
    """Make a private key."""
    return ec.generate_private_key(ec.SECP256R1())


def key_belongs_to(path: Path, certificate: x509.Certificate) -> bool:
    """Return whether a file has the key of a certificate."""
    with contextlib.suppress(ValueError, TypeError):
        return load_pem_private_key(read_file(path), None).public_key() == certificate.public_key()
    return False


def common_name_of(certificate: x509.Certificate) -> str:
    """Return the name in a certificate; empty if it has none."""
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""


def _common_name(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def hosts_of(certificate: x509.Certificate) -> tuple[str, ...]:
    """Return the hosts that a certificate names."""
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ()
    return tuple(str(name.value) for name in names)


def role_of(certificate: x509.Certificate) -> Role | None:
    """Return the role that a certificate is for; None if there is none."""
    try:
        usages = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    except x509.ExtensionNotFound:
        return None
    return next((role for role, usage in _USAGES.items() if list(usages) == [usage]), None)


def read_certificate(path: Path) -> x509.Certificate:
    """Read a certificate, or raise CredentialsError."""
    try:
        return x509.load_pem_x509_certificate(read_file(path))
    except ValueError as error:
        raise CredentialsError(f"{path}: is no certificate in PEM form") from error


def read_file(path: Path) -> bytes:
    """Read a file, or raise CredentialsError."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise CredentialsError(f"{path}: cannot be read: {error.strerror}") from error


def certificate_pem(certificate: x509.Certificate) -> bytes:
    """Return a certificate in PEM."""
    return certificate.public_bytes(Encoding.PEM)


def key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    """Return a private key in PEM, without a password."""
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())


def is_host(host: str) -> bool:
    """Return whether a certificate can name this host."""
    with contextlib.suppress(TransportError):
        return bool(parse_host(f"[{host}]" if ":" in host else host))
    return False


def normal_host(host: str) -> str:
    """Return a host as certificates name it."""
    try:
        return str(ip_address(host))
    except ValueError:
        return host.lower()
