"""Fixtures of the transport's tests."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from cryptography.x509 import oid
from tests.contracts import wires

from holdfast.transport.endpoints import TlsFiles


@pytest.fixture(scope="session")
def authority(tmp_path_factory: pytest.TempPathFactory) -> wires.Authority:
    return wires.Authority(tmp_path_factory.mktemp("tls") / "authority")


@pytest.fixture(scope="session")
def robot_tls(authority: wires.Authority) -> TlsFiles:
    return authority.issue("robot", oid.ExtendedKeyUsageOID.CLIENT_AUTH)


@pytest.fixture(scope="session")
def service_tls(authority: wires.Authority) -> TlsFiles:
    return authority.issue("service", oid.ExtendedKeyUsageOID.SERVER_AUTH)


@pytest.fixture
def socket_directory() -> Iterator[Path]:
    """Pytest's own directories have paths too long for a socket."""
    with tempfile.TemporaryDirectory(prefix="h") as directory:
        yield Path(directory)


@pytest.fixture(params=wires.WIRES)
def wire(
    request: pytest.FixtureRequest,
    socket_directory: Path,
    robot_tls: TlsFiles,
    service_tls: TlsFiles,
) -> wires.Wire:
    match request.param:
        case "in_process":
            return wires.InProcessWire()
        case "launched":
            return wires.StreamWire("unix", socket_directory, launched=True)
        case "tls" | "udp":
            return wires.StreamWire(
                request.param, socket_directory, robot_tls=robot_tls, service_tls=service_tls
            )
        case protocol:
            return wires.StreamWire(protocol, socket_directory)


@pytest.fixture
def tcp(socket_directory: Path) -> wires.StreamWire:
    return wires.StreamWire("tcp", socket_directory)


@pytest.fixture
def tls(socket_directory: Path, robot_tls: TlsFiles, service_tls: TlsFiles) -> wires.StreamWire:
    return wires.StreamWire("tls", socket_directory, robot_tls=robot_tls, service_tls=service_tls)
