"""Messages between robot and service: one kind of request, a few kinds of reply, in MessagePack.

A robot always asks the same: *this is my state; what do I do until I have sensed again?* The answer
has up to two parts: the task actions up to the next sensing step, which need no new observation and
are known at once, and the sensing action of that step, which takes longer and is computed while the
robot moves. A service that holds the robot's state needs only the observations since; the digest
shows whether both hold the same state, bit for bit. A service without it replies so and is sent the
state, or the observations that lead to it.

Every request may be sent twice, to two services, or late: a decision is a function of the state
that the digest names.

A message ends with a checksum. One bit of it decides what a robot does, and over long distances
about one damaged segment in ten thousand passes TCP's own check (Stone and Partridge, SIGCOMM
2000).
"""

from __future__ import annotations

import hashlib
import zlib
from typing import Annotated, Any, TypeAlias

import msgspec

from holdfast.errors import MessageError
from holdfast.planning.inputs import MAX_INPUTS, CatchUpInput, Moved, Sensed
from holdfast.planning.settings import PlanningSettings
from holdfast.printable import cut, one_line
from holdfast.protocol.plain_data import check_plain_data

PROTOCOL_VERSION = 6
"""Raised when a message changes its form or meaning. All versions have the same checksum."""

CHECKSUM_SIZE = 4
"""Bytes at the end of each message: CRC-32 of those before them, little-endian."""

MAX_TASK_ACTIONS = 64
"""Bound on the task actions of one answer; a robot that senses more rarely asks again."""

MAX_ACTION_SIZE = 4096
"""Bound on the numbers of one task action, and of one observation."""

MAX_WORD = 2**32 - 1
"""Largest integer in a message."""

MAX_CODE, MAX_TEXT = 40, 4000
"""Bounds on the characters of a refusal's code and text."""

MAX_CONFIGURATION_BYTES = 256 * 1024
"""Bound on a session configuration, encoded."""

DIGEST_SIZE = 16
"""Bytes sent of a state's digest: the first of :func:`holdfast.planning.planner.digest`."""

Word = Annotated[int, msgspec.Meta(ge=0, le=MAX_WORD)]
Name = Annotated[str, msgspec.Meta(min_length=1, max_length=200)]
Session = Annotated[bytes, msgspec.Meta(min_length=16, max_length=16)]
Digest = Annotated[bytes, msgspec.Meta(min_length=DIGEST_SIZE, max_length=DIGEST_SIZE)]
# Longer than allowed, so that the refusal can name the size.
PackedConfiguration = Annotated[bytes, msgspec.Meta(max_length=16 * MAX_CONFIGURATION_BYTES)]
Numbers = Annotated[bytes, msgspec.Meta(max_length=8 * MAX_ACTION_SIZE * MAX_TASK_ACTIONS)]


Observation = Annotated[bytes, msgspec.Meta(max_length=8 * MAX_ACTION_SIZE)]


class SessionConfiguration(msgspec.Struct, array_like=True, frozen=True):
    """What a service must know of a robot's run: names and plain data, never code.

    The settings are complete, and their digest is sent with them (:func:`settings_digest`), so a
    service to which they mean something else refuses. Code is named by its digest, so a service
    with other code refuses.
    """

    problem: Name
    # model, state_space_planner: the problem's two sections of the configuration.
    model: dict[str, object]
    state_space_planner: dict[str, object]
    planning: PlanningSettings
    seed: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
    # core_version, problem_digest: of the robot's holdfast, and of the problem's code beyond that
    # (:mod:`holdfast.config.source_digest`).
    core_version: Annotated[str, msgspec.Meta(max_length=200)] = ""
    problem_digest: Annotated[str, msgspec.Meta(max_length=200)] = ""


class _FreeSections(msgspec.Struct, array_like=True, frozen=True):
    """The beginning of a packed session configuration, its free sections still packed."""

    problem: Name
    model: msgspec.Raw
    state_space_planner: msgspec.Raw


class Request(msgspec.Struct, array_like=True, frozen=True):
    """A robot's question: what to do from this state until it has sensed again.

    Encode it with :func:`encode` only: on the wire the session configuration has another form.
    """

    version: int
    session: Session  # random, drawn once per run
    # Raised by each restart of the robot; a service refuses a lower one than it has seen.
    epoch: Word
    # Increases within an epoch, and is unique among epochs. Every reply repeats it.
    number: Word
    # trial, step, sensed, digest: of the state; ``sensed`` says whether the step's observation is
    # part of it.
    trial: Word
    step: Word
    sensed: bool
    digest: Digest
    # Of this trial, in order, since the state that this service acknowledged last; all of them if
    # it acknowledged none. What a service can fold in: what was sensed, and what moves have shown.
    inputs: tuple[CatchUpInput, ...] = ()
    # For a service that may not know the session.
    session_configuration: SessionConfiguration | None = None
    # The state (:func:`holdfast.planning.planner.encode_checkpoint`); then ``inputs`` is empty. A
    # decoded one is a view of the message.
    checkpoint: bytes | memoryview | None = None


class _SentSensed(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True, tag=1):
    """What of a :class:`~holdfast.planning.inputs.Sensed` is on the wire."""

    step: Word
    sensing_action: Word
    observation: Observation


class _SentMoved(msgspec.Struct, array_like=True, frozen=True, forbid_unknown_fields=True, tag=2):
    """What of a :class:`~holdfast.planning.inputs.Moved` is on the wire."""

    step: Word
    motion: Observation
    observation: Observation


_SentInputs = Annotated[tuple[_SentSensed | _SentMoved, ...], msgspec.Meta(max_length=MAX_INPUTS)]


class _SentRequest(Request, array_like=True, frozen=True, forbid_unknown_fields=True):
    """A request on the wire, with the settings' digest as the robot understands them.

    Its session configuration is bytes inside the message, so each field's length precedes the field
    and is checked before any of it is decoded: bytes that are no request are refused at once,
    whatever their size.
    """

    inputs: _SentInputs = ()  # type: ignore[assignment]
    session_configuration: PackedConfiguration | None = None  # type: ignore[assignment]
    # Not copied: that would hold up all other threads, 40 ms for 60 MB.
    checkpoint: memoryview | None = None
    settings: Digest | None = None


class TaskAnswer(msgspec.Struct, array_like=True, frozen=True, tag=1):
    """The task actions from the state on, up to the next sensing step.

    ``actions`` are the executed ones, ``count`` in number, in order, as little-endian float64.
    """

    number: Word
    count: Annotated[int, msgspec.Meta(ge=1, le=MAX_TASK_ACTIONS)]
    actions: Numbers
    computed_us: Word


class SensingAnswer(msgspec.Struct, array_like=True, frozen=True, tag=2):
    """The sensing action of the next sensing step."""

    number: Word
    # The sensing step: the request's own if its state must still sense, else that after the task
    # actions.
    step: Word
    sensing_action: Word
    # Of the state in which it was chosen; the robot follows it only in exactly that state.
    digest: Digest
    computed_us: Word


class Progress(msgspec.Struct, array_like=True, frozen=True, tag=3):
    """A sign of life: the request is in work, or still waits for a worker."""

    number: Word
    waiting: bool


class NeedState(msgspec.Struct, array_like=True, frozen=True, tag=4):
    """The service lacks the state: send the session configuration, and what leads to the state."""

    number: Word
    # Whether the service holds a state of the trial that does not lead to the robot's; then only
    # the checkpoint helps.
    differs: bool
    diverged: bool = False  # whether it reached that step with all observations, but another digest


class Busy(msgspec.Struct, array_like=True, frozen=True, tag=5):
    """The service has too much work: ask another, or again later.

    ``number`` is 0 if the request was turned away unread.
    """

    number: Word
    retry_after_ms: Word


class Refused(msgspec.Struct, array_like=True, frozen=True, tag=6):
    """The request is not answered; ``code`` says whether it may be sent again."""

    number: Word  # 0 if the request could not be read
    # ``damaged`` (in transit: it may be sent again), ``malformed``, ``too_large``, ``version``,
    # ``stale_epoch``, ``unknown_problem``, ``other_code`` (the service's holdfast or problem is not
    # the robot's), ``invalid`` (settings or state out of bounds), ``out_of_memory`` (it may be
    # asked again) or ``failed`` (the problem's own functions failed in this state).
    code: Annotated[str, msgspec.Meta(max_length=MAX_CODE)]
    text: Annotated[str, msgspec.Meta(max_length=MAX_TEXT)]


Reply: TypeAlias = TaskAnswer | SensingAnswer | Progress | NeedState | Busy | Refused

_ENCODER = msgspec.msgpack.Encoder()
_REQUEST_DECODER = msgspec.msgpack.Decoder(_SentRequest)
_FREE_SECTIONS_DECODER = msgspec.msgpack.Decoder(_FreeSections)
_CONFIGURATION_DECODER = msgspec.msgpack.Decoder(SessionConfiguration)
_REPLY_DECODER: msgspec.msgpack.Decoder[Reply] = msgspec.msgpack.Decoder(Reply)

_ARRAY_HEADERS = {0xDC: 3, 0xDD: 5}
"""Sizes in bytes of the longer array headers of MessagePack, by their first byte."""

_WORDS = {0xCC: 1, 0xCD: 2, 0xCE: 4}
"""Sizes in bytes of the longer unsigned integers of MessagePack, by their first byte."""


def encode(message: Request | Reply) -> bytes:
    """Encode a message."""
    if isinstance(message, Request) and message.inputs:
        sent: Any = tuple(map(_sent, message.inputs))
        message = msgspec.structs.replace(message, inputs=sent)
    if isinstance(message, Request) and message.session_configuration is not None:
        # Without a session configuration the shorter form is read as the same request.
        packed = pack_configuration(message.session_configuration)
        # What a service will make of them, not what they were before: an int where a float belongs.
        settings = settings_digest(unpack_configuration(packed))
        fields = msgspec.structs.asdict(message) | {"session_configuration": packed}
        message = _SentRequest(**fields, settings=settings)
    return with_checksum(_ENCODER.encode(message))


def pack_configuration(session_configuration: SessionConfiguration) -> bytes:
    """Encode a session configuration: decoded it takes twenty times the memory."""
    return _ENCODER.encode(session_configuration)


def settings_digest(session_configuration: SessionConfiguration) -> bytes:
    """Return the digest of what decides: the problem, its settings, the planning's and the seed."""
    decide = (
        session_configuration.problem,
        session_configuration.model,
        session_configuration.state_space_planner,
        session_configuration.planning,
        session_configuration.seed,
    )
    return hashlib.blake2b(_ENCODER.encode(decide), digest_size=DIGEST_SIZE).digest()


def unpack_configuration(packed: bytes) -> SessionConfiguration:
    """Decode a session configuration that was packed here, after it was checked."""
    return _CONFIGURATION_DECODER.decode(packed)


def with_checksum(content: bytes) -> bytes:
    """Append the checksum."""
    return content + zlib.crc32(content).to_bytes(CHECKSUM_SIZE, "little")


def _checked_content(payload: bytes) -> memoryview:
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

    Raises MessageError: ``damaged``: the checksum is wrong. ``malformed``: not a request, or its
    session configuration has free sections that :func:`check_plain_data` refuses.
    ``out_of_memory``: it may be sent again. ``version``: another protocol version. ``too_large``:
    the session configuration has more than :data:`MAX_CONFIGURATION_BYTES`, or too many values.
    ``other_code``: its settings mean something else here than on the robot.
    """
    content = _checked_content(payload)
    # Other versions may have other fields. A decoder would look at all of a large message first.
    version = _version_of(content)
    if version is not None and version != PROTOCOL_VERSION:
        raise _other_version(version)
    try:
        sent = _REQUEST_DECODER.decode(content)
        session_configuration = (
            None
            if sent.session_configuration is None
            else _session_configuration_of(sent.session_configuration, sent.settings)
        )
    except MessageError:
        raise
    except MemoryError:
        text = f"out of memory for a request of {len(payload)} bytes"
        raise MessageError("out_of_memory", text) from None
    except Exception as error:
        # Decoding has raised RecursionError, UnicodeDecodeError and ValueError, too.
        raise MessageError("malformed", f"{len(payload)} bytes are no request: {error}") from error
    if sent.version != PROTOCOL_VERSION:
        raise _other_version(sent.version)
    if sent.checkpoint is not None and sent.inputs:
        raise MessageError("malformed", "a request has a checkpoint and inputs as well")
    return Request(
        version=sent.version,
        session=sent.session,
        epoch=sent.epoch,
        number=sent.number,
        trial=sent.trial,
        step=sent.step,
        sensed=sent.sensed,
        digest=sent.digest,
        inputs=tuple(map(_received, sent.inputs)),
        session_configuration=session_configuration,
        checkpoint=sent.checkpoint,
    )


def _sent(given: CatchUpInput) -> _SentSensed | _SentMoved:
    if isinstance(given, Sensed):
        return _SentSensed(given.step, given.sensing_action, given.observation)
    return _SentMoved(given.step, given.motion, given.observation)


def _received(sent: Any) -> CatchUpInput:
    if isinstance(sent, _SentSensed):
        return Sensed(sent.step, sent.sensing_action, sent.observation)
    return Moved(sent.step, None, sent.motion, sent.observation)


def decode_reply(payload: bytes) -> Reply:
    """Decode a reply; raise MessageError if it was changed in transit, or is no reply."""
    content = _checked_content(payload)
    try:
        reply = _REPLY_DECODER.decode(content)
    except Exception as error:
        raise MessageError("malformed", f"{len(payload)} bytes are no reply: {error}") from error
    if isinstance(reply, Refused):
        # A peer's words go into logs and messages, where a line of theirs would look like ours.
        code, text = cut(one_line(reply.code), MAX_CODE), cut(one_line(reply.text), MAX_TEXT)
        return Refused(reply.number, code, text)
    return reply


def _other_version(version: int) -> MessageError:
    return MessageError(
        "version", f"protocol version {version}: this holdfast speaks version {PROTOCOL_VERSION}"
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


def _session_configuration_of(data: bytes, settings: bytes | None) -> SessionConfiguration:
    if len(data) > MAX_CONFIGURATION_BYTES:
        raise MessageError(
            "too_large",
            f"{len(data)} bytes of problem and settings, the sections model and "
            f"state_space_planner among them: at most {MAX_CONFIGURATION_BYTES} are allowed",
        )
    free = _FREE_SECTIONS_DECODER.decode(data)
    # What has passed can be encoded again, at any depth of the caller's stack.
    check_plain_data(
        (bytes(free.model), bytes(free.state_space_planner)),
        f"problem {free.problem}: sections model and state_space_planner",
    )
    session_configuration = _CONFIGURATION_DECODER.decode(data)
    understood = settings_digest(session_configuration)
    if settings != understood:
        raise MessageError(
            "other_code",
            f"problem {session_configuration.problem}: the digest of the settings is "
            f"{understood.hex()} as this service understands them, "
            f"{settings.hex() if settings else 'not told'} on the robot; "
            "they may decide differently, so deploy the same version on both",
        )
    return session_configuration
