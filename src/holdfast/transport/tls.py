"""TLS for one link, in memory: encrypted bytes in, messages out.

Both ends show a certificate of our own authority, and TLS 1.3 is the only version. The robot is
the client. So its certificate only allows calls, and it checks the service's host against the
service's certificate.

The link reads the socket and decrypts in memory, so no handshake begins before the peer's first
byte, and a port scanner costs no more than its connection.

The handshake also tells the robot whether it has reached the same process as before, one round trip
before the hello: the robot offers "holdfast/INCARNATION" as a protocol (ALPN), and a service
selects its own incarnation.
"""

from __future__ import annotations

import contextlib
import os
import re
import ssl
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from holdfast.errors import FrameError, TransportError
from holdfast.transport.endpoints import AUTHORITY_FILE, NEXT_KEY_FILE, TlsFiles
from holdfast.transport.revocation import refuse_revoked

_ANY_INCARNATION = "holdfast"

_KEY_EXCHANGE = "prime256v1"
"""The only group: with OpenSSL's largest (ffdhe8192), an unauthenticated client would cost a
service 0.2 s of computing. Python 3.11.2 (Debian 12) cannot choose X25519."""

_READ_BYTES = 16 * 1024
"""The largest record."""

_ONE_AUTHORITY = "; both ends need files of one 'holdfast keys DIR'"

REMEDIES = {
    10: "; 'holdfast keys DIR --renew --{role} NAME' makes another",
    **dict.fromkeys((7, 18, 19, 20, 21), _ONE_AUTHORITY),
    23: "; 'holdfast keys DIR --rotate --{role} NAME' makes a new key",
    26: "; a {role} shows its own: 'holdfast keys DIR' makes DIR/{role}",
}
"""For a certificate, by OpenSSL's error numbers."""

_ALERTS = {
    "CERTIFICATE_EXPIRED": f"it has expired by the clock there{REMEDIES[10]}",
    "CERTIFICATE_REVOKED": f"it has been revoked{REMEDIES[23]}",
    "UNKNOWN_CA": f"it was not signed by the authority in {AUTHORITY_FILE} there{_ONE_AUTHORITY}",
    "CERTIFICATE_REQUIRED": "there is none, and one is required",
    "UNSUPPORTED_CERTIFICATE": f"it is not for a {{role}}{REMEDIES[26]}",
    "DECRYPT_ERROR": "this end's key is not the certificate's",
    "BAD_CERTIFICATE": "it is not valid yet by the clock there, or is malformed",
}
"""The peer's alerts about this end's certificate (RFC 8446, section 6.2)."""

_BAD_SERVICE_CERTIFICATE = (
    "it does not name the host that the robot calls, or is not valid yet by the clock there; the "
    "robot's log says which"
)


class PeerCertificate(NamedTuple):
    """The peer's certificate."""

    name: str  # the common name
    serial_number: int
    expires_at: float  # in seconds since 1970
    authorities: frozenset[bytes]  # the one that signed it, as DER; several with one name


def client_context(files: TlsFiles) -> ssl.SSLContext:
    """Return the context of a robot's links; handshakes refuse revoked certificates."""
    context = make_context(ssl.PROTOCOL_TLS_CLIENT, files)
    refuse_revoked(context, files.authority.parent)
    return context


def server_context(files: TlsFiles, incarnation: str) -> ssl.SSLContext:
    """Return the context of a service's links.

    Handshakes accept revoked certificates. The service refuses them afterwards, so its log has the
    name.
    """
    context = make_context(ssl.PROTOCOL_TLS_SERVER, files)
    context.num_tickets = 0  # no resumption: every link shows the certificate
    context.set_alpn_protocols([_alpn_name(incarnation), _ANY_INCARNATION])
    return context


def make_context(protocol: int, files: TlsFiles) -> ssl.SSLContext:
    """Return a context with these credentials; raise TransportError if they cannot be used."""
    context = ssl.SSLContext(protocol)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.verify_mode = ssl.CERT_REQUIRED
    context.set_ecdh_curve(_KEY_EXCHANGE)
    at = files.authority
    try:
        context.load_verify_locations(cafile=at)
        at = files.certificate
        try:
            # Without the empty password, an encrypted key would ask for one on the terminal.
            context.load_cert_chain(files.certificate, files.key, password="")
        except ssl.SSLError as error:
            next_key = files.key.with_name(NEXT_KEY_FILE)
            if error.reason != "KEY_VALUES_MISMATCH" or not next_key.exists():
                raise
            # A rotation is under way, or was killed: the certificate is the new one already.
            context.load_cert_chain(files.certificate, next_key, password="")
    except (OSError, ssl.SSLError) as error:
        raise TransportError(_why_unusable(files, at, error)) from error
    return context


def _why_unusable(files: TlsFiles, at: Path, error: OSError) -> str:
    certificate, key = files.certificate, files.key
    if not isinstance(error, ssl.SSLError):
        absent = next((each for each in (certificate, key) if not os.access(each, os.R_OK)), at)
        return f"{at if at == files.authority else absent}: cannot be read: {error.strerror}"
    if at == files.authority:
        return f"{at}: is no certificate in PEM form"
    if error.reason == "KEY_VALUES_MISMATCH":
        return f"{key}: is not the key of {certificate}"
    if b"PRIVATE KEY" not in key.read_bytes():
        return f"{key}: is no private key in PEM form"
    if b"ENCRYPTED" in key.read_bytes():
        return f"{key}: is encrypted; a key that a program reads by itself must not be"
    if b"BEGIN CERTIFICATE" not in certificate.read_bytes():
        return f"{certificate}: is no certificate in PEM form"
    return f"{certificate} and {key} cannot be used: {error.reason or error}"


class ClientCredentials:
    """A robot's credentials, read again for a new link if the files have changed.

    When changed files cannot be used, ``on_unusable`` is called with the reason, and the previous
    ones stay in use. At the beginning TransportError is raised instead.
    """

    def __init__(self, files: TlsFiles, on_unusable: Callable[[str], None]) -> None:
        self._files = files
        self._on_unusable = on_unusable
        self._seen = files.versions()
        self._context = client_context(files)

    def context(self) -> ssl.SSLContext:
        """Return the context for a new link."""
        seen = self._files.versions()
        if seen != self._seen:
            self._seen = seen
            try:
                self._context = client_context(self._files)
            except TransportError as error:
                self._on_unusable(f"{error}; the previous ones stay in use")
        return self._context


def _alpn_name(incarnation: str) -> str:
    return f"{_ANY_INCARNATION}/{incarnation}"


class TlsStream:
    """One end of TLS on one stream.

    For a robot, ``host`` is the name or address that the certificate must be for, and ``known`` the
    last incarnation of the service.
    """

    def __init__(
        self, context: ssl.SSLContext, host: str | None = None, known: str | None = None
    ) -> None:
        self._is_server = context.protocol == ssl.PROTOCOL_TLS_SERVER
        if not self._is_server:
            names = [_ANY_INCARNATION]
            context.set_alpn_protocols([_alpn_name(known), *names] if known is not None else names)
        self._known = known
        self._incoming = ssl.MemoryBIO()
        self._outgoing = ssl.MemoryBIO()
        self._tls = context.wrap_bio(
            self._incoming, self._outgoing, server_side=self._is_server, server_hostname=host
        )
        self._has_first_byte = False
        # Whether the handshake is complete at this end. The robot's end completes it before the
        # service has checked the robot's certificate.
        self.established = False
        self.ended = False  # whether the peer will send nothing more

    @property
    def is_known_incarnation(self) -> bool:
        """For a robot: whether the service is the known process, once established."""
        chosen = self._tls.selected_alpn_protocol()
        return self._known is not None and chosen == _alpn_name(self._known)

    def begin(self) -> None:
        """Begin the handshake, at the robot's end; or go on with it."""
        with contextlib.suppress(ssl.SSLWantReadError):
            self._tls.do_handshake()
            self.established = True

    def receive(self, data: bytes) -> bytes:
        """Take bytes of the stream; return those of messages.

        Raises ssl.SSLError if the handshake fails at either end; FrameError if the peer does not
        speak TLS at all.
        """
        if not self._has_first_byte:
            self._has_first_byte = True
            if self._is_server and data[:1] != b"\x16":
                raise FrameError("does not speak TLS, and this endpoint does")
        self._incoming.write(data)
        if not self.established:
            self.begin()
            if not self.established:
                return b""
        parts = []
        try:
            while self._incoming.pending or self._tls.pending():
                part = self._tls.read(_READ_BYTES)
                if not part:
                    self.ended = True
                    break
                parts.append(part)
        except ssl.SSLWantReadError:
            pass
        except ssl.SSLZeroReturnError:
            self.ended = True
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def send(self, data: bytes) -> None:
        """Encrypt bytes of messages, for :meth:`take`."""
        self._tls.write(data)

    def take(self) -> bytes:
        """Return the bytes to send, once."""
        return self._outgoing.read()

    def close(self) -> None:
        """Announce that this end sends nothing more."""
        if self.established:
            with contextlib.suppress(ssl.SSLError):  # the peer's announcement is not awaited
                self._tls.unwrap()

    def peer(self) -> PeerCertificate:
        """Return the peer's certificate, once established; raise FrameError if it has no name."""
        shown = self._tls.getpeercert() or {}
        try:
            name = common_name(shown)
        except ValueError as error:
            raise FrameError(f"has a certificate that {error}") from error
        return PeerCertificate(
            name,
            int(str(shown["serialNumber"]), 16),
            float(ssl.cert_time_to_seconds(str(shown["notAfter"]))),
            self._authorities(shown["issuer"]),
        )

    def _authorities(self, name: object) -> frozenset[bytes]:
        context = self._tls.context
        named = context.get_ca_certs()
        known = context.get_ca_certs(binary_form=True)
        found = [der for read, der in zip(named, known, strict=True) if read["subject"] == name]
        # The issuer may be an intermediate certificate, which only the handshake has seen.
        return frozenset(found or known)

    def describe_error(self, error: OSError) -> str:
        """Return the meaning of OpenSSL's error, as the rest of a sentence about the peer."""
        assert isinstance(error, ssl.SSLError)
        if isinstance(error, ssl.SSLCertVerificationError):
            role = "robot" if self._is_server else "service"
            fault = describe_certificate_error(error, role)
            what_to_do = REMEDIES.get(error.verify_code, "")
            return f"has a certificate that {fault}{what_to_do.format(role=role)}"
        reason = error.reason or ""
        alert = reason.partition("_ALERT_")[2]
        if alert:
            own = "service" if self._is_server else "robot"
            meaning = _ALERTS.get(alert)
            if self._is_server and alert == "BAD_CERTIFICATE":
                meaning = _BAD_SERVICE_CERTIFICATE
            if meaning is None:
                return f"refuses this end's TLS ({alert.lower().replace('_', ' ')})"
            return f"refuses this end's certificate: {meaning.format(role=own)}"
        if "PEER_DID_NOT_RETURN_A_CERTIFICATE" in reason:
            return "shows no certificate"
        # OpenSSL's own words, without source positions.
        text = re.sub(r"^\[.*?\] | \(_ssl.*\)$", "", str(error.args[-1]))
        text = reason.lower().replace("_", " ") if reason else text
        return f"does not speak TLS 1.3 as expected: {text}"


def common_name(shown: Mapping[str, Any]) -> str:
    """Return the common name in a certificate of ``getpeercert``; raise ValueError if not one.

    The message continues a sentence about the certificate.
    """
    subject = shown.get("subject", ())
    names = [str(value) for part in subject for key, value in part if key == "commonName"]
    if len(names) != 1:
        raise ValueError(f"has {len(names)} common names, and must have one")
    return names[0]


def describe_certificate_error(error: ssl.SSLCertVerificationError, role: str) -> str:
    """Return why a certificate of this role is refused, as the rest of a sentence about it."""
    message = error.verify_message.rstrip(".")
    match error.verify_code:  # OpenSSL's numbers
        case 9:
            return "is not valid yet; is a clock wrong?"
        case 10:
            return "has expired"
        case 23:
            return "has been revoked"
        case 26:
            return f"is not for a {role}"
        case 7 | 18 | 19 | 20 | 21:
            return f"was not signed by the authority in {AUTHORITY_FILE}"
        case 62 | 64:
            return (
                f"does not name this host ({message}); "
                "'holdfast keys DIR --renew --service NAME --host HOST' adds it"
            )
        case _:
            return f"is refused: {message}"
