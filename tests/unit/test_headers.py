"""Headers of ROS 1's connections, as bytes."""

import struct

import pytest

from ros1_master_guard.errors import ProtocolError
from ros1_master_guard.headers import decode_header, encode_header, encode_message


def test_a_header_is_read_as_it_was_written() -> None:
    fields = {"callerid": "/robot", "message_definition": "a=b\nstring c", "empty": ""}
    written = encode_header(fields)
    (size,) = struct.unpack_from("<I", written)
    assert size == len(written) - 4
    assert decode_header(written[4:]) == fields


def test_a_header_has_the_bytes_that_ros_documents() -> None:
    assert encode_header({"md5sum": "*"}) == b"\x0c\0\0\0\x08\0\0\0md5sum=*"
    assert encode_message(b"abc") == b"\3\0\0\0abc"


@pytest.mark.parametrize(
    "data", [b"\1", b"\4\0\0\0abc", b"\3\0\0\0abc", b"\xff\xff\xff\xff", b"\0\0\0\0"]
)
def test_what_is_no_header_is_refused(data: bytes) -> None:
    with pytest.raises(ProtocolError, match=r"has sent .* connection header"):
        decode_header(data)
