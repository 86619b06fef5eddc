"""What must hold of any bytes that reach a decoder; for Hypothesis and for coverage alike.

Each target takes bytes, decodes them, and asserts that they were either refused with the error
that the decoder documents, or are a message within its bounds which survives another journey.
Anything else, another exception above all, is a finding.
"""

import functools
from collections.abc import Callable, Mapping

import msgspec
import numpy as np
from tests.fuzz import corpus
from tests.wire import MAGIC, frame_of, hello_of

from holdfast.config import yaml_document
from holdfast.errors import (
    CheckpointError,
    ConfigurationError,
    FrameError,
    InvalidValueError,
    MessageError,
)
from holdfast.journal import journal_file
from holdfast.journal.journal_reader import decode_records
from holdfast.planning.inputs import MAX_INPUTS
from holdfast.planning.planner import Planner, decode_checkpoint, digest, encode_checkpoint
from holdfast.problems.problem import Problem
from holdfast.protocol.messages import (
    MAX_TASK_ACTIONS,
    PROTOCOL_VERSION,
    decode_reply,
    decode_request,
    encode,
    with_checksum,
)
from holdfast.transport.frames import WIRE_VERSION, decode_hello

_HELLO_BEGINS = len(MAGIC) + len(frame_of(0))
_LIST_OF_ONE = b"\x91"

_CODES = ("malformed", "version", "too_large", "other_code")


def check_request(data: bytes) -> None:
    """Check ``decode_request``, of what stands before the checksum."""
    if not data:
        return
    try:
        decoded = decode_request(with_checksum(data))
    except MessageError as error:
        assert error.code in _CODES
        assert len(str(error)) < 2000
        return
    assert decoded.version == PROTOCOL_VERSION
    assert len(decoded.session) == 16
    assert len(decoded.inputs) <= MAX_INPUTS
    assert not (decoded.inputs and decoded.checkpoint is not None)
    again = encode(decoded)
    assert encode(decode_request(again)) == again


def check_reply(data: bytes) -> None:
    """Check ``decode_reply``, of what stands before the checksum."""
    if not data:
        return
    try:
        decoded = decode_reply(with_checksum(data))
    except MessageError as error:
        assert error.code == "malformed"
        assert len(str(error)) < 2000
        return
    assert 0 <= decoded.number < 2**32
    assert getattr(decoded, "count", 1) <= MAX_TASK_ACTIONS
    again = encode(decoded)
    assert encode(decode_reply(again)) == again


def check_record(data: bytes) -> None:
    """Check ``decode_records``, of a list of one."""
    try:
        decoded = decode_records(_LIST_OF_ONE + data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):  # what says: damaged
        return
    again = journal_file.encode(decoded)
    assert journal_file.encode(decode_records(again)) == again


@functools.cache
def _problem() -> Problem:
    return corpus.problem_of(corpus.session_configuration_of())


def check_checkpoint(data: bytes) -> None:
    """Check ``decode_checkpoint``, and ``check_state`` of what it lets through."""
    try:
        state = decode_checkpoint(data)
    except CheckpointError:
        return
    states, weights = state.belief
    assert np.isfinite(states).all()
    assert (weights >= 0.0).all()
    assert abs(float(weights.sum()) - 1.0) < 1e-6
    assert not states.flags.writeable
    assert digest(decode_checkpoint(encode_checkpoint(state))) == digest(state)
    try:
        Planner(_problem(), corpus.PLANNING).check(state)
    except InvalidValueError:
        return
    assert states.shape == (corpus.PLANNING.particle_filter.num_particles, _problem().state_size)


def check_configuration(data: bytes) -> None:
    """Check the reader of configurations: what it takes, it can write and read again."""
    try:
        document = yaml_document.read(data, "fuzzed.yaml")
    except ConfigurationError as error:
        assert "fuzzed.yaml" in str(error)
        assert len(str(error)) < 2000
        return
    written = yaml_document.write(document.data)
    assert yaml_document.read(written.encode(), "written.yaml").data == document.data


def check_hello(data: bytes) -> None:
    """Check ``decode_hello``."""
    try:
        decoded = decode_hello(data)
    except FrameError as error:
        assert len(str(error)) < 2000
        return
    assert decoded.version == WIRE_VERSION
    assert decoded.role in ("robot", "service")
    assert 0 < len(decoded.incarnation) <= 200
    assert decoded.lease_ms > 0.0
    assert decode_hello(msgspec.msgpack.encode(decoded)) == decoded


TARGETS: Mapping[str, Callable[[bytes], None]] = {
    "hello": check_hello,
    "request": check_request,
    "reply": check_reply,
    "record": check_record,
    "checkpoint": check_checkpoint,
    "configuration": check_configuration,
}


def _specimens() -> dict[str, list[bytes]]:
    return {
        "hello": [
            hello_of(*who)[_HELLO_BEGINS:] for who in (("robot",), ("service", "cloud", "a1"))
        ],
        "request": [corpus.content_of(each) for each in corpus.requests()],
        "reply": [corpus.content_of(each) for each in corpus.replies()],
        "record": [journal_file.encode(each) for each in corpus.records()],
        "checkpoint": corpus.checkpoints(),
        "configuration": corpus.configurations(),
    }


SPECIMENS: Mapping[str, list[bytes]] = _specimens()
"""What each target must let through."""
