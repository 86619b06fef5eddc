"""Journals of earlier versions: read where they are, and gone on with in the form of today."""

import contextlib
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
from tests.unit.test_journal import TRIAL, all_records, result_of

from holdfast.errors import OutputError
from holdfast.journal.journal import Journal

KILLED = Path(__file__).parent / "data" / "killed"
"""What that code has left when it was killed: three trials, and six steps, of which the last are in
the log alone. (``journal_survives: power_cut``: the machine was booted since.)"""


@pytest.fixture
def old(tmp_path: Path) -> Path:
    return Path(shutil.copytree(KILLED, tmp_path / "run")) / "journal.sqlite"


def content(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in directory.iterdir()}


def check(journal: Journal) -> None:
    assert journal.meta() == {
        "session": journal.session().hex(),
        "configuration": "x" * 100,
        "epoch": "1",
        "steps_boot": journal.meta()["steps_boot"],
        "steps_on_disk": "1",
    }
    assert list(journal.results(with_decisions=True)) == [result_of(0), result_of(1)]
    assert journal.kept_steps(0) == all_records(3)
    assert journal.kept_steps(1) is None
    unfinished = journal.unfinished()
    assert unfinished is not None
    assert unfinished.trial == TRIAL
    assert unfinished.records == all_records(6)
    assert unfinished.is_complete


def test_it_is_read_where_it_is(old: Path) -> None:
    before = content(old.parent)
    with Journal.read(old) as journal:
        check(journal)
    assert content(old.parent) == before


def test_whoever_goes_on_leaves_it_under_another_name(old: Path) -> None:
    before = content(old.parent)
    new = old.with_name("journal.bin")
    Journal.convert(old, new)
    with Journal.open(new) as journal:
        check(journal)
        assert journal.raise_epoch() == 2
    moved = {name.replace(old.name, f"{old.name}.old"): data for name, data in before.items()}
    assert content(old.parent) == {**moved, new.name: new.read_bytes()}
    # It is an old journal still. And of a process that was killed between the two, the new one
    # counts.
    for name, data in before.items():
        (old.parent / name).write_bytes(data)
    Journal.convert(old, new)
    with Journal.open(new) as journal:
        assert journal.raise_epoch() == 3
    assert content(old.parent) == {**moved, new.name: new.read_bytes()}


@pytest.mark.parametrize("missing", ["-wal", "-count"])
def test_without_its_log_or_count_records_may_be_missing(old: Path, missing: str) -> None:
    old.with_name(f"{old.name}{missing}").unlink()
    with Journal.read(old) as journal:
        unfinished = journal.unfinished()
        assert unfinished is not None
        assert unfinished.records == all_records(6)[: len(unfinished.records)]
        assert (len(unfinished.records) == len(all_records(6))) == (missing == "-count")
        assert not unfinished.is_complete


def test_a_run_of_an_earlier_version_may_be_going_on(old: Path) -> None:
    program = (
        "import sqlite3, sys\n"
        "connection = sqlite3.connect(sys.argv[1])\n"
        "connection.execute('PRAGMA locking_mode = EXCLUSIVE')\n"
        "connection.execute('BEGIN EXCLUSIVE')\n"
        "print(flush=True)\n"
        "sys.stdin.read()\n"
    )
    command = [sys.executable, "-c", program, str(old)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        with pytest.raises(OutputError, match="another process is using this run"):
            Journal.read(old)
        process.communicate(b"")
    Journal.read(old).close()


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        ("UPDATE steps SET record = x'90' WHERE sequence = 5", "record 5 .* has a wrong checksum"),
        ("UPDATE steps SET record = 7 WHERE sequence = 5", "damaged"),
        ("DELETE FROM steps WHERE sequence = 5", "record 5 of the unfinished trial 3 is missing"),
        ("UPDATE trials SET result = x'90'", "the result of trial 0 has a wrong checksum"),
        ("UPDATE trials SET decisions = x'90'", "the decisions of 0 has a wrong checksum"),
        ("UPDATE kept_steps SET records = x'90'", "steps of trial 0 has a wrong checksum"),
        ("UPDATE meta SET value = 'y'", "note 'configuration' has a wrong checksum"),
        ("DELETE FROM meta WHERE key = 'schema_version'", "schema version None"),
        ("DROP TABLE trials", "no such table"),
        # Somebody else's file may compute without end, or write, when it is read.
        ("CREATE VIEW v AS SELECT * FROM meta", "'v' in it is no table of a journal"),
        ("CREATE TRIGGER t AFTER INSERT ON meta BEGIN SELECT 1; END", "'t' in it is no table"),
        ("CREATE INDEX i ON meta (value) WHERE value LIKE '%a%b%c%'", "'i' in it is no table"),
        ("ALTER TABLE steps ADD COLUMN more BLOB AS (zeroblob(900000000))", "'steps' in it is no"),
    ],
)
def test_damage_is_named(old: Path, statement: str, message: str) -> None:
    with contextlib.closing(sqlite3.connect(old, isolation_level=None)) as connection:
        connection.execute(statement)
    before = content(old.parent)
    with pytest.raises(OutputError, match=message):
        Journal.read(old)
    with pytest.raises(OutputError, match=message):
        Journal.convert(old, old.with_name("journal.bin"))
    assert content(old.parent) == before


def test_a_file_that_is_cut_off(old: Path) -> None:
    data = old.read_bytes()
    for size in (1, 100, 1024, 3000, len(data) - 1):
        old.write_bytes(data[:size])
        with pytest.raises(OutputError, match=r"journal\.sqlite: "):
            Journal.read(old)
