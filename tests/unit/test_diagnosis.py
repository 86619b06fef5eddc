"""What is said of a service that cannot be reached, against real sockets and real certificates."""

from __future__ import annotations

import contextlib
import socket
import ssl
import threading
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from tests.ports import free_port

from holdfast.runtime.diagnosis import MissingServices, why_unreachable
from holdfast.transport.endpoints import TlsFiles
from holdfast.transport.key_ring import make_credentials

TIMEOUT_S = 20.0
"""Generous: a test that passes does not wait for it."""


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("keys")
    for name in ("ours", "theirs"):
        make_credentials(directory / name)
    make_credentials(directory / "ours", services=["elsewhere"])
    return directory


def name_another(context: ssl.SSLContext, keys: Path) -> None:
    """Show a certificate of ours that names another machine alone."""
    home, service = keys / "ours" / "authority", keys / "ours" / "elsewhere"
    authority = x509.load_pem_x509_certificate((home / "authority.pem").read_bytes())
    now = datetime.now(UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "elsewhere")]))
        .issuer_name(authority.subject)
        .public_key(private_key(service / "key.pem").public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=1))
        .add_extension(
            x509.SubjectAlternativeName([x509.DNSName("planner.example")]), critical=False
        )
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(
                private_key(home / "authority.key").public_key()
            ),
            critical=False,
        )
        .sign(private_key(home / "authority.key"), hashes.SHA256())
    )
    path = keys / "elsewhere.pem"
    path.write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    context.load_cert_chain(path, service / "key.pem")


def private_key(path: Path) -> ec.EllipticCurvePrivateKey:
    key = serialization.load_pem_private_key(path.read_bytes(), None)
    assert isinstance(key, ec.EllipticCurvePrivateKey)
    return key


@contextlib.contextmanager
def listening(answer: Callable[[socket.socket], None]) -> Iterator[int]:
    """Listen on a free port, and give each connection to ``answer``."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            while True:
                try:
                    connection, _ = server.accept()
                except OSError:
                    return
                with connection, contextlib.suppress(OSError):
                    connection.settimeout(TIMEOUT_S)
                    answer(connection)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield server.getsockname()[1]
        finally:
            # Wakes the thread that accepts; closing alone does not.
            server.shutdown(socket.SHUT_RDWR)
            thread.join(TIMEOUT_S)


@contextlib.contextmanager
def tls_service(keys: Path, authority: str, *, names_another: bool = False) -> Iterator[int]:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.verify_mode = ssl.CERT_REQUIRED
    files = TlsFiles.of(keys / authority / "service")
    context.load_verify_locations(files.authority)
    if names_another:
        name_another(context, keys)
    else:
        context.load_cert_chain(files.certificate, files.key)

    def answer(connection: socket.socket) -> None:
        with context.wrap_socket(connection, server_side=True) as secure:
            secure.recv(1)  # until the other end closes

    with listening(answer) as port:
        yield port


class TestWhyUnreachable:
    def test_what_is_no_endpoint_has_no_reason(self) -> None:
        assert why_unreachable("in_process", None, TIMEOUT_S) is None

    @pytest.mark.parametrize("protocol", ["tcp", "tls"])
    def test_nobody_listens(self, protocol: str, keys: Path) -> None:
        files = TlsFiles.of(keys / "ours" / "robot")
        endpoint = f"{protocol}/127.0.0.1:{free_port()}"
        assert why_unreachable(endpoint, files, TIMEOUT_S) == "connection refused"

    @pytest.mark.parametrize("protocol", ["tcp", "tls", "udp"])
    def test_a_name_that_nobody_has(self, protocol: str, keys: Path) -> None:
        files = TlsFiles.of(keys / "ours" / "robot")
        # A label this long exists nowhere, and no server need be asked to know it.
        host = "a" * 70 + ".invalid"
        reason = why_unreachable(f"{protocol}/{host}:7447", files, TIMEOUT_S)
        assert reason == f"host name not found: {host}"

    def test_a_local_socket(self, tmp_path: Path) -> None:
        reason = why_unreachable(f"unix/{tmp_path}/s", None, TIMEOUT_S)
        assert reason == "no such file or directory"

    def test_whoever_listens_over_tcp_is_not_asked_more(self) -> None:
        with listening(void) as port:
            assert why_unreachable(f"tcp/127.0.0.1:{port}", None, TIMEOUT_S) is None

    def test_a_service_of_ours_has_no_reason(self, keys: Path) -> None:
        with tls_service(keys, "ours") as port:
            files = TlsFiles.of(keys / "ours" / "robot")
            assert why_unreachable(f"tls/127.0.0.1:{port}", files, TIMEOUT_S) is None

    def test_a_service_of_another_authority(self, keys: Path) -> None:
        with tls_service(keys, "theirs") as port:
            files = TlsFiles.of(keys / "ours" / "robot")
            reason = why_unreachable(f"tls/127.0.0.1:{port}", files, TIMEOUT_S)
        assert reason == "the certificate is signed by another authority"

    def test_a_service_that_refuses_this_robot(self, keys: Path) -> None:
        """It trusts another authority than that which signed its own certificate."""
        ours, theirs = (
            TlsFiles.of(keys / "ours" / "service"),
            TlsFiles.of(keys / "theirs" / "robot"),
        )
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.verify_mode = ssl.CERT_REQUIRED
        context.load_verify_locations(theirs.authority)
        context.load_cert_chain(ours.certificate, ours.key)

        def answer(connection: socket.socket) -> None:
            with context.wrap_socket(connection, server_side=True) as secure:
                secure.recv(1)

        with listening(answer) as port:
            files = TlsFiles.of(keys / "ours" / "robot")
            reason = why_unreachable(f"tls/127.0.0.1:{port}", files, TIMEOUT_S)
        assert reason is not None
        assert reason.startswith("refuses this robot's certificate (")

    def test_a_certificate_for_another_name(self, keys: Path) -> None:
        with tls_service(keys, "ours", names_another=True) as port:
            files = TlsFiles.of(keys / "ours" / "robot")
            reason = why_unreachable(f"tls/127.0.0.1:{port}", files, TIMEOUT_S)
        assert reason == "the certificate does not name 127.0.0.1 (it names planner.example)"

    def test_it_does_not_speak_tls(self, keys: Path) -> None:
        def answer(connection: socket.socket) -> None:
            connection.recv(1)
            connection.sendall(b"SSH-2.0-anything\r\n")
            connection.recv(65536)

        with listening(answer) as port:
            files = TlsFiles.of(keys / "ours" / "robot")
            reason = why_unreachable(f"tls/127.0.0.1:{port}", files, TIMEOUT_S)
        assert reason == "answers, but does not speak TLS"

    def test_it_says_nothing(self, keys: Path) -> None:
        release = threading.Event()

        def answer(connection: socket.socket) -> None:
            del connection
            release.wait(TIMEOUT_S)

        with listening(answer) as port:
            files = TlsFiles.of(keys / "ours" / "robot")
            reason = why_unreachable(f"tls/127.0.0.1:{port}", files, 0.2)
            release.set()
        assert reason is not None
        assert "does not answer in TLS" in reason

    @pytest.mark.parametrize("protocol", ["tls", "udp"])
    def test_credentials_that_are_not_there(self, protocol: str, tmp_path: Path) -> None:
        reason = why_unreachable(f"{protocol}/127.0.0.1:7447", TlsFiles.of(tmp_path), TIMEOUT_S)
        assert reason is not None
        assert reason.startswith("this robot's credentials: ")


def void(value: object) -> None:
    del value


class Notes:
    """Keeps what is reported."""

    def __init__(self) -> None:
        self.events: list[tuple[str, dict[str, object]]] = []

    def event(self, name: str, /, **fields: object) -> None:
        self.events.append((name, fields))

    def close(self) -> None:
        pass


class TestMissingServices:
    def test_each_that_is_absent_is_reported_once(self) -> None:
        first, second = (f"tcp/127.0.0.1:{free_port()}" for _ in range(2))
        notes = Notes()
        missing = MissingServices((first, second), None, notes)
        missing.heard("service_appeared", {"service": second})
        for name, fields in (
            ("status", {"from": "standard", "to": "local_recovery"}),
            ("holding", {"step": 3}),
        ):
            missing.heard(name, fields)
            missing.wait(TIMEOUT_S)
        assert notes.events == [("unreachable", {"service": first, "reason": "connection refused"})]
        missing.heard("service_vanished", {"service": second})
        missing.heard("service_vanished", {"service": "of somebody else"})
        missing.heard("holding", {"step": 4})
        missing.wait(TIMEOUT_S)
        assert notes.events[1:] == [
            ("unreachable", {"service": second, "reason": "connection refused"})
        ]

    def test_one_that_is_something_else(self) -> None:
        notes = Notes()
        with listening(void) as port:
            missing = MissingServices((f"tcp/127.0.0.1:{port}",), None, notes)
            missing.heard("holding", {"step": 0})
            missing.wait(TIMEOUT_S)
        ((name, fields),) = notes.events
        assert name == "unreachable"
        assert "does not answer as a holdfast service" in str(fields["reason"])
        assert "tls/..." in str(fields["reason"])

    def test_a_link_that_was_refused_says_more_than_a_look_from_outside(self) -> None:
        notes = Notes()
        with listening(void) as port:
            service = f"tcp/127.0.0.1:{port}"
            refusals = {service: "is at a udp/... endpoint, which goes with udp/... at both ends"}
            missing = MissingServices((service,), None, notes, refusals)
            missing.heard("holding", {"step": 0})
            missing.wait(TIMEOUT_S)
        ((name, fields),) = notes.events
        assert name == "unreachable"
        assert str(fields["reason"]).endswith(f"it {refusals[service]}")

    def test_nothing_is_examined_while_the_cloud_decides(self) -> None:
        notes = Notes()
        missing = MissingServices((f"tcp/127.0.0.1:{free_port()}",), None, notes)
        missing.heard("status", {"from": "local_recovery", "to": "keep_alive"})
        missing.heard("retry", {})
        missing.wait(TIMEOUT_S)
        assert notes.events == []
