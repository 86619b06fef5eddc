"""A client of a service in ROS 1, against a master and a service that are not there, or refuse."""

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from xmlrpc.server import SimpleXMLRPCServer

import pytest
from tests.ports import free_port

from holdfast.errors import TransportError
from holdfast.protocol.status import Status
from holdfast_ros.active_sensing import DecisionRequest, RequestKind
from holdfast_ros.ros1_client import STATUS_WORDS, Ros1Client, Ros1Service, service_type
from holdfast_ros.ros1_environment import RosEnvironment
from ros1_master_guard.headers import decode_header, encode_header

BEGIN = DecisionRequest(RequestKind.INITIALIZE, seed=1)
PATIENCE_S = 30.0


def ros_environment(port: int) -> RosEnvironment:
    return RosEnvironment.of(
        {"ROS_MASTER_URI": f"http://127.0.0.1:{port}", "ROS_HOSTNAME": "127.0.0.1"}
    )


@contextmanager
def master(service_uri: str) -> Iterator[int]:
    """Run a master that knows one service."""
    with SimpleXMLRPCServer(("127.0.0.1", 0), logRequests=False) as server:
        server.register_function(lambda *_: (1, "", service_uri), "lookupService")
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield server.server_address[1]
        finally:
            server.shutdown()
            thread.join()


async def ask(service: Ros1Service) -> None:
    try:
        await service.ask(BEGIN, PATIENCE_S)
    finally:
        service.disconnect()


async def test_without_a_master() -> None:
    service = Ros1Service("cloud", ros_environment(free_port()), "robot")
    with pytest.raises(TransportError, match="there is no master at"):
        await ask(service)


async def test_a_refused_connection_means_a_dead_service() -> None:
    port = free_port()
    with master(f"rosrpc://127.0.0.1:{port}") as at:
        service = Ros1Service("cloud", ros_environment(at), "robot")
        with pytest.raises(TransportError, match=rf"nobody listens at .*{port}, .* it is dead"):
            await ask(service)


async def test_a_service_of_another_type_refuses() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        fields: dict[str, str] = {}

        def refuse() -> None:
            stream, _ = listening.accept()
            with stream, stream.makefile("rb") as sent:
                size = int.from_bytes(sent.read(4), "little")
                fields.update(decode_header(sent.read(size)))
                stream.sendall(encode_header({"error": "another type"}))

        refusing = threading.Thread(target=refuse)
        refusing.start()
        with master(f"rosrpc://127.0.0.1:{listening.getsockname()[1]}") as at:
            service = Ros1Service("cloud", ros_environment(at), "robot")
            with pytest.raises(TransportError, match="it refuses: another type"):
                await ask(service)
        refusing.join()
    assert fields["service"] == "/cloud"
    assert fields["callerid"] == "/robot"
    assert fields["md5sum"] == service_type()[1]


def test_every_status_has_its_words() -> None:
    assert set(STATUS_WORDS) == set(Status)


def test_what_it_waits_for_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    with (
        Ros1Client(ros_environment=ros_environment(free_port()), deadline_s=0.01) as client,
        pytest.raises(TransportError, match="nobody has answered"),
    ):
        client.decide(BEGIN, give_up_s=0.2)
    assert [record.getMessage().partition(":")[0] for record in caplog.records] == [
        "status",
        "holding",
    ]
