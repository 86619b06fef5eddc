"""A damaged journal, however it was damaged: what is read of it was written, or it is refused.

Damage is drawn at three levels: bits and bytes, whole pages (swapped, doubled, emptied, cut off),
and entries whose checksums are right (left out, exchanged, of other types). What is found must be
exactly what was written, a part of it from its beginning on, or an error that names the file.
"""

import contextlib
import os
import random
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import strategies as st
from tests.fuzz.examples import always, examples
from tests.unit.test_journal import TRIAL, all_records, records_of, result_of

from holdfast.errors import InvalidValueError, OutputError
from holdfast.journal.journal import Journal
from holdfast.journal.journal_file import START, JournalFile

STEPS = 6
META = {"configuration": "x" * 100}
_PAGE = 512


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    """A directory for thousands of journals: in memory if possible, for a disk takes its time."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as directory:
        yield Path(directory)


@pytest.fixture(scope="module")
def written(folder: Path) -> bytes:
    """The file of a run that is going on: three trials and some steps."""
    path = folder / "original.bin"
    with Journal.create(path, META) as journal:
        for trial in range(TRIAL):
            journal.add(result_of(trial))
        journal.raise_epoch()
        for step in range(STEPS):
            journal.append(TRIAL, records_of(step))
    return path.read_bytes()


def look(path: Path, *, read: bool, is_ours: bool = True) -> None:
    """Use all that a journal offers; each must be right, or an error that names the file."""

    def see_run(journal: Journal) -> None:
        assert len(journal.session()) == 16
        assert not is_ours or {**META, "epoch": "1"}.items() <= journal.meta().items()

    def see_results(journal: Journal) -> None:
        found = list(journal.results(with_decisions=True))
        # What `holdfast run` takes for done is what it has just counted.
        assert journal.finished() >= {result.trial for result in found}
        assert not is_ours or found == [result_of(trial) for trial in range(TRIAL)]

    def see_unfinished(journal: Journal) -> None:
        unfinished = journal.unfinished()
        assert not is_ours or unfinished is not None
        if unfinished is not None:
            assert unfinished.trial == journal.unfinished_trial()
            assert not is_ours or unfinished.records == all_records(STEPS)

    def go_on(journal: Journal) -> None:
        expected_epoch = 1 + int(journal.meta().get("epoch", 0))
        assert journal.raise_epoch() == expected_epoch
        before = journal.unfinished()
        with contextlib.suppress(InvalidValueError):  # a trial of that number is in the damage
            journal.append(TRIAL, records_of(STEPS + 1))
            after = journal.unfinished()
            assert after is not None
            known = [] if before is None else before.records
            assert after.records == [*known, *records_of(STEPS + 1)]
            journal.add(result_of(TRIAL))
            assert journal.unfinished() is None

    try:
        journal = Journal.read(path) if read else Journal.open(path)
    except OutputError as error:
        assert str(path) in str(error)
        return
    with journal:
        for check in (see_run, see_results, see_unfinished, *(() if read else (go_on,))):
            try:
                check(journal)
            except OutputError as error:
                assert str(path) in str(error)


def damage_bytes(chance: random.Random, data: bytes) -> bytes:
    spoilt = bytearray(data)
    match chance.choice(("flip", "overwrite", "cut", "swap", "double", "empty", "random", "grow")):
        case "flip":
            for _ in range(chance.choice((1, 1, 1, 4, 64))):
                spoilt[chance.randrange(len(spoilt))] ^= 1 << chance.randrange(8)
        case "overwrite":
            start = chance.randrange(len(spoilt))
            spoilt[start : start + 16] = chance.randbytes(len(spoilt[start : start + 16]))
        case "cut":
            del spoilt[chance.randrange(len(spoilt)) :]
        case "swap":
            one, other = (_page(chance, data) for _ in range(2))
            spoilt[one], spoilt[other] = data[other], data[one]
        case "double":
            spoilt[_page(chance, data)] = data[_page(chance, data)]
        case "empty":
            spoilt[_page(chance, data)] = bytes(_PAGE)
        case "random":
            spoilt[_page(chance, data)] = chance.randbytes(_PAGE)
        case _:
            spoilt += chance.randbytes(chance.choice((1, 100, _PAGE)))
    return bytes(spoilt)


def _page(chance: random.Random, data: bytes) -> slice:
    start = chance.randrange(max(1, len(data) // _PAGE)) * _PAGE
    return slice(start, start + _PAGE)


@examples(quick=40, slow=4_000)
def test_damaged_bytes_and_pages(examples: int, written: bytes, folder: Path) -> None:
    path = folder / "journal.bin"

    def check(seed: int) -> None:
        chance = random.Random(seed)
        data = written
        for _ in range(chance.choice((1, 1, 2))):
            data = damage_bytes(chance, data or b"?")
        path.write_bytes(data)
        read = chance.random() < 0.5
        look(path, read=read)
        if data[: len(written)] != written:
            # All of it was promised, so none may be missing and nobody told.
            with pytest.raises(OutputError, match="journal"):
                (Journal.read if read else Journal.open)(path)

    always(examples, check, st.integers(0, 2**48))


def damage_entries(chance: random.Random, payloads: list[bytes]) -> None:
    """Change entries as somebody may who knows how the file is made."""
    number, other = (chance.randrange(len(payloads)) for _ in range(2))
    match chance.choice(("delete", "exchange", "copy", "value", "value", "value")):
        case "delete":
            del payloads[number]
        case "exchange":
            payloads[number], payloads[other] = payloads[other], payloads[number]
        case "copy":
            payloads.insert(other, payloads[number])
        case _:
            parts = msgspec.msgpack.decode(payloads[number])
            values: list[Any] = [
                0,
                -1,
                2**63 - 1,
                1.5,
                "",
                "x",
                b"",
                chance.randbytes(40),
                [],
                {},
                None,
            ]
            parts[chance.randrange(len(parts))] = chance.choice(values)
            payloads[number] = msgspec.msgpack.encode(parts)


@examples(quick=25, slow=3_000)
def test_damaged_entries(examples: int, written: bytes, folder: Path) -> None:
    path = folder / "journal.bin"
    path.write_bytes(written)
    with contextlib.closing(JournalFile(path, os.O_RDONLY)) as file:
        whole = [payload for payload, _ in file.frames(START)]

    def check(seed: int) -> None:
        chance = random.Random(seed)
        payloads = list(whole)
        for _ in range(chance.choice((1, 1, 2, 3))):
            damage_entries(chance, payloads)
        path.unlink(missing_ok=True)
        with contextlib.closing(JournalFile(path, os.O_RDWR | os.O_CREAT)) as file:
            file.fill([])
            file.mark(file.append(START, payloads).offset, 0)
        look(path, read=chance.random() < 0.5, is_ours=False)

    always(examples, check, st.integers(0, 2**48))
