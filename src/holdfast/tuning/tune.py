"""Tuning: race configurations in the user's own simulated world, and judge the winner afresh.

A default is right for the problems on which it was chosen. A user's own problem can be simulated,
so what suits it can be measured: the candidates (:mod:`holdfast.tuning.candidates`) race
(:mod:`holdfast.tuning.race`), and the winner is judged on other trials beside the configuration as
it was and random sensing (:mod:`holdfast.tuning.verdict`).

A trial depends on its candidate and number alone, and each is kept as soon as it is finished. So a
tuning that goes on runs the same race again, with the trials that it has.
"""

from __future__ import annotations

import contextlib
import csv
import fcntl
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, NamedTuple, get_args

import msgspec
import numpy as np

from holdfast.config.loader import Configuration, load
from holdfast.errors import InvalidValueError, OutputError, TrialError
from holdfast.numerics.arrays import real_number, whole
from holdfast.recording.fingerprint import fingerprint
from holdfast.recording.run_directory import first_difference
from holdfast.recording.table_formats import csv_rows
from holdfast.robot.trial_pool import Arm, TrialPool, available_cores
from holdfast.runtime.command_line import MAX_JOBS
from holdfast.runtime.files import shown_path, write_atomically
from holdfast.tuning.candidates import (
    AS_CONFIGURED,
    BY_DEFAULT,
    DEFAULT,
    RANDOM,
    VARIATIONS,
    Candidate,
    Objective,
    Variation,
    changed,
    first_candidates,
    has_rewards,
    later_candidates,
)
from holdfast.tuning.check_process import require_right
from holdfast.tuning.race import PILOT_TRIALS, MeasuredTrial, Standing, race
from holdfast.tuning.tuning_report import CandidateRow, Tuning, write_report
from holdfast.tuning.verdict import TrialRow, cost_of, judge, mean_difference
from holdfast.validation import as_function, as_path

__all__ = ["Progress", "tune"]

FRESH = 1_000_000
"""Number of the first trial that judges; those of the race are below it."""

TRIALS_NAME = "trials.csv"
SETTINGS_NAME = "tune.json"

_SHARE_OF_THE_RACE = 0.6
_LEAST_FRESH = 20


class Progress(NamedTuple):
    """How far a tuning is: seconds of work over the processes, trials, and what it does."""

    spent_s: float
    trials: int
    doing: str


def tune(
    configuration: Configuration | str | Path,
    *,
    vary: Sequence[Variation] = BY_DEFAULT,
    objective: Objective | None = None,
    budget_s: float = 600.0,
    most: int = 200,
    jobs: int | None = None,
    max_decision_ms: float = math.inf,
    check: bool = True,
    out: str | Path | None = None,
    on_progress: Callable[[Progress], None] = lambda _: None,
) -> Tuning:
    """Find what to sense on a problem, by simulating it.

    Parameters
    ----------
    configuration : Configuration or path
        Its world is simulated; its services and environment have no part in it.
    vary : sequence of Variation
        What is tried: ``methods``, ``looks`` (of ``expected_return``), ``resolution`` (three and
        ten times), ``estimators``, ``fixed`` (always one sensing action); then, of the winner,
        ``interval`` and ``particles``.
    objective : {"reward", "steps", "success"}, optional
        None: ``reward`` if sensing has prices, else ``steps``.
    budget_s : float
        About how long it may take. The race has three fifths of it.
    most : int
        Trials of a candidate in the race, and as many to judge.
    jobs : int, optional
        Processes; None: one for each core.
    max_decision_ms : float
        A candidate whose median decision takes longer must not win.
    check : bool
        Whether the problem is checked first (:func:`hf.check_problem`), for a tenth of the budget
        and at most 20 s; not if ``out`` has trials of this tuning.
    out : path, optional
        A directory for the files; if it has trials of the same tuning, it goes on with these.

    Raises
    ------
    InvalidValueError
        If a value does not fit.
    OutputError
        If ``out`` belongs to something else, or cannot be written.
    ProblemError
        If the check finds an error.
    TrialError
        If the trials of the configuration itself fail.
    """
    if not isinstance(configuration, Configuration):
        configuration = load(as_path("configuration", configuration))
    for each in vary if isinstance(vary, list | tuple) else [vary]:
        if not isinstance(each, str) or each not in VARIATIONS:
            allowed = ", ".join(VARIATIONS)
            raise InvalidValueError(f"vary has {each!r:.80}; allowed are {allowed}")
    as_function("on_progress", on_progress)
    most = whole("most", most, 2, FRESH - 1)
    jobs = available_cores() if jobs is None else whole("jobs", jobs, 1, MAX_JOBS)
    for name, value in (("budget_s", budget_s), ("max_decision_ms", max_decision_ms)):
        number = real_number(value)
        if number is None or not number > 0.0:
            raise InvalidValueError(f"{name} is {value!r:.80}; it must be a number above 0")
    if objective not in (None, *get_args(Objective)):
        allowed = ", ".join(get_args(Objective))
        raise InvalidValueError(f"objective is {objective!r:.80}; allowed are {allowed}")
    out = None if out is None else as_path("out", out)
    if objective is None:
        priced = getattr(configuration.problem, "sensing_costs", None) is not None
        objective = "reward" if priced else "steps"
    if objective == "reward" and not has_rewards(configuration.problem):
        raise InvalidValueError(
            f"objective is 'reward', but {configuration.problem_name} has neither rewards nor "
            "sensing_costs; take 'steps' or 'success'"
        )
    settings = {
        "configuration": configuration.plain()["configuration"],
        "objective": objective,
        "max_decision_ms": None if math.isinf(max_decision_ms) else max_decision_ms,
        "code": fingerprint(configuration),
    }
    if check and not (out is not None and (out / TRIALS_NAME).exists()):
        require_right(configuration, budget_s)
    with _Trials(out, settings) as kept, TrialPool(jobs) as pool:
        tuner = _Tuner(configuration, objective, kept, pool, max_decision_ms, on_progress)
        found = tuner.run(vary, most, budget_s * jobs)
    if out is not None:
        write_report(out, configuration, found)
    return found


class _Tuner:
    """One tuning: its candidates, and the trials that are asked for of them."""

    def __init__(
        self,
        base: Configuration,
        objective: Objective,
        kept: _Trials,
        pool: TrialPool,
        max_decision_ms: float,
        on_progress: Callable[[Progress], None],
    ) -> None:
        self._base = base
        self._objective = objective
        self._kept = kept
        self._pool = pool
        self._max_decision_ms = max_decision_ms
        self._on_progress = on_progress
        self._limit = base.simulator.max_steps
        self._candidates: dict[str, Candidate] = {}
        self._arms: dict[str, Arm] = {}
        self._failed: dict[str, str] = {}
        self._counted: set[tuple[str, int]] = set()
        self._spent_s = 0.0
        self._doing = ""

    def run(self, vary: Sequence[Variation], most: int, budget_s: float) -> Tuning:
        """Race and judge; ``budget_s`` is of a processor."""
        candidates, refused = first_candidates(self._base, vary, self._objective)
        later = [each for each in vary if each in ("interval", "particles")]
        for_first = _SHARE_OF_THE_RACE * budget_s * (0.6 if later else 1.0)
        standings = self._race(candidates, refused, most, for_first)
        if later:
            winner = self._candidates[standings[0].candidate]
            others, refused = later_candidates(self._base, winner, later)
            more = self._race(others, refused, most, _SHARE_OF_THE_RACE * budget_s)
            standings = [*more, *(each for each in standings if each.candidate != winner.name)]
        finalist = self._candidates[standings[0].candidate]
        judged = self._judged(finalist)
        self._doing = f"{finalist.name} is judged on fresh trials"
        fresh = 0
        # Whether to go on depends on the time alone, never on what has come out.
        while fresh < most and (fresh < _LEAST_FRESH or self._spent_s < budget_s):
            block = range(fresh, min(fresh + _LEAST_FRESH, most))
            for _ in self._measured([(name, FRESH + n) for n in block for name in judged]):
                pass
            fresh = block.stop
        rows = {
            name: [self._kept.rows[name, FRESH + trial] for trial in range(fresh)]
            for name in judged
            if name not in self._failed
        }
        barred = {name for name in rows if self._refusal(name) is not None}
        verdict = judge(rows, finalist.name, self._objective, self._limit, barred)
        untried = sum(
            each.state == "set aside" and each.trials <= PILOT_TRIALS for each in standings
        )
        sentence = verdict.sentence
        if untried:
            what = "candidate was" if untried == 1 else "candidates were"
            sentence += f" {untried} slow {what} not tried: a larger budget does that."
        open_ones = sum(
            each.state == "in the race" and each.candidate not in judged for each in standings
        )
        if open_ones and fresh < most:
            what = "candidate is" if open_ones == 1 else "candidates are"
            sentence += (
                f" {open_ones} more {what} not beaten yet: --resume with a larger budget goes on."
            )
        return Tuning(
            sentence=sentence,
            choice=verdict.choice,
            changes=dict(self._candidates[verdict.choice].changes),
            matters=verdict.matters,
            objective=self._objective,
            fresh_trials=fresh,
            comparisons=verdict.comparisons,
            candidates=tuple(map(self._row, standings)),
        )

    def _race(
        self,
        candidates: Sequence[Candidate],
        refused: Mapping[str, str],
        most: int,
        until_s: float,
    ) -> list[Standing]:
        for each in candidates:
            self._add(each)
        names = [each.name for each in candidates]
        of_them = {key for key in self._counted if key[0] in names}
        before_s = sum(self._kept.rows[key].seconds for key in of_them)
        self._doing = f"{len(names)} candidates race"
        standings = race(
            names,
            self._measured,
            limit={"steps": float(self._limit), "success": 1.0}.get(self._objective),
            most=most,
            budget_s=until_s - self._spent_s + before_s,
            refuse=self._refusal,
        )
        if standings[0].state == "refused":
            raise InvalidValueError(
                f"no candidate is admitted: {standings[0].candidate}: {standings[0].reason}"
            )
        nothing = Standing("", 0, math.inf, math.inf, 0.0, "refused", "")
        return standings + [
            nothing._replace(candidate=name, reason=reason) for name, reason in refused.items()
        ]

    def _add(self, candidate: Candidate) -> None:
        if candidate.name not in self._candidates:
            self._candidates[candidate.name] = candidate
            self._arms[candidate.name] = Arm.of(candidate.configuration, candidate.name)

    def _judged(self, finalist: Candidate) -> list[str]:
        """Return whom the fresh trials judge, the configuration first."""
        rivals = {AS_CONFIGURED: None, finalist.name: None}
        own = self._base.planning.selector.method
        if own != "random":
            rivals[RANDOM] = None
        if own not in ("random", DEFAULT) and DEFAULT in self._candidates:
            rivals[DEFAULT] = None
        others = {
            key: value for key, value in finalist.changes.items() if not key.startswith("selector.")
        }
        if others:
            # It must not be that the particles or the interval do it, and not what is sensed.
            changes = others | {"selector.method": "random"}
            name = f"random,{finalist.name.rpartition(',')[2]}"
            self._add(Candidate(name, changed(self._base, changes), changes))
            rivals[name] = None
        return [name for name in rivals if name not in self._failed]

    def _refusal(self, name: str) -> str | None:
        """Return why a candidate must not win."""
        rows = self._kept.of(name)
        if rows and name not in self._failed:
            decision_ms = float(np.median([row.decision_ms for row in rows]))
            if decision_ms > self._max_decision_ms:
                return (
                    f"a decision takes {decision_ms:.3g} ms, and at most "
                    f"{self._max_decision_ms:g} were asked for"
                )
        return self._failed.get(name)

    def _measured(self, jobs: Sequence[tuple[str, int]]) -> Iterator[MeasuredTrial]:
        """Run trials, or take those that are kept; leave out those of a candidate that fails."""
        missing = []
        for name, trial in jobs:
            row = self._kept.rows.get((name, trial))
            if row is None:
                missing.append((name, trial))
            else:
                yield self._count(row)
        more = ((self._arms[name], trial) for name, trial in missing if name not in self._failed)
        while True:
            try:
                for finished in self._pool.run(more):
                    result = finished.result
                    row = TrialRow(
                        finished.arm.label,
                        finished.trial,
                        result.success,
                        result.failed,
                        result.steps,
                        result.reward,
                        float(np.median(result.sensing_ms)) if result.sensing_ms else 0.0,
                        finished.elapsed_s,
                    )
                    self._kept.add(row)
                    yield self._count(row)
            except TrialError as error:
                arm = error.arm
                if not isinstance(arm, Arm) or arm.label == AS_CONFIGURED:
                    raise
                self._failed[arm.label] = f"it fails: {error}"
                self._pool.drop(arm)
            else:
                return

    def _count(self, row: TrialRow) -> MeasuredTrial:
        key = row.candidate, row.trial
        if key not in self._counted:
            self._counted.add(key)
            self._spent_s += row.seconds
        self._on_progress(Progress(self._spent_s, len(self._counted), self._doing))
        cost = cost_of(row, self._objective, self._limit)
        return MeasuredTrial(row.candidate, row.trial, cost, row.seconds)

    def _row(self, standing: Standing) -> CandidateRow:
        name = standing.candidate
        changes = dict(self._candidates[name].changes) if name in self._candidates else {}
        state = f"{standing.state}{': ' * bool(standing.reason)}{standing.reason}"
        rows = self._kept.of(name)[: standing.trials]
        if len(rows) <= PILOT_TRIALS:
            return CandidateRow(candidate=name, changes=changes, trials=len(rows), state=state)
        costs, base = (
            np.array([cost_of(row, self._objective, self._limit) for row in each[: len(rows)]])
            for each in (rows, self._kept.of(AS_CONFIGURED))
        )
        common = min(len(costs), len(base))
        difference, interval = mean_difference(costs[:common] - base[:common])
        return CandidateRow(
            candidate=name,
            changes=changes,
            trials=len(rows),
            cost=float(np.mean(costs)),
            difference=difference,
            interval=interval,
            success=float(np.mean([row.success for row in rows])),
            decision_ms=float(np.median([row.decision_ms for row in rows])),
            trial_s=standing.seconds,
            state=state,
        )


class _Trials:
    """The trials that are finished, in memory and, if there is a directory, in its file.

    Attributes
    ----------
    rows : dict
        By candidate and number.
    """

    def __init__(self, directory: Path | None, settings: Mapping[str, Any]) -> None:
        self.rows: dict[tuple[str, int], TrialRow] = {}
        self._directory = directory
        self._settings = settings
        self._file: IO[str] | None = None

    def __enter__(self) -> _Trials:
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
            self._require_the_same(directory / SETTINGS_NAME)
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

    def _require_the_same(self, path: Path) -> None:
        settings = msgspec.to_builtins(self._settings)
        try:
            there = msgspec.json.decode(path.read_bytes())
        except FileNotFoundError:
            if self.rows:
                raise OutputError(
                    f"{shown_path(path)}: is gone, so nothing tells of which tuning the trials of "
                    f"{TRIALS_NAME} are; choose another directory"
                ) from None
            content = msgspec.json.format(msgspec.json.encode(settings), indent=2)
            write_atomically(path, content)
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
        try:
            ((name, trial, success, failed, steps, reward, *times),) = csv.reader([line])
            decision_ms, seconds = map(float, times)
            if not 0.0 <= decision_ms + seconds < math.inf:
                continue
            yield TrialRow(
                name,
                int(trial),
                success == "1",
                failed == "1",
                int(steps),
                float(reward) if reward else None,
                decision_ms,
                seconds,
            )
        except (ValueError, csv.Error):
            continue  # the head, or a damaged row
