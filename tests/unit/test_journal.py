"""Steps of an unfinished trial: what a killed process leaves, and what damage does to it."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import sqlite3
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from holdfast.errors import InvalidValueError, OutputError
from holdfast.planning.outcome import Decisions, TrialResult
from holdfast.protocol.records import (
    ActingRecord,
    ObservedRecord,
    PausedRecord,
    PerformedRecord,
    Record,
)
from holdfast.recording import journal as journal_module
from holdfast.recording import journal_reader
from holdfast.recording.journal import Journal
from holdfast.recording.journal_file import Survives
from holdfast.recording.journal_reader import UnfinishedTrial

TRIAL = 3


def records_of(step: int) -> list[Record]:
    """What a robot writes at one step, with numbers that tell the step."""
    action = struct.pack("<3d", step, -0.0, 1.0 / (step + 1))
    shown, reached = struct.pack("<d", step / 7), bytes([100 + step]) * 32
    observed = ObservedRecord(step, step % 5, shown, reached, step / 3)
    performed = [PerformedRecord(step - 1, -float(step))] if step else []
    return [*performed, observed, ActingRecord(step, action)]


def all_records(steps: int) -> list[Record]:
    return [record for step in range(steps) for record in records_of(step)]


def result_of(trial: int) -> TrialResult:
    decisions = Decisions(1, bytes([trial]) * 200)
    return TrialResult(
        trial=trial,
        seed=5,
        success=True,
        steps=10,
        reward=-1.0,
        sensing_decisions=0,
        mean_sensing_ms=0.0,
        recoveries=0,
        unexplained_observations=0,
        digest=decisions.digest(),
        sensing_ms=(),
        decisions=decisions,
    )


def unfinished_of(path: Path) -> UnfinishedTrial | None:
    with Journal.open(path) as journal:
        return journal.unfinished()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "journal.sqlite"


WRITER = """
import os, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from tests.unit.test_journal import TRIAL, records_of, result_of
from holdfast.recording import journal as journal_module
from holdfast.recording import journal_reader
from holdfast.recording.journal import Journal

journal = Journal.create(Path(sys.argv[2]), {"configuration": "x" * 100}, survives=sys.argv[3])
for trial in range(TRIAL):
    journal.add(result_of(trial))
journal.close()
journal = Journal.open(Path(sys.argv[2]), survives=sys.argv[3])
journal.raise_epoch()
for step in range(int(sys.argv[4])):
    journal.append(TRIAL, records_of(step))
    print(step, flush=True)
sys.stdin.read()
"""


@contextlib.contextmanager
def writer(
    path: Path, steps: int, survives: Survives = "process_crash"
) -> Iterator[subprocess.Popen[str]]:
    """A process that has appended these steps, and holds the journal until it is killed."""
    command = [sys.executable, "-c", WRITER, str(Path(__file__).parents[2])]
    with subprocess.Popen(
        [*command, str(path), survives, str(steps)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            assert process.stdout is not None
            for step in range(steps):
                assert process.stdout.readline() == f"{step}\n"
            yield process
        finally:
            process.send_signal(signal.SIGKILL)


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A journal of six steps that a killed process has left, with its log."""
    path = tmp_path_factory.mktemp("killed") / "journal.sqlite"
    with writer(path, 6):
        pass
    assert path.with_name("journal.sqlite-wal").stat().st_size > 0
    return path


def copy_of(journal: Path, directory: Path) -> Path:
    for name in ("journal.sqlite", "journal.sqlite-wal", "journal.sqlite-count"):
        if journal.with_name(name).exists():
            shutil.copyfile(journal.with_name(name), directory / name)
    return directory / "journal.sqlite"


@pytest.fixture
def memory_path(tmp_path: Path) -> Iterator[Path]:
    """A directory for thousands of journals: in memory if possible, for a disk takes its time."""
    memory = Path("/dev/shm")
    usable = memory.is_dir() and os.access(memory, os.W_OK)
    with tempfile.TemporaryDirectory(dir=memory if usable else tmp_path) as directory:
        yield Path(directory)


def content(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in directory.iterdir()}


class TestSteps:
    def test_what_was_appended_comes_back_in_order(self, path: Path) -> None:
        with Journal.create(path, {}) as journal:
            assert journal.unfinished() is None
            for step in range(4):
                journal.append(TRIAL, records_of(step))
                journal.append(TRIAL, [])
            journal.append(TRIAL, [PausedRecord()])
        with Journal.open(path) as journal:
            unfinished = journal.unfinished()
            assert unfinished is not None
            assert unfinished.trial == journal.unfinished_trial() == TRIAL
            assert unfinished.records == [*all_records(4), PausedRecord()]
            journal.append(TRIAL, records_of(4))
        unfinished = unfinished_of(path)
        assert unfinished is not None
        assert unfinished.records == [*all_records(4), PausedRecord(), *records_of(4)]

    def test_a_finished_trial_has_no_steps(self, path: Path) -> None:
        with Journal.create(path, {}) as journal:
            for trial in range(3):
                for step in range(4):
                    journal.append(trial, records_of(step))
                journal.add(result_of(trial))
                assert journal.unfinished() is None
            with pytest.raises(InvalidValueError, match="trial 1 is finished"):
                journal.append(1, records_of(0))
            journal.append(3, records_of(0))
        unfinished = unfinished_of(path)
        assert unfinished is not None
        assert unfinished.records == records_of(0)

    def test_one_trial_at_a_time(self, path: Path) -> None:
        with Journal.create(path, {}) as journal:
            journal.append(TRIAL, records_of(0))
            with pytest.raises(InvalidValueError, match=r"trial 3 is not finished .* 4 cannot"):
                journal.append(TRIAL + 1, records_of(0))
            journal.add(result_of(0))
            unfinished = journal.unfinished()
            assert unfinished is not None
            assert unfinished.records == records_of(0)

    def test_a_listener_gets_records_that_are_written(self, path: Path) -> None:
        with Journal.create(path, {}) as journal:

            def listen(trial: int, records: Sequence[Record]) -> None:
                unfinished = journal.unfinished()
                assert unfinished is not None
                assert (unfinished.trial, unfinished.records[-len(records) :]) == (trial, records)
                told.append(trial)

            told: list[int] = []
            journal.on_append = listen
            journal.append(TRIAL, records_of(0))
            assert told == [TRIAL]

    def test_a_journal_with_steps_is_not_empty(self, path: Path) -> None:
        with Journal.create(path, {}) as journal:
            assert journal.is_empty()
            journal.append(TRIAL, records_of(0))
            assert not journal.is_empty()
            with pytest.raises(OutputError, match="finished or begun"):
                journal.restart({})

    def test_closing_leaves_one_plain_file(self, path: Path) -> None:
        with Journal.create(path, {}) as journal:
            journal.append(TRIAL, records_of(0))
        assert [entry.name for entry in path.parent.iterdir()] == [path.name]
        # Read and write version 1: no log is needed to read it.
        assert path.read_bytes()[18:20] == b"\1\1"

    def test_a_failed_append_leaves_nothing_of_it(self, path: Path) -> None:
        """A limit on the size of files stands for a disk that is full."""
        code = WRITER.replace(
            "for step in range(int(sys.argv[4])):\n",
            "import resource, signal\n"
            "from holdfast.runtime.files import OutputError\n"
            "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
            "journal.append(TRIAL, records_of(0))\n"
            "hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]\n"
            "resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))\n"
            "try:\n"
            "    journal.append(TRIAL, records_of(1))\n"
            "except OutputError as error:\n"
            "    print(error, flush=True)\n"
            "resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))\n"
            "for step in range(1, 3):\n",
        )
        done = subprocess.run(
            [
                sys.executable,
                "-c",
                code,
                str(Path(__file__).parents[2]),
                str(path),
                "process_crash",
            ],
            input="",
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        assert done.stdout.splitlines()[0].startswith(f"{path}: ")
        unfinished = unfinished_of(path)
        assert unfinished is not None
        assert unfinished.records == all_records(3)


class TestProcesses:
    def test_kill_leaves_every_appended_record(self, killed: Path, tmp_path: Path) -> None:
        path = copy_of(killed, tmp_path)
        unfinished = unfinished_of(path)
        assert unfinished is not None
        assert unfinished.trial == TRIAL
        assert unfinished.records == all_records(6)
        assert unfinished.same_boot
        assert unfinished.is_complete
        with Journal.open(path) as journal:
            assert journal.finished() == {0, 1, 2}
            assert journal.raise_epoch() == 2
            journal.add(result_of(TRIAL))
            assert journal.unfinished() is None

    @pytest.mark.parametrize("content", [None, b"", b"\0" * 15, struct.pack("<qq", TRIAL + 1, 1)])
    def test_without_its_count_nobody_knows_what_is_missing(
        self, content: bytes | None, killed: Path, tmp_path: Path
    ) -> None:
        path = copy_of(killed, tmp_path)
        count = tmp_path / "journal.sqlite-count"
        count.unlink()
        if content is not None:
            count.write_bytes(content)
        unfinished = unfinished_of(path)
        assert unfinished is not None
        assert unfinished.records == all_records(6)
        assert not unfinished.is_complete

    def test_what_is_missing_is_missing_for_whoever_comes_next(
        self, killed: Path, tmp_path: Path
    ) -> None:
        path = copy_of(killed, tmp_path)
        log = tmp_path / "journal.sqlite-wal"
        os.truncate(log, log.stat().st_size // 2)
        for _ in range(2):
            unfinished = unfinished_of(path)
            assert unfinished is not None
            kept = len(unfinished.records)
            assert kept < len(all_records(6))
            assert not unfinished.is_complete
        # Somebody knew enough to go on from there.
        with Journal.open(path) as journal:
            journal.append(TRIAL, records_of(7))
            unfinished = journal.unfinished()
            assert unfinished is not None
            assert unfinished.is_complete
        assert [entry.name for entry in tmp_path.iterdir()] == [path.name]
        unfinished = unfinished_of(path)
        assert unfinished is not None
        assert len(unfinished.records) == kept + len(records_of(7))
        assert unfinished.is_complete

    def test_a_journal_that_cannot_note_its_end_keeps_its_count(self, path: Path) -> None:
        with Journal.create(path, {}) as journal:
            journal.append(TRIAL, records_of(0))

            def refuse(operation: int, *_: object) -> int:
                return sqlite3.SQLITE_DENY if operation == sqlite3.SQLITE_INSERT else 0

            journal._connection.set_authorizer(refuse)
        unfinished = unfinished_of(path)
        assert unfinished is not None
        assert unfinished.is_complete

    def test_a_count_that_cannot_be_removed_is_no_trouble(self, path: Path) -> None:
        """As where the directory may not be written any more."""
        with Journal.create(path, {}) as journal:
            journal.append(TRIAL, records_of(0))
            count = path.with_name("journal.sqlite-count")
            count.unlink()
            count.mkdir()
        unfinished = unfinished_of(path)
        assert unfinished is not None
        assert unfinished.is_complete

    def test_a_finished_trial_leaves_no_count(self, killed: Path, tmp_path: Path) -> None:
        path = copy_of(killed, tmp_path)
        with Journal.open(path) as journal:
            journal.add(result_of(TRIAL))
        assert [entry.name for entry in tmp_path.iterdir()] == [path.name]

    def test_reading_changes_nothing(self, killed: Path, tmp_path: Path) -> None:
        path = copy_of(killed, tmp_path)
        before = content(tmp_path)
        with Journal.read(path) as journal:
            unfinished = journal.unfinished()
            assert unfinished is not None
            assert unfinished.records == all_records(6)
            assert unfinished.is_complete
            assert [result.trial for result in journal.results(with_decisions=True)] == [0, 1, 2]
            assert content(tmp_path) == before
            with pytest.raises(OutputError, match="readonly"):
                journal.add(result_of(7))
            journal.require_unchanged()
            with Journal.open(path) as other:
                other.append(TRIAL, records_of(6))
            with pytest.raises(OutputError, match="written to it while it was read"):
                journal.require_unchanged()

    def test_a_closed_journal_is_read_where_it_is(self, path: Path) -> None:
        with Journal.create(path, {}) as journal:
            journal.append(TRIAL, records_of(0))
        path.chmod(0o400)
        path.parent.chmod(0o500)
        try:
            before = content(path.parent)
            with Journal.read(path) as journal:
                unfinished = journal.unfinished()
                assert unfinished is not None
                assert unfinished.records == records_of(0)
                with pytest.raises(OutputError, match="readonly"):
                    journal.set_meta(key="value")
            assert content(path.parent) == before
        finally:
            path.parent.chmod(0o700)

    def test_it_belongs_to_one_process_at_a_time(self, path: Path) -> None:
        with writer(path, 2):
            for use in (Journal.open, Journal.read):
                with pytest.raises(OutputError, match="another process is using this run"):
                    use(path)
            # The log's index is in memory: no file beside it that several processes share.
            names = {entry.name for entry in path.parent.iterdir()}
            assert names == {"journal.sqlite", "journal.sqlite-wal", "journal.sqlite-count"}
        unfinished = unfinished_of(path)
        assert unfinished is not None
        assert unfinished.records == all_records(2)

    def test_reading_does_not_give_up_the_lock_of_this_process(self, path: Path) -> None:
        """Closing any descriptor of a file drops the locks that a process has on it."""
        opener = f"""
from pathlib import Path
from holdfast.recording import journal as journal_module
from holdfast.recording import journal_reader
from holdfast.recording.journal import Journal
Journal.open(Path({str(path)!r}))
"""
        with Journal.create(path, {}) as journal:
            journal.append(TRIAL, records_of(0))
            with pytest.raises(OutputError, match="this process is using this run"):
                Journal.read(path)
            done = subprocess.run(
                [sys.executable, "-c", opener], capture_output=True, text=True, timeout=60
            )
            assert "another process is using this run" in done.stderr
        Journal.read(path).close()


class TestRun:
    def test_the_session_is_drawn_once(self, tmp_path: Path) -> None:
        sessions = []
        for name in ("first", "second"):
            with Journal.create(tmp_path / name, {}) as journal:
                sessions.append(journal.session())
            with Journal.open(tmp_path / name) as journal:
                assert journal.session() == sessions[-1]
        assert len(set(sessions)) == 2
        assert all(len(session) == 16 for session in sessions)
        with Journal.open(tmp_path / "first") as journal:
            journal.restart({})
            assert journal.session() not in sessions

    def test_the_epoch_counts_processes(self, path: Path) -> None:
        with Journal.create(path, {}) as journal:
            assert journal.raise_epoch() == 1
        for expected in (2, 3):
            with Journal.open(path) as journal:
                assert journal.raise_epoch() == expected
        with Journal.open(path) as journal:
            journal.set_meta(epoch=str(2**32 - 1))
            with pytest.raises(OutputError, match="its epoch is '4294967295'"):
                journal.raise_epoch()

    @pytest.mark.parametrize("survives", ["process_crash", "power_cut"])
    def test_the_epoch_outlives_the_log(self, path: Path, survives: Survives) -> None:
        """No two processes have the same: each leaves only its main file, as it was then."""
        Journal.create(path, {}, survives=survives).close()
        for expected in (1, 2, 3):
            with Journal.open(path, survives=survives) as journal:
                assert journal.raise_epoch() == expected
                main = path.read_bytes()
            path.write_bytes(main)
            path.with_name(f"{path.name}-wal").unlink(missing_ok=True)

    @pytest.mark.parametrize("written", [None, "", "a boot"])
    @pytest.mark.parametrize("now", [None, "another boot"])
    def test_a_boot_that_is_not_known_is_not_the_same(
        self, path: Path, monkeypatch: pytest.MonkeyPatch, written: str | None, now: str | None
    ) -> None:
        """At neither end: in a container, say, that hides it."""
        monkeypatch.setattr(journal_module, "boot_id", lambda: written)
        monkeypatch.setattr(journal_reader, "boot_id", lambda: now)
        with Journal.create(path, {}) as journal:
            journal.append(TRIAL, records_of(0))
            for state in (journal.unfinished(), None):
                if state is None:  # an older journal says nothing of it
                    with journal._connection:
                        journal._connection.execute("DELETE FROM meta WHERE key = 'steps_boot'")
                    state = journal.unfinished()
                assert state is not None
                assert not state.same_boot
                assert not state.is_complete

    @pytest.mark.skipif(
        not Path("/proc/sys/kernel/random/boot_id").exists(), reason="the kernel names no boot"
    )
    @pytest.mark.parametrize("survives", ["process_crash", "power_cut"])
    def test_another_boot_is_found_out(self, path: Path, survives: Survives) -> None:
        with Journal.create(path, {}, survives=survives) as journal:
            journal.append(TRIAL, records_of(0))
            unfinished = journal.unfinished()
            assert unfinished is not None
            assert unfinished.same_boot
            assert unfinished.is_complete
            journal.set_meta(steps_boot="another")
        with Journal.open(path) as journal:
            unfinished = journal.unfinished()
            assert unfinished is not None
            assert not unfinished.same_boot
            assert unfinished.is_complete == unfinished.on_disk == (survives == "power_cut")
            # From here on it is this boot's.
            journal.append(TRIAL, records_of(1))
            unfinished = journal.unfinished()
            assert unfinished is not None
            assert unfinished.same_boot

    def test_what_begins_or_ends_a_trial_is_on_the_disk(self, path: Path) -> None:
        Journal.create(path, {}).close()
        for survives in ("process_crash", "power_cut"):
            with Journal.open(path, survives=survives) as journal:
                modes: list[int] = []

                def note(statement: str, modes: list[int] = modes, own: Journal = journal) -> None:
                    # A single statement is a transaction by itself.
                    alone = not own._connection.in_transaction and statement.startswith("INSERT")
                    if statement == "COMMIT" or alone:
                        (mode,) = own._connection.execute("PRAGMA synchronous").fetchone()
                        modes.append(mode)

                trial = len(journal.finished())
                journal._connection.set_trace_callback(note)
                journal.append(trial, records_of(0))
                journal.append(trial, records_of(1))
                journal.raise_epoch()
                journal.append(trial, records_of(2))
                journal.add(result_of(trial))
                normal, full = 1, 2
                later = normal if survives == "process_crash" else full
                assert modes == [full, later, full, later, full]


class TestDamage:
    """Whatever is cut off or flipped: what comes back is what was written, from the first on."""

    @staticmethod
    def outcome(path: Path, *, read: bool) -> UnfinishedTrial | str:
        try:
            with Journal.read(path) if read else Journal.open(path) as journal:
                unfinished = journal.unfinished()
                finished = {result.trial for result in journal.results(with_decisions=True)}
                assert finished == {0, 1, 2}
                assert journal.meta()["configuration"] == "x" * 100
        except OutputError as error:
            return str(error)
        assert unfinished is not None
        assert unfinished.trial == TRIAL
        return unfinished

    def check(self, path: Path, *, read: bool, where: str) -> int | None:
        """Return how many records came back; None if it was refused."""
        found = self.outcome(path, read=read)
        if isinstance(found, str):
            assert found.startswith(f"{path}: "), f"{where}: {found}"
            assert "--out" in found, f"{where}: {found}"
            return None
        expected = all_records(6)
        assert found.records == expected[: len(found.records)], where
        # Whatever is missing, it is known that something is.
        assert found.is_complete == (len(found.records) == len(expected)), where
        return len(found.records)

    @staticmethod
    def check_goes_on(path: Path, kept: int) -> None:
        with Journal.open(path) as journal:
            journal.append(TRIAL, records_of(7))
        unfinished = unfinished_of(path)
        assert unfinished is not None
        assert unfinished.records == [*all_records(6)[:kept], *records_of(7)]

    @pytest.mark.parametrize(
        "name", [pytest.param("journal.sqlite", marks=pytest.mark.slow), "journal.sqlite-wal"]
    )
    @pytest.mark.parametrize("read", [False, True], ids=["resumed", "read"])
    def test_cut_off_anywhere(self, killed: Path, memory_path: Path, name: str, read: bool) -> None:
        whole = killed.with_name(name).read_bytes()
        # Every 16th byte; of a long log that is only read, as nothing goes on from it, every 64th.
        # And the bytes around the ends of what SQLite writes at once.
        offsets = set(range(0, len(whole), 64 if read and name.endswith("-wal") else 16))
        for unit, head in ((4096, 0), (24 + 4096, 32)):
            for end in range(head, len(whole), unit):
                offsets |= {end - 1, end, end + 1}
        kept = []
        for offset in sorted(offset for offset in offsets if 0 <= offset < len(whole)):
            path = copy_of(killed, memory_path)
            path.with_name(name).write_bytes(whole[:offset])
            kept.append(self.check(path, read=read, where=f"{name} cut at {offset}"))
            if not read and kept[-1] is not None and len(kept) % 32 == 0:
                self.check_goes_on(path, kept[-1])
        if name.endswith("-wal"):
            # A log never makes a journal unusable, and the longer it is, the more comes back.
            numbers = [number for number in kept if number is not None]
            assert numbers == kept
            assert numbers == sorted(numbers)
            # What began the trial is in the journal itself.
            assert set(numbers) == {2, 5, 8, 11, 14}

    def test_a_flipped_bit_of_a_record_is_named(self, killed: Path, tmp_path: Path) -> None:
        path = copy_of(killed, tmp_path)
        Journal.open(path).close()  # all is in the one file now
        whole = path.read_bytes()
        for index, record in enumerate(all_records(6)):
            if isinstance(record, ObservedRecord):
                assert whole.count(record.digest) == 1
                flipped = bytearray(whole)
                flipped[whole.index(record.digest) + 7] ^= 1
                path.write_bytes(flipped)
                with pytest.raises(
                    OutputError,
                    match=rf"record {index} of the unfinished trial 3 has a wrong checksum.*--out",
                ):
                    unfinished_of(path)

    def test_a_flipped_bit_of_a_finished_trial_is_named(self, killed: Path, tmp_path: Path) -> None:
        path = copy_of(killed, tmp_path)
        Journal.open(path).close()
        whole = path.read_bytes()
        decisions = whole.index(bytes([2]) * 200)
        digest = whole.index(result_of(2).digest.encode())
        for offset, what in (
            (decisions, "decisions of trial 2 have"),
            (digest, "result of trial 2"),
        ):
            flipped = bytearray(whole)
            flipped[offset + 3] ^= 1
            path.write_bytes(flipped)
            with (
                Journal.open(path) as journal,
                pytest.raises(OutputError, match=f"the {what}.* a wrong checksum"),
            ):
                list(journal.results(with_decisions=True))

    def test_a_flipped_bit_of_a_note_is_named(self, killed: Path, tmp_path: Path) -> None:
        path = copy_of(killed, tmp_path)
        Journal.open(path).close()
        flipped = bytearray(path.read_bytes())
        flipped[flipped.index(b"x" * 100)] ^= 1
        path.write_bytes(flipped)
        with (
            Journal.open(path) as journal,
            pytest.raises(OutputError, match="its note 'configuration' has a wrong checksum"),
        ):
            journal.meta()

    @pytest.mark.parametrize("sequence", [0, 5])
    def test_a_missing_record_is_named(self, killed: Path, tmp_path: Path, sequence: int) -> None:
        path = copy_of(killed, tmp_path)
        with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as connection:
            connection.execute("DELETE FROM steps WHERE sequence = ?", (sequence,))
        with pytest.raises(OutputError, match=f"record {sequence} .* is missing"):
            unfinished_of(path)

    def test_a_log_without_its_journal_is_nobodys(self, killed: Path, tmp_path: Path) -> None:
        """A new journal beside it would get the pages of the old one."""
        path = copy_of(killed, tmp_path)
        path.unlink()
        before = content(tmp_path)
        with pytest.raises(OutputError, match=r"-wal: is the log of a journal that is gone.*--out"):
            Journal.create(path, {})
        assert content(tmp_path) == before

    def test_an_emptied_journal_keeps_its_log(self, killed: Path, tmp_path: Path) -> None:
        path = copy_of(killed, tmp_path)
        os.truncate(path, 0)
        before = content(tmp_path)
        for read in (False, True):
            assert self.check(path, read=read, where="") is None
        assert content(tmp_path) == before


class TestKeptSteps:
    """Steps that stay when their trial is finished, because nobody could make them again."""

    def journal(self, path: Path, *, keep_steps: bool) -> list[Record]:
        with Journal.create(path, {"configuration": ""}) as journal:
            for step in range(4):
                journal.append(TRIAL, records_of(step))
            journal.add(result_of(TRIAL), keep_steps=keep_steps)
        return all_records(4)

    def test_they_stay_if_that_is_asked_for(self, path: Path) -> None:
        records = self.journal(path, keep_steps=True)
        with Journal.read(path) as journal:
            assert journal.unfinished() is None
            assert journal.kept_steps(TRIAL) == records
            assert journal.kept_steps(TRIAL + 1) is None
            assert journal.finished() == {TRIAL}

    def test_else_they_go(self, path: Path) -> None:
        self.journal(path, keep_steps=False)
        with Journal.open(path) as journal:
            assert journal.kept_steps(TRIAL) is None
            # Of a trial without steps there are none to keep.
            journal.add(result_of(5), keep_steps=True)
            assert journal.kept_steps(5) is None

    @pytest.mark.parametrize("changes", ["records = x'90'", "trial = 4", "records = 7"])
    def test_damage_is_noticed(self, changes: str, path: Path) -> None:
        self.journal(path, keep_steps=True)
        with contextlib.closing(sqlite3.connect(path)) as connection:
            connection.execute(f"UPDATE kept_steps SET {changes}")
            connection.commit()
        trial = 4 if changes == "trial = 4" else TRIAL
        with (
            Journal.read(path) as journal,
            pytest.raises(OutputError, match=f"the steps of trial {trial} have a wrong checksum"),
        ):
            journal.kept_steps(trial)
