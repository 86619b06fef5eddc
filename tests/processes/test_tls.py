"""Services behind mutual TLS: their faults change no decision, and strangers stay outside."""

from pathlib import Path

import pytest
from tests.ports import free_port
from tests.processes import faults

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
    site: faults.Site, keys: Path, protocol: str, authority: str = "ours", host: str = "127.0.0.1"
) -> faults.Service:
    directory = keys / authority / "service"
    return site.service(
        *("--tls", str(directory)),
        endpoint=f"{protocol}/{host}:{free_port(host)}",
        lease_ms=faults.QUICK["lease_ms"],
    )


@UDP_AND_SLOWLY_TLS
def test_killed_stopped_and_started_again(
    protocol: str, keys: Path, site: faults.Site, references: faults.References
) -> None:
    document = faults.document_of(PEG)
    steps = faults.sensing_steps(document)
    cloud = secure(site, keys, protocol).start()
    story = faults.Story(site, references, document, offload=faults.QUICK)
    story.at("sense", steps[1], cloud.kill)
    story.at("perform", steps[3], cloud.start, story.status(faults.KEEP_ALIVE))
    story.at("sense", steps[4], cloud.stop)
    story.at("perform", steps[6], cloud.resume, story.status(faults.KEEP_ALIVE, 2))
    robot = story.run(cloud, options=("--tls", str(keys / "ours" / "robot")))
    assert robot.statuses() == [faults.LOST, faults.RESTORED, faults.LOST_AGAIN, faults.RESTORED]


@TLS_AND_SLOWLY_UDP
def test_a_robot_of_another_authority_stays_outside(
    protocol: str, keys: Path, site: faults.Site, references: faults.References
) -> None:
    cloud = secure(site, keys, protocol).start()
    offload = {"startup_timeout_ms": 1000.0}
    story = faults.Story(site, references, faults.document_of(PEG), offload=offload)
    # It cannot use the cloud and does not believe it either; its own service decides.
    robot = story.run(cloud, options=("--tls", str(keys / "theirs" / "robot")))
    assert robot.statuses() == [faults.LOST]
    assert not robot.matching("service_appeared", service=cloud.endpoint)
    assert not cloud.process.matching("session_opened")
