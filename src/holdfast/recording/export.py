"""A recorded run, step by step: what was believed, sensed and done, and when.

A journal keeps decisions, not beliefs: those would be a thousand times larger, and decisions are a
function of seed, trial and observations. So each trial is run again with the planner in this
process, and every decision, bit for bit, is compared with the recorded one before it is passed on.
What comes out are *facts*, in order, for whoever writes them down (:class:`FactSink`).

A simulated world is a function of the seed as well, so its true states are facts, too. What a
robot's own world has shown is in the journal. Of journals that were written before observations
were kept there are the decisions and the times, and no beliefs.

All facts have times on one clock: that of the robot, where the run was recorded with times
(``timings.csv``; steps between two rows are spread evenly), else a clock on which every step takes
the same time.
"""

from __future__ import annotations

import csv
import json
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, NamedTuple, Protocol, Self

import numpy as np
import numpy.typing as npt

from holdfast.belief import Belief, estimate
from holdfast.configuration import Configuration
from holdfast.errors import HoldfastError
from holdfast.files import OutputError
from holdfast.outcome import Decisions, SensingDecision, TaskDecision, TrialResult
from holdfast.planning import PlanningState, digest
from holdfast.problems.problem import FloatArray
from holdfast.recording.fingerprint import difference, fingerprint
from holdfast.recording.journal import Journal, UnfinishedTrial
from holdfast.recording.recorder import DecidedOtherwiseError, RecordedEnvironment
from holdfast.recording.run_directory import EVENTS_NAME, JOURNAL_NAME, TIMINGS_NAME
from holdfast.recording.timings import TIMING_COLUMNS
from holdfast.runtime.environment import Environment, SimulatedEnvironment
from holdfast.runtime.trial import SensingStep, TaskStep, run_trial
from holdfast.session.messages import numbers_from
from holdfast.session.records import ActingRecord, ObservedRecord, PerformedRecord

__all__ = [
    "Decider",
    "EventFact",
    "FactSink",
    "Facts",
    "RecordedRun",
    "SensingFact",
    "TaskFact",
    "TrialBeginFact",
    "TrialEndFact",
]

IntArray = npt.NDArray[np.int64]

_SQLITE = b"SQLite format 3\0"
"""What a journal begins with."""

_NS_PER_S = 1_000_000_000
_LEAST_GAP_NS = 1_000
"""Between two moments of a trial; of two facts with one time nobody knows which came first."""

_FIRST_NS = _NS_PER_S
"""When a run without recorded times begins: for ROS, time 0 means that there is no time."""

_PARTS = 4
"""Moments of a step: sensing decided, observed, task action decided, and the next step's first."""


class Decider(NamedTuple):
    """Who made a decision, and how long it took; from ``timings.csv``.

    Attributes
    ----------
    service, status : str
    waited_ms : float
        How long the robot stood still for it.
    round_trip_ms, computed_ms : float or None
        None for an action that came in the answer to an earlier question.
    """

    service: str
    status: str
    waited_ms: float
    round_trip_ms: float | None
    computed_ms: float | None


class TrialBeginFact(NamedTuple):
    """A trial begins.

    Attributes
    ----------
    trial : int
    time_ns : int
        On the clock of the export.
    beliefs_known : bool
        Whether the facts of this trial have beliefs.
    """

    trial: int
    time_ns: int
    beliefs_known: bool


class SensingFact(NamedTuple):
    """A sensing action, and what came of it.

    Attributes
    ----------
    trial, step : int
    decided_ns, observed_ns : int
        When it was chosen, and when its observation was part of the belief.
    sensing_action : int
    state_digest : bytes
        Of the planning state after the observation.
    decider : Decider or None
    before, after : Belief or None
        The beliefs in which it was chosen, and after the observation.
    stage : int or None
    entropies : array of shape (num_sensing_actions,) or None
        What was minimised, in nats; None if nothing was.
    observation : array or None
    explained, resampled : bool or None
    effective_sample_size, mahalanobis_distance : float or None
    """

    trial: int
    step: int
    decided_ns: int
    observed_ns: int
    sensing_action: int
    state_digest: bytes
    decider: Decider | None
    before: Belief | None = None
    after: Belief | None = None
    stage: int | None = None
    entropies: FloatArray | None = None
    observation: FloatArray | None = None
    explained: bool | None = None
    resampled: bool | None = None
    effective_sample_size: float | None = None
    mahalanobis_distance: float | None = None


class TaskFact(NamedTuple):
    """A task action that was performed.

    Attributes
    ----------
    trial, step : int
    time_ns : int
    action : array of shape (action_size,)
        As it was executed.
    decider : Decider or None
    belief : Belief or None
        In which it was chosen.
    stage : int or None
    estimate : array of shape (state_size,) or None
        The state that the policy was asked for.
    true_state : array of shape (state_size,) or None
        Before the action.
    reward : float or None
    """

    trial: int
    step: int
    time_ns: int
    action: FloatArray
    decider: Decider | None
    belief: Belief | None = None
    stage: int | None = None
    estimate: FloatArray | None = None
    true_state: FloatArray | None = None
    reward: float | None = None


class TrialEndFact(NamedTuple):
    """A trial ends, or what is recorded of it.

    Attributes
    ----------
    trial : int
    time_ns : int
    steps : int
    result : TrialResult or None
        None if the trial is not finished.
    belief, estimate, true_state
        As in :class:`TaskFact`, after the last action.
    """

    trial: int
    time_ns: int
    steps: int
    result: TrialResult | None
    belief: Belief | None = None
    estimate: FloatArray | None = None
    true_state: FloatArray | None = None


class EventFact(NamedTuple):
    """A line of ``events.jsonl``.

    Attributes
    ----------
    time_ns : int
    name : str
        Such as ``status``.
    fields : mapping
        The others of the line.
    """

    time_ns: int
    name: str
    fields: Mapping[str, Any]


class FactSink(Protocol):
    """Writes facts down, in the order in which they come; they are read-only and need no copy."""

    def trial_begins(self, fact: TrialBeginFact) -> None:
        """Write that a trial begins."""
        ...

    def sensed(self, fact: SensingFact) -> None:
        """Write what was sensed."""
        ...

    def acted(self, fact: TaskFact) -> None:
        """Write what was done."""
        ...

    def trial_ends(self, fact: TrialEndFact) -> None:
        """Write how a trial ended."""
        ...

    def happened(self, fact: EventFact) -> None:
        """Write what happened to the services."""
        ...


class Facts:
    """Passes facts on to several sinks, each in turn.

    Parameters
    ----------
    sinks : sequence of FactSink
    """

    def __init__(self, sinks: Sequence[FactSink]) -> None:
        self._sinks = sinks

    def trial_begins(self, fact: TrialBeginFact) -> None:
        """Pass on that a trial begins."""
        for sink in self._sinks:
            sink.trial_begins(fact)

    def sensed(self, fact: SensingFact) -> None:
        """Pass on what was sensed."""
        for sink in self._sinks:
            sink.sensed(fact)

    def acted(self, fact: TaskFact) -> None:
        """Pass on what was done."""
        for sink in self._sinks:
            sink.acted(fact)

    def trial_ends(self, fact: TrialEndFact) -> None:
        """Pass on how a trial ended."""
        for sink in self._sinks:
            sink.trial_ends(fact)

    def happened(self, fact: EventFact) -> None:
        """Pass on what happened to the services."""
        for sink in self._sinks:
            sink.happened(fact)


class RecordedRun:
    """A run that was recorded, open to be read; to be used in a ``with`` statement.

    Parameters
    ----------
    run : Path
        Its directory, or its journal. Nobody may be using it; it is not changed.

    Attributes
    ----------
    path : Path
    configuration : Configuration
        What decides; it names no services and no environment, for nobody is asked again.
    trials : tuple of int
        All trials that have facts, in order: those that are finished, and the one that was begun.
    unfinished : int or None
        The number of the latter.
    has_times : bool
        Whether the facts have the robot's times.
    untimed : tuple of int
        Trials of which the table of times has nothing, although it has others; then no fact has
        the robot's times.
    world_is_simulated : bool

    Raises
    ------
    OutputError
        If it is no run, damaged, or in use.
    HoldfastError
        If its problem cannot be built any more.
    """

    def __init__(self, run: Path) -> None:
        self.path = run
        directory, path = _places(run)
        with ExitStack() as stack:
            self._journal = stack.enter_context(Journal.read(path))
            self._meta = self._journal.meta()
            self.configuration, self.world_is_simulated = _configuration(self._meta, path)
            self._estimate = self.configuration.planning.particle_filter.estimate
            self._begun = self._journal.unfinished()
            self.unfinished = None if self._begun is None else self._begun.trial
            trials = self._journal.finished()
            if self.unfinished is not None:
                trials.add(self.unfinished)
            self.trials = tuple(sorted(trials))
            self._rows = _timings(directory / TIMINGS_NAME)
            self._events = _events(directory / EVENTS_NAME)
            self._ends = _trial_ends(self._events)
            # A batch has no rows of its times: then those of other trials are of no use, for all
            # facts have one clock. A trial in which nothing was decided needs none.
            lacking = [
                result.trial
                for result in self._journal.results()
                if result.steps and result.trial not in self._rows
            ]
            self.has_times = bool(self._rows) and not lacking
            self.untimed = tuple(lacking) if self._rows else ()
            self._close = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._close.close()

    def require_unchanged(self) -> None:
        """Make sure that no run has written to the journal meanwhile.

        Raises
        ------
        OutputError
            If one has.
        """
        self._journal.require_unchanged()

    def beliefs_known(self, trial: int) -> bool:
        """Tell whether a trial can be run again: its observations are known."""
        if self.world_is_simulated or trial == self.unfinished:
            return True
        return self._journal.kept_steps(trial) is not None

    def tell(self, trials: Sequence[int], sink: FactSink, rate_hz: float) -> Iterator[int]:
        """Tell the facts of some trials, in order, and yield the number of each when it is told.

        Parameters
        ----------
        trials : sequence of int
            Ascending; some of :attr:`trials`.
        sink : FactSink
        rate_hz : float
            Steps a second, for a run that has no times.

        Raises
        ------
        OutputError
            If a trial is damaged.
        HoldfastError
            If a trial is decided otherwise when it is run again.
        """
        clock = _Clock(round(_NS_PER_S / rate_hz))
        chosen = set(trials)
        events = self._events if self.has_times else []
        merged = _WithEvents(sink, events, all_of_them=chosen.issuperset(self.trials))
        begun = self._begun if self._begun is not None and self._begun.trial in chosen else None
        for result in self._journal.results(with_decisions=True):
            if begun is not None and begun.trial < result.trial:
                yield self._tell_begun(begun, merged, clock)
                begun = None
            if result.trial in chosen:
                yield self._tell_finished(result, merged, clock)
        if begun is not None:
            yield self._tell_begun(begun, merged, clock)
        merged.tell_the_rest()

    def _tell_finished(self, result: TrialResult, sink: FactSink, clock: _Clock) -> int:
        trial, decisions = result.trial, result.decisions
        assert decisions is not None
        moments = self._moments(trial, result.steps, clock)
        world: Environment | None = None
        if self.world_is_simulated:
            world = SimulatedEnvironment(
                self.configuration.problem, self.configuration.simulator.seed, trial
            )
        elif (records := self._journal.kept_steps(trial)) is not None:
            world = RecordedEnvironment(records, result)
        if world is not None:
            expected = list(decisions)
            teller = _Teller(trial, expected, moments, sink, result, decisions, self._estimate)
            self._run_again(trial, world, teller)
        else:
            _tell_decisions(result, decisions, moments, sink)
        return trial

    def _tell_begun(self, begun: UnfinishedTrial, sink: FactSink, clock: _Clock) -> int:
        problem = self.configuration.problem
        trial = begun.trial
        simulated = None
        if self.world_is_simulated:
            simulated = SimulatedEnvironment(problem, self.configuration.simulator.seed, trial)
        expected: list[SensingDecision | TaskDecision] = []
        for record in begun.records:
            if isinstance(record, ObservedRecord):
                expected.append(SensingDecision(record.step, record.sensing_action, record.digest))
            elif isinstance(record, ActingRecord):
                action = numbers_from(record.action, problem.action_size)
                expected.append(TaskDecision(record.step, tuple(action.tolist())))
        steps = sum(isinstance(decision, TaskDecision) for decision in expected)
        world = _JournalledWorld(begun, simulated)
        moments = self._moments(trial, steps, clock)
        teller = _Teller(trial, expected, moments, sink, None, None, self._estimate)
        try:
            self._run_again(trial, world, teller)
        except _EndOfRecords:
            teller.end_here()
        return trial

    def _run_again(self, trial: int, world: Environment, teller: _Teller) -> None:
        configuration = self.configuration
        try:
            run_trial(
                configuration.problem,
                configuration.planning,
                configuration.simulator,
                trial,
                world,
                teller,
            )
        except DecidedOtherwiseError as error:
            # Another code is the likelier reason; the decisions have told that it matters.
            other = difference(self._meta, fingerprint(configuration))
            because = "" if other is None else f" ({other})"
            raise HoldfastError(f"{error}{because}; --trials leaves it out") from error

    def _moments(self, trial: int, steps: int, clock: _Clock) -> _Moments:
        rows = self._rows.get(trial, {}) if self.has_times else {}
        times = clock.next_trial(steps, rows, self._ends.get(trial))
        deciders = {key: row.decider for key, row in rows.items()}
        current: Decider | None = None
        for step in range(steps):
            asked = deciders.get((step, "task"))
            if asked is not None:
                # An answer has the task actions up to the next sensing step.
                current = Decider(asked.service, asked.status, 0.0, None, None)
            elif (step, "sensing") in deciders:
                current = None
            elif current is not None:
                deciders[step, "task"] = current
        return _Moments(times, deciders)


# -- one trial -------------------------------------------------------------------------------------


class _EndOfRecords(Exception):  # noqa: N818 (no error: what is recorded ends here)
    """The records of a trial that is not finished end."""


class _Moments(NamedTuple):
    """When the moments of a trial were, and who decided."""

    times_ns: IntArray
    deciders: Mapping[tuple[int, str], Decider]

    def at(self, step: int, part: int) -> int:
        return int(self.times_ns[_PARTS * step + part])


class _Teller:
    """Looks on while a trial is run again, compares its decisions and passes its facts on."""

    def __init__(
        self,
        trial: int,
        expected: Sequence[SensingDecision | TaskDecision],
        moments: _Moments,
        sink: FactSink,
        result: TrialResult | None,
        decisions: Decisions | None,
        estimate_kind: Literal["mean", "most_likely"],
    ) -> None:
        self._trial = trial
        self._estimate = estimate_kind
        self._expected = expected
        self._moments = moments
        self._sink = sink
        self._result = result
        self._decisions = decisions
        self._told = 0
        self._steps = 0
        self._state: PlanningState | None = None
        self._true_state: FloatArray | None = None

    def trial_began(self, environment: Environment, state: PlanningState) -> None:
        self._state = state
        self._true_state = _true_state(environment)
        self._sink.trial_begins(TrialBeginFact(self._trial, self._moments.at(0, 0), True))

    def sensed(self, step: SensingStep) -> None:
        number, after = step.before.step, step.after
        state_digest = digest(after)
        self._require(SensingDecision(number, step.sensing_action, state_digest))
        entropies = step.sensing_info.entropies
        info = step.observation_info
        self._sink.sensed(
            SensingFact(
                trial=self._trial,
                step=number,
                decided_ns=self._moments.at(number, 0),
                observed_ns=self._moments.at(number, 1),
                sensing_action=step.sensing_action,
                state_digest=state_digest,
                decider=self._moments.deciders.get((number, "sensing")),
                before=step.before.belief,
                after=after.belief,
                stage=step.before.stage,
                entropies=None if entropies is None else np.array(entropies, dtype=np.float64),
                observation=np.asarray(step.observation, dtype=np.float64).reshape(-1),
                explained=info.explained,
                resampled=info.resampled,
                effective_sample_size=info.effective_sample_size,
                mahalanobis_distance=info.mahalanobis_distance,
            )
        )
        self._state = after

    def acted(self, step: TaskStep) -> None:
        number = step.state.step
        action = np.array(step.executed, dtype=np.float64)
        self._require(TaskDecision(number, tuple(action.tolist())))
        self._sink.acted(
            TaskFact(
                trial=self._trial,
                step=number,
                time_ns=self._moments.at(number, 2),
                action=action,
                decider=self._moments.deciders.get((number, "task")),
                belief=step.state.belief,
                stage=step.task_info.stage,
                estimate=np.array(step.task_info.estimate, dtype=np.float64),
                true_state=self._true_state,
                reward=None if step.reward is None else float(step.reward),
            )
        )
        self._true_state = _true_state(step.environment)
        self._steps = number + 1
        self._state = None  # the next one is not known before something is done in it

    def trial_ended(self, state: PlanningState, result: TrialResult) -> None:
        if self._decisions is None or result.decisions != self._decisions:
            raise DecidedOtherwiseError(self._trial, result.steps, None)
        self._state = state
        self.end_here()

    def end_here(self) -> None:
        belief = None if self._state is None else self._state.belief
        self._sink.trial_ends(
            TrialEndFact(
                trial=self._trial,
                time_ns=self._moments.at(self._steps, 3 if self._result is None else 0),
                steps=self._steps,
                result=self._result,
                belief=belief,
                estimate=None if belief is None else estimate(belief, self._estimate),
                true_state=self._true_state,
            )
        )

    def _require(self, decision: SensingDecision | TaskDecision) -> None:
        kept = self._expected[self._told] if self._told < len(self._expected) else None
        if kept is None or not _same(kept, decision):
            kind = "sensing" if isinstance(decision, SensingDecision) else "task"
            raise DecidedOtherwiseError(self._trial, decision.step, kind)
        self._told += 1


def _same(one: SensingDecision | TaskDecision, other: SensingDecision | TaskDecision) -> bool:
    if isinstance(one, TaskDecision) and isinstance(other, TaskDecision):
        # By their bits: 0.0 and -0.0 are different actions.
        return one.step == other.step and (
            np.array(one.action).tobytes() == np.array(other.action).tobytes()
        )
    return type(one) is type(other) and one == other


def _true_state(environment: Environment) -> FloatArray | None:
    # Only a simulated world knows its own state.
    state = getattr(environment, "state", None)
    return None if state is None else np.array(state, dtype=np.float64)


class _JournalledWorld:
    """The world of a trial that is not finished: it has answered what its records say.

    Parameters
    ----------
    begun : UnfinishedTrial
    simulated : SimulatedEnvironment or None
        Moved along, to know the true state.
    """

    def __init__(self, begun: UnfinishedTrial, simulated: SimulatedEnvironment | None) -> None:
        self._trial = begun.trial
        self._simulated = simulated
        kinds = (ObservedRecord, ActingRecord, PerformedRecord)
        self._records = [record for record in begun.records if isinstance(record, kinds)]
        self._next = 0
        self._step = 0

    @property
    def state(self) -> FloatArray | None:
        return None if self._simulated is None else self._simulated.state

    def perform_sensing(self, sensing_action: int) -> FloatArray:
        record = self._take()
        if not isinstance(record, ObservedRecord) or record.sensing_action != sensing_action:
            raise DecidedOtherwiseError(self._trial, self._step, "sensing")
        return numbers_from(record.observation, len(record.observation) // 8)

    def perform(self, task_action: FloatArray) -> float | None:
        record = self._take()
        action = np.ascontiguousarray(task_action, dtype="<f8").tobytes()
        if not isinstance(record, ActingRecord) or record.action != action:
            raise DecidedOtherwiseError(self._trial, self._step, "task")
        self._step += 1
        if self._simulated is not None:
            self._simulated.perform(task_action)
        if self._next < len(self._records):
            performed = self._records[self._next]
            if isinstance(performed, PerformedRecord):
                self._next += 1
                return performed.reward
        return None

    def is_done(self) -> bool:
        # The trial would be finished.
        if self._next == len(self._records) and self._step:
            raise _EndOfRecords
        return False

    def _take(self) -> ObservedRecord | ActingRecord | PerformedRecord:
        if self._next == len(self._records):
            raise _EndOfRecords
        self._next += 1
        return self._records[self._next - 1]


def _tell_decisions(
    result: TrialResult, decisions: Decisions, moments: _Moments, sink: FactSink
) -> None:
    """Tell of a trial what its decisions alone say."""
    trial = result.trial
    sink.trial_begins(TrialBeginFact(trial, moments.at(0, 0), False))
    for decision in decisions:
        step = decision.step
        if isinstance(decision, SensingDecision):
            sink.sensed(
                SensingFact(
                    trial=trial,
                    step=step,
                    decided_ns=moments.at(step, 0),
                    observed_ns=moments.at(step, 1),
                    sensing_action=decision.sensing_action,
                    state_digest=decision.state_digest,
                    decider=moments.deciders.get((step, "sensing")),
                )
            )
        else:
            sink.acted(
                TaskFact(
                    trial=trial,
                    step=step,
                    time_ns=moments.at(step, 2),
                    action=np.array(decision.action, dtype=np.float64),
                    decider=moments.deciders.get((step, "task")),
                )
            )
    sink.trial_ends(TrialEndFact(trial, moments.at(result.steps, 0), result.steps, result))


class _WithEvents:
    """Passes facts on, and what happened to the services in between.

    Parameters
    ----------
    sink : FactSink
    events : sequence of EventFact
        In order.
    all_of_them : bool
        Whether to tell also what happened outside of the trials that are told.
    """

    def __init__(self, sink: FactSink, events: Sequence[EventFact], *, all_of_them: bool) -> None:
        self._sink = sink
        self._events = deque(events)
        self._all = all_of_them

    def trial_begins(self, fact: TrialBeginFact) -> None:
        self._until(fact.time_ns, left_out=not self._all)
        self._sink.trial_begins(fact)

    def sensed(self, fact: SensingFact) -> None:
        self._until(fact.decided_ns)
        self._sink.sensed(fact)

    def acted(self, fact: TaskFact) -> None:
        self._until(fact.time_ns)
        self._sink.acted(fact)

    def trial_ends(self, fact: TrialEndFact) -> None:
        self._until(fact.time_ns)
        self._sink.trial_ends(fact)

    def happened(self, fact: EventFact) -> None:
        self._sink.happened(fact)

    def tell_the_rest(self) -> None:
        self._until(None, left_out=not self._all)

    def _until(self, time_ns: int | None, *, left_out: bool = False) -> None:
        while self._events and (time_ns is None or self._events[0].time_ns <= time_ns):
            event = self._events.popleft()
            if not left_out:
                self._sink.happened(event)


# -- times -----------------------------------------------------------------------------------------


class _Row(NamedTuple):
    """A row of ``timings.csv``."""

    time_ns: int
    decider: Decider


class _Clock:
    """Gives the moments of one trial after the other times that only grow.

    Parameters
    ----------
    period_ns : int
        Of a step, where nothing else is known.
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = max(period_ns, _PARTS * _LEAST_GAP_NS)
        self._last_ns = _FIRST_NS - self._period_ns

    def next_trial(
        self, steps: int, rows: Mapping[tuple[int, str], _Row], end_ns: int | None
    ) -> IntArray:
        """Return the times of all moments of a trial and of its end."""
        count = _PARTS * (steps + 1)
        part_ns = self._period_ns / _PARTS
        known = [
            (_PARTS * step + (0 if kind == "sensing" else 2), row.time_ns)
            for (step, kind), row in rows.items()
            if kind in ("sensing", "task") and step <= steps
        ]
        if end_ns is not None:
            known.append((_PARTS * steps, end_ns))
        anchors: list[tuple[int, int]] = []
        for moment, time_ns in sorted(known):
            # A clock that was set back is not followed.
            last_ns = anchors[-1][1] if anchors else self._last_ns
            if time_ns > last_ns and (not anchors or moment > anchors[-1][0]):
                anchors.append((moment, time_ns))
        if not anchors:
            anchors = [(0, self._last_ns + self._period_ns)]
        moments = np.array([moment for moment, _ in anchors], dtype=np.float64)
        origin = anchors[0][1]
        # From the first anchor on, because a double has no room for nanoseconds since 1970.
        since = np.array([time_ns - origin for _, time_ns in anchors], dtype=np.float64)
        positions = np.arange(count, dtype=np.float64)
        offsets = np.interp(positions, moments, since)
        early, late = positions < moments[0], positions > moments[-1]
        offsets[early] = (positions[early] - moments[0]) * part_ns
        offsets[late] = since[-1] + (positions[late] - moments[-1]) * part_ns
        times = origin + np.rint(offsets).astype(np.int64)
        floor = self._last_ns + _LEAST_GAP_NS * (1 + np.arange(count))
        # Each at least the least gap after the one before it.
        ramp = _LEAST_GAP_NS * np.arange(count)
        times = np.maximum.accumulate(np.maximum(times, floor) - ramp) + ramp
        self._last_ns = int(times[_PARTS * steps])
        return np.asarray(times, dtype=np.int64)


def _timings(path: Path) -> dict[int, dict[tuple[int, str], _Row]]:
    """Return the rows of a run's table by trial, step and kind; damaged ones do not count."""
    rows: dict[int, dict[tuple[int, str], _Row]] = {}
    try:
        with path.open(encoding="utf-8", errors="replace", newline="") as file:
            for row in csv.reader(line.replace("\0", "") for line in file):
                if len(row) != len(TIMING_COLUMNS):
                    continue
                trial, step, kind, service, status, *spans, moment = row
                try:
                    waited, round_trip, computed = map(float, spans)
                    entry = _Row(
                        _nanoseconds(moment),
                        Decider(service, status, waited, round_trip, computed),
                    )
                    # Of a decision that was asked for again, the one that was used.
                    rows.setdefault(int(trial), {})[int(step), kind] = entry
                except ValueError:
                    continue  # the head, or a row that a power cut has spoilt
    except FileNotFoundError:
        return {}
    except (OSError, csv.Error) as error:
        raise OutputError(f"{path}: cannot be read: {error}") from error
    return rows


def _events(path: Path) -> list[EventFact]:
    """Return the lines of ``events.jsonl`` in the order of their times."""
    events = []
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            for line in file:
                try:
                    fields = json.loads(line)
                    moment, name = fields.pop("time"), fields.pop("event")
                    events.append(EventFact(_nanoseconds(moment), str(name), fields))
                except (ValueError, KeyError, TypeError, AttributeError):
                    continue  # a line that a power cut has spoilt
    except FileNotFoundError:
        return []
    except OSError as error:
        raise OutputError(f"{path}: cannot be read: {error.strerror}") from error
    return sorted(events, key=lambda event: event.time_ns)


def _trial_ends(events: Sequence[EventFact]) -> dict[int, int]:
    ends = {}
    for event in events:
        trial = event.fields.get("trial")
        if event.name == "trial" and isinstance(trial, int):
            ends[trial] = event.time_ns
    return ends


def _nanoseconds(moment: str) -> int:
    """Return nanoseconds since 1970 of a time as our files have it."""
    parsed = datetime.fromisoformat(moment)
    if parsed.tzinfo is None:
        raise ValueError(moment)
    seconds = int(parsed.replace(microsecond=0).timestamp())
    return _NS_PER_S * seconds + 1000 * parsed.microsecond


# -- opening ---------------------------------------------------------------------------------------


def _places(run: Path) -> tuple[Path, Path]:
    """Return the directory of a run and its journal."""
    if run.is_dir():
        if not (run / JOURNAL_NAME).is_file():
            raise OutputError(f"{run}: holds no {JOURNAL_NAME}, so no run to export")
        return run, run / JOURNAL_NAME
    if not run.exists():
        raise OutputError(f"{run}: there is no such directory or journal, so no run to export")
    if not run.is_file():
        raise OutputError(f"{run}: is a pipe or device, not a journal")
    with run.open("rb") as file:
        if file.read(len(_SQLITE)) not in (_SQLITE, b""):
            raise OutputError(f"{run}: is neither the directory of a run nor its journal")
    return run.parent, run


def _configuration(meta: Mapping[str, str], path: Path) -> tuple[Configuration, bool]:
    """Return what decided in a run, and whether its world was simulated.

    A run may have been copied from the robot: its world, keys and directories need not be here.
    """
    from holdfast.yaml_document import read

    text = meta.get("configuration", "")
    plain = dict(read(text.encode(), f"the configuration in {path}").data)
    environment = plain.pop("environment", None) or {}
    plain.pop("offload", None)
    directory = plain.get("problem_directory")
    if directory is not None and not Path(directory).is_dir():
        # Then its module is looked for beside the journal and in the current directory.
        del plain["problem_directory"]
    configuration = Configuration.from_plain({"path": str(path), "configuration": plain})
    return configuration, environment.get("object") is None
