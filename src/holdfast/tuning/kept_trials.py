"""The finished trials of a tuning, each kept in a file as soon as it is finished."""

from __future__ import annotations

import contextlib
import csv
import fcntl
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any, NamedTuple

import msgspec

from holdfast.conversion import convert
from holdfast.errors import OutputError
from holdfast.journal.run_directory import first_difference
from holdfast.printable import csv_rows
from holdfast.runtime.files import shown_path, write_atomically

FRESH = 1_000_000  # number of the first trial that judges; those of the race are below it
TRIALS_NAME = "trials.csv"
SETTINGS_NAME = "tune.json"


class TrialRow(NamedTuple):
    """What is kept of a trial; ``decision_ms`` is the median of its sensing decisions."""

    candidate: str
    trial: int
    success: bool
    failed: bool
    lost_values: str  # names of coordinates (:class:`holdfast.robot.lost_values.LostValues`)
    steps: int
    reward: float | None
    decision_ms: float
    seconds: float


class KeptTrials:
    """The finished trials, ``rows``, by candidate and number; kept in a directory, if any."""

    def __init__(self, directory: Path | None, settings: Mapping[str, Any]) -> None:
        self.rows: dict[tuple[str, int], TrialRow] = {}
        self._directory = directory
        self._settings = settings
        self._file: IO[str] | None = None

    def __enter__(self) -> KeptTrials:
        if self._directory is not None:
            try:
                self._open(self._directory)
            except BaseException:
                self.__exit__()
                raise
        return self

    def _open(self, directory: Path) -> None:
        path = directory / TRIALS_NAME
        try:
            directory.mkdir(parents=True, exist_ok=True)
            self._file = path.open("a", encoding="utf-8", newline="")
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            content = path.read_bytes()
            whole = content[: content.rfind(b"\n") + 1]
            lines = whole.decode(errors="replace").split("\n")
            self.rows = {(row.candidate, row.trial): row for row in _rows_of(lines)}
            self._require_the_same(directory / SETTINGS_NAME, is_new=not content)
            # What a kill has cut short goes. The rest stays as it is: a disk may be full.
            self._file.truncate(len(whole))
            if not whole:
                self._file.write(_line(TrialRow._fields))
                self._file.flush()
        except BlockingIOError:
            raise OutputError(f"{shown_path(path)}: another process is writing it") from None
        except OSError as error:
            raise OutputError(f"{shown_path(path)}: cannot be written: {error.strerror}") from error

    def __exit__(self, *exception: object) -> None:
        if self._file is not None:
            with contextlib.suppress(OSError):  # what a full disk does not take was an error before
                self._file.close()

    def _require_the_same(self, path: Path, *, is_new: bool) -> None:
        settings = msgspec.to_builtins(self._settings)
        try:
            there = msgspec.json.decode(path.read_bytes())
        except FileNotFoundError:
            if not is_new:
                raise OutputError(
                    f"{shown_path(path)}: is not there, so {TRIALS_NAME} is of a run, or nobody "
                    "knows of which tuning; choose another directory"
                ) from None
            write_atomically(path, msgspec.json.format(msgspec.json.encode(settings), indent=2))
            return
        except (OSError, UnicodeDecodeError, msgspec.DecodeError) as error:
            raise OutputError(f"{shown_path(path)}: cannot be read: {error}") from None
        found = first_difference(there, msgspec.json.decode(msgspec.json.encode(settings)))
        if found is not None:
            key, old, new = found
            raise OutputError(
                f"{shown_path(path)}: is of another tuning: {key} was {old} and is {new}; "
                "choose another directory"
            )

    def of(self, name: str) -> list[TrialRow]:
        """Return the trials of a candidate in the race, in order."""
        found = [row for row in self.rows.values() if row.candidate == name and row.trial < FRESH]
        return sorted(found, key=lambda row: row.trial)

    def add(self, row: TrialRow) -> None:
        """Keep a trial."""
        self.rows[row.candidate, row.trial] = row
        if self._file is not None:
            try:
                self._file.write(_line(row))
                self._file.flush()
            except OSError as error:
                where = shown_path(Path(self._file.name))
                raise OutputError(f"{where}: cannot be written: {error.strerror}") from error


def _line(values: Iterable[Any]) -> str:
    _, line = csv_rows((), [tuple(values)])
    return line


def _rows_of(lines: Iterable[str]) -> Iterator[TrialRow]:
    """Yield the trials; each line is read by itself, so that a damaged one costs no other."""
    for line in lines:
        # The head, and damaged rows, are left out.
        with contextlib.suppress(ValueError, csv.Error, msgspec.ValidationError):
            ((*cells, reward, decision_ms, seconds),) = csv.reader([line])
            plain = [*cells, float(reward) if reward else None, decision_ms, seconds]
            row = convert(plain, TrialRow, strict=False)
            if 0.0 <= row.decision_ms + row.seconds < math.inf:
                yield row
