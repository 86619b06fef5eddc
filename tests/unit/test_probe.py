"""One address of a service: certificates, interfaces, and calls that cannot be broken off."""

import asyncio
import socket
import threading
from concurrent.futures import Future

import pytest
from tests.ports import free_port

from holdfast.robot.probe import AddressPath, account_of, in_thread, interface_of
from holdfast.transport.endpoints import Endpoint


def test_without_a_service_there_is_no_certificate() -> None:
    async def look() -> bytes:
        endpoint = Endpoint("tls", "127.0.0.1", free_port())
        address = (endpoint.host, endpoint.port)
        return await AddressPath(endpoint, "anna", socket.AF_INET, address).certificate()

    assert asyncio.run(look()) == b""


@pytest.mark.parametrize("der", [b"", b"nonsense"])
def test_bytes_that_are_no_certificate_say_nothing(der: bytes) -> None:
    assert account_of(der) == ""


def test_the_loopback_interface_is_known_by_its_address() -> None:
    assert interface_of("127.0.0.1") == "lo, "
    assert interface_of("192.0.2.1") == ""


def test_a_call_in_a_thread_is_waited_for_only_so_long() -> None:
    may = threading.Event()
    done: Future[bool] = in_thread(lambda: may.wait(30.0))
    with pytest.raises(TimeoutError):
        done.result(0.0)
    late = in_thread(may.is_set)
    assert late.result(30.0) is False
    may.set()


def test_an_error_in_a_thread_comes_back() -> None:
    def fail() -> None:
        raise OSError("no")

    with pytest.raises(OSError, match="no"):
        in_thread(fail).result(30.0)
