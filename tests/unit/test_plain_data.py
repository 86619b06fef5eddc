"""What a session configuration's free sections may hold, at each bound and just beyond it."""

import datetime as dt
import math

import msgspec
import pytest

from holdfast.errors import MessageError
from holdfast.protocol.plain_data import (
    MAX_CONFIGURATION_DEPTH,
    MAX_CONFIGURATION_VALUES,
    check_plain_data,
)

pack = msgspec.msgpack.encode


def refused(data: bytes) -> MessageError:
    with pytest.raises(MessageError, match=r"^model: ") as caught:
        check_plain_data([data], "model")
    return caught.value


@pytest.mark.parametrize(
    "value",
    [
        None,
        True,
        -1,
        127,
        128,
        2**16,
        2**63,
        -33,
        -(2**40),
        0.5,
        "",
        "x" * 31,
        "x" * 32,
        "x" * 300,
        "x" * 70_000,
        [],
        [1] * 16,
        [1] * 400,
        {},
        {str(each): each for each in range(16)},
        {str(each): [each] for each in range(400)},
        {"walls": [[0.0, 1], [2, 3.5]], "name": "a", "x" * 40: {"y" * 300: None}},
    ],
)
def test_what_a_file_can_say(value: object) -> None:
    check_plain_data([pack(value), pack({"after": value})], "model")


@pytest.mark.parametrize(
    "value",
    [
        b"bytes",
        dt.datetime.now(dt.UTC),
        msgspec.msgpack.Ext(7, b"x"),
        math.nan,
        math.inf,
        {1: 2},
        {None: 1},
        {"a": {0.5: 1}},
    ],
)
def test_what_a_file_lacks(value: object) -> None:
    assert refused(pack(value)).code == "malformed"
    assert refused(pack({"a": [1, value]})).code == "malformed"


def test_a_key_that_is_an_array() -> None:
    assert "a key that is no text" in str(refused(b"\x81\x92\xff\xfe\x01"))


def test_levels() -> None:
    most = b"\x91" * (MAX_CONFIGURATION_DEPTH - 1) + b"\x90"
    check_plain_data([most, most], "model")
    assert f"more than {MAX_CONFIGURATION_DEPTH} levels" in str(refused(b"\x91" + most))


def test_values_of_all_sections() -> None:
    half = pack([0] * (MAX_CONFIGURATION_VALUES // 2))
    check_plain_data([half, half], "model")
    with pytest.raises(MessageError, match=f"more than {MAX_CONFIGURATION_VALUES} values") as error:
        check_plain_data([half, half, pack([0])], "model")
    assert error.value.code == "too_large"


def test_a_length_that_is_only_promised() -> None:
    assert refused(b"\xdd\xff\xff\xff\xff").code == "too_large"
