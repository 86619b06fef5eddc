"""ROS 1's answers, names and surroundings, as bytes and text."""

from __future__ import annotations

import pytest

from holdfast.errors import TransportError
from holdfast_ros.tcpros import RosEnvironment, encode_answer, encode_refusal, place_of_service

HERE = RosEnvironment("http://localhost:11311", "localhost", "127.0.0.1", "/")


def test_requests_and_answers() -> None:
    assert encode_answer(b"abc") == b"\1\3\0\0\0abc"
    assert encode_refusal("no") == b"\0\2\0\0\0no"


def test_where_a_service_is() -> None:
    assert place_of_service("rosrpc://robot.local:40001") == ("robot.local", 40001)
    assert place_of_service("rosrpc://[::1]:40001") == ("::1", 40001)


@pytest.mark.parametrize("uri", ["", "http://a:1", "rosrpc://a", "rosrpc://:1", "rosrpc://a:x", 7])
def test_what_is_no_place_is_refused(uri: object) -> None:
    with pytest.raises(TransportError, match="which is no place"):
        place_of_service(uri)


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        (
            {"ROS_HOSTNAME": "robot.local"},
            ("http://localhost:11311", "robot.local", "0.0.0.0", "/"),
        ),
        ({"ROS_IP": "10.0.0.7"}, ("http://localhost:11311", "10.0.0.7", "0.0.0.0", "/")),
        ({"ROS_HOSTNAME": "localhost"}, tuple(HERE)),
        (
            {"ROS_IP": "127.0.0.1", "ROS_MASTER_URI": "http://m:1/", "ROS_NAMESPACE": "/arm/left/"},
            ("http://m:1/", "127.0.0.1", "127.0.0.1", "/arm/left/"),
        ),
    ],
)
def test_surroundings(variables: dict[str, str], expected: tuple[str, ...]) -> None:
    assert tuple(RosEnvironment.of(variables)) == expected


@pytest.mark.parametrize("uri", ["localhost:11311", "https://a:1", "http://a", "http://:1", "x"])
def test_a_master_s_uri_that_is_none_is_refused(uri: str) -> None:
    with pytest.raises(TransportError, match=r"ROS_MASTER_URI is .* expected http://HOST:PORT"):
        RosEnvironment.of({"ROS_MASTER_URI": uri})


def test_names() -> None:
    arm = HERE._replace(namespace="/arm/")
    assert [HERE.resolved(name) for name in ("a", "/a/b_1", "a/b")] == ["/a", "/a/b_1", "/a/b"]
    assert [arm.resolved(name) for name in ("a", "/a")] == ["/arm/a", "/a"]


@pytest.mark.parametrize("name", ["", "/", "a b", "a-b", "1a", "a//b", "a/", "a" * 201, "\u00e4"])
def test_what_is_no_name_is_refused(name: str) -> None:
    with pytest.raises(TransportError, match="is no name in ROS 1"):
        HERE.resolved(name)
