"""Reading endpoints, and what is refused."""

import socket

import pytest
from tests.answers import answers_in

from holdfast.errors import TransportError
from holdfast.transport.endpoints import Endpoint, parse_endpoint


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("tcp/127.0.0.1:7447", Endpoint("tcp", "127.0.0.1", 7447)),
        ("tcp/localhost:0", Endpoint("tcp", "localhost", 0)),
        ("tls/planner.example.org:65535", Endpoint("tls", "planner.example.org", 65535)),
        ("udp/[::1]:7447", Endpoint("udp", "::1", 7447)),
        ("tcp/[fe80::1%eth0]:7447", Endpoint("tcp", "fe80::1%eth0", 7447)),
        ("tcp/cloud_1:80", Endpoint("tcp", "cloud_1", 80)),
        (f"tcp/{'b' * 63}.c:80", Endpoint("tcp", f"{'b' * 63}.c", 80)),
        ("unix//run/s", Endpoint("unix", "/run/s", 0)),
        ("unix/s", Endpoint("unix", "s", 0)),
    ],
)
def test_an_endpoint_is_read_and_written(text: str, expected: Endpoint) -> None:
    assert parse_endpoint(text) == expected
    assert str(expected) == text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        *answers_in("endpoint_mistakes.txt"),
        ("", "does not begin with a protocol.*tcp, tls, udp and unix"),
        ("tcp/localhost:" + "9" * 5000, "is not a number from 0"),
    ],
)
def test_what_is_no_endpoint_is_refused_with_the_reason(text: str, message: str) -> None:
    with pytest.raises(TransportError, match=message):
        parse_endpoint(text.rstrip("\n"))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("tcp/127.0.0.1:1", True),
        ("tcp/127.1.2.3:1", True),
        ("tcp/[::1]:1", True),
        ("tcp/[::ffff:127.0.0.1]:1", True),
        ("tcp/localhost:1", True),
        ("tcp/LOCALHOST:1", True),
        ("unix//run/s", True),
        ("tcp/0.0.0.0:1", False),
        ("tcp/[::]:1", False),
        ("tcp/[::ffff:10.0.0.1]:1", False),
        ("tcp/10.0.0.1:1", False),
        ("tcp/localhost.example.org:1", False),
        ("udp/planner:1", False),
    ],
)
def test_loopback_is_what_only_this_machine_can_reach(text: str, expected: bool) -> None:
    assert parse_endpoint(text).is_loopback is expected


def test_localhost_that_leads_elsewhere_is_not_loopback(monkeypatch: pytest.MonkeyPatch) -> None:
    elsewhere = [(socket.AF_INET, socket.SOCK_STREAM, 6, "", ("10.0.0.7", 0))]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_: elsewhere)
    assert not parse_endpoint("tcp/localhost:1").is_loopback
