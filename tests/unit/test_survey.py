"""Questions to a stock master and its nodes, all at once."""

import asyncio
import socket
import threading
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from xmlrpc.server import SimpleXMLRPCServer

import pytest
from tests.ports import free_port

from ros1_master_guard.errors import CallError
from ros1_master_guard.plan import gone_and_silent, process_of, snapshot
from ros1_master_guard.process import MasterState
from ros1_master_guard.ros1_calls import Connection


class Stock:
    """A master and a node in one: both answer XML-RPC."""

    uri = ""

    def getSystemState(self, caller: str) -> tuple[int, str, object]:  # noqa: N802
        scans = [["/scan", ["/lidar", "/ended"]]]
        services = [["/stop", ["/lidar"]], ["/ended/stop", ["/ended"]]]
        return 1, "", [scans, [["/left", ["/ended"]]], services]

    def getTopicTypes(self, caller: str) -> tuple[int, str, object]:  # noqa: N802
        return 1, "", [["/scan", "sensor_msgs/LaserScan"]]

    def getParam(self, caller: str, key: str) -> tuple[int, str, object]:  # noqa: N802
        return 1, "", {"speed": 2}

    def lookupNode(self, caller: str, name: str) -> tuple[int, str, str]:  # noqa: N802
        return (-1, f"unknown node [{name}]", "") if name == "/ended" else (1, "", self.uri)

    def lookupService(self, caller: str, name: str) -> tuple[int, str, str]:  # noqa: N802
        return 1, "", "rosrpc://robot:1"


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
        assert state.subscribers == {}
        assert state.services == {"/stop": ("/lidar", uri, "rosrpc://robot:1")}
    assert state.types == {"/scan": "sensor_msgs/LaserScan"}
    assert state.parameters == {"speed": 2}


async def asked(uri: str, ask: Callable[[Connection], Awaitable[object]]) -> object:
    connection = Connection(uri)
    try:
        return await ask(connection)
    finally:
        connection.close()


@pytest.mark.parametrize("pid", ["7447", "a text", "", [], {}, -1, 0, 1.5, None])
def test_a_master_that_tells_no_process_id(pid: object, monkeypatch: pytest.MonkeyPatch) -> None:
    def answer(self: Stock, caller: str) -> tuple[int, str, object]:
        return 1, "", "nothing" if pid is None else pid

    monkeypatch.setattr(Stock, "getPid", answer, raising=False)
    with stock() as uri, pytest.raises(CallError, match="which is no process id"):
        asyncio.run(asked(uri, lambda connection: process_of(connection, within_s=30.0)))


@pytest.mark.parametrize(
    ("method", "value"),
    [
        ("getSystemState", 5),
        ("getSystemState", []),
        ("getSystemState", [[], []]),
        ("getSystemState", {}),
        ("getSystemState", [[[1, 2, 3]], [], []]),
        ("getSystemState", [[["/scan", [["/lidar"]]]], [], []]),
        ("getSystemState", [[["/scan", ["/lidar", 5]]], [], []]),
        ("getTopicTypes", 5),
        ("getTopicTypes", ["ab", "c"]),
        ("getParam", "a text"),
    ],
)
def test_a_master_whose_answers_have_another_form(
    method: str, value: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Stock, method, lambda *_: (1, "", value))
    with stock() as uri, pytest.raises(CallError, match="cannot be understood"):
        asyncio.run(asked(uri, snapshot))


def test_a_node_that_answers_lives_and_a_dead_one_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Stock, "getPid", lambda *_: (1, "", 5), raising=False)
    dead = f"http://127.0.0.1:{free_port()}/"
    with stock() as uri, socket.create_server(("127.0.0.1", 0)) as stopped:
        silent = f"http://127.0.0.1:{stopped.getsockname()[1]}/"
        assert asyncio.run(gone_and_silent([uri, dead, silent])) == ({dead}, {silent})
