"""A series of trials, and its table on the disk, which gets a line with each.

An interrupted series resumes after the trials in its table. Trials are independent, so several may
run at the same time; each has a thread here that drives its testbed.
"""

from __future__ import annotations

import shutil
import threading
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path

import msgspec

from holdfast import __version__
from holdfast.errors import OutputError
from holdfast.files import write_atomically
from holdfast.lab.chaos.schedule import Wire, draw_schedule, kinds_over
from holdfast.lab.chaos.trial import Pace, TrialOutcome, run_chaos_trial
from holdfast.lab.errors import CancelledTrialError
from holdfast.lab.testbed.faults import FaultKind

__all__ = ["TRIALS_NAME", "Series", "SeriesPlan"]

PLAN_NAME = "series.json"
TRIALS_NAME = "trials.jsonl"


class SeriesPlan(msgspec.Struct, frozen=True, kw_only=True):
    """The identity of a series; it resumes only with the same.

    Attributes
    ----------
    wires : tuple of str
        Trial n is over wire n modulo their number.
    kinds : tuple of FaultKind
        The trials over each wire are of one kind after another; each wire begins with another one.
    possible : tuple of FaultKind
        The kinds that this machine can inject, for combinations.
    """

    seed: int
    first: int
    wires: tuple[Wire, ...]
    kinds: tuple[FaultKind, ...]
    possible: tuple[FaultKind, ...]
    commit: str
    holdfast_version: str = __version__

    def of(self, trial: int) -> tuple[Wire, FaultKind]:
        """Return the wire and the kind of a trial."""
        turn, place = divmod(trial, len(self.wires))
        wire = self.wires[place]
        kinds = kinds_over(wire, self.kinds)
        return wire, kinds[(turn + place * len(kinds) // len(self.wires)) % len(kinds)]


class Series:
    """A series in its directory.

    Parameters
    ----------
    directory : Path
        An empty one, or with ``resume`` that of a series that was begun.
    keep : bool
        Whether the directories of good trials stay. Those of others always do.

    Raises
    ------
    OutputError
        If the directory holds no series, or another one.
    """

    def __init__(
        self,
        directory: Path,
        plan: SeriesPlan,
        *,
        resume: bool = False,
        keep: bool = False,
    ) -> None:
        self._directory = directory
        self._plan = plan
        self._keep = keep
        self.outcomes: list[TrialOutcome] = []
        path = directory / PLAN_NAME
        if resume:
            self._require_same(path)
            self.outcomes = _read_outcomes(directory / TRIALS_NAME)
        else:
            text = msgspec.json.format(msgspec.json.encode(plan), indent=2)
            write_atomically(path, text + b"\n")

    def directory_of(self, trial: int) -> Path:
        """Return the directory of a trial's files."""
        return self._directory / f"trial-{trial:05}"

    def run(
        self,
        trials: int,
        jobs: int,
        on_start: Callable[[int, FaultKind], None],
        on_outcome: Callable[[TrialOutcome], None],
    ) -> None:
        """Run the trials that are missing; the callbacks run in this thread.

        Raises
        ------
        HoldfastError
            If a trial cannot be run at all.
        KeyboardInterrupt
            Once all processes have ended.
        """
        finished = {outcome.trial for outcome in self.outcomes}
        numbers = range(self._plan.first, self._plan.first + trials)
        missing = deque(trial for trial in numbers if trial not in finished)
        cancelled = threading.Event()
        pool = ThreadPoolExecutor(jobs, thread_name_prefix="chaos")
        running: set[Future[TrialOutcome]] = set()
        try:
            while missing or running:
                while missing and len(running) < jobs:
                    trial = missing.popleft()
                    on_start(trial, self._plan.of(trial)[1])
                    running.add(pool.submit(self._run_trial, trial, cancelled))
                done, running = wait(running, return_when=FIRST_COMPLETED)
                for each in done:
                    self._add(each.result())
                    on_outcome(self.outcomes[-1])
        finally:
            cancelled.set()
            pool.shutdown(cancel_futures=True)

    def _run_trial(self, trial: int, cancelled: threading.Event) -> TrialOutcome:
        directory = self.directory_of(trial)
        wire, kind = self._plan.of(trial)
        schedule = draw_schedule(self._plan.seed, trial, kind, wire, self._plan.possible)
        # An unfinished trial begins anew.
        shutil.rmtree(directory, ignore_errors=True)
        try:
            directory.mkdir()
            outcome = run_chaos_trial(schedule, directory, Pace(), cancelled)
        except OSError as error:
            raise OutputError(f"{directory}: cannot be written: {error.strerror}") from error
        except CancelledTrialError:
            shutil.rmtree(directory, ignore_errors=True)
            raise
        if outcome.verdict == "identical" and not self._keep:
            shutil.rmtree(directory, ignore_errors=True)
        return outcome

    def _add(self, outcome: TrialOutcome) -> None:
        self.outcomes.append(outcome)
        path = self._directory / TRIALS_NAME
        try:
            with path.open("ab") as file:
                file.write(msgspec.json.encode(outcome) + b"\n")
        except OSError as error:
            raise OutputError(f"{path}: cannot be written: {error.strerror}") from error

    def _require_same(self, path: Path) -> None:
        try:
            earlier = msgspec.json.decode(path.read_bytes(), type=SeriesPlan)
        except FileNotFoundError:
            raise OutputError(
                f"{path.parent}: holds no {PLAN_NAME}, so no series to go on with"
            ) from None
        except (OSError, msgspec.DecodeError) as error:
            raise OutputError(f"{path}: cannot be read: {error}") from error
        for key in SeriesPlan.__struct_fields__:
            old, new = getattr(earlier, key), getattr(self._plan, key)
            if old != new:
                raise OutputError(
                    f"{path.parent}: is a series with {key} {_written(old)}, not {_written(new)}; "
                    "go on with that, or choose another directory (--out)"
                )


def _written(value: object) -> str:
    if isinstance(value, Sequence) and not isinstance(value, str):
        return " ".join(map(str, value))
    return str(value)


def _read_outcomes(path: Path) -> list[TrialOutcome]:
    """Read the table; a last line that is not whole is cut off."""
    if not path.exists():
        return []
    try:
        content = path.read_bytes()
        whole = content.rfind(b"\n") + 1
        if whole < len(content):
            with path.open("rb+") as file:
                file.truncate(whole)
        decoder = msgspec.json.Decoder(TrialOutcome)
        return [decoder.decode(line) for line in content[:whole].splitlines()]
    except (OSError, msgspec.DecodeError) as error:
        raise OutputError(f"{path}: cannot be read: {error}") from error
