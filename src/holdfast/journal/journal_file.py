r"""The file of a journal: frames that are only ever appended, and a mark of how far they go.

::

    "holdfast journal 4\n"                                       32 bytes
    mark: written up to, on the disk up to, boot, checksum       32 bytes
    frame: length of the payload, checksum, payload              12 bytes and the payload
    frame ...

The checksum of a frame covers that of the frame before it: one that is missing, doubled, exchanged
or of another file is found as a flipped bit is.

A frame that is not whole was either cut short while it was written, or was whole once. The mark
tells which: it is written after the frame, and nothing is acted on before. So what lies before the
mark was promised, and if it is not whole the file is damaged. What lies behind it was promised to
nobody, and is cut off. After a power cut that holds for what was on the disk; the mark itself, 32
bytes of one sector, is there or the one before is.

Readers need no lock: they read the mark first, then the frames up to it and beyond.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import struct
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

import msgspec

from holdfast.errors import LostJournalError, OutputError

JOURNAL_NAME = "journal.bin"
OLD_JOURNAL_NAME = "journal.sqlite"
"""Name of the journal of earlier versions; :mod:`holdfast.journal.old_journal` reads it."""

Survives: TypeAlias = Literal["process_crash", "power_cut"]
"""What a journalled step survives; see :class:`holdfast.planning.settings.RecoverySettings`."""

START_ANEW = "start anew in another directory (--out)"
SQLITE_MAGIC = b"SQLite format 3\0"

_VERSION = 4
"""Raised whenever frames or their content change form. Up to 3 it was a database."""

_MAGIC = b"holdfast journal "
_HEADER = (_MAGIC + b"%d\n" % _VERSION).ljust(32, b"\0")
_MARK = struct.Struct("<QQ8s")
_FRAME = struct.Struct("<I8s")
_CHECKSUM_SIZE = 8
_MAX_FRAME_BYTES = 2**29
"""Bound on a frame, for a file of somebody else's; a trial of a million steps has a tenth of it."""

_CHUNK_BYTES = 1 << 18
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_EMPTY = hashlib.blake2b(digest_size=_CHECKSUM_SIZE, person=b"holdfast-journal")


class Position(NamedTuple):
    """A place between two frames: its offset in the file, and the checksum of the frame before."""

    offset: int
    checksum: bytes


START = Position(len(_HEADER) + _MARK.size + _CHECKSUM_SIZE, bytes(_CHECKSUM_SIZE))


class Notes(msgspec.Struct, array_like=True, frozen=True, tag=0):
    """Notes about the run; ``anew`` drops all earlier ones."""

    notes: Mapping[str, str]
    anew: bool = False


class Steps(msgspec.Struct, array_like=True, frozen=True, tag=1):
    """Records of the unfinished trial, packed."""

    trial: int
    records: msgspec.Raw


class Finished(msgspec.Struct, array_like=True, frozen=True, tag=2):
    """The end of a trial: its result and decisions, packed; whether its records are still used."""

    trial: int
    result: msgspec.Raw
    decisions: msgspec.Raw
    keeps_steps: bool


Entry: TypeAlias = Notes | Steps | Finished

encode = msgspec.msgpack.Encoder().encode
decode_entry: Callable[[bytes], Entry] = msgspec.msgpack.Decoder(Notes | Steps | Finished).decode


def steps_payload(trial: int, records: Sequence[object]) -> bytes:
    """Encode ``Steps(trial, packed(records))`` in one go."""
    return encode((1, trial, records))


def packed(value: object) -> msgspec.Raw:
    """Pack a part of an entry."""
    return msgspec.Raw(encode(value))


def _checksum(data: bytes) -> bytes:
    checksum = _EMPTY.copy()  # creating one takes longer than hashing a step
    checksum.update(data)
    return checksum.digest()


class JournalFile:
    """An open journal. Its methods raise OSError if the system refuses something.

    One that is open to be written (``flags`` with ``os.O_RDWR``) is locked. The lock is that of
    this opening, so it ends with the process, and no other use of the file touches it. ``name`` is
    the name under which it is created. Raises OutputError if it cannot be opened, or another
    process is writing to it.
    """

    def __init__(self, path: Path, flags: int, name: Path | None = None) -> None:
        self.path = path
        self._writes = bool(flags & os.O_RDWR)
        self._boot = _checksum((boot_id() or os.urandom(16).hex()).encode())
        self.descriptor = -1
        try:
            self.descriptor = os.open(name or path, flags | os.O_CLOEXEC, 0o666)
            if self._writes:
                fcntl.flock(self.descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                _written_here.add(self)
        except BlockingIOError:
            self.close()
            raise OutputError(f"{path}: another process is using this run") from None
        except OSError as error:
            self.close()
            what = "written" if self._writes else "read"
            raise OutputError(f"{path}: cannot be {what}: {error.strerror}") from error

    def close(self) -> None:
        """Close the file, and give up its lock. May be repeated."""
        if self.descriptor >= 0:
            os.close(self.descriptor)
            self.descriptor = -1

    def fill(self, entries: Iterable[Entry]) -> int:
        """Make a journal of an empty file, on the disk; return its size."""
        self._write(_HEADER, 0)
        self.mark(START.offset, 0)
        end = START
        for entry in entries:
            end = self.append(end, [encode(entry)])
        os.fdatasync(self.descriptor)
        self.mark(end.offset, end.offset)
        return end.offset

    def require_journal(self) -> None:
        """Raise OutputError if it is no journal, or one of another version."""
        header = os.pread(self.descriptor, len(_HEADER), 0)
        if header == _HEADER:
            return
        run = f"the directory of a run, or its {JOURNAL_NAME}"
        anew = f", or {START_ANEW}" if self._writes else ""  # a reader begins no run
        if not header.startswith(_MAGIC):
            what = "not" if header else "empty, so not"
            raise OutputError(f"{self.path}: is {what} a journal; name {run}{anew}")
        version = header[len(_MAGIC) :].rstrip(b"\n\0").decode("ascii", "replace")
        raise OutputError(
            f"{self.path}: journal version {version!r}; this holdfast reads version {_VERSION}; "
            f"use the holdfast that made it{anew}"
        )

    def append(self, position: Position, payloads: Sequence[bytes]) -> Position:
        """Write frames, and return where they end; nobody may be told before :meth:`mark`."""
        parts = []
        offset, checksum = position
        for payload in payloads:
            checksum = _checksum(checksum + payload)
            parts.append(_FRAME.pack(len(payload), checksum) + payload)
        data = b"".join(parts)
        self._write(data, offset)
        return Position(offset + len(data), checksum)

    def _write(self, data: bytes, offset: int) -> None:
        while (written := os.pwrite(self.descriptor, data, offset)) < len(data):
            data, offset = data[written:], offset + written  # the next call says what is wrong

    def mark(self, written: int, on_disk: int) -> None:
        """Note how far the file is written, and how far it is on the disk."""
        mark = _MARK.pack(written, on_disk, self._boot)
        os.pwrite(self.descriptor, mark + _checksum(mark), len(_HEADER))

    def promised(self) -> tuple[int, int]:
        """Return how far the file must be whole, and how far it is known to be on the disk."""
        for _ in range(100):  # while it is written, a part of it may be read
            data = os.pread(self.descriptor, _MARK.size + _CHECKSUM_SIZE, len(_HEADER))
            if _checksum(data[: _MARK.size]) == data[_MARK.size :]:
                written, on_disk, boot = _MARK.unpack_from(data)
                return written if boot == self._boot else on_disk, on_disk
        raise damaged(self.path, "the mark of how far it goes has a wrong checksum")

    def frames(
        self, position: Position, chunk_bytes: int = _CHUNK_BYTES
    ) -> Iterator[tuple[bytes, Position]]:
        """Yield the payload and the end of each whole frame, up to the first that is not whole."""
        offset, before = position
        chunk, start, size = b"", 0, os.fstat(self.descriptor).st_size
        while True:
            if len(chunk) - start < _FRAME.size:
                chunk, start = os.pread(self.descriptor, chunk_bytes, offset), 0
                if len(chunk) < _FRAME.size:
                    return
            length, checksum = _FRAME.unpack_from(chunk, start)
            whole = _FRAME.size + length
            if length > _MAX_FRAME_BYTES or offset + whole > size:
                return
            if len(chunk) - start < whole:
                chunk, start = os.pread(self.descriptor, max(whole, chunk_bytes), offset), 0
            payload = chunk[start + _FRAME.size : start + whole]
            if _checksum(before + payload) != checksum:
                return
            offset, start, before = offset + whole, start + whole, checksum
            yield payload, Position(offset, before)

    def require_in_place(self) -> None:
        """Raise LostJournalError if the file was removed or replaced: nobody finds it any more."""
        if not os.fstat(self.descriptor).st_nlink:
            raise LostJournalError(
                f"{self.path}: the journal is gone: it was removed or replaced while this run was "
                "writing to it; nothing is performed that is not written down"
            )


_written_here: weakref.WeakSet[JournalFile] = weakref.WeakSet()


def _close_all() -> None:
    for file in list(_written_here):
        file.close()


os.register_at_fork(after_in_child=_close_all)  # a fork has the lock, too, and may outlive the run


def damaged(path: Path, how: str) -> OutputError:
    """Return the error of a damaged journal."""
    return OutputError(
        f"{path}: the journal is damaged ({how}); restore the file, or run anew in another "
        "directory"
    )


def find_journal(run: Path, purpose: str) -> Path:
    """Return the journal of a run, by its directory or the journal itself.

    ``purpose`` is a verb, for messages: what the run is needed for. Raises OutputError if there is
    none.
    """
    if run.is_dir():
        for name in (JOURNAL_NAME, OLD_JOURNAL_NAME):
            if (run / name).is_file():
                return run / name
        within = next(run.glob(f"*/{JOURNAL_NAME}"), None)
        hint = f"; one of a sweep's is {within.parent}" if within else ""
        raise OutputError(f"{run}: holds no {JOURNAL_NAME}, so no run to {purpose}{hint}")
    if not run.exists():
        raise OutputError(f"{run}: there is no such directory or journal, so no run to {purpose}")
    if not run.is_file():
        raise OutputError(f"{run}: is a pipe or device, not a journal")
    return run


def boot_id() -> str | None:
    """Return the identity of this boot of the machine, None if there is none."""
    try:
        return _BOOT_ID.read_text(encoding="ascii").strip() or None
    except (OSError, UnicodeDecodeError):
        return None
