"""A recorded run, planned again: what was believed, sensed and done, and when.

A journal holds decisions, not beliefs: those would be a thousand times larger, and decisions are a
function of seed, trial and observations. So each trial is run again with the planner in this
process, and every decision is compared, bit for bit, with the recorded one before it is passed on
as a fact (:mod:`holdfast.reports.facts`).

A simulated world is a function of the seed as well, so its true states are facts, too. What a
robot's own world has shown is in the journal.
"""

from __future__ import annotations

import contextlib
import math
import shlex
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Self

from holdfast.config.loader import Configuration
from holdfast.errors import DecidedOtherwiseError, HoldfastError, OutputError, UntrustedCodeError
from holdfast.journal.fingerprint import difference, fingerprint
from holdfast.journal.journal_reader import JournalReader, UnfinishedTrial
from holdfast.journal.run_directory import recorded_configuration
from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.floating_mode import in_own_mode
from holdfast.planning.inputs import ActingRecord
from holdfast.planning.outcome import TrialResult
from holdfast.planning.planner import Planner, PlanningState
from holdfast.printable import one_line
from holdfast.protocol.robot_events import Timing
from holdfast.reports.facts import (
    EventFact,
    FactSink,
    LateFact,
    SensingFact,
    TaskFact,
    TrialBeginFact,
    TrialEndFact,
)
from holdfast.reports.recorder import true_state
from holdfast.reports.step_times import StepClock, TrialTimes, read_times, trial_ends
from holdfast.robot.environment import Environment
from holdfast.robot.recomputing import ComparedTrial, RecordedTrials
from holdfast.robot.trial import NULL_OBSERVER, LateStep, SensingStep, TaskStep, TrialObserver


class RecordedRun:
    """A recorded run, open to be read; to be used in a ``with`` statement.

    ``run`` is its directory, or its journal. It is not changed, and a run may go on meanwhile. A
    record names no code that is run: where its problem is a class of a module (``module:Class``),
    the caller says in which directory that module lies, and so that its code may run. Raises
    OutputError if it is no run, or damaged; UntrustedCodeError if its problem is a class of a
    module, and nobody says where that lies; HoldfastError if its problem cannot be built any more.

    ``configuration`` has the settings that decide, no services and no environment. ``trials`` are
    all that have facts, in order: the finished ones, and the unfinished one. ``has_times`` is
    whether facts have the robot's times: none has, if the table of times lacks the trials
    ``untimed`` although it has others. ``clock_notes`` say how the robot's wall clock was set while
    it ran. ``observer`` gets the steps of what is replayed, beside the facts.
    """

    observer: TrialObserver = NULL_OBSERVER

    def __init__(
        self, run: Path, purpose: str = "export", *, problem_directory: Path | None = None
    ) -> None:
        self.path = run
        with contextlib.ExitStack() as stack:
            self.journal = stack.enter_context(JournalReader.read_run(run, purpose))
            path = self.journal.path
            self._meta = self.journal.meta()
            self.configuration, simulated = _configuration(
                self._meta, path, purpose, problem_directory
            )
            self._recorded = RecordedTrials(
                self.journal, self.configuration, world_is_simulated=simulated
            )
            self._begun = self.journal.unfinished()
            self.unfinished = None if self._begun is None else self._begun.trial
            trials = self.journal.finished()
            if self.unfinished is not None:
                trials.add(self.unfinished)
            self.trials = tuple(sorted(trials))
            self._rows, self._events, self.clock_notes = read_times(path.parent)
            self._ends = trial_ends(self._events)
            # All facts have one clock: if one trial has no times, those of the others are of no
            # use. A trial in which nothing was decided needs none.
            lacking = [
                result.trial
                for result in self.journal.results()
                if result.steps and result.trial not in self._rows
            ]
            self.has_times = bool(self._rows) and not lacking
            self.untimed = tuple(lacking) if self._rows else ()
            self._close = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._close.close()

    def replay(self, trials: Sequence[int], sinks: Sequence[FactSink]) -> Iterator[int]:
        """Write the facts of some trials to each sink, and yield each trial's number at its end.

        ``trials`` ascend; in a run without times each step takes 0.1 s. Raises OutputError if a
        trial is damaged, or of a robot's own world whose observations were not kept; HoldfastError
        if a trial is decided otherwise when it is run again.
        """
        clock = StepClock()
        chosen = set(trials)
        events = self._events if self.has_times else []
        output = _Output(sinks, events, with_others=chosen.issuperset(self.trials))
        begun = self._begun if self._begun is not None and self._begun.trial in chosen else None
        for result in self.journal.results(with_decisions=True):
            if begun is not None and begun.trial < result.trial:
                yield self._replay(begun, output, clock)
                begun = None
            if result.trial in chosen:
                yield self._replay(result, output, clock)
        if begun is not None:
            yield self._replay(begun, output, clock)
        output.at(math.inf, between_trials=True)

    def _replay(
        self, recorded: TrialResult | UnfinishedTrial, output: _Output, clock: StepClock
    ) -> int:
        facts = _Facts(recorded, output, self._recorded.planner, self.observer)
        facts.times = self._times(facts, clock)
        try:
            if not self._recorded.run(recorded, facts):
                raise OutputError(
                    f"{self.path}: trial {recorded.trial} cannot be computed again: this run is "
                    "older than the keeping of what an environment of your own has shown; --trials "
                    "leaves it out"
                )
        except DecidedOtherwiseError as error:
            # Most likely the code has changed.
            changed = difference(self._meta, fingerprint(self.configuration))
            because = "" if changed is None else f" ({changed.words})"
            raise HoldfastError(f"{error}{because}; --trials leaves it out") from error
        facts.end_here()
        return recorded.trial

    def _times(self, facts: _Facts, clock: StepClock) -> TrialTimes:
        trial, steps = facts.trial, sum(isinstance(each, ActingRecord) for each in facts.expected)
        rows = self._rows.get(trial, {}) if self.has_times else {}
        times = clock.next_trial(steps, rows, self._ends.get(trial))
        deciders = {key: row.timing for key, row in rows.items()}
        current: Timing | None = None
        for step in range(steps):
            asked = deciders.get((step, "task"))
            if asked is not None:
                # An answer has the task actions up to the next sensing step.
                current = asked._replace(
                    waited_ms=0.0, round_trip_ms=math.nan, computed_ms=math.nan
                )
            elif (step, "sensing") in deciders:
                current = None
            elif current is not None:
                deciders[step, "task"] = current
        return TrialTimes(times, deciders)


class _Facts(ComparedTrial):
    """Writes the facts of a trial that is run again."""

    times: TrialTimes

    def __init__(
        self,
        recorded: TrialResult | UnfinishedTrial,
        output: _Output,
        planner: Planner,
        observer: TrialObserver,
    ) -> None:
        super().__init__(recorded, observer=observer)
        self._planner = planner
        self._output = output
        self._steps = 0
        self._sensed_step = -1
        self._state: PlanningState | None = None
        self._true_state: FloatArray | None = None

    def trial_began(self, environment: Environment, state: PlanningState) -> None:
        super().trial_began(environment, state)
        self._state = state
        self._true_state = true_state(environment)
        begin = TrialBeginFact(self.trial, self.times.at(0, 0))
        for sink in self._output.at(begin.time_ns, between_trials=True):
            sink.trial_begins(begin)

    @in_own_mode
    def sensed(self, step: SensingStep) -> None:
        super().sensed(step)
        number, times = step.before.step, self.times
        decider = times.deciders.get((number, "sensing"))
        fact = SensingFact(step, times.at(number, 0), times.at(number, 1), decider)
        for sink in self._output.at(fact.decided_ns):
            sink.sensed(fact)
        self._state = step.after
        self._sensed_step = number

    @in_own_mode
    def acted(self, step: TaskStep) -> None:
        super().acted(step)
        number = step.state.step
        decider = self.times.deciders.get((number, "task"))
        fact = TaskFact(step, self.times.at(number, 2), decider, self._true_state)
        for sink in self._output.at(fact.time_ns):
            sink.acted(fact)
        self._true_state = true_state(step.environment)
        self._steps = number + 1
        self._state = None  # the next one is not known before something is done in it

    @in_own_mode
    def observed_late(self, step: LateStep) -> None:
        number = step.after.step
        # With the move before, or, if the robot was killed meanwhile, after it has sensed again.
        moment = (number, 1) if self._sensed_step == number else (number - 1, 3)
        if self._state is not None:
            self._state = step.after
        fact = LateFact(step, self.times.at(*moment))
        for sink in self._output.at(fact.time_ns):
            sink.observed_late(fact)

    def reinitialised(self, state: PlanningState) -> None:
        if self._state is not None:
            self._state = state

    def trial_ended(self, state: PlanningState, result: TrialResult) -> None:
        super().trial_ended(state, result)
        self._state = state

    @in_own_mode
    def end_here(self) -> None:
        belief = None if self._state is None else self._state.belief
        end = TrialEndFact(
            trial=self.trial,
            time_ns=self.times.at(self._steps, 3 if self.result is None else 0),
            steps=self._steps,
            result=self.result,
            belief=belief,
            estimate=None if self._state is None else self._planner.estimate(self._state),
            true_state=self._true_state,
        )
        for sink in self._output.at(end.time_ns):
            sink.trial_ends(end)


class _Output:
    """The sinks, which also get the events of the services, in order, between the facts.

    Events outside of the replayed trials are written only ``with_others``.
    """

    def __init__(
        self, sinks: Sequence[FactSink], events: Sequence[EventFact], *, with_others: bool
    ) -> None:
        self._sinks = sinks
        self._events = deque(events)
        self._with_others = with_others

    def at(self, time_ns: float, *, between_trials: bool = False) -> Sequence[FactSink]:
        """Write the events up to a time, and return the sinks."""
        while self._events and self._events[0].time_ns <= time_ns:
            event = self._events.popleft()
            if self._with_others or not between_trials:
                for sink in self._sinks:
                    sink.happened(event)
        return self._sinks


def _configuration(
    meta: Mapping[str, str], path: Path, purpose: str, problem_directory: Path | None
) -> tuple[Configuration, bool]:
    """Return the settings that decided in a run, and whether its world was simulated.

    A run may have been copied from the robot, whose environment, keys and directories are not here;
    or somebody else has made it, and names any module of any directory in it.
    """
    plain = dict(recorded_configuration(meta.get("configuration", ""), path))
    environment = plain.pop("environment", None) or {}
    plain.pop("offload", None)
    recorded = plain.pop("problem_directory", None)
    if ":" in str(plain.get("problem")):
        if problem_directory is None:
            raise UntrustedCodeError(_what_to_say(str(plain["problem"]), recorded, path, purpose))
        plain["problem_directory"] = str(problem_directory.absolute())
    configuration = Configuration.from_plain({"path": str(path), "configuration": plain})
    return configuration, environment.get("object") is None


def _what_to_say(problem: str, recorded: object, path: Path, purpose: str) -> str:
    """Return how a caller says that a run's own problem may run."""
    # On one line each, for these are somebody's words as well.
    directory = one_line(recorded) if isinstance(recorded, str) and len(recorded) < 4096 else "DIR"
    if purpose == "open":
        how = f"open_run(..., problem_directory={directory!r})"
    else:
        how = f"--problem-directory {shlex.quote(directory)}"
    told = "" if directory == "DIR" else ", where it lay when it was run"
    return (
        f"{path}: its problem is {one_line(problem):.100}, and the code that a record names is "
        f"not run unasked. If you know that module, say in which directory it lies: {how}{told}"
    )
