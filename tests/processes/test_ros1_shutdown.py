"""What ROS 1 asks to end ends; what a service offers beside it goes on."""

from __future__ import annotations

import xmlrpc.client
from pathlib import Path

import pytest
from tests.fuzz import corpus
from tests.ports import free_port
from tests.processes.faults import EXAMPLES, Service, Site, wait_until
from tests.unit.test_ros1_node import Master, master  # noqa: F401 - a fixture
from tests.wire import RawClient

from holdfast.protocol.messages import SensingAnswer, encode
from holdfast.transport.ros1_calls import CALLER


def shut_down(uri: str) -> None:
    """Ask a node to end, as ``rosnode kill`` does, and as anybody can who reaches its port."""
    with xmlrpc.client.ServerProxy(uri) as node:
        assert node.shutdown(CALLER, "go away") == [1, "", 0]


def is_gone(uri: str) -> bool:
    try:
        with xmlrpc.client.ServerProxy(uri) as node:
            node.getPid(CALLER)
    except ConnectionRefusedError:
        return True
    except ConnectionError:
        pass  # it ends just now
    return False


def service_of(site: Site, master: Master, endpoint: str, *options: str) -> Service:  # noqa: F811
    service = site.service(endpoint=endpoint)
    service.options = options
    service.variables = {
        "ROS_MASTER_URI": f"http://127.0.0.1:{master.port}",
        "ROS_HOSTNAME": "127.0.0.1",
    }
    return service.start()


def answers(endpoint: str) -> bool:
    with RawClient(endpoint) as robot:
        return any(
            isinstance(each, SensingAnswer) for each in robot.ask(encode(corpus.requests()[1]))
        )


@pytest.mark.parametrize(
    ("node", "options"),
    [
        ("/cloud/exchange_node", ("--listen", "ros1/cloud")),
        (
            "/cloud_active_sensing",
            ("--ros1", "--configuration", str(EXAMPLES / "peg_in_hole_2d.yaml")),
        ),
    ],
    ids=["links", "typed service"],
)
def test_what_is_served_beside_ros_goes_on(
    node: str,
    options: tuple[str, ...],
    tmp_path: Path,
    master: Master,  # noqa: F811
) -> None:
    with Site(tmp_path) as site:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        service = service_of(site, master, endpoint, *options)
        wait_until(lambda: node in master.nodes, "the node's registration")
        with RawClient(endpoint) as before:
            shut_down(master.nodes[node])
            told = service.process.wait_for("ros_shutdown")
            assert told["goes_on"] is True
            assert "go away" in told["reason"]
            wait_until(lambda: is_gone(master.nodes[node]), "the node's end")
            wait_until(lambda: "system.multicall" in master.asked, "its withdrawal")
            # A link from before stands, and there is room for another one.
            assert before.ask(encode(corpus.requests()[1]))
        assert answers(endpoint)
        assert service.process.process.poll() is None


def test_a_node_that_serves_nothing_else_ends(tmp_path: Path, master: Master) -> None:  # noqa: F811
    with Site(tmp_path) as site:
        service = service_of(site, master, "ros1/cloud")
        wait_until(lambda: "/cloud/exchange_node" in master.nodes, "the node's registration")
        shut_down(master.nodes["/cloud/exchange_node"])
        assert service.process.wait() == 0
        (told,) = [each for each in service.process.events if each["event"] == "ros_shutdown"]
        assert told["goes_on"] is False
