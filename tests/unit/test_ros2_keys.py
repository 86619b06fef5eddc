"""Keys, tokens and attachments of ROS 2's wire, as rmw_zenoh has them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from holdfast.errors import InvalidValueError
from holdfast.ros.ros2_keys import (
    NO_HASH,
    Attachment,
    check_domain,
    check_service_name,
    graph_tokens,
    service_key,
)

HASH = json.loads((Path(__file__).parent / "data" / "ros2" / "hashes.json").read_text())[
    "holdfast_interfaces/srv/ActiveSensing"
]
TYPE = "holdfast_interfaces::srv::dds_::ActiveSensing_"


def test_keys() -> None:
    assert service_key(7, "robot/decide", HASH) == f"7/robot/decide/{TYPE}/{HASH}"
    assert service_key(0, "decide", NO_HASH) == f"0/decide/{TYPE}/TypeHashNotSupported"


def test_tokens() -> None:
    node, service = graph_tokens(7, "ab12", "robot/decide", "decide", serves=True)
    assert node == "@ros2_lv/7/ab12/0/0/NN/%/%/decide"
    assert service == f"@ros2_lv/7/ab12/0/1/SS/%/%/decide/%robot%decide/{TYPE}/{HASH}/::,10:,:,:,,"
    assert "/SC/" in graph_tokens(7, "ab12", "decide", "client", serves=False)[1]


def test_attachment() -> None:
    gid = bytes(range(16))
    data = Attachment(3, 2**40 + 5, gid).encode()
    assert data == bytes.fromhex("0300000000000000050000000001000010") + gid
    assert Attachment.decode(data) == (3, 2**40 + 5, gid)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        bytes(33),
        Attachment(1, 1, bytes(16)).encode() + b"\0",
        Attachment(-1, 1, bytes(16)).encode(),
        Attachment(1, -1, bytes(16)).encode(),
    ],
)
def test_what_is_no_attachment(data: bytes) -> None:
    with pytest.raises(InvalidValueError, match=f"attachment of {len(data)} bytes"):
        Attachment.decode(data)


@pytest.mark.parametrize("name", ["", "/", "a//b", "a/", "1a", "a/2b", "a__b", "a b", "ä", "~/a"])
def test_names_that_ros_does_not_allow(name: str) -> None:
    with pytest.raises(InvalidValueError, match="--ros2-name"):
        check_service_name(name, "--ros2-name")


def test_names() -> None:
    assert check_service_name("/robot_1/cloud_active_sensing") == "robot_1/cloud_active_sensing"
    with pytest.raises(InvalidValueError, match="200"):
        check_service_name("a" * 201)


def test_domains() -> None:
    assert check_domain(232) == 232
    for domain in (-1, 233):
        with pytest.raises(InvalidValueError, match=f"{domain}: .* 0 to 232"):
            check_domain(domain)


def test_a_service_that_is_not_in_ros_loads_nothing_for_it() -> None:
    text = (
        "import sys; from holdfast.cli import main; sys.argv = ['holdfast', 'serve', '--help']\n"
        "try: main()\nexcept SystemExit: pass\n"
        "print([name for name in sys.modules if 'ros' in name.split('.') or name == 'zenoh'],"
        " file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    assert done.stderr == "[]\n"
