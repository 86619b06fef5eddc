"""Every message, record and state: each survives its journey, and what is spoilt is found out."""

import random
import tracemalloc

import pytest
from hypothesis import strategies as st
from tests.fuzz import corpus, strategies
from tests.fuzz.examples import always, examples
from tests.fuzz.mutations import Mutator
from tests.fuzz.targets import SPECIMENS, TARGETS

from holdfast.journal import journal_file
from holdfast.journal.journal_reader import decode_records
from holdfast.planning.inputs import Record
from holdfast.planning.planner import PlanningState, decode_checkpoint, digest, encode_checkpoint
from holdfast.printable import cut, one_line
from holdfast.protocol.messages import Refused, Reply, Request, decode_reply, decode_request, encode

DECODED = sorted(TARGETS)


@examples(quick=40, slow=4_000)
def test_a_request_survives_its_journey(examples: int) -> None:
    def check(request: Request) -> None:
        assert decode_request(encode(request)) == request

    always(examples, check, strategies.requests)


@examples(quick=40, slow=4_000)
def test_a_reply_survives_its_journey(examples: int) -> None:
    def check(reply: Reply) -> None:
        came = decode_reply(encode(reply))
        if isinstance(reply, Refused):
            # Its words are shown, so they come as one printable line.
            reply = Refused(reply.number, cut(one_line(reply.code), 40), one_line(reply.text))
        assert came == reply

    always(examples, check, strategies.replies)


@examples(quick=40, slow=4_000)
def test_a_record_survives_its_journey(examples: int) -> None:
    def check(record: Record) -> None:
        assert decode_records(journal_file.encode([record])) == [record]

    always(examples, check, strategies.records)


@examples(quick=30, slow=3_000)
def test_a_state_survives_its_journey(examples: int) -> None:
    def check(state: PlanningState) -> None:
        data = encode_checkpoint(state)
        decoded = decode_checkpoint(data)
        assert digest(decoded) == digest(state)
        assert encode_checkpoint(decoded) == data

    always(examples, check, strategies.states())


@pytest.mark.parametrize("name", DECODED)
def test_every_specimen_is_let_through(name: str) -> None:
    for specimen in SPECIMENS[name]:
        TARGETS[name](specimen)


@pytest.mark.parametrize("name", DECODED)
@examples(quick=100, slow=8_000)
def test_what_is_spoilt_decodes_or_is_refused(name: str, examples: int) -> None:
    always(examples, TARGETS[name], strategies.spoilt(SPECIMENS[name]))


@pytest.mark.parametrize("encoded", ["request", "reply", "record"])
@examples(quick=30, slow=3_000)
def test_a_message_of_any_content_that_is_spoilt(encoded: str, examples: int) -> None:
    drawn: dict[str, st.SearchStrategy[bytes]] = {
        "request": strategies.requests.map(corpus.content_of),
        "reply": strategies.replies.map(corpus.content_of),
        "record": strategies.records.map(journal_file.encode),
    }

    def check(message: bytes, seed: int) -> None:
        TARGETS[encoded](Mutator(random.Random(seed), [message]).spoilt())

    always(examples, check, drawn[encoded], st.integers(0, 2**32))


@pytest.mark.parametrize("name", DECODED)
def test_to_find_that_out_takes_little_memory(name: str) -> None:
    mutator = Mutator(random.Random(7), SPECIMENS[name])
    for _ in range(20 if name == "configuration" else 300):
        message = mutator.spoilt()
        tracemalloc.start()
        try:
            TARGETS[name](message)
            _, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        # A value of one byte takes about sixty in Python, and YAML's nodes thousands.
        bound = 4000 if name == "configuration" else 64
        assert peak < 200_000 + bound * len(message), message[:100]
