"""Who is refused, and what the robot's log says of it: real services, robots and certificates.

A robot that stands still is given one certificate after another, as if somebody replaced its files,
and one service after another; each time its log must say why it cannot use the service. What its
own check at the start finds is said before anything is connected. docs/trust.md has the sentences.
"""

from __future__ import annotations

import contextlib
import shutil
import signal
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from tests.ports import free_port
from tests.processes.faults import (
    PATIENCE_S,
    PATIENT,
    Robot,
    Service,
    Site,
    document_of,
    events_of,
    wait_until,
)

from holdfast.transport.key_ring import make_credentials, revoke_credentials

DOCUMENT = document_of("peg_in_hole_2d")
TRUST = " ".join(
    (Path(__file__).parents[2] / "docs" / "trust.md").read_text().replace("|", " ").split()
)
LATE, EARLY = "has expired", "is not valid yet; is a clock wrong?"
ONE_RING = "both ends need files of one 'holdfast keys DIR'"


def documented(sentence: str) -> str:
    """Return a sentence that docs/trust.md has."""
    assert f"`{sentence}`" in TRUST, sentence
    return sentence


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with Site(tmp_path) as site:
        yield site


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return ``keys`` with credentials of all sorts, and others beside it."""
    home = tmp_path_factory.mktemp("home") / "keys"
    now = datetime.now(UTC)
    make_credentials(home, robots=["anna", "berta"], services=["cloud"], now=now - timedelta(30))
    for days, name in ((3, "late"), (-3, "early")):
        moment = now - timedelta(days=days)
        make_credentials(home, robots=[name], services=[f"{name}-cloud"], days=2, now=moment)
    make_credentials(home.with_name("other"), robots=["anna"], services=["cloud"])
    # Strangers who believe our authority.
    mixed(home, "stranger", certificate="other/anna", key="other/anna")
    mixed(home, "thief", certificate="keys/berta", key="keys/berta")
    mixed(home, "crossed", certificate="keys/anna", key="keys/berta")
    make_credentials(home, services=["stolen-cloud"])
    shutil.copytree(home / "stolen-cloud", home.with_name("stolen-cloud"))
    revoke_credentials(home, names=["berta", "stolen-cloud"])
    return home


def mixed(home: Path, name: str, *, certificate: str, key: str) -> None:
    directory = home.with_name(name)
    directory.mkdir()
    shutil.copy(home / "anna" / "authority.pem", directory)
    shutil.copy(home.parent / certificate / "certificate.pem", directory)
    shutil.copy(home.parent / key / "key.pem", directory)


@pytest.mark.parametrize(
    ("credentials", "sentence"),
    [
        (None, "tls needs credentials (--tls DIR; 'holdfast keys DIR' makes them)"),
        ("keys/late", f"certificate.pem: {LATE}"),
        ("keys/early", f"certificate.pem: {EARLY}"),
        ("keys/berta", "certificate.pem: has been revoked"),
        ("keys/cloud", "certificate.pem: is not for a robot"),
        ("crossed", "key.pem: is not the key of"),
        ("stranger", "certificate.pem: was not signed by the authority in authority.pem"),
        ("keys/anna", "offload.name 'arm2': the certificate in"),
    ],
)
def test_what_a_robot_is_told_before_it_connects(
    credentials: str | None, sentence: str, home: Path, site: Site
) -> None:
    file = site.configure(DOCUMENT, offload={"name": "arm2"})
    options = () if credentials is None else ("--tls", home.parent / credentials)
    robot = site.run(file, *options, services=[f"tls/127.0.0.1:{free_port()}"])
    assert robot.wait() == 2
    assert documented(sentence) in robot.output


class Standing:
    """A robot that waits for a service, and tells why it cannot use what it finds."""

    def __init__(self, home: Path, site: Site, endpoint: str) -> None:
        self._home = home
        self._site = site
        self.endpoint = endpoint
        self.credentials = site.directory / "robot"
        shutil.copytree(home / "anna", self.credentials)
        file = site.configure(DOCUMENT, offload=PATIENT)
        options = ("--tls", self.credentials, "--recovery", "never")
        self.robot: Robot = site.run(file, *options, services=[endpoint])
        self.wait_for("connection refused")

    def show(self, credentials: str) -> None:
        """Replace the robot's files."""
        directory = self._home.parent / credentials
        for name in ("certificate.pem", "key.pem", "authority.pem", "revoked.pem"):
            new = self.credentials / "new"
            if (directory / name).exists():
                shutil.copy(directory / name, new)
                new.rename(self.credentials / name)
            else:
                (self.credentials / name).unlink(missing_ok=True)

    def serve(self, credentials: str) -> Service:
        options = ("--tls", str(self._home.parent / credentials))
        return self._site.service(*options, endpoint=self.endpoint).start()

    @contextlib.contextmanager
    def tls_server(self, credentials: str) -> Iterator[None]:
        """Be a service with credentials with which ``holdfast serve`` would not start."""
        directory = self._home.parent / credentials
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(directory / "certificate.pem", directory / "key.pem")

        def handle(taken: socket.socket) -> None:
            with taken, contextlib.suppress(OSError):
                context.wrap_socket(taken, server_side=True).recv(1)

        def accept(listener: socket.socket) -> None:
            with contextlib.suppress(OSError):
                while True:
                    handle(listener.accept()[0])

        address = ("127.0.0.1", int(self.endpoint.rpartition(":")[2]))
        with socket.create_server(address) as listener:
            accepting = threading.Thread(target=accept, args=(listener,))
            accepting.start()
            try:
                yield
            finally:
                listener.shutdown(socket.SHUT_RDWR)
                accepting.join(PATIENCE_S)

    def reasons(self) -> list[str]:
        events = events_of(self.robot.out)
        return [each["reason"] for each in events if each["event"] == "unreachable"]

    def wait_for(self, reason: str) -> None:
        path = self.robot.out / "events.jsonl"
        wait_until(path.exists, f"{path}: {self.robot.account()}")
        wait_until(lambda: reason in self.reasons(), f"{reason!r}: {self.robot.account()}")


@pytest.mark.parametrize("protocol", ["tls", "udp"])
def test_what_the_log_of_a_robot_says_of_a_refusal(protocol: str, home: Path, site: Site) -> None:
    standing = Standing(home, site, f"{protocol}/127.0.0.1:{free_port()}")
    refuses = "refuses this end's certificate: "
    again = "makes another"
    standing.show("stranger")
    cloud = standing.serve("keys/cloud")
    for credentials, reason in {
        "stranger": f"{refuses}it was not signed by the authority in authority.pem there; "
        f"{ONE_RING}",
        "keys/late": f"{refuses}it has expired by the clock there; "
        f"'holdfast keys DIR --renew --robot NAME' {again}",
        "keys/early": f"{refuses}it is not valid yet by the clock there, or is malformed",
        "keys/cloud": f"{refuses}it is not for a robot",
        "thief": "refuses this end, which has a certificate that has been revoked",
    }.items():
        standing.show(credentials)
        standing.wait_for(documented(reason))
    cloud.process.wait_for("link_refused", robot="berta")
    assert not cloud.process.matching("robot_connected")
    # Files that do not belong together are no reason to give up what was there.
    standing.show("crossed")
    told = standing.robot.wait_for("credentials")["reason"]
    assert "key.pem: is not the key of " in told
    assert told.endswith("certificate.pem; the previous ones stay in use")
    cloud.kill()

    has = "has a certificate that "
    standing.show("keys/anna")
    other = standing.serve("other/cloud")
    standing.wait_for(
        documented(f"{has}was not signed by the authority in authority.pem; {ONE_RING}")
    )
    other.kill()
    stolen = standing.serve("stolen-cloud")
    standing.wait_for(
        documented(
            f"{has}has been revoked; 'holdfast keys DIR --rotate --service NAME' makes a new key"
        )
    )
    stolen.kill()
    for credentials, reason in {
        "keys/late-cloud": f"{has}{LATE}; 'holdfast keys DIR --renew --service NAME' {again}",
        "keys/early-cloud": f"{has}{EARLY}",
        "keys/anna": f"{has}is not for a service",
    }.items():
        with standing.tls_server(credentials):
            standing.wait_for(documented(reason))
    # With the right ones at both ends it goes on as if nothing had been.
    standing.serve("keys/cloud")
    standing.robot.wait_for("service_appeared")
    standing.robot.finish()


def test_a_service_at_a_host_that_its_certificate_does_not_name(home: Path, site: Site) -> None:
    standing = Standing(home, site, f"tls/127.0.0.2:{free_port('127.0.0.2')}")
    standing.serve("keys/cloud")
    wait_until(
        lambda: any(
            reason.startswith(documented("has a certificate that does not name this host"))
            for reason in standing.reasons()
        ),
        "the reason",
    )
    assert "--renew --service NAME --host HOST" in standing.reasons()[-1]


def test_a_robot_without_a_certificate(home: Path, site: Site) -> None:
    port = free_port()
    site.service("--tls", str(home / "cloud"), endpoint=f"tls/127.0.0.1:{port}").start()
    file = site.configure(DOCUMENT, offload=PATIENT)
    robot = site.run(file, "--recovery", "never", services=[f"tcp/127.0.0.1:{port}"])
    sentence = (
        "refuses this end, which does not speak TLS; as at that end, write tls/... or udp/... "
        "with --tls DIR"
    )
    robot.wait_for("unreachable", reason=documented(sentence))


@pytest.mark.parametrize("protocol", ["tls", "udp"])
def test_a_link_that_stands_ends_when_its_certificate_is_revoked(
    protocol: str,
    site: Site,
    record_property: Callable[[str, object], None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    home = site.directory / "keys"
    make_credentials(home, robots=["anna"], services=["cloud"])
    endpoint = f"{protocol}/127.0.0.1:{free_port()}"
    cloud = site.service("--tls", str(home / "cloud"), endpoint=endpoint).start()
    # Long enough to be caught at it; what it does without a service is not the subject here.
    file = site.configure(DOCUMENT, offload=PATIENT)
    options: tuple[Any, ...] = ("--tls", home / "anna", "--recovery", "never", "--rate", "5")
    robot = site.run(file, *options, services=[endpoint])
    robot.wait_for("service_appeared")
    revoke_credentials(home, names=["anna"])
    began = time.perf_counter()
    cloud.process.signal(signal.SIGHUP)
    robot.wait_for("service_vanished")
    took_s = time.perf_counter() - began
    record_property("link_ended_after_s", took_s)
    with capsys.disabled():
        print(f"{protocol}: the link has ended {1e3 * took_s:.0f} ms after kill -HUP")
    reason = "has a certificate that has been revoked"
    robot.wait_for("unreachable", reason=f"refuses this end, which {reason}")
    ended = cloud.process.wait_for("robot_disconnected", robot="anna")
    assert ended["reason"] == reason
    assert cloud.process.wait_for("credentials_reloaded")["links_ended"] == 1
