"""Each system call that the journal makes on its files fails once, or is the process's last one.

``strace`` does that to a real process, one call after another. Whatever was said to be kept must be
there afterwards, what is there must be known to be all, and the journal must be of use.
"""

import shutil
import sys
import tempfile
from pathlib import Path

import pytest
from tests.programs import completed
from tests.unit.test_journal import all_records, records_of

from holdfast.journal.journal import Journal

_CALLS = "pwrite64,fsync,fdatasync,ftruncate,unlink,link,flock"


def why_no_strace() -> str | None:
    """Return why no process can be traced here; None if one can."""
    if shutil.which("strace") is None:
        return "strace is not installed (Debian's package: strace)"
    done = completed(["strace", "-o", "/dev/null", "true"], timeout=30)
    return None if done.returncode == 0 else f"nothing can be traced: {done.stderr.strip()}"


WHY_NOT = why_no_strace()


def said_when_struck(path: Path, fault: str, number: int) -> list[str] | None:
    """Return what the writer said to whom this happened at that call; None if it made fewer."""
    trace = path.parent.with_name("trace")
    command = ["strace", "-f", "-qq", "-o", str(trace)]
    command += ["-e", f"trace={_CALLS}", "-e", f"inject={_CALLS}:{fault}:when={number}"]
    writer = Path(__file__).with_name("journal_writer.py")
    done = completed([*command, sys.executable, str(writer), str(path)], timeout=240)
    assert "Traceback" not in done.stderr, done.stderr
    struck = "INJECTED" in trace.read_text() or done.returncode != 0
    return done.stdout.splitlines() if struck else None


@pytest.mark.slow
@pytest.mark.skipif(WHY_NOT is not None, reason=str(WHY_NOT))
@pytest.mark.parametrize("fault", ["signal=KILL", "error=EIO", "error=ENOSPC"])
def test_what_was_kept_is_there(fault: str) -> None:
    number = 0
    while True:
        number += 1
        with tempfile.TemporaryDirectory(dir=memory()) as directory:
            path = Path(directory) / "run" / "journal.bin"
            path.parent.mkdir()
            said = said_when_struck(path, fault, number)
            if said is None:
                break
            where = f"{fault} at call {number}, after {said[-1:]}"
            if path.exists():
                check(path, said, where)
            else:
                assert not [line for line in said if not line.startswith("error")], where
    assert number > 20


def memory() -> Path | None:
    """Return a directory in memory, if there is one: a disk would take its time."""
    memory = Path("/dev/shm")
    return memory if memory.is_dir() else None


def check(path: Path, said: list[str], where: str) -> None:
    """Compare what is in a journal with what its writer was told is kept."""
    words = [line.split() for line in said]
    trials = {int(trial) for what, trial, *_ in words if what == "trial"}
    steps = [(int(each[1]), int(each[2])) for each in words if each[0] == "step"]
    with Journal.open(path) as journal:
        finished = journal.finished()
        unfinished = journal.unfinished()
        assert trials <= finished, where
        if steps:
            assert journal.meta()["epoch"] == "1", where
            trial, step = steps[-1]
            if trial not in finished:
                assert unfinished is not None, where
                assert unfinished.trial == trial, where
                assert len(unfinished.records) >= len(all_records(step + 1)), where
        if unfinished is not None:
            assert unfinished.records == all_records(3)[: len(unfinished.records)], where
            assert unfinished.is_complete, where
        going_on = len(finished) if unfinished is None else unfinished.trial
        journal.append(going_on, records_of(4))
    with Journal.open(path) as journal:
        unfinished = journal.unfinished()
        assert unfinished is not None, where
        assert unfinished.is_complete, where
        assert unfinished.records[-len(records_of(4)) :] == records_of(4), where
