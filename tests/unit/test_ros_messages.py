"""The typed service's messages: the bytes and the digest that ROS 1 has for them.

The MD5 sum is genmsg's; tests/ros/test_ros1_service.py has rospy at the other end.
"""

import contextlib
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holdfast.errors import CheckpointError, HoldfastError, InvalidValueError
from holdfast.planning.belief import Belief
from holdfast.planning.planner import PlanningState
from holdfast_ros.active_sensing import DecisionAnswer, DecisionRequest, ErrorCode, RequestKind
from holdfast_ros.messages import (
    SERVICE,
    decode_answer,
    decode_request,
    encode_answer,
    encode_request,
    md5_sum,
    typestore,
)

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


def test_md5_sum() -> None:
    assert md5_sum() == "d8922908c4123cea68a83d93a239f22e"


def test_the_bytes_of_a_request() -> None:
    """Little-endian, without padding, each text and array after its length."""
    text = "\u00fc".encode()
    state = struct.pack("<qIII?", STATE.seed, STATE.trial, STATE.step, STATE.stage, STATE.sensed)
    states, weights = STATE.belief
    belief = struct.pack("<II6d", 3, 6, *states.ravel()) + struct.pack("<I2d", 2, *weights)
    assert encode_request(REQUESTS["request"]) == (
        struct.pack("<BI2sqI", RequestKind.CHOOSE_TASK_ACTIONS, len(text), text, -1, 3)
        + state
        + belief
        + struct.pack("<II3d", 4, 3, 1.5, 2.5, -3.5)
    )


class TestBothWays:
    @pytest.mark.parametrize("name", REQUESTS)
    def test_request(self, name: str) -> None:
        data = encode_request(REQUESTS[name])
        assert same(decode_request(data), REQUESTS[name])

    @pytest.mark.parametrize("name", ANSWERS)
    def test_answer(self, name: str) -> None:
        data = encode_answer(ANSWERS[name])
        decoded = decode_answer(data)
        assert same(decoded, ANSWERS[name])
        # Nothing hangs on the bytes that were received.
        assert decoded.entropies.flags.owndata and decoded.entropies.flags.writeable

    @settings(max_examples=300)
    @given(cut=st.integers(0, 300), place=st.integers(0, 300), byte=st.integers(0, 255))
    def test_other_bytes_are_refused(self, cut: int, place: int, byte: int) -> None:
        pairs: list[tuple[bytes, Callable[..., Any]]] = [
            (encode_request(REQUESTS["request"]), decode_request),
            (encode_answer(ANSWERS["answer"]), decode_answer),
        ]
        for data, decode in pairs:
            with pytest.raises(HoldfastError):
                decode(data[: min(cut, len(data) - 1)])
            damaged = bytearray(data)
            damaged[place % len(data)] = byte
            with contextlib.suppress(HoldfastError):
                decode(bytes(damaged))

    @settings(max_examples=300)
    @given(data=st.binary(max_size=400))
    def test_any_bytes_are_refused_or_read(self, data: bytes) -> None:
        for decode in (decode_request, decode_answer):
            with contextlib.suppress(HoldfastError):
                decode(data)


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
    """Return an answer with other fields."""
    name = f"{SERVICE}_Response"
    message: Any = typestore().deserialize_ros1(encode_answer(ANSWERS["answer"]), name)
    for field, value in fields.items():
        setattr(message, field, value)
    return bytes(typestore().serialize_ros1(message, name))


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


@pytest.mark.parametrize(
    ("states", "weights", "said"),
    [(1.0, 2.0, "weights"), (np.nan, 1.0, "finite"), (1.0, None, "state_size 3 need 3")],
)
def test_a_state_is_checked_as_a_checkpoint_is(
    states: float, weights: float | None, said: str
) -> None:
    before = STATE.belief
    changed = before.weights[:1] if weights is None else weights * before.weights
    state = STATE._replace(belief=Belief(states * before.states, changed))
    asked = encode_request(DecisionRequest(RequestKind.CHOOSE_SENSING_ACTION, state=state))
    with pytest.raises(CheckpointError, match=said):
        decode_request(asked)
