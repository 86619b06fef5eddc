"""Tuning: race configurations in the user's own simulated world, and judge the winner afresh.

A default is right for the problems on which it was chosen. A user's own problem can be simulated,
so what suits it can be measured: the candidates (:mod:`holdfast.tuning.candidates`) race
(:mod:`holdfast.tuning.race`), and the winner is judged on other trials beside the configuration as
it was and random sensing (:mod:`holdfast.tuning.verdict`).

A trial depends on its candidate and number alone, and each is kept as soon as it is finished. So a
tuning that goes on runs the same race again, with the trials that it has.

Trials run in processes of their own: a candidate that ends its process, or hangs, leaves the race.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from time import monotonic
from typing import Any, NamedTuple, get_args

import msgspec
import numpy as np

from holdfast.config.loader import Configuration, load
from holdfast.errors import InvalidValueError, TrialCrashError, TrialError, WorkerDiedError
from holdfast.journal.fingerprint import fingerprint
from holdfast.numerics.arrays import FloatArray, real_number, whole
from holdfast.printable import brief
from holdfast.robot.lost_values import remark_on_lost_values
from holdfast.robot.trial_pool import Arm, TrialPool
from holdfast.runtime.command_line import MAX_JOBS
from holdfast.runtime.files import shown_path
from holdfast.runtime.machine import available_cores
from holdfast.runtime.ray_workers import RayCluster
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
from holdfast.tuning.kept_trials import FRESH, TRIALS_NAME, KeptTrials, TrialRow
from holdfast.tuning.race import PILOT_TRIALS, MeasuredTrial, Standing, race
from holdfast.tuning.tuning_report import CandidateRow, Tuning, write_report
from holdfast.tuning.verdict import GO_ON, MUCH_SLOWER, cost_of, judge, mean_difference
from holdfast.validation import as_function, as_path, close_match

_SHARE_OF_THE_RACE = 0.6
_LEAST_FRESH = 20
_AT_MOST_OF_THE_RACE = 0.75  # where trials take longer than those before
_REPORT_S = 3.0
_JUDGED_ANYWAY = (AS_CONFIGURED, RANDOM)
_PATIENCE_S = 10.0  # no trial is ended sooner while there is time
_FAR_LONGER = 10.0  # times the longest possible trial, by the seconds per step seen so far
_FIRST_SHARE = 0.1  # of the budget: a first trial that takes longer leaves no time for ten
_MOST_REFUSED = 4  # of those that could not be tried, the sentence names so many


class Progress(NamedTuple):
    """How far a tuning is: seconds of its budget, trials, and what it does."""

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
    ray: str | None = None,
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
        How long it may take, but for the trials that run at its end. The race has three fifths.
    most : int
        Trials of a candidate in the race, and up to twice as many to judge.
    jobs : int, optional
        Processes; None: one for each core.
    ray : str, optional
        A Ray cluster whose cores run the trials: ``auto`` (of this machine), ``HOST:PORT`` or
        ``ray://HOST:PORT``. Nodes need the same holdfast, and the problem at the same path.
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
    TrialError, WorkerDiedError, TrialCrashError
        If trials of the configuration itself fail, end their process, or do not end.
    """
    if not isinstance(configuration, Configuration):
        kind = "a path, or what load_configuration returns"
        configuration = load(as_path("configuration", configuration, kind))
    vary = vary if isinstance(vary, list | tuple) else [vary]  # type: ignore[list-item]
    for each in vary:
        if not isinstance(each, str) or each not in VARIATIONS:
            allowed = ", ".join(VARIATIONS) + close_match(str(each), VARIATIONS)
            raise InvalidValueError(f"vary has {brief(each)}; allowed are {allowed}")
    as_function("on_progress", on_progress)
    most = whole("most", most, 2, FRESH - 1)
    jobs = None if jobs is None else whole("jobs", jobs, 1, MAX_JOBS)
    for name, value in (("budget_s", budget_s), ("max_decision_ms", max_decision_ms)):
        if (number := real_number(value)) is None or not number > 0.0:
            raise InvalidValueError(f"{name} is {brief(value)}; it must be a number above 0")
    if objective not in (None, *get_args(Objective)):
        allowed = ", ".join(get_args(Objective))
        raise InvalidValueError(f"objective is {brief(objective)}; allowed are {allowed}")
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
    began_s = monotonic()
    if check and not (out is not None and (out / TRIALS_NAME).exists()):
        require_right(configuration, budget_s)
    with contextlib.ExitStack() as stack:
        kept = stack.enter_context(KeptTrials(out, settings))
        cluster = None if ray is None else stack.enter_context(RayCluster(ray))
        cores = available_cores() if cluster is None else min(cluster.cores, MAX_JOBS)
        jobs = jobs or cores
        tuner = _Tuner(configuration, objective, kept, jobs, max_decision_ms, on_progress)
        with TrialPool(jobs, overdue=tuner.is_overdue, cluster=cluster) as tuner.pool:
            left_s = budget_s - _REPORT_S - (monotonic() - began_s)  # joining takes its time
            found = tuner.run(vary, most, max(0.5 * budget_s, left_s))
    if out is not None:
        write_report(out, configuration, found)
    return found


@dataclasses.dataclass
class _Tuner:
    """One tuning: its candidates, and the trials that are asked for of them."""

    base: Configuration
    objective: Objective
    kept: KeptTrials
    jobs: int
    max_decision_ms: float
    on_progress: Callable[[Progress], None]
    pool: TrialPool = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        self._limit = self.base.simulator.max_steps
        self._candidates: dict[str, Candidate] = {}
        self._arms: dict[str, Arm] = {}
        self._failed: dict[str, str] = {}
        self._killed: set[tuple[str, int]] = set()
        self._counted: set[tuple[str, int]] = set()
        self._longest_s: dict[str, float] = {}
        self._notes: dict[str, str] = {}  # of candidates in the race, whether and why not judged
        self._doing = ""
        self._began_s = monotonic()
        self._budget_s = self._until_s = math.inf

    def run(self, vary: Sequence[Variation], most: int, budget_s: float) -> Tuning:
        """Race and judge, within ``budget_s``."""
        self._budget_s = budget_s
        # What was run before has had its part of the budget.
        self._began_s -= self._seconds(key for key in self.kept.rows if key[1] < FRESH)
        candidates, refused = first_candidates(self.base, vary, self.objective)
        left_out = dict(refused)
        later = [each for each in vary if each in ("interval", "particles")]
        for_first = _SHARE_OF_THE_RACE * budget_s * (0.6 if later else 1.0)
        standings = self._race(candidates, refused, most, for_first)
        if later:
            winner = self._candidates[standings[0].candidate]
            others, refused = later_candidates(self.base, winner, later)
            more = self._race(others, refused, most, _SHARE_OF_THE_RACE * budget_s)
            standings = [*more, *(each for each in standings if each.candidate != winner.name)]
        finalists = self._finalists(standings)
        judged = self._judged(finalists)
        self._doing = f"{', '.join(finalists)}: judged on fresh trials"
        self._until_s = budget_s
        most_fresh = 2 * most
        wanted = [(name, FRESH + trial) for trial in range(most_fresh) for name in judged]
        self._began_s -= self._seconds(key for key in wanted if key in self.kept.rows)
        # Whether to go on depends on the time alone, never on what has come out.
        for _ in self._measured(wanted):
            pass
        judged = [name for name in judged if name not in self._failed]
        self._notes |= {name: "judged" for name in judged if name not in finalists}
        fresh = next(
            trial
            for trial in range(most_fresh + 1)
            if any((name, FRESH + trial) not in self.kept.rows for name in judged)
        )
        numbers = range(FRESH, FRESH + fresh)
        rows = {name: [self.kept.rows[name, trial] for trial in numbers] for name in judged}
        barred = {name for name in rows if self._refusal(name) is not None}
        least = min(most, _LEAST_FRESH)
        verdict = judge(rows, finalists, self.objective, self._limit, barred, least)
        sentence = verdict.sentence
        chosen = (row.lost_values for row in rows[verdict.choice])
        if lost := remark_on_lost_values([each.split("; ") if each else [] for each in chosen]):
            particles = 10 * self.base.planning.particle_filter.num_particles
            again = _words(self.base, {"particle_filter.num_particles": particles})
            sentence += f" But {lost}. More particles may gain more than any method: "
            sentence += f"holdfast tune {again}."
        if self.base.overrides:
            sentence += f" Your configuration, here, is {_words(self.base)}."
        several = len(self.base.problem.sensing_actions) > 1
        if several and "fixed" not in (*vary, self.base.planning.selector.method):
            fixed = f"holdfast tune {_words(self.base)} --vary methods,fixed"
            sentence += f" Always the same sensing action was not tried: {fixed} does that."
        left_out |= self._failed
        for name, reason in list(left_out.items())[:_MOST_REFUSED]:
            sentence += f" {name} was left out: {reason.splitlines()[0]}."
        late = {name for name, note in self._notes.items() if note.endswith("for lack of time")}
        few = [each for each in standings if each.trials < most or each.candidate in late]
        untried = sum(each.state == "set aside" and each.trials <= PILOT_TRIALS for each in few)
        unjudged = sum(each.state == "in the race" and each.candidate not in judged for each in few)
        sentence += _note(len(left_out) - _MOST_REFUSED, "left out, too: the table says why")
        sentence += _note(untried, "not tried: a larger budget does that")
        sentence += _note(unjudged, f"neither beaten nor judged: a larger budget {GO_ON}")
        return Tuning(
            sentence=sentence,
            choice=verdict.choice,
            changes=dict(self._candidates[verdict.choice].changes),
            matters=verdict.matters,
            objective=self.objective,
            fresh_trials=fresh,
            comparisons=verdict.comparisons,
            candidates=tuple(map(self._row, standings)),
        )

    def _spent_s(self) -> float:
        return monotonic() - self._began_s

    def _seconds(self, keys: Iterable[tuple[str, int]]) -> float:
        """Return how long kept trials took, over all processes."""
        return sum(self.kept.rows[key].seconds for key in keys) / self.jobs

    def _race(
        self, candidates: Sequence[Candidate], refused: Mapping[str, str], most: int, until_s: float
    ) -> list[Standing]:
        for each in candidates:
            self._add(each)
        names = [each.name for each in candidates]
        self._doing = f"{len(names)} candidates race"
        self._until_s = until_s * _AT_MOST_OF_THE_RACE / _SHARE_OF_THE_RACE
        raced = [key for key in self.kept.rows if key[0] in names and key[1] < FRESH]
        standings = race(
            names,
            self._measured,
            limit={"steps": float(self._limit), "success": 1.0}.get(self.objective),
            most=most,
            budget_s=self.jobs * (until_s - self._spent_s() + self._seconds(raced)),
            refuse=self._refusal,
        )
        if standings[0].state == "refused":
            raise InvalidValueError(
                f"no candidate is admitted: {standings[0].candidate}: {standings[0].reason}"
            )
        return standings + [
            Standing(name, 0, math.inf, math.inf, 0.0, "refused", reason)
            for name, reason in refused.items()
        ]

    def _finalists(self, standings: Sequence[Standing]) -> list[str]:
        """Return the winner, and one that may be as good, two if the winner is judged anyway."""
        winner = standings[0].candidate
        costs, equals = self._costs(winner), []
        for each in standings[1:]:
            own = self._costs(each.candidate)
            common = min(len(own), len(costs))
            if each.state != "in the race" or each.candidate in _JUDGED_ANYWAY or common < 2:
                continue
            differences = own[:common] - costs[:common]
            self._notes[each.candidate] = "not judged, the winner leads in common trials"
            if np.mean(differences) <= 2.0 * np.std(differences, ddof=1) / math.sqrt(common):
                equals.append(each.candidate)
        own_ms = self._decision_ms(winner) if equals else 0.0
        quick = [name for name in equals if MUCH_SLOWER * self._decision_ms(name) <= own_ms]
        each_s = {each.candidate: each.seconds for each in standings}
        found = [winner]
        for name in dict.fromkeys([*quick[:1], *equals]):
            judged = self._judged([*found, name])
            needed_s = 3 * _LEAST_FRESH * sum(each_s.get(each, 0.0) for each in judged)
            has_room = len(found) < 2 + (winner in _JUDGED_ANYWAY)
            why = "for lack of time" if has_room else "others were chosen"
            self._notes[name] = f"not judged, {why}"
            if has_room and needed_s <= self.jobs * (self._budget_s - self._spent_s()):
                found.append(name)
        self._notes |= dict.fromkeys(found, "a finalist")
        return found

    def _add(self, candidate: Candidate) -> None:
        if candidate.name not in self._candidates:
            self._candidates[candidate.name] = candidate
            self._arms[candidate.name] = Arm.of(candidate.configuration, candidate.name)

    def _judged(self, finalists: Sequence[str]) -> list[str]:
        """Return whom the fresh trials judge, the configuration first."""
        rivals = dict.fromkeys((AS_CONFIGURED, *finalists))
        own = self.base.planning.selector.method
        if own != "random":
            rivals[RANDOM] = None
        if own not in ("random", DEFAULT) and DEFAULT in self._candidates:
            rivals[DEFAULT] = None
        for finalist in finalists:
            own_keys = self._candidates[finalist].changes
            others = {key: own_keys[key] for key in own_keys if not key.startswith("selector.")}
            if others:
                # It must not be that the particles or the interval do it, and not what is sensed.
                changes = others | {"selector.method": "random"}
                name = f"random,{finalist.rpartition(',')[2]}"
                self._add(Candidate(name, changed(self.base, changes), changes))
                rivals[name] = None
        return [name for name in rivals if name not in self._failed]

    def _refusal(self, name: str) -> str | None:
        """Return why a candidate must not win."""
        if name in self._failed or not self.kept.of(name):
            return self._failed.get(name)
        own_ms, most_ms = self._decision_ms(name), self.max_decision_ms
        if own_ms <= most_ms:
            return None
        return f"a decision takes {own_ms:.3g} ms, and at most {most_ms:g} were asked for"

    def is_overdue(self, arm: Arm, ran_s: float) -> bool:
        """Return whether a trial that has run so long is to be ended."""
        longest_s = self._longest_s.get(arm.label)
        if arm.label in self._failed or (
            self._spent_s() > self._until_s and max(0.0, ran_s) >= (longest_s or 0.0)
        ):
            return True
        first_s = _FIRST_SHARE * self._budget_s
        return ran_s > max(_PATIENCE_S, first_s if longest_s is None else _FAR_LONGER * longest_s)

    def _measured(self, jobs: Sequence[tuple[str, int]]) -> Iterator[MeasuredTrial]:
        """Run trials while there is time, or take those that are kept.

        Those of a candidate that fails are left out.
        """
        missing = [key for key in jobs if key not in self.kept.rows]
        yield from [self._count(self.kept.rows[key]) for key in jobs if key in self.kept.rows]
        more = (
            (self._arms[name], trial)
            for name, trial in missing
            if name not in self._failed and self._spent_s() < self._until_s
        )
        while True:
            try:
                for finished in self.pool.run(more):
                    result = finished.result
                    row = TrialRow(
                        finished.arm.label,
                        finished.trial,
                        result.success,
                        result.failed,
                        "; ".join(finished.lost_values),
                        result.steps,
                        result.reward,
                        float(np.median(result.sensing_ms)) if result.sensing_ms else 0.0,
                        finished.elapsed_s,
                    )
                    self.kept.add(row)
                    yield self._count(row)
                    if self._spent_s() >= self._until_s:
                        self.pool.drop()
            except (TrialError, TrialCrashError, WorkerDiedError) as error:
                self._leave_out(error)
            else:
                return

    def _leave_out(self, error: TrialError | TrialCrashError | WorkerDiedError) -> None:
        """Take a candidate out of the race; raise the error if it is the configuration itself."""
        arm = error.arm
        assert isinstance(arm, Arm)
        name, reason = arm.label, f"it fails: {error}"
        if isinstance(error, TrialCrashError):
            reason = f"it fails: {' '.join(str(error).splitlines()[-2:])}"
        if isinstance(error, WorkerDiedError):
            reason = f"it died: its process {error.how} in trial {error.trial % FRESH}"
            if error.overdue and self._spent_s() > self._until_s:
                self.pool.drop()  # time is up, and nobody's fault
                return
            if error.overdue:
                kind = "it hangs" if name in self._longest_s else "it is too slow, or hangs"
                reason = f"{kind}: trial {error.trial % FRESH} {error.how}"
            elif error.killed and (name, error.trial) not in self._killed:
                # Whoever killed it may have meant another one, if memory was short.
                self._killed.add((name, error.trial))
                self.pool.submit(arm, error.trial)
                return
        if name == AS_CONFIGURED and isinstance(error, WorkerDiedError):
            raise WorkerDiedError(f"your configuration: {reason}") from error
        if name == AS_CONFIGURED:
            raise error
        self._failed.setdefault(name, reason)
        self.pool.drop(arm)

    def _count(self, row: TrialRow) -> MeasuredTrial:
        key = row.candidate, row.trial
        if key not in self._counted:
            self._counted.add(key)
            possible_s = row.seconds * self._limit / max(1, row.steps)
            self._longest_s[key[0]] = max(self._longest_s.get(key[0], 0.0), possible_s)
        self.on_progress(Progress(self._spent_s(), len(self._counted), self._doing))
        cost = cost_of(row, self.objective, self._limit)
        return MeasuredTrial(row.candidate, row.trial, cost, row.seconds)

    def _costs(self, name: str) -> FloatArray:
        """Return what the trials of the race cost, in order."""
        return np.array([cost_of(row, self.objective, self._limit) for row in self.kept.of(name)])

    def _decision_ms(self, name: str) -> float:
        return float(np.median([row.decision_ms for row in self.kept.of(name)]))

    def _row(self, standing: Standing) -> CandidateRow:
        name = standing.candidate
        changes = dict(self._candidates[name].changes) if name in self._candidates else {}
        reason = standing.reason or self._notes.get(name, "")
        state = " ".join(f"{standing.state}{': ' * bool(reason)}{reason}".split())
        rows = self.kept.of(name)[: standing.trials]
        costs, base = self._costs(name)[: len(rows)], self._costs(AS_CONFIGURED)
        common = min(len(costs), len(base))
        plain = CandidateRow(candidate=name, changes=changes, trials=len(rows), state=state)
        if common <= PILOT_TRIALS:
            return plain
        difference, interval = mean_difference(costs[:common] - base[:common])
        return msgspec.structs.replace(
            plain,
            cost=float(np.mean(costs)),
            difference=difference,
            interval=interval,
            success=float(np.mean([row.success for row in rows])),
            decision_ms=self._decision_ms(name),
            trial_s=standing.seconds,
        )


def _words(base: Configuration, more: Mapping[str, Any] | None = None) -> str:
    """Return the words for a configuration, with what was given instead of the file's values."""
    words = [shown_path(base.path)]
    for key, value in {**base.overrides, **(more or {})}.items():
        text = msgspec.json.encode(value).decode()
        words += ["--problem", value] if key == "problem" else ["--set", f"{key}={text}"]
    return shlex.join(words)


def _note(count: int, rest: str) -> str:
    what = "candidate was" if count == 1 else "candidates were"
    return f" {count} more {what} {rest}." if count > 0 else ""
