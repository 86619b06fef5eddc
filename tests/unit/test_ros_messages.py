"""The typed service's messages: the bytes and digests that real ROS has for them.

tests/ros/golden_ros2.py has written tests/unit/data/ros2; the MD5 sums are genmsg's.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holdfast.belief import Belief
from holdfast.errors import CheckpointError, HoldfastError, InvalidValueError
from holdfast.planning import PlanningState
from holdfast.ros import messages
from holdfast.ros.active_sensing import DecisionAnswer, DecisionRequest, ErrorCode, RequestKind
from holdfast.ros.messages import (
    SERVICE,
    Serialization,
    decode_answer,
    decode_request,
    encode_answer,
    encode_request,
    md5_sum,
    service_types,
    type_hash,
    typestore,
)

GOLDEN = Path(__file__).parent / "data" / "ros2"
HASHES: dict[str, str] = json.loads((GOLDEN / "hashes.json").read_text())
CONFIGURATION = "0123456789abcdef"

STATE = PlanningState(
    2**53 + 1,
    2**32 - 1,
    7,
    2,
    True,
    Belief(np.array([[0.5, -1.25, 3e-300], [4.0, 5.5, -0.0]]), np.array([0.25, 0.75])),
)
REQUESTS = {
    "empty_request": DecisionRequest(RequestKind.INITIALIZE),
    "initialize_request": DecisionRequest(RequestKind.INITIALIZE, CONFIGURATION, 5, 6),
    "request": DecisionRequest(
        RequestKind.CHOOSE_TASK_ACTIONS, "ü", -1, 3, STATE, 4, np.array([1.5, 2.5, -3.5])
    ),
}
ANSWERS = {
    "empty_answer": DecisionAnswer(ErrorCode.OK, "", ""),
    "refusal": DecisionAnswer(ErrorCode.BUSY, "später", CONFIGURATION),
    "answer": DecisionAnswer(
        ErrorCode.OK,
        "",
        CONFIGURATION,
        STATE,
        9,
        np.array([0.125, 1e300]),
        np.arange(1.0, 7.0).reshape(3, 2),
    ),
}


def same(one: object, other: object) -> bool:
    """Compare bit by bit, so that -0.0 is not 0.0."""
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return one.tobytes() == other.tobytes() and (one.shape == other.shape or not one.size)
    return one == other


class TestAgainstRos:
    @pytest.mark.parametrize("name", [name for name in HASHES if not name.startswith("std_srvs")])
    def test_hash(self, name: str) -> None:
        assert type_hash(name) == HASHES[name]

    def test_hash_of_another_service_with_an_empty_request(self) -> None:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(messages._TIME, "builtin_interfaces/msg/Time"))
        store.register(
            get_types_from_msg(messages._EVENT_INFO, "service_msgs/msg/ServiceEventInfo")
        )
        store.register(
            service_types("std_srvs/srv/Trigger", "---\nbool success # worked\nstring message\n")
        )
        for name, expected in HASHES.items():
            if name.startswith("std_srvs"):
                assert type_hash(name, store) == expected

    def test_md5_sums(self) -> None:
        assert md5_sum() == "d8922908c4123cea68a83d93a239f22e"
        assert md5_sum("holdfast_interfaces/msg/Belief") == "099e63b04f587c765a482c4b7c35fbfd"
        assert (
            md5_sum("holdfast_interfaces/msg/PlanningState") == "bb3b6612623bfb1d7c85264e85d688bb"
        )

    @pytest.mark.parametrize("name", REQUESTS)
    def test_request(self, name: str) -> None:
        data = (GOLDEN / f"{name}.cdr").read_bytes()
        assert encode_request(REQUESTS[name]) == data
        assert same(decode_request(data), REQUESTS[name])

    @pytest.mark.parametrize("name", ANSWERS)
    def test_answer(self, name: str) -> None:
        data = (GOLDEN / f"{name}.cdr").read_bytes()
        assert encode_answer(ANSWERS[name]) == data
        assert same(decode_answer(data), ANSWERS[name])


@pytest.mark.parametrize("serialization", ["cdr", "ros1"])
class TestBothWays:
    @pytest.mark.parametrize("name", REQUESTS)
    def test_request(self, name: str, serialization: Serialization) -> None:
        data = encode_request(REQUESTS[name], serialization)
        assert same(decode_request(data, serialization), REQUESTS[name])

    @pytest.mark.parametrize("name", ANSWERS)
    def test_answer(self, name: str, serialization: Serialization) -> None:
        data = encode_answer(ANSWERS[name], serialization)
        decoded = decode_answer(data, serialization)
        assert same(decoded, ANSWERS[name])
        # Nothing hangs on the bytes that were received.
        assert decoded.entropies.flags.owndata and decoded.entropies.flags.writeable

    @settings(max_examples=300, deadline=None)
    @given(cut=st.integers(0, 300), place=st.integers(0, 300), byte=st.integers(0, 255))
    def test_other_bytes_are_refused(
        self, serialization: Serialization, cut: int, place: int, byte: int
    ) -> None:
        pairs: list[tuple[bytes, Callable[..., Any]]] = [
            (encode_request(REQUESTS["request"], serialization), decode_request),
            (encode_answer(ANSWERS["answer"], serialization), decode_answer),
        ]
        for data, decode in pairs:
            with pytest.raises(HoldfastError):
                decode(data[: min(cut, len(data) - 1)], serialization)
            damaged = bytearray(data)
            damaged[place % len(data)] = byte
            with contextlib.suppress(HoldfastError):
                decode(bytes(damaged), serialization)

    @settings(max_examples=300, deadline=None)
    @given(data=st.binary(max_size=400))
    def test_any_bytes_are_refused_or_read(self, serialization: Serialization, data: bytes) -> None:
        for decode in (decode_request, decode_answer):
            with contextlib.suppress(HoldfastError):
                decode(data, serialization)


@pytest.mark.parametrize(
    ("request_", "text"),
    [
        (DecisionRequest(256), "kind 256: it must be from 0 to 255"),
        (DecisionRequest(0, seed=2**63), "seed 9223372036854775808"),
        (DecisionRequest(0, trial=-1), "trial -1"),
        (DecisionRequest(0, state=STATE._replace(step=2**32)), "state.step 4294967296"),
        (DecisionRequest(0, configuration="\ud800"), "text"),
        (DecisionRequest(0, observation=np.zeros(2_000_001)), "at most 16000000"),
    ],
)
def test_what_does_not_fit_is_refused(request_: DecisionRequest, text: str) -> None:
    with pytest.raises(InvalidValueError, match=text):
        encode_request(request_)


def damaged_answer(**fields: object) -> bytes:
    """Return the golden answer with other fields."""
    name = f"{SERVICE}_Response"
    data = (GOLDEN / "answer.cdr").read_bytes()
    message: Any = typestore().deserialize_cdr(data, name)
    for field, value in fields.items():
        setattr(message, field, value)
    return bytes(typestore().serialize_cdr(message, name))


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"error": 9}, "error 9: there are 0 OK"),
        ({"action_size": 4}, "task_actions has 6 numbers"),
        ({"action_size": 0}, "task_actions has 6 numbers"),
    ],
)
def test_answers_that_contradict_themselves(fields: dict[str, object], text: str) -> None:
    with pytest.raises(InvalidValueError, match=text):
        decode_answer(damaged_answer(**fields))


def test_a_state_that_is_none() -> None:
    broken = STATE._replace(belief=Belief(STATE.belief.states, np.array([0.5, 0.75])))
    with pytest.raises(CheckpointError, match="1"):
        decode_request(encode_request(DecisionRequest(1, state=broken)))
