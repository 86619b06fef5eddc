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

SERVICE = "holdfast_interfaces/srv/ActiveSensing"
MAX_BYTES = 16_000_000
"""Largest message; a state of 100,000 particles in nine coordinates has half of it."""

_BELIEF, _STATE = "holdfast_interfaces/msg/Belief", "holdfast_interfaces/msg/PlanningState"
_REQUEST, _RESPONSE = f"{SERVICE}_Request", f"{SERVICE}_Response"
_NO_STATE = PlanningState(0, 0, 0, 0, False, Belief(np.empty((0, 0)), np.empty(0)))


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

    def definition(name: str, kind: str) -> str:
        place = files("holdfast_ros") / "interfaces" / kind / f"{name.rpartition('/')[2]}.{kind}"
        return place.read_text(encoding="utf-8")

    types: Typesdict = {}
    for name in (_BELIEF, _STATE):
        types |= get_types_from_msg(definition(name, "msg"), name)
    parts = definition(SERVICE, "srv").split("\n---\n")
    for name, text in zip((_REQUEST, _RESPONSE), parts, strict=True):
        # Parsed as a message, so that a name without a package means one of the service's own.
        message = name.replace("/srv/", "/msg/")
        types[name] = get_types_from_msg(text, message)[message]
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    return store


def md5_sum() -> str:
    """Return the MD5 sum by which ROS 1 knows the service."""
    text = _hashed_text(_REQUEST) + _hashed_text(_RESPONSE)
    return hashlib.md5(text.encode(), usedforsecurity=False).hexdigest()


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
    """Return a request as a message; raise InvalidValueError if a field cannot hold its value."""
    fields = request._asdict() | {"state": _state_message(request.state)}
    return _encode(_message(_REQUEST, fields | {"observation": _flat(request.observation)}))


def decode_request(data: bytes | memoryview) -> DecisionRequest:
    """Return the request that a message has; raise HoldfastError if it is invalid."""
    fields = _decode(data, _REQUEST)
    observation = _array(fields["observation"])
    return DecisionRequest(
        **fields | {"state": _state(fields["state"]), "observation": observation}
    )


def encode_answer(answer: DecisionAnswer) -> bytes:
    """Return an answer as a message; raise InvalidValueError if a field cannot hold its value."""
    actions = answer.task_actions
    fields = answer._asdict() | {
        "state": _state_message(answer.state),
        "entropies": _flat(answer.entropies),
        "action_size": actions.shape[1] if len(actions) else 0,
        "task_actions": _flat(actions),
    }
    return _encode(_message(_RESPONSE, fields))


def decode_answer(data: bytes | memoryview) -> DecisionAnswer:
    """Return the answer that a message has; raise HoldfastError if it is invalid."""
    fields = _decode(data, _RESPONSE)
    try:
        error = ErrorCode(fields["error"])
    except ValueError:
        known = ", ".join(f"{code.value} {code.name}" for code in ErrorCode)
        raise InvalidValueError(f"error {fields['error']}: there are {known}") from None
    actions, size = _array(fields["task_actions"]), fields.pop("action_size")
    if actions.size and (not size or actions.size % size):
        raise InvalidValueError(
            f"task_actions has {actions.size} numbers: they must be actions of action_size {size}"
        )
    fields["error"], fields["state"] = error, _state(fields["state"])
    fields["entropies"] = _array(fields["entropies"])
    fields["task_actions"] = actions.reshape(-1, size) if size else np.empty((0, 0))
    return DecisionAnswer(**fields)


def answer_message(service: ActiveSensing, request: bytes) -> bytes:
    """Have a service answer a request, both as messages; every failure is an answer, too."""
    try:
        answer = service.answer(decode_request(request))
    except HoldfastError as error:
        answer = service.refusal(ErrorCode.BAD_REQUEST, str(error))
    try:
        return encode_answer(answer)
    except HoldfastError as error:
        return encode_answer(service.refusal(ErrorCode.PROBLEM_FAILED, str(error)))


def _state_message(state: PlanningState | None) -> Any:
    fields = (_NO_STATE if state is None else state)._asdict()
    states, weights = fields["belief"]
    belief = {"state_size": states.shape[1], "states": _flat(states), "weights": _flat(weights)}
    return _message(_STATE, fields | {"belief": _message(_BELIEF, belief)}, "state.")


def _state(message: Any) -> PlanningState | None:
    """Return the state that a message has, or None if it has no particles.

    A state from outside must pass the checks of a checkpoint, else this raises CheckpointError.
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
    return decode_checkpoint(encode_checkpoint(state))


def _message(name: str, values: dict[str, Any], path: str = "") -> Any:
    """Return a message with these fields' values; errors name a field with ``path`` before it."""
    store = typestore()
    fields = {}
    for field, (_, kind) in store.fielddefs[name][1]:
        fields[field] = values[field]
        if kind[0] in ("uint8", "uint32", "int64"):
            limits = np.iinfo(kind[0])
            fields[field] = int(values[field])
            if not limits.min <= fields[field] <= limits.max:
                raise InvalidValueError(
                    f"{path}{field} {values[field]}: it must be from {limits.min} to {limits.max}"
                )
    return store.types[name](**fields)


def _encode(message: Any) -> bytes:
    try:
        data = bytes(typestore().serialize_ros1(message, message.__msgtype__))
    except UnicodeEncodeError as error:
        raise InvalidValueError(f"{message.__msgtype__}: a text in it is none: {error}") from error
    _require_size(data, message.__msgtype__)
    return data


def _decode(data: bytes | memoryview, name: str) -> dict[str, Any]:
    _require_size(data, name)
    try:
        message = typestore().deserialize_ros1(data, name)
        return {field: getattr(message, field) for field, _ in typestore().fielddefs[name][1]}
    except Exception as error:
        # The generated code checks nothing; invalid bytes raise many kinds of errors.
        raise InvalidValueError(
            f"{len(data)} bytes are no {name}: {type(error).__name__} {error}".rstrip()
        ) from error


def _require_size(data: bytes | memoryview, name: str) -> None:
    if len(data) > MAX_BYTES:
        raise InvalidValueError(f"{name} of {len(data)} bytes: at most {MAX_BYTES} are allowed")


def _flat(array: npt.ArrayLike) -> FloatArray:
    return np.ascontiguousarray(array, dtype=np.float64).ravel()


def _array(array: npt.ArrayLike) -> FloatArray:
    """Return a copy; a message's array is a view of its bytes."""
    return np.array(array, dtype=np.float64)
