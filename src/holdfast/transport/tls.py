"""TLS for one link, in memory: bytes of the stream in, bytes of the messages out.

Both ends show a certificate, TLS 1.3 is the only version, and the one authority that is believed is
our own. The robot is always the client, whoever dialled: so its certificate can do no more than
ask, and it looks for the service's host in the service's certificate.

The link reads the socket itself and has the ``ssl`` module decrypt in memory. So nothing of a
handshake is begun before the other end has sent its first byte, and a port scanner costs no more
than its connection.

A handshake also tells the robot whether it is the process that it knew, a round trip before that
process can say so: the robot offers "holdfast/" and the incarnation among the protocols that it
speaks (ALPN), and a service takes its own.
"""

from __future__ import annotations

import re
import ssl
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from holdfast.errors import TransportError
from holdfast.transport.credentials import file_versions
from holdfast.transport.endpoints import AUTHORITY_FILE, TlsFiles
from holdfast.transport.frames import FrameError
from holdfast.transport.revocation import refuse_revoked

__all__ = [
    "ClientCredentials",
    "PeerCertificate",
    "TlsStream",
    "client_context",
    "common_name",
    "fault_of_certificate",
    "server_context",
]

_ANY_INCARNATION = "holdfast"

_KEY_EXCHANGE = "prime256v1"
"""The only one: of those that OpenSSL offers, whoever asks for the largest (ffdhe8192) would have
a service compute for two tenths of a second before it knows who asks. Python 3.11.2, which is
Debian 12's, cannot choose X25519."""

_READ_BYTES = 16 * 1024
"""The largest record."""


_WHAT_TO_DO = {
    10: "; 'holdfast keys DIR --renew --{role} NAME' makes another",
    18: "; both ends need files of one 'holdfast keys DIR'",
    19: "; both ends need files of one 'holdfast keys DIR'",
    20: "; both ends need files of one 'holdfast keys DIR'",
    23: "; 'holdfast keys DIR --rotate --{role} NAME' makes a new key",
}
"""By OpenSSL's numbers, about a certificate of the other end."""

_ALERTS = {
    "both": {
        "CERTIFICATE_EXPIRED": (
            "it has expired by the clock there; 'holdfast keys DIR --renew --{role} NAME' makes "
            "another"
        ),
        "CERTIFICATE_REVOKED": (
            "it has been revoked; 'holdfast keys DIR --rotate --{role} NAME' makes a new key"
        ),
        "UNKNOWN_CA": (
            f"it was not signed by the authority in {AUTHORITY_FILE} there; both ends need files "
            "of one 'holdfast keys DIR'"
        ),
        "CERTIFICATE_REQUIRED": "there is none, and one is required",
        "UNSUPPORTED_CERTIFICATE": "it is not for a {role}",
        "DECRYPT_ERROR": "this end's key is not the certificate's",
    },
    "robot": {"BAD_CERTIFICATE": "it is not valid yet by the clock there, or is malformed"},
    "service": {
        "BAD_CERTIFICATE": (
            "it does not name the host that the robot calls, or is not valid yet by the clock "
            "there; the robot's log says which"
        )
    },
}
"""What the other end says of this end's certificate (RFC 8446, section 6.2), by this end's role."""


class PeerCertificate(NamedTuple):
    """The certificate with which the other end has proved who it is.

    Attributes
    ----------
    name : str
        Its common name.
    serial_number : int
    expires_at : float
        In seconds since 1970.
    der : bytes
        The whole of it.
    authorities : frozenset of bytes
        The one whose signature was believed, as DER; several if some have the same name.
    """

    name: str
    serial_number: int
    expires_at: float
    der: bytes
    authorities: frozenset[bytes]


def client_context(files: TlsFiles) -> ssl.SSLContext:
    """Return what a robot's links need; handshakes refuse who is revoked.

    Raises
    ------
    TransportError
        If the credentials cannot be used.
    """
    context = _context(ssl.PROTOCOL_TLS_CLIENT, files)
    refuse_revoked(context, files.authority.parent)
    return context


def server_context(files: TlsFiles, incarnation: str) -> ssl.SSLContext:
    """Return what a service's links need.

    Handshakes do not refuse who is revoked: then nobody would know who that was. The service does,
    as soon as it knows.

    Raises
    ------
    TransportError
        If the credentials cannot be used.
    """
    context = _context(ssl.PROTOCOL_TLS_SERVER, files)
    context.num_tickets = 0  # nothing is resumed: who comes again shows the certificate again
    context.set_alpn_protocols([_of(incarnation), _ANY_INCARNATION])
    return context


def _context(protocol: int, files: TlsFiles) -> ssl.SSLContext:
    context = ssl.SSLContext(protocol)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.verify_mode = ssl.CERT_REQUIRED
    context.set_ecdh_curve(_KEY_EXCHANGE)
    try:
        context.load_verify_locations(cafile=files.authority)
        # Without the empty password, an encrypted key would ask for one on the terminal.
        context.load_cert_chain(files.certificate, files.key, password="")
    except (OSError, ssl.SSLError) as error:
        reason = str(error)
        if getattr(error, "reason", None) == "KEY_VALUES_MISMATCH":
            reason = f"{files.key.name} is not the key of {files.certificate.name}"
        raise TransportError(
            f"credentials {files.certificate.parent} cannot be used: {reason}"
        ) from error
    return context


class ClientCredentials:
    """A robot's credentials, read anew for a new link if somebody has replaced them.

    So a list of revoked services counts as soon as it is there.

    Parameters
    ----------
    files : TlsFiles
    on_unusable : callable or None
        Is told why what is there now cannot be used.

    Raises
    ------
    TransportError
        If they cannot be used at the beginning.
    """

    def __init__(self, files: TlsFiles, on_unusable: Callable[[str], None] | None = None) -> None:
        self._files = files
        self._on_unusable = on_unusable
        self._seen = file_versions(files)
        self._context = client_context(files)

    def context(self) -> ssl.SSLContext:
        """Return what a new link needs; that of before, if what is there now cannot be used."""
        seen = file_versions(self._files)
        if seen != self._seen:
            self._seen = seen
            try:
                self._context = client_context(self._files)
            except TransportError as error:
                if self._on_unusable is not None:
                    self._on_unusable(f"{error}; those of before stay in use")
        return self._context


def _of(incarnation: str) -> str:
    return f"{_ANY_INCARNATION}/{incarnation}"


class TlsStream:
    """One end of TLS on one stream.

    Parameters
    ----------
    context : SSLContext
    host : str or None
        For a robot: the name or address that the certificate must be for; None if the service has
        dialled, which has no address that a robot would know.
    known : str or None
        For a robot: the incarnation of the service that it knew last.

    Attributes
    ----------
    established : bool
        Whether the handshake is complete at this end. At the robot's it is before the service has
        looked at the robot's certificate.
    ended : bool
        Whether the other end has said that nothing more will come.
    """

    def __init__(
        self, context: ssl.SSLContext, host: str | None = None, known: str | None = None
    ) -> None:
        self._is_server = context.protocol == ssl.PROTOCOL_TLS_SERVER
        if not self._is_server:
            context.check_hostname = host is not None
            names = [_ANY_INCARNATION]
            context.set_alpn_protocols([_of(known), *names] if known is not None else names)
        self._known = known
        self._incoming = ssl.MemoryBIO()
        self._outgoing = ssl.MemoryBIO()
        self._tls = context.wrap_bio(
            self._incoming, self._outgoing, server_side=self._is_server, server_hostname=host
        )
        self._has_first_byte = False
        self.established = False
        self.ended = False

    @property
    def is_known_incarnation(self) -> bool:
        """For a robot: whether the service is the process that it knew, once established."""
        return self._known is not None and self._tls.selected_alpn_protocol() == _of(self._known)

    def begin(self) -> None:
        """Begin the handshake, at the robot's end."""
        self._shake_hands()

    def receive(self, data: bytes) -> bytes:
        """Take bytes of the stream; return those of messages.

        Raises
        ------
        ssl.SSLError
            If the handshake fails, or the other end says that it did.
        FrameError
            If the other end does not speak TLS at all.
        """
        if not self._has_first_byte:
            self._has_first_byte = True
            if self._is_server and data[:1] != b"\x16":
                raise FrameError("does not speak TLS, and this endpoint does")
        self._incoming.write(data)
        if not self.established:
            self._shake_hands()
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
        """Take bytes of messages; what becomes of them is there to :meth:`take`."""
        self._tls.write(data)

    def take(self) -> bytes:
        """Return the bytes that are to be sent, and forget them."""
        return self._outgoing.read()

    def close(self) -> None:
        """Say that nothing more will come from this end."""
        if self.established:
            try:
                self._tls.unwrap()
            except ssl.SSLError:
                return  # it is not waited for that the other end says so, too

    def peer(self) -> PeerCertificate:
        """Return the other end's certificate, once established.

        Raises
        ------
        FrameError
            If it does not say who that is.
        """
        shown = self._tls.getpeercert() or {}
        der = self._tls.getpeercert(binary_form=True) or b""
        try:
            name = common_name(shown)
        except ValueError as error:
            raise FrameError(f"has a certificate that {error}") from error
        return PeerCertificate(
            name,
            int(str(shown.get("serialNumber", "0")), 16),
            float(ssl.cert_time_to_seconds(str(shown["notAfter"]))) if shown else 0.0,
            der,
            self._authorities(shown.get("issuer")),
        )

    def _authorities(self, name: object) -> frozenset[bytes]:
        context = self._tls.context
        named = context.get_ca_certs()
        known = context.get_ca_certs(binary_form=True)
        found = [der for read, der in zip(named, known, strict=True) if read["subject"] == name]
        # There may be another certificate between the two, which only the handshake has seen.
        return frozenset(found or known)

    def what_is_wrong(self, error: OSError) -> str:
        """Return what OpenSSL's error means, as the rest of a sentence about the other end."""
        assert isinstance(error, ssl.SSLError)
        if isinstance(error, ssl.SSLCertVerificationError):
            role = "robot" if self._is_server else "service"
            fault = fault_of_certificate(error, role)
            what_to_do = _WHAT_TO_DO.get(error.verify_code, "")
            return f"has a certificate that {fault}{what_to_do.format(role=role)}"
        reason = error.reason or ""
        alert = reason.partition("_ALERT_")[2]
        if alert:
            own = "service" if self._is_server else "robot"
            meaning = _ALERTS[own].get(alert, _ALERTS["both"].get(alert))
            if meaning is None:
                return f"refuses this end's TLS ({alert.lower().replace('_', ' ')})"
            return f"refuses this end's certificate: {meaning.format(role=own)}"
        if "PEER_DID_NOT_RETURN_A_CERTIFICATE" in reason:
            return "shows no certificate"
        # Of what this Python has no word for, OpenSSL's own, without the places in the sources.
        text = re.sub(r"^\[.*?\] | \(_ssl.*\)$", "", str(error.args[-1]))
        text = reason.lower().replace("_", " ") if reason else text
        return f"does not speak TLS 1.3 as expected: {text}"

    def _shake_hands(self) -> None:
        try:
            self._tls.do_handshake()
        except ssl.SSLWantReadError:
            return
        self.established = True


def common_name(shown: Mapping[str, Any]) -> str:
    """Return the name in a certificate: it is by this that robots are told apart.

    Parameters
    ----------
    shown : mapping
        As ``getpeercert`` returns it.

    Raises
    ------
    ValueError
        If it has none or several: the rest of a sentence about it.
    """
    subject = shown.get("subject", ())
    names = [str(value) for part in subject for key, value in part if key == "commonName"]
    if len(names) != 1:
        raise ValueError(f"has {len(names)} common names, and must have one")
    return names[0]


def fault_of_certificate(error: ssl.SSLCertVerificationError, role: str) -> str:
    """Return why a certificate is refused, as the rest of a sentence about it.

    Parameters
    ----------
    error : SSLCertVerificationError
    role : {"robot", "service"}
        Whose it should be.
    """
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
