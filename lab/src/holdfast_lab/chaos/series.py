"""A series of trials, and its file on the disk, which gets a line with each.

Trials are independent, so several may run at the same time; each has a thread here that drives its
testbed.
"""

from __future__ import annotations

import shutil
import threading
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import NamedTuple

import msgspec

from holdfast.errors import OutputError
from holdfast_lab.chaos.schedule import Wire, draw_schedule, kinds_over
from holdfast_lab.chaos.trial import Pace, TrialOutcome, run_chaos_trial
from holdfast_lab.errors import CancelledTrialError
from holdfast_lab.testbed.faults import FaultKind

TRIALS_NAME = "trials.jsonl"


class SeriesPlan(NamedTuple):
    """What each trial of a series is."""

    seed: int
    wires: tuple[Wire, ...]  # trial n is over wire n modulo their number
    # The trials over each wire are of one kind after another; each wire begins with another one.
    kinds: tuple[FaultKind, ...]
    possible: tuple[FaultKind, ...]  # the kinds that this machine can inject, for combinations

    def of(self, trial: int) -> tuple[Wire, FaultKind]:
        """Return the wire and the kind of a trial."""
        turn, place = divmod(trial, len(self.wires))
        wire = self.wires[place]
        kinds = kinds_over(wire, self.kinds)
        return wire, kinds[(turn + place * len(kinds) // len(self.wires)) % len(kinds)]


class Series:
    """A series in a directory, which is empty; ``outcomes`` come in the order in which trials end.

    With ``keep`` the directories of good trials stay. Those of others always do.
    """

    def __init__(self, directory: Path, plan: SeriesPlan, *, keep: bool = False) -> None:
        self._directory = directory
        self.plan = plan
        self._keep = keep
        self.outcomes: list[TrialOutcome] = []

    @property
    def wrong(self) -> list[TrialOutcome]:
        """The outcomes that are not identical with their reference runs, by trial."""
        found = [outcome for outcome in self.outcomes if outcome.verdict != "identical"]
        return sorted(found, key=lambda outcome: outcome.trial)

    def directory_of(self, trial: int) -> Path:
        """Return the directory of a trial's files."""
        return self._directory / f"trial-{trial:05}"

    def run(
        self,
        trials: Sequence[int],
        jobs: int,
        on_outcome: Callable[[TrialOutcome], None],
    ) -> None:
        """Run trials; what gets each outcome runs in this thread.

        Raises HoldfastError if a trial cannot be run at all, and KeyboardInterrupt once all
        processes have ended.
        """
        missing = deque(trials)
        cancelled = threading.Event()
        pool = ThreadPoolExecutor(jobs, thread_name_prefix="chaos")
        running: set[Future[TrialOutcome]] = set()
        try:
            while missing or running:
                while missing and len(running) < jobs:
                    running.add(pool.submit(self._run_trial, missing.popleft(), cancelled))
                done, running = wait(running, return_when=FIRST_COMPLETED)
                for each in done:
                    self._add(each.result())
                    on_outcome(self.outcomes[-1])
        finally:
            cancelled.set()
            pool.shutdown(cancel_futures=True)

    def _run_trial(self, trial: int, cancelled: threading.Event) -> TrialOutcome:
        directory = self.directory_of(trial)
        wire, kind = self.plan.of(trial)
        schedule = draw_schedule(self.plan.seed, trial, kind, wire, self.plan.possible)
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
