"""What ROS 1 asks to end ends; what a service offers beside it goes on."""

import xmlrpc.client
from pathlib import Path

from tests.fuzz import corpus
from tests.processes.faults import EXAMPLES, Site, wait_until
from tests.unit.test_ros1_node import Master, master  # noqa: F401 - a fixture
from tests.wire import RawClient

from holdfast.protocol.messages import SensingAnswer, encode
from holdfast_lab.testbed.processes import HOLDFAST
from ros1_master_guard.ros1_calls import CALLER

NODE = "/cloud_active_sensing"
OPTIONS = ("--configuration", str(EXAMPLES / "peg_in_hole_2d.yaml"))


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


def environment(master: Master) -> dict[str, str]:  # noqa: F811
    return {"ROS_MASTER_URI": f"http://127.0.0.1:{master.port}", "ROS_HOSTNAME": "127.0.0.1"}


def answers(endpoint: str) -> bool:
    with RawClient(endpoint) as robot:
        return any(
            isinstance(each, SensingAnswer) for each in robot.ask(encode(corpus.requests()[1]))
        )


def test_what_is_served_beside_ros_goes_on(tmp_path: Path, master: Master) -> None:  # noqa: F811
    with Site(tmp_path) as site:
        service = site.service(*OPTIONS)
        service.verb = "ros1-serve"
        service.variables = environment(master)
        service.start()
        wait_until(lambda: NODE in master.nodes, "the node's registration")
        with RawClient(service.endpoint) as before:
            shut_down(master.nodes[NODE])
            told = service.process.wait_for("ros_shutdown")
            assert told["goes_on"] is True
            assert "go away" in told["reason"]
            wait_until(lambda: is_gone(master.nodes[NODE]), "the node's end")
            wait_until(lambda: "system.multicall" in master.asked, "its withdrawal")
            # A link from before stands, and there is room for another one.
            assert before.ask(encode(corpus.requests()[1]))
        assert answers(service.endpoint)
        assert service.process.process.poll() is None


def test_a_node_that_serves_nothing_else_ends(tmp_path: Path, master: Master) -> None:  # noqa: F811
    with Site(tmp_path) as site:
        process = site.process(
            *(*HOLDFAST, "ros1-serve", "--log", "json", *OPTIONS), variables=environment(master)
        )
        wait_until(lambda: NODE in master.nodes, "the node's registration")
        shut_down(master.nodes[NODE])
        assert process.wait() == 0
        (told,) = [each for each in process.events if each["event"] == "ros_shutdown"]
        assert told["goes_on"] is False
