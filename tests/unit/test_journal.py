"""What a killed process leaves, what a power cut leaves, and what damage does to it."""

import contextlib
import itertools
import os
import signal
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.programs import completed

from holdfast.errors import InvalidValueError, LostJournalError, OutputError
from holdfast.journal import journal as journal_module
from holdfast.journal import journal_reader
from holdfast.journal.journal import Journal
from holdfast.journal.journal_file import Survives
from holdfast.journal.journal_reader import JournalReader, UnfinishedTrial
from holdfast.planning.inputs import ActingRecord, Moved, PausedRecord, Record, Sensed
from holdfast.planning.outcome import Decisions, TrialResult

TRIAL = 3


def records_of(step: int) -> list[Record]:
    """What a robot writes at one step, with numbers that tell the step."""
    action = struct.pack("<3d", step, -0.0, 1.0 / (step + 1))
    shown, reached = struct.pack("<d", step / 7), bytes([100 + step]) * 32
    observed = Sensed(step, step % 5, shown, reached, step / 3)
    performed = [Moved(step - 1, -float(step))] if step else []
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


def unfinished_of(journal: JournalReader | Path) -> UnfinishedTrial:
    """Return what is left of the unfinished trial, which there is."""
    if isinstance(journal, Path):
        with Journal.open(journal) as opened:
            return unfinished_of(opened)
    unfinished = journal.unfinished()
    assert unfinished is not None
    return unfinished


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "journal.bin"


WRITER = """
import os, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from tests.unit.test_journal import TRIAL, records_of, result_of
from holdfast.journal.journal import Journal

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
def killed(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A journal of six steps that a killed process has left."""
    path = tmp_path_factory.mktemp("killed") / "journal.bin"
    with writer(path, 6):
        pass
    return path.read_bytes()


class TestSteps:
    def test_what_was_appended_comes_back_in_order(self, path: Path) -> None:
        with Journal.create(path, {}) as journal:
            assert journal.unfinished() is None
            for step in range(4):
                journal.append(TRIAL, records_of(step))
                journal.append(TRIAL, [])
            journal.append(TRIAL, [PausedRecord()])
        with Journal.open(path) as journal:
            unfinished = unfinished_of(journal)
            assert unfinished.trial == journal.unfinished_trial() == TRIAL
            assert unfinished.records == [*all_records(4), PausedRecord()]
            journal.append(TRIAL, records_of(4))
        assert unfinished_of(path).records == [*all_records(4), PausedRecord(), *records_of(4)]

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
        assert unfinished_of(path).records == records_of(0)

    def test_one_trial_at_a_time(self, path: Path) -> None:
        with Journal.create(path, {}) as journal:
            journal.append(TRIAL, records_of(0))
            with pytest.raises(InvalidValueError, match=r"trial 3 is not finished .* 4 cannot"):
                journal.append(TRIAL + 1, records_of(0))
            journal.add(result_of(0))
            journal.append(TRIAL, records_of(1))
            assert unfinished_of(journal).records == all_records(2)

    def test_a_journal_with_steps_is_not_empty(self, path: Path) -> None:
        with Journal.create(path, {}) as journal:
            assert journal.is_empty()
            journal.append(TRIAL, records_of(0))
            assert not journal.is_empty()
            with pytest.raises(OutputError, match="finished or begun"):
                journal.restart({})

    @pytest.mark.parametrize("number", [0, 1, 2])
    def test_a_failed_append_leaves_nothing_of_it(self, path: Path, number: int) -> None:
        """A limit on the size of files stands for a disk that is full, by this many bytes."""
        code = WRITER.replace(
            "for step in range(int(sys.argv[4])):\n",
            "import resource, signal\n"
            "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
            "journal.append(TRIAL, records_of(0))\n"
            f"size = os.stat(sys.argv[2]).st_size + 40 * {number}\n"
            "hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]\n"
            "resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))\n"
            "for step in (1, 2):\n"
            "    try:\n"
            "        journal.append(TRIAL, records_of(step))\n"
            "    except Exception as error:\n"
            "        print(error, flush=True)\n"
            "    resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))\n"
            "for step in ():\n",
        )
        root = str(Path(__file__).parents[2])
        command = [sys.executable, "-c", code, root, str(path), "process_crash"]
        done = subprocess.run(command, input="", capture_output=True, text=True, timeout=60)
        # Nothing is written after it, for nobody knows what of the file is on the disk.
        assert done.stdout.splitlines() == [f"{path}: cannot be written: File too large"] * 2
        assert unfinished_of(path).records == all_records(1)

    @pytest.mark.parametrize("replace", [False, True])
    def test_nothing_is_acted_on_that_nobody_finds(self, path: Path, replace: bool) -> None:
        with Journal.create(path, {}) as journal:
            journal.append(TRIAL, records_of(0))
            if replace:
                Journal.create(path.with_name("other"), {}).close()
                path.with_name("other").rename(path)
            else:
                path.unlink()
            with pytest.raises(LostJournalError, match="the journal is gone"):
                journal.append(TRIAL, records_of(1))


class TestProcesses:
    def test_kill_leaves_every_appended_record(self, killed: bytes, path: Path) -> None:
        path.write_bytes(killed)
        unfinished = unfinished_of(path)
        assert unfinished.trial == TRIAL
        assert unfinished.records == all_records(6)
        assert unfinished.is_complete
        with Journal.open(path) as journal:
            assert journal.finished() == {0, 1, 2}
            assert journal.raise_epoch() == 2
            journal.add(result_of(TRIAL))
            assert journal.unfinished() is None

    def test_reading_changes_nothing(self, killed: bytes, path: Path) -> None:
        path.write_bytes(killed + b"half a frame")
        path.chmod(0o400)
        path.parent.chmod(0o500)
        try:
            with Journal.read(path) as journal:
                assert unfinished_of(journal).records == all_records(6)
                assert [each.trial for each in journal.results(with_decisions=True)] == [0, 1, 2]
                with pytest.raises(OutputError, match="cannot be written"):
                    journal.add(result_of(7))
            assert path.read_bytes() == killed + b"half a frame"
        finally:
            path.parent.chmod(0o700)
        assert [entry.name for entry in path.parent.iterdir()] == [path.name]

    def test_one_process_writes_and_any_number_read(self, path: Path) -> None:
        with writer(path, 2):
            with pytest.raises(OutputError, match="another process is using this run"):
                Journal.open(path)
            with Journal.read(path) as journal:
                assert unfinished_of(journal).records == all_records(2)
            # To close the file has not given up the other's lock.
            with pytest.raises(OutputError, match="another process is using this run"):
                Journal.open(path)
        Journal.open(path).close()

    def test_what_is_read_is_the_journal_as_it_was(self, path: Path) -> None:
        with Journal.create(path, {}) as journal:
            journal.append(TRIAL, records_of(0))
            with Journal.read(path) as before:
                journal.append(TRIAL, records_of(1))
                journal.add(result_of(TRIAL), keep_steps=True)
                assert unfinished_of(before).records == all_records(1)
                assert before.finished() == set()

    def test_a_fork_does_not_keep_the_lock(self, path: Path) -> None:
        """A robot's own processes may outlive it."""
        # In a process of its own: a copy of this one, which has threads, might never run.
        program = """
import os, sys
from pathlib import Path
from holdfast.journal.journal import Journal
journal = Journal.create(Path(sys.argv[1]), {})
is_there, ends = os.pipe(), os.pipe()
if os.fork() == 0:
    os.close(ends[1])
    os.write(is_there[1], b"!")
    os.read(ends[0], 1)  # until the other one has ended
    os._exit(0)
os.read(is_there[0], 1)
journal.close()
Journal.open(Path(sys.argv[1])).close()
print("opened")
"""
        done = completed([sys.executable, "-c", program, str(path)], timeout=60.0)
        assert done.stdout == "opened\n", done.stderr


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
            assert not unfinished_of(journal).is_complete

    @pytest.mark.skipif(
        not Path("/proc/sys/kernel/random/boot_id").exists(), reason="the kernel names no boot"
    )
    @pytest.mark.parametrize("survives", ["process_crash", "power_cut"])
    def test_another_boot_is_found_out(self, path: Path, survives: Survives) -> None:
        with Journal.create(path, {}, survives=survives) as journal:
            journal.append(TRIAL, records_of(0))
            assert unfinished_of(journal).is_complete
            journal.set_meta(steps_boot="another")
        with Journal.open(path) as journal:
            assert unfinished_of(journal).is_complete == (survives == "power_cut")
            # From here on it is this boot's.
            journal.append(TRIAL, records_of(1))
            assert unfinished_of(journal).is_complete

    def test_what_begins_or_ends_a_trial_is_on_the_disk(
        self, path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        calls: list[str] = []
        for name in ("fdatasync", "pwrite"):
            real = getattr(os, name)

            def call(*arguments: object, name: str = name, real: Any = real) -> object:
                calls.append(name)
                return real(*arguments)

            monkeypatch.setattr(os, name, call)
        Journal.create(path, {}).close()
        assert calls[-2:] == ["fdatasync", "pwrite"]
        for survives in ("process_crash", "power_cut"):
            with Journal.open(path, survives=survives) as journal:
                trial = len(journal.finished())
                calls.clear()
                journal.append(trial, records_of(0))
                journal.append(trial, records_of(1))
                journal.raise_epoch()
                journal.append(trial, records_of(2))
                journal.add(result_of(trial))
                # A frame, and the mark that is written when it is where it has to be.
                synchronized, later = ["pwrite", "fdatasync", "pwrite"], ["pwrite", "pwrite"]
                step = later if survives == "process_crash" else synchronized
                assert calls == [*synchronized, *step, *synchronized, *step, *synchronized]


class TestDamage:
    """Whatever is cut off or flipped: what comes back is what was written, from the first on."""

    @staticmethod
    def outcome(path: Path, *, read: bool) -> list[Record] | str:
        try:
            with Journal.read(path) if read else Journal.open(path) as journal:
                unfinished = unfinished_of(journal)
                finished = {result.trial for result in journal.results(with_decisions=True)}
        except OutputError as error:
            assert str(error).startswith(f"{path}: ")
            assert read or "another directory" in str(error)
            return str(error)
        assert finished == {0, 1, 2}
        return unfinished.records

    @pytest.mark.parametrize("read", [False, True], ids=["resumed", "read"])
    def test_a_flipped_bit_anywhere_is_found(self, killed: bytes, path: Path, read: bool) -> None:
        for offset in range(0, len(killed), 7):
            flipped = bytearray(killed)
            flipped[offset] ^= 1 << offset % 8
            path.write_bytes(flipped)
            assert isinstance(self.outcome(path, read=read), str), offset

    def test_where_it_is_damaged_is_named(self, killed: bytes, path: Path) -> None:
        observed = [record for record in all_records(6) if isinstance(record, Sensed)]
        for what, named in (
            (b"x" * 100, "after its notes, at byte 64"),
            (bytes([1]) * 200, "after the result of trial 0, at byte"),
            (observed[0].digest, "after the result of trial 2, at byte"),
            (observed[4].digest, "after record 10 of the unfinished trial 3, at byte"),
        ):
            assert killed.count(what) == 1
            path.write_bytes(killed.replace(what, what[:7] + b"?" + what[8:]))
            found = self.outcome(path, read=True)
            assert f"the journal is damaged ({named}" in str(found)

    @pytest.mark.parametrize("survives", ["process_crash", "power_cut"])
    def test_a_torn_tail_is_cut_off(self, path: Path, survives: Survives) -> None:
        """The process was killed while it wrote: nobody was told that it is done."""
        with Journal.create(path, {}, survives=survives) as journal:
            journal.append(TRIAL, records_of(0))
            before = path.read_bytes()
            journal.append(TRIAL, records_of(1))
            after = path.read_bytes()
        tail = after[len(before) :]
        for size in range(0, len(tail) + 1, 5):
            path.write_bytes(before + tail[:size])
            for _ in range(2):
                unfinished = unfinished_of(path)
                assert unfinished.is_complete
                assert path.stat().st_size == len(before) + (size if size == len(tail) else 0)
                # Whole, it may as well be there: nobody was told that it is not.
                assert unfinished.records == all_records(1 + (size == len(tail)))
            with Journal.open(path) as journal:
                journal.append(TRIAL, records_of(5))
            assert unfinished_of(path).records[-3:] == records_of(5)

    def test_what_cannot_be_opened_to_the_end_is_not_kept_open(
        self, path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        Journal.create(path, {}).close()
        path.write_bytes(path.read_bytes() + b"half a frame")
        with monkeypatch.context() as patch, pytest.raises(OutputError, match="written: Bad file"):
            patch.setattr(os, "ftruncate", lambda *_: os.fstat(-1))
            Journal.open(path)
        Journal.open(path).close()  # nobody uses it

    def test_frames_are_of_one_file_and_in_their_order(self, killed: bytes, path: Path) -> None:
        with Journal.create(path, {}) as journal:
            ends = [journal._end.offset]
            for step in range(4):
                journal.append(TRIAL, [PausedRecord()] * (step != 2) or records_of(9)[:1])
                ends.append(journal._end.offset)
        data = path.read_bytes()
        parts = [data[start:end] for start, end in itertools.pairwise(ends)]
        assert len(parts[1]) == len(parts[3])
        for order in ((0, 2, 1, 3), (0, 1, 1, 3), (0, 1, 3), (0, 3, 2, 1), (1, 1, 2, 3)):
            path.write_bytes(data[: ends[0]] + b"".join(parts[index] for index in order))
            with pytest.raises(OutputError, match="damaged"):
                Journal.open(path)


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
