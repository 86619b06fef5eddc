"""Questions to a stock master and its nodes, all at once."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from xmlrpc.server import SimpleXMLRPCServer

from tests.ports import free_port

from holdfast.ros.master.plan import NodeReport, ask_everyone, snapshot
from holdfast.ros.master.process import MasterState
from holdfast.transport.ros1_calls import Connection


class Stock:
    """A master and a node in one: both answer XML-RPC."""

    uri = ""

    def getSystemState(self, caller: str) -> tuple[int, str, object]:  # noqa: N802
        state = [[["/scan", ["/lidar"]]], [], [["/stop", ["/lidar"]]]]
        return 1, "", state

    def getTopicTypes(self, caller: str) -> tuple[int, str, object]:  # noqa: N802
        return 1, "", [["/scan", "sensor_msgs/LaserScan"]]

    def getParam(self, caller: str, key: str) -> tuple[int, str, object]:  # noqa: N802
        return 1, "", {"speed": 2}

    def lookupNode(self, caller: str, name: str) -> tuple[int, str, str]:  # noqa: N802
        return 1, "", self.uri

    def lookupService(self, caller: str, name: str) -> tuple[int, str, str]:  # noqa: N802
        return 1, "", "rosrpc://robot:1"

    def getPublications(self, caller: str) -> tuple[int, str, object]:  # noqa: N802
        return 1, "", [["/scan", "sensor_msgs/LaserScan"]]

    def getSubscriptions(self, caller: str) -> tuple[int, str, object]:  # noqa: N802
        return 1, "", []


@contextmanager
def stock() -> Iterator[str]:
    with SimpleXMLRPCServer(("127.0.0.1", 0), logRequests=False) as server:
        node = Stock()
        node.uri = f"http://127.0.0.1:{server.server_address[1]}/"
        server.register_instance(node)
        server.register_multicall_functions()
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield node.uri
        finally:
            server.shutdown()
            thread.join()


def test_a_stock_masters_state() -> None:
    async def ask(uri: str) -> MasterState:
        connection = Connection(uri)
        try:
            return await snapshot(connection)
        finally:
            connection.close()

    with stock() as uri:
        state = asyncio.run(ask(uri))
        assert state.publishers == {"/scan": [("/lidar", uri)]}
        assert state.services == {"/stop": ("/lidar", uri, "rosrpc://robot:1")}
    assert state.types == {"/scan": "sensor_msgs/LaserScan"}
    assert state.parameters == {"speed": 2}


def test_a_node_reports_its_topics_and_a_dead_one_is_gone() -> None:
    dead = f"http://127.0.0.1:{free_port()}/"
    known = MasterState()
    with stock() as uri:
        known.publishers = {"/scan": [("/lidar", uri), ("/dead", dead)]}
        known.services = {"/stop": ("/dead", dead, f"rosrpc://127.0.0.1:{free_port()}")}
        nodes, services = asyncio.run(ask_everyone(known))
    assert nodes == {uri: NodeReport({"/scan": "sensor_msgs/LaserScan"}, {}), dead: "gone"}
    assert services == {"/stop": False}
