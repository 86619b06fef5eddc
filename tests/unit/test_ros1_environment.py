"""ROS 1's answers, names and surroundings, as bytes and text."""

import pytest

from holdfast.errors import TransportError
from holdfast_ros.ros1_environment import RosEnvironment

HERE = RosEnvironment("http://localhost:11311", "localhost", "127.0.0.1", "/")


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
