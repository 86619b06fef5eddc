"""Why is a service not there? One look from outside, for a person who has to mend it.

The transport tries again and again and says only that nobody answers, for that is all that it needs
to know. A person needs the reason: a mistyped name, a port that nobody listens on, a certificate of
another authority. So when a service is missed, a thread of its own connects once as the transport
does, with the robot's own credentials, and reports what came of it. Nothing waits for that thread
and nothing is decided by what it finds.
"""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import monotonic
from types import MappingProxyType
from typing import TYPE_CHECKING

from holdfast.errors import HoldfastError
from holdfast.runtime.logs import EventSink
from holdfast.transport.endpoints import Endpoint, TlsFiles, parse_endpoint

if TYPE_CHECKING:
    import ssl

__all__ = ["MissingServices", "why_unreachable"]

_INTERVAL_S = 10.0
"""A service that stays away is looked for once in this time at most."""

_TIMEOUT_S = 3.0

_REFUSAL_S = 0.5
"""In TLS 1.3 a service refuses a robot's certificate only after the robot's part of the handshake;
for so long it is waited for."""

_OTHER_AUTHORITY = frozenset({7, 18, 19, 20, 21})
_OTHER_NAME = frozenset({62, 64})
"""OpenSSL's numbers of what is wrong with a certificate."""

_BY_ANOTHER_AUTHORITY = "the certificate is signed by another authority"


def why_unreachable(endpoint: str, tls_files: TlsFiles | None, timeout_s: float) -> str | None:
    """Say why a service cannot be reached; never raises.

    Parameters
    ----------
    endpoint : str
    tls_files : TlsFiles or None
        The robot's credentials.
    timeout_s : float
        For connecting, and again for each part of the handshake. The system's search for a host's
        address has a limit of its own.

    Returns
    -------
    str or None
        The reason in a few words; None if none is found, or the text is no endpoint.
    """
    try:
        place = parse_endpoint(endpoint)
    except HoldfastError:
        return None
    try:
        if place.is_local_socket:
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as plain:
                plain.settimeout(timeout_s)
                plain.connect(place.host)
            return None
        try:
            socket.getaddrinfo(place.host, place.port, type=socket.SOCK_STREAM)
        except (socket.gaierror, UnicodeError):
            return f"host name not found: {place.host}"
        if place.is_encrypted and tls_files is not None:
            wrong = _own_credentials(tls_files)
            if wrong is not None:
                return wrong
        with socket.create_connection((place.host, place.port), timeout_s) as plain:
            if not place.is_encrypted or tls_files is None:
                return None
            return _shake_hands(plain, place, tls_files, timeout_s)
    except TimeoutError:
        return "nothing answers"
    except OSError as error:
        return _first_lower(error.strerror or str(error))
    except Exception as error:  # noqa: BLE001 (a diagnosis must not add to the trouble)
        return f"could not be examined: {type(error).__name__}: {error}"


class MissingServices:
    """Reports why services that a robot misses cannot be reached: the event ``unreachable``.

    It is told what the robot reports. When that is a lost cloud or a robot that holds still, each
    service that is not there is examined, in a thread of its own and once in ten seconds at most.

    Parameters
    ----------
    services : sequence of str
        Endpoints of the cloud's services.
    tls_directory : Path or None
        With the robot's credentials.
    events : EventSink
        Gets the findings.
    refusals : mapping
        From services to why the last link to them was refused that was, as the rest of a sentence
        about the service. A look from outside does not find all of these reasons.
    """

    def __init__(
        self,
        services: Sequence[str],
        tls_directory: Path | None,
        events: EventSink,
        refusals: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        self._absent = set(services)
        self._services = tuple(services)
        self._tls_directory = tls_directory
        self._events = events
        self._threads: dict[str, threading.Thread] = {}
        self._examined_at: dict[str, float] = {}
        self._refusals = refusals

    def heard(self, name: str, fields: Mapping[str, object]) -> None:
        """Take note of what the robot reports; returns at once.

        Parameters
        ----------
        name : str
            Of the event.
        fields : mapping
        """
        if name == "service_appeared":
            self._absent.discard(str(fields.get("service")))
        elif name == "service_vanished":
            if fields.get("service") in self._services:
                self._absent.add(str(fields["service"]))
        elif name == "holding" or (name == "status" and fields.get("to") == "local_recovery"):
            for service in self._services:
                if service in self._absent:
                    self._start(service)

    def wait(self, timeout_s: float) -> None:
        """Wait until what is being examined is reported, for a limited time."""
        deadline = monotonic() + timeout_s
        for thread in self._threads.values():
            thread.join(max(0.0, deadline - monotonic()))

    def _start(self, service: str) -> None:
        now = monotonic()
        running = self._threads.get(service)
        if running is not None and running.is_alive():
            return
        if now - self._examined_at.get(service, -_INTERVAL_S) < _INTERVAL_S:
            return
        self._examined_at[service] = now
        thread = threading.Thread(
            target=self._examine, args=(service,), name="holdfast-diagnosis", daemon=True
        )
        self._threads[service] = thread
        # Without room for one more thread the robot goes on without a reason.
        with contextlib.suppress(RuntimeError):
            thread.start()

    def _examine(self, service: str) -> None:
        tls_files = None
        if self._tls_directory is not None:
            tls_files = TlsFiles.of(self._tls_directory)
        reason = why_unreachable(service, tls_files, _TIMEOUT_S) or _unexplained(
            service, self._refusals.get(service)
        )
        # It may have come meanwhile.
        if service in self._absent:
            self._events.event("unreachable", service=service, reason=reason)


def _unexplained(service: str, refusal: str | None) -> str:
    """Say what is known of a service that is missed although nothing wrong was found."""
    if refusal is not None:
        return f"accepts connections; of the last link that was refused: it {refusal}"
    protocol = service.partition("/")[0]
    or_else = "hangs, or speaks TLS (tls/...)" if protocol == "tcp" else "or hangs"
    return (
        "accepts connections, but does not answer as a holdfast service: it is none, is just "
        f"starting, {or_else}"
    )


def _own_credentials(files: TlsFiles) -> str | None:
    """Look at the robot's credentials once more: a certificate may have expired during the run."""
    from holdfast.transport.credentials import CredentialsError, load_credentials

    try:
        load_credentials(files.certificate.parent, "robot", warn=lambda _: None)
    except CredentialsError as error:
        return f"this robot's credentials: {error}"
    return None


def _shake_hands(
    plain: socket.socket, place: Endpoint, files: TlsFiles, timeout_s: float
) -> str | None:
    import ssl

    from holdfast.transport.tls import client_context

    context = client_context(files)
    try:
        with context.wrap_socket(plain, server_hostname=place.host) as secure:
            secure.settimeout(min(timeout_s, _REFUSAL_S))
            # It says nothing, unless it refuses what this robot has shown.
            with contextlib.suppress(TimeoutError):
                secure.recv(1)
    except ssl.SSLCertVerificationError as error:
        if error.verify_code in _OTHER_AUTHORITY:
            return _BY_ANOTHER_AUTHORITY
        if error.verify_code in _OTHER_NAME:
            return _names_another(place, _names_of_certificate(context, place, timeout_s))
        return f"the certificate is refused: {error.verify_message}"
    except ssl.SSLError as error:
        alert = (error.reason or "").partition("_ALERT_")[2]
        if alert:
            what = alert.lower().replace("_", " ")
            return f"refuses this robot's certificate ({what})"
        return "answers, but does not speak TLS"
    except TimeoutError:
        return "accepts connections, but does not answer in TLS: it speaks tcp, or hangs"
    except ConnectionError:
        return "answers, but does not speak TLS"
    return None


def _names_of_certificate(context: ssl.SSLContext, place: Endpoint, timeout_s: float) -> list[str]:
    """Connect once more, without looking at the name, to see which ones there are."""
    context.check_hostname = False
    with (
        contextlib.suppress(OSError),
        socket.create_connection((place.host, place.port), timeout_s) as plain,
        context.wrap_socket(plain, server_hostname=place.host) as secure,
    ):
        shown = secure.getpeercert() or {}
        alternatives = shown.get("subjectAltName", ())
        return [str(entry[1]) for entry in alternatives if isinstance(entry, tuple)]
    return []


def _names_another(place: Endpoint, names: Sequence[str]) -> str:
    text = f"the certificate does not name {place.host}"
    if not names:
        return text
    return f"{text} (it names {', '.join(names[:8])}{', ...' if len(names) > 8 else ''})"


def _first_lower(text: str) -> str:
    """Write the system's own words as the rest of a sentence."""
    return text[:1].lower() + text[1:]
