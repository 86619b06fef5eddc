"""The journal on a simulated disk: killed in the midst of a write, cut from the power, damaged.

The production code runs; its system calls are written down. A kill leaves all of them, and a part
of the last. A power cut leaves, of what was not synchronised, some sectors as they are and others
as they were. Whoever opens the file then must find all that was acted on, or know that something is
missing. Planted defects show that this would be found out.
"""

import os
import random
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import pytest
from tests.simulation.edits import Defect, Edit, applied
from tests.unit.test_journal import all_records, records_of

from holdfast.errors import OutputError
from holdfast.journal import journal as journal_module
from holdfast.journal import journal_file, journal_reader
from holdfast.journal.journal import Journal
from holdfast.journal.journal_file import START, JournalFile
from holdfast.journal.journal_reader import JournalReader
from holdfast.planning.inputs import Record

SECTOR = 512
LIMIT = 400
"""Seeds within which each defect is to be found."""


class Told(NamedTuple):
    """What the robot was told is written, and after how many states of the disk."""

    records: int
    states: int


class Disk:
    """A file, as it was after each system call since it was last synchronised."""

    def __init__(self, image: bytes) -> None:
        self.states = [image]
        self.synchronized = 0

    def write(self, data: bytes, offset: int) -> None:
        image = self.states[-1].ljust(offset, b"\0")
        self.states.append(image[:offset] + data + image[offset + len(data) :])

    def killed(self, chance: random.Random, last: int) -> bytes:
        """Return the file after a call that may be done in part: calls write in order."""
        before, after = self.states[max(0, last - 1)], self.states[last]
        changed = [at for at in range(len(after)) if after[at : at + 1] != before[at : at + 1]]
        if changed and changed[-1] < START.offset:  # the mark: a part of one sector
            return chance.choice((before, after))
        cut = chance.choice([0, *changed, len(after)])
        image = after[:cut] + before[cut:]
        return image[: max(len(before), cut)]

    def without_power(self, chance: random.Random, last: int) -> bytes:
        """Return the file after a power cut: each sector is as new or as old as it likes."""
        states = self.states[min(self.synchronized, last) : last + 1]
        size = len(chance.choice(states))
        padded = [state.ljust(size, b"\0") for state in states]
        return b"".join(chance.choice(padded)[at : at + SECTOR] for at in range(0, size, SECTOR))[
            :size
        ]


@contextmanager
def on(disk: Disk) -> Iterator[None]:
    """Let the journal's system calls go to the disk as well."""
    pwrite, fdatasync, ftruncate = os.pwrite, os.fdatasync, os.ftruncate

    def write(descriptor: int, data: bytes, offset: int) -> int:
        disk.write(data, offset)
        return pwrite(descriptor, data, offset)

    def synchronize(descriptor: int) -> None:
        disk.synchronized = len(disk.states) - 1
        fdatasync(descriptor)

    def truncate(descriptor: int, size: int) -> None:
        disk.states.append(disk.states[-1][:size])
        ftruncate(descriptor, size)

    with (
        mock.patch.object(os, "pwrite", write),
        mock.patch.object(os, "fdatasync", synchronize),
        mock.patch.object(os, "ftruncate", truncate),
    ):
        yield


def violation_of(seed: int, folder: Path) -> str | None:
    """Let a robot write, fail and go on, some times; return what it was told wrongly."""
    chance = random.Random(seed)
    path = folder / "journal.bin"
    path.unlink(missing_ok=True)
    survives: Any = chance.choice(("process_crash", "power_cut"))
    boots = 0
    patches = [
        mock.patch.object(module, "boot_id", lambda: f"boot {boots}")
        for module in (journal_file, journal_module, journal_reader)
    ]
    with patches[0], patches[1], patches[2]:
        Journal.create(path, {"configuration": "x" * 700}, survives=survives).close()
        known: list[Record] = []
        for _ in range(3):
            disk, told = Disk(path.read_bytes()), [Told(len(known), 0)]
            written = list(known)
            with on(disk), Journal.open(path, survives=survives) as journal:
                journal.raise_epoch()
                for step in range(len(known) // 3, len(known) // 3 + chance.randrange(1, 9)):
                    more = all_records(step + 1)[len(written) :]
                    journal.append(0, more)
                    written += more
                    told.append(Told(len(written), len(disk.states) - 1))
                try:
                    Journal.open(path).close()
                except OutputError:
                    pass
                else:
                    return "two processes write to it"
            last = chance.randrange(len(disk.states))
            acted_on = max(each.records for each in told if each.states <= last)
            loses_power = chance.random() < 0.5
            leaves = disk.without_power if loses_power else disk.killed
            path.write_bytes(leaves(chance, last))
            boots += loses_power
            try:
                with Journal.open(path) as journal:
                    unfinished = journal.unfinished()
            except OutputError as error:
                return f"what nobody was told is taken for damage: {error}"
            found = [] if unfinished is None else unfinished.records
            if found != written[: len(found)]:
                return "it holds what was not written"
            is_complete = unfinished is None or unfinished.is_complete
            if len(found) < acted_on and (is_complete or not loses_power):
                return f"{len(found)} of {acted_on} records, and nobody knows"
            if loses_power and survives == "power_cut" and not is_complete:
                return "what was on the disk is said to be uncertain"
            known = found
        return _damaged(chance, path, known)


def _damaged(chance: random.Random, path: Path, known: list[Record]) -> str | None:
    """Damage what was promised."""
    with Journal.open(path) as journal:
        journal.append(0, records_of(len(known)))
        end = journal._end.offset
    whole = path.read_bytes()
    at = chance.randrange(end)
    spoilt = bytearray(whole)
    match chance.choice(("flip", "page", "cut")):
        case "flip":
            spoilt[at] ^= 1 << chance.randrange(8)
        case "page":
            page = at // SECTOR * SECTOR
            spoilt[page : page + SECTOR] = bytes(len(spoilt[page : page + SECTOR]))
        case _:
            del spoilt[at:]
    path.write_bytes(spoilt)
    try:
        Journal.read(path).close()
    except OutputError:
        return None
    return "damage is taken for a tail that nobody was told of"


FRAME = "end = file.append(self._end, payloads)"
AHEAD = "self._end.offset + 12 + len(payloads[0])"

JOURNAL_DEFECTS = {
    defect.name: defect
    for defect in (
        Defect(
            "torn_tail_taken",
            "A frame that is not whole is taken for one that is.",
            (
                Edit(
                    JournalFile,
                    "frames",
                    "if _checksum(before + payload) != checksum:",
                    "if False:",
                ),
            ),
        ),
        Defect(
            "flipped_bit_ends_the_journal",
            "What follows a flipped bit is cut off, as a torn tail is.",
            (Edit(JournalReader, "_read_all", "if self._end.offset < promised:", "if False:"),),
        ),
        Defect(
            "lost_page_not_expected",
            "After a power cut, the mark is believed.",
            (
                Edit(
                    JournalFile,
                    "promised",
                    "return written if boot == self._boot else on_disk, on_disk",
                    "return written, on_disk",
                ),
            ),
        ),
        Defect(
            "lost_page_not_noticed",
            "Each step is said to be on the disk.",
            (Edit(Journal, "append", "str(int(on_disk))", "'1'"),),
        ),
        Defect(
            "not_synchronized",
            "A step that is to survive a power cut is not forced to the disk.",
            (Edit(Journal, "append", "synchronize=on_disk)", "synchronize=False)"),),
        ),
        Defect(
            "two_writers",
            "The lock is one that several processes may have.",
            (Edit(JournalFile, "__init__", "fcntl.LOCK_EX", "fcntl.LOCK_SH"),),
        ),
        Defect(
            "mark_before_frame",
            "The mark goes ahead of what it promises.",
            (Edit(Journal, "_append", FRAME, f"file.mark({AHEAD}, self._on_disk); {FRAME}"),),
        ),
        Defect(
            "no_mark",
            "A step is not noted at the head of the file.",
            (Edit(Journal, "_append", "file.mark(end.offset, self._on_disk)", "pass"),),
        ),
    )
}


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as directory:
        yield Path(directory)


@pytest.mark.parametrize("seeds", [60, pytest.param(3000, marks=pytest.mark.slow)])
def test_what_was_acted_on_is_there(seeds: int, folder: Path) -> None:
    for seed in range(seeds):
        assert violation_of(seed, folder) is None, seed


@pytest.mark.parametrize("name", JOURNAL_DEFECTS)
def test_a_defect_is_found(name: str, folder: Path) -> None:
    with applied(JOURNAL_DEFECTS[name]):
        assert any(violation_of(seed, folder) is not None for seed in range(LIMIT))
