"""The typed service as messages of ROS 1.

ROS 1 identifies a type by the MD5 sum of its definition, and two ends with different sums do not
connect. So the definitions are in one place, the package ``holdfast_interfaces``, which catkin
reads, too. Serialisation and sum are made from them, by rosbags.
"""

from __future__ import annotations

import functools
import hashlib
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from holdfast.errors import CheckpointError, HoldfastError, InvalidValueError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.belief import Belief
from holdfast.planning.planner import PlanningState, decode_checkpoint, encode_checkpoint
from holdfast_ros.active_sensing import DecisionAnswer, DecisionRequest, ErrorCode

if TYPE_CHECKING:
    from rosbags.interfaces.typing import Typesdict
    from rosbags.typesys.store import Typestore

    from holdfast_ros.active_sensing import ActiveSensing

__all__ = [
    "MAX_BYTES",
    "SERVICE",
    "answer_message",
    "decode_answer",
    "decode_request",
    "encode_answer",
    "encode_request",
    "md5_sum",
    "typestore",
]

SERVICE = "holdfast_interfaces/srv/ActiveSensing"
"""The service's type."""

MAX_BYTES = 16_000_000
"""Largest message; a state of 100,000 particles in nine coordinates has half of it."""

_PACKAGE = "holdfast_interfaces"
_MESSAGES = ("Belief", "PlanningState")


@functools.cache
def typestore() -> Typestore:
    """Return rosbags' store of the types that the service is made of.

    Raises InvalidValueError if rosbags is not installed.
    """
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise InvalidValueError(
            f"ROS messages need rosbags: pip install rosbags ({error})"
        ) from error
    folder = files("holdfast_ros") / "interfaces"
    types: Typesdict = {}
    for name in _MESSAGES:
        text = (folder / "msg" / f"{name}.msg").read_text(encoding="utf-8")
        types |= get_types_from_msg(text, f"{_PACKAGE}/msg/{name}")
    name = SERVICE.rpartition("/")[2]
    text = (folder / "srv" / f"{name}.srv").read_text(encoding="utf-8")
    for part, definition in zip(("Request", "Response"), text.split("\n---\n"), strict=True):
        # Parsed as a message, so that a name without a package means one of the service's own.
        message = f"{_PACKAGE}/msg/{name}_{part}"
        types[f"{SERVICE}_{part}"] = get_types_from_msg(definition, message)[message]
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    return store


def md5_sum() -> str:
    """Return the MD5 sum by which ROS 1 knows the service."""
    texts = (_hashed_text(f"{SERVICE}_{part}") for part in ("Request", "Response"))
    return hashlib.md5("".join(texts).encode(), usedforsecurity=False).hexdigest()


def _hashed_text(name: str) -> str:
    """Return what the MD5 sum is made of: the definition, with sums in place of messages' names."""
    parts: dict[str, tuple[str, str]] = {}
    text, _ = typestore().gendefhash(name, parts)
    sums = {part.replace("/msg/", "/"): md5 for part, (_, md5) in parts.items()}
    lines = []
    for line in text.splitlines():
        kind, _, field = line.partition(" ")
        nested = sums.get(kind.partition("[")[0])
        lines.append(line if nested is None else f"{nested} {field}")
    return "\n".join(lines)


def encode_request(request: DecisionRequest) -> bytes:
    """Return a request as a message.

    Raises InvalidValueError if a number does not fit into its field, or the text is none.
    """
    types = typestore().types
    message = types[f"{SERVICE}_Request"](
        kind=_whole("kind", request.kind, 0, 8),
        configuration=request.configuration,
        seed=_whole("seed", request.seed, 63, 63),
        trial=_whole("trial", request.trial, 0, 32),
        state=_state_message(request.state),
        sensing_action=_whole("sensing_action", request.sensing_action, 0, 32),
        observation=_flat(request.observation),
    )
    return _encode(message, "Request")


def decode_request(data: bytes | memoryview) -> DecisionRequest:
    """Return the request that a message has.

    Raises InvalidValueError if it is no message of this type. Raises CheckpointError if its state
    is none.
    """
    message = _decode(data, "Request")
    return DecisionRequest(
        kind=message.kind,
        configuration=message.configuration,
        seed=message.seed,
        trial=message.trial,
        state=_state(message.state),
        sensing_action=message.sensing_action,
        observation=_array(message.observation),
    )


def encode_answer(answer: DecisionAnswer) -> bytes:
    """Return an answer as a message.

    Raises InvalidValueError if a number does not fit into its field, or a text is none.
    """
    types = typestore().types
    actions = answer.task_actions
    message = types[f"{SERVICE}_Response"](
        error=_whole("error", answer.error, 0, 8),
        message=answer.message,
        configuration=answer.configuration,
        state=_state_message(answer.state),
        sensing_action=_whole("sensing_action", answer.sensing_action, 0, 32),
        entropies=_flat(answer.entropies),
        action_size=actions.shape[1] if len(actions) else 0,
        task_actions=_flat(actions),
    )
    return _encode(message, "Response")


def decode_answer(data: bytes | memoryview) -> DecisionAnswer:
    """Return the answer that a message has.

    Raises InvalidValueError if it is no message of this type, or its fields contradict each other.
    Raises CheckpointError if its state is none.
    """
    message = _decode(data, "Response")
    try:
        error = ErrorCode(message.error)
    except ValueError:
        known = ", ".join(f"{code.value} {code.name}" for code in ErrorCode)
        raise InvalidValueError(f"error {message.error}: there are {known}") from None
    actions = _array(message.task_actions)
    size = message.action_size
    if actions.size and (not size or actions.size % size):
        raise InvalidValueError(
            f"task_actions has {actions.size} numbers: they must be actions of action_size {size}"
        )
    return DecisionAnswer(
        error=error,
        message=message.message,
        configuration=message.configuration,
        state=_state(message.state),
        sensing_action=message.sensing_action,
        entropies=_array(message.entropies),
        task_actions=actions.reshape(-1, size) if actions.size else np.empty((0, size)),
    )


def answer_message(service: ActiveSensing, request: bytes) -> bytes:
    """Have a service answer a request, both as messages; every failure is an answer, too."""
    try:
        decoded = decode_request(request)
    except HoldfastError as error:
        answer = service.refusal(ErrorCode.BAD_REQUEST, str(error))
    else:
        answer = service.answer(decoded)
    try:
        return encode_answer(answer)
    except HoldfastError as error:
        return encode_answer(service.refusal(ErrorCode.PROBLEM_FAILED, str(error)))


def _state_message(state: PlanningState | None) -> Any:
    types = typestore().types
    none = PlanningState(0, 0, 0, 0, False, Belief(np.empty((0, 0)), np.empty(0)))
    seed, trial, step, stage, sensed, (states, weights) = none if state is None else state
    return types[f"{_PACKAGE}/msg/PlanningState"](
        seed=_whole("state.seed", seed, 63, 63),
        trial=_whole("state.trial", trial, 0, 32),
        step=_whole("state.step", step, 0, 32),
        stage=_whole("state.stage", stage, 0, 32),
        sensed=bool(sensed),
        belief=types[f"{_PACKAGE}/msg/Belief"](
            state_size=states.shape[1], states=_flat(states), weights=_flat(weights)
        ),
    )


def _state(message: Any) -> PlanningState | None:
    """Return the state that a message has, or None if it has no particles.

    Raises CheckpointError if this is no state: numbers that are missing or not finite, weights that
    are negative or do not sum to 1, a negative seed.
    """
    belief = message.belief
    states, weights, size = _array(belief.states), _array(belief.weights), belief.state_size
    if not weights.size and not states.size:
        return None
    if states.size != weights.size * size:
        raise CheckpointError(
            f"state.belief.states has {states.size} numbers: {weights.size} weights and "
            f"state_size {size} need {weights.size * size}"
        )
    head = message.seed, message.trial, message.step, message.stage, bool(message.sensed)
    state = PlanningState(*head, Belief(states.reshape(weights.size, size), weights))
    # A state from outside must pass the checks of a checkpoint.
    return decode_checkpoint(encode_checkpoint(state))


def _encode(message: Any, part: str) -> bytes:
    try:
        data = bytes(typestore().serialize_ros1(message, f"{SERVICE}_{part}"))
    except UnicodeEncodeError as error:
        raise InvalidValueError(f"{part}: a text in it is none: {error}") from error
    if len(data) > MAX_BYTES:
        raise InvalidValueError(f"{part} of {len(data)} bytes: at most {MAX_BYTES} are allowed")
    return data


def _decode(data: bytes | memoryview, part: str) -> Any:
    if len(data) > MAX_BYTES:
        raise InvalidValueError(f"{part} of {len(data)} bytes: at most {MAX_BYTES} are allowed")
    try:
        return typestore().deserialize_ros1(data, f"{SERVICE}_{part}")
    except HoldfastError:
        raise
    except Exception as error:
        # The generated code checks nothing; invalid bytes raise many kinds of errors.
        raise InvalidValueError(
            f"{len(data)} bytes are no {SERVICE}_{part}: {type(error).__name__} {error}".rstrip()
        ) from error


def _whole(name: str, value: int, negative_bits: int, bits: int) -> int:
    """Return a whole number that fits into a field of so many bits below and above zero."""
    least, most = -(2**negative_bits) if negative_bits else 0, 2**bits - 1
    if not least <= value <= most:
        raise InvalidValueError(f"{name} {value}: it must be from {least} to {most}")
    return int(value)


def _flat(array: npt.ArrayLike) -> FloatArray:
    return np.ascontiguousarray(array, dtype=np.float64).ravel()


def _array(array: npt.ArrayLike) -> FloatArray:
    """Return a copy; a message's array is a view of its bytes."""
    return np.array(array, dtype=np.float64)
