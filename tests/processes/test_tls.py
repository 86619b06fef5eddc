"""Services behind mutual TLS: their faults change no decision, and strangers stay outside."""

from __future__ import annotations

import socket
import ssl
from pathlib import Path

import pytest
from tests.ports import free_port
from tests.processes.faults import (
    KEEP_ALIVE,
    LOCAL_RECOVERY,
    LOST,
    LOST_AGAIN,
    PATIENCE_S,
    QUICK,
    RESTORED,
    References,
    Service,
    Site,
    Story,
    document_of,
    events_of,
    sensing_steps,
)

PEG = "peg_in_hole_2d"

# Over udp the links are TLS's, with datagrams beside them.
UDP_AND_SLOWLY_TLS = pytest.mark.parametrize(
    "protocol", ["udp", pytest.param("tls", marks=pytest.mark.slow)]
)
# test_transport_credentials.py shows who lets whom in, with links in one process; this shows that a
# refused service decides nothing.
TLS_AND_SLOWLY_UDP = pytest.mark.parametrize(
    "protocol", ["tls", pytest.param("udp", marks=pytest.mark.slow)]
)


def secure(
    site: Site, keys: Path, protocol: str, authority: str = "ours", host: str = "127.0.0.1"
) -> Service:
    directory = keys / authority / "service"
    return site.service(
        *("--tls", str(directory)),
        endpoint=f"{protocol}/{host}:{free_port(host)}",
        lease_ms=QUICK["lease_ms"],
    )


@UDP_AND_SLOWLY_TLS
def test_killed_stopped_and_started_again(
    protocol: str, keys: Path, site: Site, references: References
) -> None:
    document = document_of(PEG)
    steps = sensing_steps(document)
    cloud = secure(site, keys, protocol).start()
    story = Story(site, references, document, offload=QUICK)
    story.at("sense", steps[1], cloud.kill)
    story.at("perform", steps[3], cloud.start, story.status(KEEP_ALIVE))
    story.at("sense", steps[4], cloud.stop)
    story.at("perform", steps[6], cloud.resume, story.status(KEEP_ALIVE, 2))
    robot = story.run(cloud, options=("--tls", str(keys / "ours" / "robot")))
    assert robot.statuses() == [LOST, RESTORED, LOST_AGAIN, RESTORED]


@TLS_AND_SLOWLY_UDP
def test_a_robot_of_another_authority_stays_outside(
    protocol: str, keys: Path, site: Site, references: References
) -> None:
    cloud = secure(site, keys, protocol).start()
    offload = {"startup_timeout_ms": 1000.0}
    story = Story(site, references, document_of(PEG), offload=offload)
    # It cannot use the cloud and does not believe it either; its own service decides.
    robot = story.run(cloud, options=("--tls", str(keys / "theirs" / "robot")))
    assert robot.statuses() == [LOST]
    assert not robot.matching("service_appeared", service=cloud.endpoint)
    assert not cloud.process.matching("session_opened")


@UDP_AND_SLOWLY_TLS
def test_a_service_of_another_authority_is_not_believed(
    protocol: str, keys: Path, site: Site, references: References
) -> None:
    cloud = secure(site, keys, protocol, authority="theirs").start()
    assert_not_believed(cloud, keys, site, references)


@pytest.mark.slow  # of links in one process: TestOnRealLinks in test_transport_credentials.py
@pytest.mark.parametrize("protocol", ["tls", "udp"])
def test_a_service_at_another_address_than_it_was_certified_for_is_not_believed(
    protocol: str, keys: Path, site: Site, references: References
) -> None:
    # All of 127/8 is this machine, and of it the certificate names 127.0.0.1 alone.
    cloud = secure(site, keys, protocol, host="127.0.0.2").start()
    assert_not_believed(cloud, keys, site, references)


def assert_not_believed(cloud: Service, keys: Path, site: Site, references: References) -> None:
    story = Story(site, references, document_of(PEG), offload={"startup_timeout_ms": 1000.0})
    robot = story.run(cloud, options=("--tls", str(keys / "ours" / "robot")))
    assert robot.statuses() == [LOST]
    assert not robot.matching("service_appeared", service=cloud.endpoint)
    assert not cloud.process.matching("session_opened")


def test_a_robot_without_credentials_is_told_so(keys: Path, site: Site) -> None:
    cloud = secure(site, keys, "tls").start()
    robot = site.run(site.configure(document_of(PEG)), services=[cloud])
    assert robot.wait() == 2
    assert cloud.endpoint in robot.output
    assert "--tls" in robot.output
    assert "Traceback" not in robot.output


def test_a_stranger_is_cut_off(keys: Path, site: Site, references: References) -> None:
    """Seen from outside, by TLS itself; and the robot at work notices nothing."""
    cloud = secure(site, keys, "tls").start()
    story = Story(site, references, document_of(PEG))

    def knock(certificate: Path | None) -> None:
        """Shake hands, and hear what comes of it."""
        port = int(cloud.endpoint.rpartition(":")[2])
        context = ssl.create_default_context(cafile=str(keys / "ours" / "robot" / "authority.pem"))
        if certificate is not None:
            context.load_cert_chain(certificate / "certificate.pem", certificate / "key.pem")
        with (
            socket.create_connection(("127.0.0.1", port), PATIENCE_S) as plain,
            context.wrap_socket(plain, server_hostname="127.0.0.1") as secured,
        ):
            secured.recv(1)

    def knock_at_the_door() -> None:
        for stranger in (None, keys / "theirs" / "robot"):
            # It comes after the client's own part of the handshake.
            with pytest.raises(ssl.SSLError, match=r"alert (certificate required|unknown ca)"):
                knock(stranger)

    story.at("perform", 20, knock_at_the_door)
    robot = story.run(cloud, options=("--tls", str(keys / "ours" / "robot")))
    assert robot.statuses() == []


class TestServeOnAddressesThatOthersReach:
    def test_allowed_if_it_is_said(self, site: Site, references: References) -> None:
        port = free_port()
        cloud = site.service("--insecure", endpoint=f"tcp/0.0.0.0:{port}").start()
        story = Story(site, references, document_of(PEG))
        robot = story.run(f"tcp/127.0.0.1:{port}")
        assert robot.statuses() == []
        assert cloud.process.matching("session_opened")

    def test_allowed_with_credentials(self, keys: Path, site: Site, references: References) -> None:
        port = free_port()
        cloud = site.service(
            "--tls", str(keys / "ours" / "service"), endpoint=f"tls/0.0.0.0:{port}"
        ).start()
        story = Story(site, references, document_of(PEG))
        story.at("perform", 30, cloud.kill, story.status(LOCAL_RECOVERY))
        robot = story.run(f"tls/127.0.0.1:{port}", options=("--tls", str(keys / "ours" / "robot")))
        assert robot.statuses() == [LOST]
        assert events_of(robot.out)
