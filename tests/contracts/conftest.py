"""Fixtures of the transport's tests."""

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tests.contracts import wires

from holdfast.transport.endpoints import TlsFiles
from holdfast.transport.key_ring import make_credentials


@pytest.fixture(scope="session")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory with the keys of two robots and a service of one authority."""
    keys = tmp_path_factory.mktemp("tls") / "keys"
    make_credentials(keys, robots=["robot", "another"], services=["service"])
    return keys


@pytest.fixture(scope="session")
def robot_tls(keys: Path) -> TlsFiles:
    return TlsFiles.of(keys / "robot")


@pytest.fixture(scope="session")
def service_tls(keys: Path) -> TlsFiles:
    return TlsFiles.of(keys / "service")


@pytest.fixture
def socket_directory() -> Iterator[Path]:
    """Pytest's own directories have paths too long for a socket."""
    with tempfile.TemporaryDirectory(prefix="h") as directory:
        yield Path(directory)


@pytest.fixture
def wire_of(
    socket_directory: Path, robot_tls: TlsFiles, service_tls: TlsFiles
) -> Callable[[str], wires.StreamWire]:
    """Return what makes a wire of a kind, with the credentials that it takes."""

    def make(kind: str) -> wires.StreamWire:
        if kind == "launched":
            return wires.StreamWire("unix", socket_directory, launched=True)
        keys = (robot_tls, service_tls) if kind in ("tls", "udp") else (None, None)
        return wires.StreamWire(kind, socket_directory, robot_tls=keys[0], service_tls=keys[1])

    return make


@pytest.fixture(params=wires.WIRES)
def wire(request: pytest.FixtureRequest, wire_of: Callable[[str], wires.StreamWire]) -> wires.Wire:
    return wires.InProcessWire() if request.param == "in_process" else wire_of(request.param)


@pytest.fixture
def tcp(wire_of: Callable[[str], wires.StreamWire]) -> wires.StreamWire:
    return wire_of("tcp")


@pytest.fixture
def tls(wire_of: Callable[[str], wires.StreamWire]) -> wires.StreamWire:
    return wire_of("tls")


@pytest.fixture
def udp(wire_of: Callable[[str], wires.StreamWire]) -> wires.StreamWire:
    return wire_of("udp")
