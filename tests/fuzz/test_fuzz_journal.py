"""A damaged journal, however it was damaged: what is read of it was written, or it is refused.

Damage is drawn at three levels: bits and bytes of both files, whole pages (swapped, doubled,
emptied, cut off), and rows (deleted, exchanged, of other types). What is found must be exactly what
was written, a part of it from its beginning on, or an error that names the file.
"""

from __future__ import annotations

import contextlib
import random
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import strategies as st
from tests.fuzz.examples import always, examples
from tests.unit.test_journal import TRIAL, all_records, records_of, result_of

from holdfast.errors import InvalidValueError, OutputError
from holdfast.recording.journal import Journal
from holdfast.recording.journal_reader import SCHEMA_VERSION

STEPS = 6
FILES = ("journal.sqlite", "journal.sqlite-wal")
META = {"configuration": "x" * 100}
_PAGE = 4096

_COLUMNS = {
    "meta": ("key", "value", "checksum"),
    "trials": ("trial", "result", "result_checksum", "decisions", "decisions_checksum"),
    "steps": ("sequence", "trial", "record", "checksum"),
}


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    """A directory for thousands of journals: in memory if possible, for a disk takes its time."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as directory:
        yield Path(directory)


@pytest.fixture(scope="module")
def written(folder: Path) -> dict[str, bytes]:
    """The two files of a run that is going on: three trials and some steps."""
    path = folder / "original" / FILES[0]
    path.parent.mkdir()
    with Journal.create(path, META) as journal:
        for trial in range(TRIAL):
            journal.add(result_of(trial))
        journal.raise_epoch()
        for step in range(STEPS // 2):
            journal.append(TRIAL, records_of(step))
    # One half has got into the file itself, the other is in the log.
    with Journal.open(path) as journal:
        for step in range(STEPS // 2, STEPS):
            journal.append(TRIAL, records_of(step))
        return {name: path.with_name(name).read_bytes() for name in FILES}


def lay_out(folder: Path, files: dict[str, bytes]) -> Path:
    directory = folder / "damaged"
    shutil.rmtree(directory, ignore_errors=True)
    directory.mkdir()
    for name, data in files.items():
        (directory / name).write_bytes(data)
    return directory / FILES[0]


def look(path: Path, *, read: bool) -> None:
    """Use all that a journal offers; each must be right, or an error that names the file."""
    expected = {trial: result_of(trial) for trial in range(TRIAL)}
    records = all_records(STEPS)
    notes = {**META, "epoch": "1", "schema_version": str(SCHEMA_VERSION)}

    def check_meta(journal: Journal) -> None:
        # A note that somebody has deleted is not there; every other one is what was noted.
        assert notes.items() <= {**notes, **journal.meta()}.items()

    def check_session(journal: Journal) -> None:
        assert len(journal.session()) == 16

    def check_results(journal: Journal) -> None:
        found = list(journal.results(with_decisions=True))
        assert len({result.trial for result in found}) == len(found)
        assert all(result == expected[result.trial] for result in found)
        # What `holdfast run` takes for done is what it has just counted.
        assert journal.finished() == {result.trial for result in found}

    def check_unfinished(journal: Journal) -> None:
        unfinished = journal.unfinished()
        if unfinished is not None:
            assert unfinished.trial == TRIAL
            assert unfinished.records == records[: len(unfinished.records)]
            assert journal.unfinished_trial() == TRIAL

    def check_unfinished_trial(journal: Journal) -> None:
        assert isinstance(journal.unfinished_trial(), int | None)

    def go_on(journal: Journal) -> None:
        expected_epoch = 1 + int(journal.meta().get("epoch", 0))
        assert journal.raise_epoch() == expected_epoch
        unfinished = journal.unfinished()
        with contextlib.suppress(InvalidValueError):  # a trial of that number is in the damage
            journal.append(TRIAL, records_of(STEPS + 1))
            after = journal.unfinished()
            assert after is not None
            known = [] if unfinished is None else unfinished.records
            assert after.records == [*known, *records_of(STEPS + 1)]
            journal.add(result_of(TRIAL))
            assert journal.unfinished() is None

    checks: list[Callable[[Journal], None]] = [
        check_meta,
        check_session,
        check_results,
        check_unfinished,
        check_unfinished_trial,
    ]
    if not read:
        checks.append(go_on)
    try:
        journal = Journal.read(path) if read else Journal.open(path)
    except OutputError as error:
        assert str(path) in str(error)
        return
    with journal:
        for check in checks:
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
    """Return a page; of a log, with whatever its headers shift it by."""
    start = chance.randrange(max(1, len(data) // _PAGE)) * _PAGE
    return slice(start, start + _PAGE)


@examples(quick=40, slow=4_000)
def test_damaged_bytes_and_pages(examples: int, written: dict[str, bytes], folder: Path) -> None:
    def check(seed: int) -> None:
        chance = random.Random(seed)
        files = dict(written)
        for _ in range(chance.choice((1, 1, 2))):
            name = chance.choice([name for name in FILES if files[name]])
            files[name] = damage_bytes(chance, files[name])
        look(lay_out(folder, files), read=chance.random() < 0.5)

    always(examples, check, st.integers(0, 2**48))


def damage_rows(chance: random.Random, path: Path) -> None:
    """Change rows as if their constraints did not exist."""
    table = chance.choice(list(_COLUMNS))
    column = chance.choice(_COLUMNS[table])
    key = _COLUMNS[table][0]
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as connection:
        keys = [row[0] for row in connection.execute(f"SELECT {key} FROM {table}")]
        row, other = chance.choice(keys), chance.choice(keys)
        # What is against a constraint of the table's key cannot be in a file that SQLite opens.
        with contextlib.suppress(sqlite3.IntegrityError, OverflowError):
            match chance.choice(("delete", "exchange", "copy", "value", "value", "value")):
                case "delete":
                    connection.execute(f"DELETE FROM {table} WHERE {key} = ?", (row,))
                case "exchange":
                    spare = "spare" if table == "meta" else 10**6
                    for before, after in ((row, spare), (other, row), (spare, other)):
                        connection.execute(
                            f"UPDATE {table} SET {key} = ? WHERE {key} = ?", (after, before)
                        )
                case "copy":
                    connection.execute(
                        f"UPDATE {table} SET {column} = "
                        f"(SELECT {column} FROM {table} WHERE {key} = ?) WHERE {key} = ?",
                        (other, row),
                    )
                case _:
                    values = (0, -1, 2**63 - 1, 1.5, "", "x", b"", chance.randbytes(40), "7")
                    connection.execute(
                        f"UPDATE {table} SET {column} = ? WHERE {key} = ?",
                        (chance.choice(values), row),
                    )


@examples(quick=25, slow=3_000)
def test_damaged_rows(examples: int, written: dict[str, bytes], folder: Path) -> None:
    def check(seed: int) -> None:
        chance = random.Random(seed)
        path = lay_out(folder, written)
        for _ in range(chance.choice((1, 1, 2, 3))):
            damage_rows(chance, path)
        look(path, read=chance.random() < 0.5)

    always(examples, check, st.integers(0, 2**48))
