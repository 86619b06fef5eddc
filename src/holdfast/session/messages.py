"""What crosses the wire: one kind of request, a few kinds of reply, MessagePack, a version.

A robot asks one question, always the same: *this is my state; what do I do until I have sensed
again?* The answer comes in up to two parts: the task actions up to the next sensing step, which
need no new observation and so are known at once, and the sensing action of that step, which takes
longer and is computed while the robot moves. A service that holds the robot's state needs only what
the robot has sensed since; the digest shows whether both mean the same state, bit for bit. One that
does not says so, and is handed the state.

Every request can be sent twice, to two services, or late: a decision is a function of the state
that the digest names.

A message ends with a checksum of the rest. One bit of it decides what a robot does, and on a long
way one segment in some ten thousand that are damaged passes TCP's own check (Stone and Partridge,
SIGCOMM 2000).
"""

from __future__ import annotations

import hashlib
import zlib
from typing import Annotated, TypeAlias

import msgspec
import numpy as np
import numpy.typing as npt

from holdfast import numerics
from holdfast.errors import HoldfastError
from holdfast.settings import PlanningSettings

__all__ = [
    "CHECKSUM_SIZE",
    "DIGEST_SIZE",
    "MAX_OBSERVATIONS",
    "MAX_OPENING_BYTES",
    "MAX_OPENING_VALUES",
    "MAX_TASK_ACTIONS",
    "PROTOCOL_VERSION",
    "Busy",
    "MessageError",
    "NeedState",
    "Observed",
    "Opening",
    "Progress",
    "Refused",
    "Reply",
    "Request",
    "SensingAnswer",
    "TaskAnswer",
    "decode_reply",
    "decode_request",
    "encode",
    "numbers_from",
    "numbers_to",
    "pack_opening",
    "sealed",
    "settings_digest",
    "unpack_opening",
]

FloatArray = npt.NDArray[np.float64]

PROTOCOL_VERSION = 4
"""Raised whenever a message changes its form or its meaning; its checksum is the same in all."""

CHECKSUM_SIZE = 4
"""Bytes at the end of each message: CRC-32 of those before them, little-endian."""

MAX_TASK_ACTIONS = 64
"""Bound on the task actions of one answer; a robot that senses more rarely asks again."""

MAX_OBSERVATIONS = 64
"""Bound on the observations of one request; a service further behind is handed the state."""

MAX_OPENING_BYTES = 256 * 1024
"""Bound on an opening as it is sent."""

MAX_OPENING_VALUES = 10_000
"""Bound on the values in an opening: the smallest fill one byte each as they are sent, and sixty in
memory."""

DIGEST_SIZE = 16
"""Bytes of a state's digest that are sent: the first ones of :func:`holdfast.planning.digest`."""

Word = Annotated[int, msgspec.Meta(ge=0, le=2**32 - 1)]
Name = Annotated[str, msgspec.Meta(min_length=1, max_length=200)]
Session = Annotated[bytes, msgspec.Meta(min_length=16, max_length=16)]
Digest = Annotated[bytes, msgspec.Meta(min_length=DIGEST_SIZE, max_length=DIGEST_SIZE)]
Numbers = Annotated[bytes, msgspec.Meta(max_length=8 * 4096 * MAX_TASK_ACTIONS)]


class MessageError(HoldfastError):
    """Bytes that are no message, or one that is out of bounds.

    Attributes
    ----------
    code : str
        As in :class:`Refused`.
    """

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code

    def retold(self) -> MessageError:
        """Return the same error without the story of how it was raised.

        To be kept beyond where it was caught: its story holds that place with all that is known
        there, the message and the error itself among it, until the collector comes by.
        """
        return MessageError(self.code, str(self))


class Observed(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True):
    """An observation that the robot has folded into its belief.

    Attributes
    ----------
    step : int
        When; it belongs to the state of that step, before its task action.
    sensing_action : int
    observation : bytes
        Little-endian float64.
    """

    step: Word
    sensing_action: Word
    observation: Annotated[bytes, msgspec.Meta(max_length=8 * 4096)]


class Opening(msgspec.Struct, array_like=True, frozen=True):
    """What a service must know of a robot's run to plan for it: names and plain data, never code.

    The settings are complete, with all defaults filled in, and on the wire their digest goes with
    them (:func:`settings_digest`), so that a service that understands them otherwise refuses. Code
    is only named, by its digest, so that a service with other code refuses instead of deciding
    otherwise.

    Attributes
    ----------
    problem : str
        Registered name of the problem.
    model, state_space_planner : dict
        The problem's two sections of the configuration.
    planning : PlanningSettings
    seed : int
    core_version : str
        Of the robot's holdfast (:func:`holdfast.source_digest.core_version`).
    problem_digest : str
        Of the code of the problem beyond that (:func:`holdfast.source_digest.problem_digest`).
    """

    problem: Name
    model: dict[str, object]
    state_space_planner: dict[str, object]
    planning: PlanningSettings
    seed: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
    core_version: Annotated[str, msgspec.Meta(max_length=200)] = ""
    problem_digest: Annotated[str, msgspec.Meta(max_length=200)] = ""


class Request(msgspec.Struct, array_like=True, frozen=True):
    """A robot's question: what to do from this state on, until it has sensed again.

    It is to be encoded with :func:`encode` alone, for on the wire its opening has another form.

    Attributes
    ----------
    version : int
        :data:`PROTOCOL_VERSION`.
    session : bytes
        16 random bytes, drawn once for a run.
    epoch : int
        Raised by each restart of the robot; a service refuses one lower than it has seen.
    number : int
        Of this request: higher than those before it in this epoch, and unlike all of other epochs.
        Every reply repeats it.
    trial, step : int
        Of the state.
    sensed : bool
        Whether the step's observation is part of the state.
    digest : bytes
        Of the state.
    observations : tuple of Observed
        What was sensed in this trial since the state that this service acknowledged last, in
        order; all of it if ``checkpoint`` is None and it acknowledged nothing of this trial.
    opening : Opening or None
        Sent to a service that may not know the session.
    checkpoint : bytes, memoryview or None
        The state itself (:func:`holdfast.planning.encode_checkpoint`); then ``observations`` is
        empty. One that was decoded is a view of the message.
    """

    version: int
    session: Session
    epoch: Word
    number: Word
    trial: Word
    step: Word
    sensed: bool
    digest: Digest
    observations: Annotated[tuple[Observed, ...], msgspec.Meta(max_length=MAX_OBSERVATIONS)] = ()
    opening: Opening | None = None
    checkpoint: bytes | memoryview | None = None


class _SentRequest(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True):
    """A request on the wire.

    Its opening is bytes inside the message. So the length of every field comes before the field,
    and is checked before anything of it is read: what is no request is found out at once, however
    large it is.
    """

    version: int
    session: Session
    epoch: Word
    number: Word
    trial: Word
    step: Word
    sensed: bool
    digest: Digest
    observations: Annotated[tuple[Observed, ...], msgspec.Meta(max_length=MAX_OBSERVATIONS)] = ()
    # So much is read of one that is too large, so that the robot can be told that.
    opening: Annotated[bytes, msgspec.Meta(max_length=16 * MAX_OPENING_BYTES)] | None = None
    # Not copied: that would hold up all other threads, 40 ms for 60 MB.
    checkpoint: memoryview | None = None
    # Of the opening's, as the robot understands them.
    settings: Digest | None = None


class TaskAnswer(msgspec.Struct, array_like=True, frozen=True, tag=1):
    """The task actions from the state on, up to the next sensing step.

    Attributes
    ----------
    number : int
        Of the request.
    count : int
        Task actions, for the request's step and those that follow.
    actions : bytes
        Executed actions one after another, little-endian float64.
    computed_us : int
        How long the service computed on it.
    """

    number: Word
    count: Annotated[int, msgspec.Meta(ge=1, le=MAX_TASK_ACTIONS)]
    actions: Numbers
    computed_us: Word


class SensingAnswer(msgspec.Struct, array_like=True, frozen=True, tag=2):
    """The sensing action of the next sensing step.

    Attributes
    ----------
    number : int
        Of the request.
    step : int
        The sensing step: the request's own if its state still has to sense, else the one after the
        task actions.
    sensing_action : int
    digest : bytes
        Of the state in which it was chosen; only in exactly that state the robot follows it.
    computed_us : int
        How long the service computed on it.
    """

    number: Word
    step: Word
    sensing_action: Word
    digest: Digest
    computed_us: Word


class Progress(msgspec.Struct, array_like=True, frozen=True, tag=3):
    """The request is in work: a sign of life from the service's process.

    Attributes
    ----------
    number : int
        Of the request.
    waiting : bool
        Whether it still waits for its turn.
    """

    number: Word
    waiting: bool


class NeedState(msgspec.Struct, array_like=True, frozen=True, tag=4):
    """The service does not have the state: send the opening and the checkpoint.

    Attributes
    ----------
    number : int
        Of the request.
    differs : bool
        True if the service holds a state of the trial from which it does not come to the robot's:
        only the state will do.
    diverged : bool
        True if it came to a state of that step with all that was sensed, but with another digest.
    """

    number: Word
    differs: bool
    diverged: bool = False


class Busy(msgspec.Struct, array_like=True, frozen=True, tag=5):
    """The service has more work than it may take: ask another, or again later.

    Attributes
    ----------
    number : int
        Of the request; 0 if it was turned away unread.
    retry_after_ms : int
    """

    number: Word
    retry_after_ms: Word


class Refused(msgspec.Struct, array_like=True, frozen=True, tag=6):
    """The request can never be answered as it is.

    Attributes
    ----------
    number : int
        Of the request; 0 if that could not be read.
    code : str
        ``damaged`` (on its way: it may be sent again), ``malformed``, ``too_large``, ``version``,
        ``stale_epoch``, ``unknown_problem``, ``other_code`` (the service's holdfast or problem
        is not the robot's), ``invalid`` (settings or state out of bounds),
        ``out_of_memory`` (it may be asked again) or ``failed`` (the problem's own functions failed
        in this state).
    text : str
        For a person.
    """

    number: Word
    code: Annotated[str, msgspec.Meta(max_length=40)]
    text: Annotated[str, msgspec.Meta(max_length=4000)]


Reply: TypeAlias = TaskAnswer | SensingAnswer | Progress | NeedState | Busy | Refused

_ENCODER = msgspec.msgpack.Encoder()
_REQUEST_DECODER = msgspec.msgpack.Decoder(_SentRequest)
_OPENING_DECODER = msgspec.msgpack.Decoder(Opening)
_REPLY_DECODER: msgspec.msgpack.Decoder[Reply] = msgspec.msgpack.Decoder(Reply)

_CONTAINERS = (dict, list, tuple)
_ARRAY_HEADERS = {0xDC: 3, 0xDD: 5}
_WORDS = {0xCC: 1, 0xCD: 2, 0xCE: 4}
"""Of MessagePack: sizes of the longer headers of an array, and of the longer words."""


def encode(message: Request | Reply) -> bytes:
    """Encode a message."""
    if isinstance(message, Request) and message.opening is not None:
        # Without an opening both forms are the same bytes.
        return sealed(_ENCODER.encode(_sent(message, pack_opening(message.opening))))
    return sealed(_ENCODER.encode(message))


def pack_opening(opening: Opening) -> bytes:
    """Return an opening as it is sent: in memory it takes twenty times as much."""
    return _ENCODER.encode(opening)


def settings_digest(opening: Opening) -> bytes:
    """Return the digest of the settings that decide: the problem's, the planning's and the seed."""
    decide = (
        opening.problem,
        opening.model,
        opening.state_space_planner,
        opening.planning,
        opening.seed,
    )
    return hashlib.blake2b(_ENCODER.encode(decide), digest_size=DIGEST_SIZE).digest()


def unpack_opening(packed: bytes) -> Opening:
    """Return an opening that was packed here, and checked before."""
    return _OPENING_DECODER.decode(packed)


def sealed(content: bytes) -> bytes:
    """Return bytes with their checksum behind them, as they are sent."""
    return content + zlib.crc32(content).to_bytes(CHECKSUM_SIZE, "little")


def _unsealed(payload: bytes) -> memoryview:
    """Return what a message contains, without a copy of it."""
    content = memoryview(payload)[:-CHECKSUM_SIZE]
    if zlib.crc32(content) != int.from_bytes(payload[-CHECKSUM_SIZE:], "little") or not content:
        raise MessageError(
            "damaged", f"{len(payload)} bytes do not have the checksum that they end with"
        )
    return content


def decode_request(payload: bytes) -> Request:
    """Decode a request and check all of it that can be checked by itself.

    A large message that is no request takes no more memory than a small one, and no more time than
    to look at each of its bytes once.

    Raises
    ------
    MessageError
        If the bytes were changed on their way (``damaged``), are no request (``malformed``), one of
        another version (``version``), one whose opening has more than :data:`MAX_OPENING_BYTES` or
        :data:`MAX_OPENING_VALUES` (``too_large``), or one whose settings are understood otherwise
        here than on the robot (``other_code``).
    """
    content = _unsealed(payload)
    # Other versions may have other fields.
    version = _version_of(content)
    if version is not None and version != PROTOCOL_VERSION:
        raise _other_version(version)
    try:
        sent = _REQUEST_DECODER.decode(content)
        opening = None if sent.opening is None else _opening_of(sent.opening, sent.settings)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise MessageError("malformed", f"{len(payload)} bytes are no request: {error}") from error
    if sent.version != PROTOCOL_VERSION:
        raise _other_version(sent.version)
    if sent.checkpoint is not None and sent.observations:
        raise MessageError("malformed", "a request has a checkpoint and observations as well")
    return Request(
        sent.version,
        sent.session,
        sent.epoch,
        sent.number,
        sent.trial,
        sent.step,
        sent.sensed,
        sent.digest,
        sent.observations,
        opening,
        sent.checkpoint,
    )


def decode_reply(payload: bytes) -> Reply:
    """Decode a reply.

    Raises
    ------
    MessageError
        If the bytes were changed on their way, or are no reply.
    """
    content = _unsealed(payload)
    try:
        return _REPLY_DECODER.decode(content)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise MessageError("malformed", f"{len(payload)} bytes are no reply: {error}") from error


def numbers_to(array: npt.ArrayLike) -> bytes:
    """Encode numbers as little-endian float64."""
    return np.ascontiguousarray(array, dtype="<f8").tobytes()


def numbers_from(data: bytes, size: int) -> FloatArray:
    """Decode ``size`` numbers.

    Raises
    ------
    MessageError
        If there is another number of them, or one is not finite.
    """
    if len(data) != 8 * size:
        raise MessageError("malformed", f"{len(data)} bytes are not {size} numbers")
    numbers = np.frombuffer(data, dtype="<f8").astype(np.float64)
    if not numerics.all_finite(numbers):
        raise MessageError("malformed", f"{numbers} are not all finite")
    return numbers


def _sent(request: Request, opening: bytes) -> _SentRequest:
    return _SentRequest(
        request.version,
        request.session,
        request.epoch,
        request.number,
        request.trial,
        request.step,
        request.sensed,
        request.digest,
        request.observations,
        opening,
        None if request.checkpoint is None else memoryview(request.checkpoint),
        # What a service will make of them, not what they were before: an int where a float belongs.
        settings_digest(unpack_opening(opening)),
    )


def _version_of(content: memoryview) -> int | None:
    """Return the version of what looks like a request of ours, from its first bytes alone."""
    first = content[0]
    start = 1 if first & 0xF0 == 0x90 else _ARRAY_HEADERS.get(first)
    if start is None or len(content) <= start:
        return None
    word = content[start]
    if word < 0x80:
        return word
    size = _WORDS.get(word)
    if size is None or len(content) <= start + size:
        return None
    return int.from_bytes(content[start + 1 : start + 1 + size], "big")


def _opening_of(data: bytes, settings: bytes | None) -> Opening:
    if len(data) > MAX_OPENING_BYTES:
        raise MessageError(
            "too_large",
            f"{len(data)} bytes of problem and settings, the sections model and "
            f"state_space_planner among them: at most {MAX_OPENING_BYTES} are allowed",
        )
    opening = _OPENING_DECODER.decode(data)
    if _count_values(opening) > MAX_OPENING_VALUES:
        raise MessageError(
            "too_large",
            f"problem {opening.problem}: more than {MAX_OPENING_VALUES} values in the sections "
            f"model and state_space_planner",
        )
    understood = settings_digest(opening)
    if settings != understood:
        raise MessageError(
            "other_code",
            f"problem {opening.problem}: the digest of the settings is {understood.hex()} as this "
            f"service understands them, {settings.hex() if settings else 'not told'} on the robot; "
            "they may decide differently, so deploy the same version on both",
        )
    return opening


def _count_values(opening: Opening) -> int:
    """Count the values in the problem's sections, however they are nested.

    Parameters
    ----------
    opening : Opening

    Returns
    -------
    int
        Of one that has more than :data:`MAX_OPENING_VALUES`, some number above that.
    """
    containers: list[object] = [opening.model, opening.state_space_planner]
    count = 0
    while containers:
        container = containers.pop()
        assert isinstance(container, _CONTAINERS)
        count += len(container) * (2 if isinstance(container, dict) else 1)
        if count > MAX_OPENING_VALUES:
            break
        parts = (*container, *container.values()) if isinstance(container, dict) else container
        containers += [part for part in parts if isinstance(part, _CONTAINERS)]
    return count


def _other_version(version: int) -> MessageError:
    return MessageError(
        "version", f"protocol version {version}: this holdfast speaks version {PROTOCOL_VERSION}"
    )
