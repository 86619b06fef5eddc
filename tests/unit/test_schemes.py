"""The links of each protocol."""

from __future__ import annotations

import subprocess
import sys

import pytest

from holdfast.transport import endpoints
from holdfast.transport.datagram_links import RobotDatagramLink, ServiceDatagramLink
from holdfast.transport.links import Link
from holdfast.transport.schemes import link_maker


@pytest.mark.parametrize("protocol", endpoints.PROTOCOLS)
def test_udp_alone_has_datagrams_beside_its_streams(protocol: str) -> None:
    robot, service = link_maker(protocol, "robot"), link_maker(protocol, "service")
    made = [getattr(each, "func", each) for each in (robot, service)]
    udp = protocol == "udp"
    assert made == ([RobotDatagramLink, ServiceDatagramLink] if udp else [Link, Link])


def test_what_no_endpoint_uses_is_not_imported() -> None:
    program = (
        "import sys; from holdfast.transport.schemes import link_maker; "
        "link_maker('tcp', 'service'); print(*sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    loaded = {name for name in done.stdout.split() if name.startswith("holdfast.transport.")}
    assert not loaded & {"holdfast.transport.datagram_links", "holdfast.transport.tls"}
