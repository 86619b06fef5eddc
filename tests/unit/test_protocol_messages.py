"""The codec: what goes in comes out, and what is no message is said to be none."""

import contextlib
import math
import random
import struct
import tracemalloc
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fuzz.odd_values import STORMS, OddValues, replaced

from holdfast.config import yaml_document
from holdfast.errors import MessageError
from holdfast.planning.inputs import MAX_INPUTS, Sensed, decode_floats, encode_floats
from holdfast.planning.settings import PlanningSettings
from holdfast.protocol.messages import (
    CHECKSUM_SIZE,
    DIGEST_SIZE,
    MAX_CONFIGURATION_BYTES,
    MAX_TASK_ACTIONS,
    PROTOCOL_VERSION,
    Busy,
    NeedState,
    Progress,
    Refused,
    Reply,
    Request,
    SensingAnswer,
    SessionConfiguration,
    TaskAnswer,
    decode_reply,
    decode_request,
    encode,
    settings_digest,
    unpack_configuration,
    with_checksum,
)
from holdfast.protocol.plain_data import MAX_CONFIGURATION_DEPTH, MAX_CONFIGURATION_VALUES

REQUEST = Request(
    PROTOCOL_VERSION,
    b"s" * 16,
    3,
    17,
    2,
    40,
    True,
    b"d" * DIGEST_SIZE,
    (Sensed(36, 1, encode_floats([1.0, 2.0])),),
    SessionConfiguration("peg_in_hole_2d", {"peg_width": 1.0}, {}, PlanningSettings(), 9),
)
REPLIES: list[Reply] = [
    TaskAnswer(17, 2, encode_floats(np.arange(6.0)), 250),
    SensingAnswer(17, 44, 2, b"e" * DIGEST_SIZE, 80),
    Progress(17, True),
    NeedState(17, False),
    Busy(17, 30),
    Refused(17, "stale_epoch", "epoch 1: epoch 2 was seen"),
]


def refuse(payload: bytes, code: str, says: str = ".", decode: Any = decode_request) -> str:
    """Assert that it is no message; return why."""
    with pytest.raises(MessageError, match=says) as raised:
        decode(payload)
    assert raised.value.code == code
    return str(raised.value)


def test_another_version_is_named_even_if_its_fields_are_unknown() -> None:
    other = msgspec.structs.replace(REQUEST, version=PROTOCOL_VERSION + 1)
    unknown = with_checksum(msgspec.msgpack.encode([PROTOCOL_VERSION + 1, {"new": 1}]))
    for payload in (encode(other), unknown):
        refuse(payload, "version", f"version {PROTOCOL_VERSION + 1}")


@pytest.mark.parametrize(
    "change",
    [
        {"session": b"short"},
        {"epoch": -1},
        {"step": 2**32},
        {"digest": b"d" * 32},
        {"inputs": (Sensed(1, 0, b""),) * (MAX_INPUTS + 1)},
        {"checkpoint": b"a checkpoint and observations"},
    ],
)
def test_a_request_out_of_bounds_is_malformed(change: dict[str, object]) -> None:
    refuse(encode(msgspec.structs.replace(REQUEST, **change)), "malformed")


def test_hostile_settings_are_malformed() -> None:
    fields = msgspec.msgpack.decode(encode(REQUEST)[:-CHECKSUM_SIZE])
    session_configuration = msgspec.msgpack.decode(fields[9])
    session_configuration[3]["particle_filter"]["num_particles"] = 10**12
    fields[9] = msgspec.msgpack.encode(session_configuration)
    refuse(with_checksum(msgspec.msgpack.encode(fields)), "malformed")


def test_a_task_answer_has_a_bounded_number_of_actions() -> None:
    for count in (0, MAX_TASK_ACTIONS + 1):
        refuse(encode(TaskAnswer(1, count, b"", 1)), "malformed", decode=decode_reply)


@given(st.binary(max_size=300))
def test_bytes_without_their_checksum_are_damaged(payload: bytes) -> None:
    if payload == with_checksum(payload[:-CHECKSUM_SIZE]):
        return  # one in four thousand million
    for decode in (decode_request, decode_reply):
        refuse(payload, "damaged", decode=decode)


@pytest.mark.parametrize("message", [REQUEST, *REPLIES], ids=lambda each: type(each).__name__)
def test_every_flipped_bit_is_seen(message: Request | Reply) -> None:
    payload = encode(message)
    decode = decode_request if isinstance(message, Request) else decode_reply
    for bit in range(8 * len(payload)):
        damaged = bytearray(payload)
        damaged[bit // 8] ^= 1 << bit % 8
        refuse(bytes(damaged), "damaged", decode=decode)


LARGE = 8_000_000
HEAD = msgspec.msgpack.decode(encode(REQUEST)[:-CHECKSUM_SIZE])[:8]


def _packed(*fields: object) -> bytes:
    """Pack fields; bytearrays are packed already."""
    packed = (
        bytes(field) if isinstance(field, bytearray) else msgspec.msgpack.encode(field)
        for field in fields
    )
    return bytes([0x90 + len(fields)]) + b"".join(packed)


def _empty_lists(count: int) -> bytearray:
    return bytearray(b"\xdd" + count.to_bytes(4, "big") + b"\x90" * count)


@pytest.mark.parametrize(
    "payload",
    [
        pytest.param(bytes(_empty_lists(LARGE)), id="no version"),
        pytest.param(b"\x91" * 100_000, id="nested lists"),
        pytest.param(b"\x81\xa1a" * 100_000, id="nested tables"),
        pytest.param(_packed(PROTOCOL_VERSION, _empty_lists(LARGE)), id="session"),
        pytest.param(_packed(PROTOCOL_VERSION + 1, _empty_lists(LARGE)), id="another version"),
        pytest.param(_packed(*HEAD, _empty_lists(LARGE)), id="observations"),
        pytest.param(
            _packed(*HEAD, bytearray(b"\x91\x94\x01\x01\xc4\x00" + _empty_lists(LARGE))),
            id="field of an observation",
        ),
        pytest.param(_packed(*HEAD, [], _empty_lists(LARGE), None), id="opening that is a list"),
        pytest.param(_packed(*HEAD, [], b"\x90" * LARGE, None), id="opening"),
        pytest.param(_packed(*HEAD, [], None, _empty_lists(LARGE)), id="checkpoint"),
        pytest.param(_packed(*HEAD, [], None, None, _empty_lists(LARGE)), id="unknown field"),
    ],
)
def test_a_large_message_that_is_no_request_is_not_read(payload: bytes) -> None:
    payload = with_checksum(payload)
    tracemalloc.start()
    try:
        with pytest.raises(MessageError):
            decode_request(payload)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 100_000


def test_settings_that_are_understood_otherwise_are_refused() -> None:
    """As by a service that does not know one of them, or takes another default."""
    encoded = encode(REQUEST)[:-CHECKSUM_SIZE]
    assert REQUEST.session_configuration is not None
    ours = settings_digest(REQUEST.session_configuration)
    assert encoded.count(ours) == 1
    for theirs in (b"t" * DIGEST_SIZE, None):
        fields = msgspec.msgpack.decode(encoded)
        fields[-1] = theirs
        said = refuse(with_checksum(msgspec.msgpack.encode(fields)), "other_code", ours.hex())
        assert (theirs.hex() if theirs else "not told") in said


def test_each_setting_that_decides_has_its_part_in_the_digest() -> None:
    session_configuration = REQUEST.session_configuration
    assert session_configuration is not None
    others = [
        msgspec.structs.replace(session_configuration, **change)
        for change in (
            {"problem": "peg_in_hole_3d"},
            {"model": {"peg_width": 2.0}},
            {"state_space_planner": {"a": 1}},
            {"planning": PlanningSettings(sensing_interval=7)},
            {"seed": 10},
        )
    ]
    digests = {settings_digest(each) for each in (session_configuration, *others)}
    assert len(digests) == 1 + len(others)
    named = msgspec.structs.replace(session_configuration, core_version="1", problem_digest="2")
    assert settings_digest(named) == settings_digest(session_configuration), (
        "code has digests of its own"
    )


def _request(model: dict[str, object], planning: PlanningSettings | None = None) -> Request:
    planning = planning or PlanningSettings()
    opening = SessionConfiguration("peg_in_hole_2d", model, {}, planning, 9)
    return msgspec.structs.replace(REQUEST, session_configuration=opening)


def test_a_whole_number_in_the_place_of_another_is_the_same_setting() -> None:
    planning = msgspec.convert({"sensing_interval": 3}, PlanningSettings)
    filter_ = msgspec.structs.replace(planning.particle_filter, num_particles=50)
    planning = msgspec.structs.replace(planning, particle_filter=filter_)
    request = _request({"peg_width": 1}, planning)
    assert decode_request(encode(request)) == request


@pytest.mark.parametrize(
    "model",
    [
        {"a": [[]] * MAX_CONFIGURATION_VALUES},
        {"a": [[[0] * 100] * 100]},
        {str(number): number for number in range(MAX_CONFIGURATION_VALUES // 2 + 1)},
        {"a": {"b": {str(number): 0 for number in range(MAX_CONFIGURATION_VALUES)}}},
    ],
    ids=["empty lists", "nested lists", "keys", "keys inside"],
)
def test_a_session_configuration_has_a_bounded_number_of_values(model: dict[str, object]) -> None:
    refuse(encode(_request(model)), "too_large", f"more than {MAX_CONFIGURATION_VALUES} values")


def _with_part(place: int, part: bytes, storm: bool = False) -> bytes:
    """Return a request of whose session configuration a part is these bytes.

    Its digest is right if they can be decoded, but for a storm, which that would take seconds.
    """
    opening = SessionConfiguration("peg_in_hole_2d", {}, {}, PlanningSettings(), 9)
    parts = [*map(msgspec.msgpack.encode, msgspec.structs.astuple(opening))]
    packed = replaced(parts, place, part)
    settings = b"s" * 16
    if not storm:
        with contextlib.suppress(Exception):  # then it will not come to that
            settings = settings_digest(unpack_configuration(packed))
    fields = [*msgspec.structs.astuple(REQUEST)[:8], (), packed, None, settings]
    return with_checksum(msgspec.msgpack.encode(fields))


_YEAR_10000 = b"\xc7\x0c\xff" + struct.pack(">Iq", 999_999_999, 253_402_300_799)


@pytest.mark.parametrize(
    ("value", "what"),
    [
        (_YEAR_10000, r"JSON lacks \(0xc7\)"),
        (b"\xd6\xff\x00\x00\x00\x01", r"JSON lacks \(0xd6\)"),
        (b"\xd4\x05\x00", r"JSON lacks \(0xd4\)"),
        (b"\xc4\x01\x00", r"JSON lacks \(0xc4\)"),
        (b"\xcb" + struct.pack(">d", math.nan), "the number nan"),
        (b"\xca" + struct.pack(">f", -math.inf), "the number -inf"),
        (b"\x81\x01\x01", r"no text \(0x01\)"),
        (b"\x91\x81\x91\x01\x01", r"no text \(0x91\)"),
        (b"\x81\xc4\x01\x00\x01", r"no text \(0xc4\)"),
        (b"\x81" + _YEAR_10000 + b"\x01", r"no text \(0xc7\)"),
        (b"\xa3\xed\xa0\x80", "utf-8"),
        (b"\x91" * MAX_CONFIGURATION_DEPTH + b"\x01", "more than 32 levels"),
        (b"\x81\xa1a" * 900 + b"\x80", "more than 32 levels"),
        (b"\x91" * 100_000, "recursion"),
    ],
)
def test_what_a_file_cannot_say_is_malformed_where_it_comes_in(value: bytes, what: str) -> None:
    """A service encodes a session configuration again, deeper in its stack than it decoded it."""
    refuse(_with_part(1, b"\x81\xa1a" + value), "malformed", what)


@pytest.mark.parametrize("storm", STORMS)
@pytest.mark.parametrize("place", [1, 2], ids=["model", "state_space_planner"])
def test_what_is_costly_to_make_is_refused_before_it_is_made(storm: str, place: int) -> None:
    """Sixteen thousand keys of the same hash held up a process for seconds."""
    payload = _with_part(place, b"\x81\xa1a" + STORMS[storm], storm=True)
    assert len(payload) < MAX_CONFIGURATION_BYTES
    tracemalloc.start()
    try:
        with pytest.raises(MessageError, match=r"no text|more than"):
            decode_request(payload)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 50_000 + 3 * len(payload)


def test_as_many_levels_as_a_file_may_have_survive_the_wire() -> None:
    nested: object = 1.5
    for _ in range(MAX_CONFIGURATION_DEPTH - 1):
        nested = [nested]
    request = _request({"a": nested})
    assert decode_request(encode(request)) == request
    assert MAX_CONFIGURATION_DEPTH == yaml_document.MAX_DEPTH


def test_any_value_at_any_place_of_a_reply_is_refused_or_a_reply() -> None:
    chance = random.Random(1)
    odd = OddValues(chance)
    replies = [
        [*map(msgspec.msgpack.encode, msgspec.msgpack.decode(encode(reply)[:-4]))]
        for reply in REPLIES
    ]
    taken = 0
    for _ in range(4000):
        fields = chance.choice(replies)
        payload = with_checksum(replaced(fields, chance.randrange(len(fields)), odd.value()))
        try:
            decode_reply(payload)
        except MessageError as error:
            assert error.code == "malformed"
        else:
            taken += 1
    assert taken > 100


def test_a_session_configuration_of_many_values_survives_the_wire() -> None:
    request = _request({"a": [0.5] * (MAX_CONFIGURATION_VALUES - 100)})
    assert decode_request(encode(request)) == request


def test_a_session_configuration_has_a_bounded_size() -> None:
    request = _request({"a": "x" * MAX_CONFIGURATION_BYTES})
    refuse(encode(request), "too_large", f"at most {MAX_CONFIGURATION_BYTES} are")


def test_a_checkpoint_is_not_copied() -> None:
    """To copy a large one would hold up all other threads."""
    request = msgspec.structs.replace(REQUEST, inputs=(), checkpoint=bytes(100_000))
    payload = bytearray(encode(request))
    decoded = decode_request(cast(bytes, payload))
    assert decoded == request
    assert decoded.checkpoint is not None
    assert np.shares_memory(np.frombuffer(decoded.checkpoint, np.uint8), payload)


@pytest.mark.parametrize("version", [0, 1, 127, 128, 255, 256, 65535, 65536, 2**32 - 1])
@pytest.mark.parametrize("count", [1, 15, 16, 70_000])
def test_a_version_is_read_in_every_form(version: int, count: int) -> None:
    content = msgspec.msgpack.encode([version, *[None] * (count - 1)])
    refuse(with_checksum(content), "version", f"version {version}: ")
    for end in range(min(len(content), 9)):
        with pytest.raises(MessageError):
            decode_request(with_checksum(content[:end]))


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), max_size=20))
def test_numbers_keep_their_bits(numbers: list[float]) -> None:
    data = encode_floats(numbers)
    assert encode_floats(decode_floats(data, len(numbers))) == data


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_refused(number: float) -> None:
    with pytest.raises(MessageError):
        decode_floats(encode_floats([0.0, number]), 2)
    with pytest.raises(MessageError):
        decode_floats(encode_floats([0.0]), 2)
