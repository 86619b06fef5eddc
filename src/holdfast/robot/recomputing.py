"""Recorded trials, computed again: whether the code of this process decides what the record says.

A decision is a function of seed, trial and observations. What a simulated world has shown follows
from the seed, and what a robot's own world has shown is in the journal. So a recorded trial can be
planned again, and each decision compared with the recorded one, bit for bit.

That is how a run goes on with another version of holdfast than began it. Two versions mostly
decide the same, but their sources do not tell. Their decisions do.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter
from typing import cast

import msgspec

from holdfast.config.loader import Configuration
from holdfast.errors import DecidedOtherwiseError, HoldfastError
from holdfast.journal.fingerprint import EarlierCode, ranges_of
from holdfast.journal.journal_reader import JournalReader, UnfinishedTrial
from holdfast.journal.run_directory import RunDirectory
from holdfast.numerics.floating_mode import in_own_mode
from holdfast.planning.inputs import (
    ActingRecord,
    Decision,
    Late,
    Moved,
    Record,
    Reinitialised,
    Sensed,
    decisions_of,
    encode_floats,
)
from holdfast.planning.outcome import Ending, TrialResult
from holdfast.planning.planner import Planner, PlanningState, TaskInfo, digest
from holdfast.planning.tracking import Trial
from holdfast.robot.environment import Environment, SimulatedEnvironment
from holdfast.robot.trial import (
    NULL_OBSERVER,
    SensingStep,
    TaskStep,
    TrialObserver,
    run_trial,
    take_late,
    take_move,
    take_reinitialisation,
    take_sensing,
)

_FINISHED_S = 30.0
"""No further finished trial is begun after this time."""


class RecordedTrials:
    """The trials of a journal, to be run again.

    Unless the world is simulated, they happen in the recorded one, which shows what it has shown.
    """

    def __init__(
        self, journal: JournalReader, configuration: Configuration, *, world_is_simulated: bool
    ) -> None:
        self._journal = journal
        self._simulator = configuration.simulator
        self._world_is_simulated = world_is_simulated
        self.planner = Planner(configuration.problem, configuration.planning)

    def run(self, recorded: TrialResult | UnfinishedTrial, observer: TrialObserver) -> bool:
        """Run a trial again, as far as it went; return whether its observations were kept.

        A result has its decisions. Raises DecidedOtherwiseError if the recorded world has no answer
        to a decision.
        """
        seed, trial, planner = self._simulator.seed, recorded.trial, self.planner
        if isinstance(recorded, UnfinishedTrial):
            simulated = None
            if self._world_is_simulated:
                simulated = SimulatedEnvironment(planner.problem, seed, trial)
            run_recorded_trial(
                planner, seed, trial, recorded.records, observer, simulated=simulated
            )
        elif self._world_is_simulated:
            assert recorded.decisions is not None
            run_trial(
                planner,
                seed,
                trial,
                max_steps=self._simulator.max_steps,
                observer=observer,
                reinitialised_after=recorded.decisions.reinitialised_after(),
            )
        else:
            records = self._journal.kept_steps(trial)
            if records is None and recorded.steps:
                return False
            run_recorded_trial(planner, seed, trial, records or [], observer, recorded)
        return True


def run_recorded_trial(
    planner: Planner,
    seed: int,
    trial: int,
    # In the order in which they were written; the one of the last performance may be missing.
    records: Sequence[Record],
    observer: TrialObserver,
    # None if the trial is not finished: then it does not end, and None is returned.
    result: TrialResult | None = None,
    # Performs the same task actions, so that the true state is known.
    simulated: SimulatedEnvironment | None = None,
) -> TrialResult | None:
    """Run a trial again, as far as its records go.

    Raises DecidedOtherwiseError if a decision is another one than the recorded.
    """
    track = Trial(planner, seed, trial)
    # For the observer, which asks it for the true state alone.
    environment = cast("Environment", simulated)
    task_info: TaskInfo | None = None

    def take(record: Record) -> None:
        nonlocal task_info
        state = track.state
        if isinstance(record, Sensed):
            otherwise = DecidedOtherwiseError(trial, state.step, "sensing")
            if not planner.needs_sensing(state):
                raise otherwise
            chosen, sensing_info = planner.choose_sensing_action(state)
            if chosen != record.sensing_action:
                raise otherwise
            take_sensing(track, record, sensing_info, observer)
        elif isinstance(record, ActingRecord):
            executed, task_info = planner.choose_task_action(state)
            if planner.needs_sensing(state) or encode_floats(executed) != record.action:
                raise DecidedOtherwiseError(trial, state.step, "task")
            track.take(record)
        elif isinstance(record, Moved):
            assert track.pending is not None
            assert task_info is not None
            if simulated is not None:
                simulated.perform(track.pending)
            take_move(track, record, task_info, observer, environment)
        elif isinstance(record, Late):
            take_late(track, record, observer)
        elif isinstance(record, Reinitialised):
            take_reinitialisation(track, observer)

    observer.trial_began(environment, track.state)
    for record in records:
        take(record)
    if track.pending is not None:
        take(Moved(track.state.step, None))
    if result is None:
        return None
    if track.state.step != result.steps:
        raise DecidedOtherwiseError(trial, track.state.step, None)
    ended = track.result(Ending(result.outcome, result.reason))
    observer.trial_ended(track.state, ended)
    return ended


class ComparedTrial(TrialObserver):
    """Observes a trial that is run again; a decision that differs raises DecidedOtherwiseError.

    ``observer`` gets the beginning, what is decided as recorded, and the end; ``expected`` are the
    recorded decisions.
    """

    def __init__(
        self,
        recorded: TrialResult | UnfinishedTrial,
        on_same: Callable[[], None] = lambda: None,
        observer: TrialObserver = NULL_OBSERVER,
    ) -> None:
        self.trial = recorded.trial
        self.result = recorded if isinstance(recorded, TrialResult) else None
        decided = (
            recorded.decisions or ()
            if isinstance(recorded, TrialResult)
            else decisions_of(recorded.records)
        )
        self.expected = list(decided)
        self._compared = 0
        self._on_same = on_same
        self._observer = observer

    def trial_began(self, environment: Environment, state: PlanningState) -> None:
        """Pass it on."""
        self._observer.trial_began(environment, state)

    @in_own_mode
    def sensed(self, step: SensingStep) -> None:
        """Compare a sensing action, and the state after its observation."""
        self._require(Sensed(step.before.step, step.sensing_action, b"", digest(step.after)))
        self._observer.sensed(step)

    @in_own_mode
    def acted(self, step: TaskStep) -> None:
        """Compare a task action."""
        self._require(ActingRecord(step.state.step, encode_floats(step.executed)))
        self._observer.acted(step)

    def trial_ended(self, state: PlanningState, result: TrialResult) -> None:
        """Compare what is no decision, too: the digests of all states."""
        if self.result is None or result.decisions != self.result.decisions:
            raise DecidedOtherwiseError(self.trial, result.steps, None)
        self._observer.trial_ended(state, result)

    def require_all(self) -> None:
        """Raise DecidedOtherwiseError if a recorded decision was not made again."""
        if self._compared < len(self.expected):
            raise DecidedOtherwiseError(self.trial, self.expected[self._compared].step, None)

    def _require(self, decision: Decision) -> None:
        at = self._compared
        kept = self.expected[at] if at < len(self.expected) else None
        if kept != decision:
            kind: str | None = "task"
            if isinstance(decision, Sensed):
                # A state that differs after the same choice is nobody's decision.
                again = isinstance(kept, Sensed) and (
                    (kept.step, kept.sensing_action) == (decision.step, decision.sensing_action)
                )
                kind = None if again else "sensing"
            raise DecidedOtherwiseError(self.trial, decision.step, kind)
        self._compared += 1
        self._on_same()


def resume_run(
    path: Path,
    configuration: Configuration,
    on_progress: Callable[[int, int], None] = lambda *_: None,
) -> RunDirectory:
    """Open the directory of a run that shall go on; see :meth:`RunDirectory.resume`."""
    return RunDirectory.resume(path, configuration, compute_again, on_progress)


def resume_run_if_begun(
    path: Path,
    configuration: Configuration,
    on_progress: Callable[[int, int], None] = lambda *_: None,
) -> RunDirectory:
    """Open that of a run that has begun, else a new one: :meth:`RunDirectory.resume_if_begun`."""
    return RunDirectory.resume_if_begun(path, configuration, compute_again, on_progress)


def compute_again(
    journal: JournalReader,
    configuration: Configuration,
    made_by: str,
    earlier: Sequence[EarlierCode],
    on_progress: Callable[[int, int], None],
) -> EarlierCode:
    """Compute decisions of a run again, and return what its earlier code has decided.

    These are all decisions of the unfinished trial, and those of up to three finished ones (the
    first, the last and one between), of which none but the first is begun after 30 s. So it takes
    no longer than these trials were planned.

    ``made_by`` is the version that decided since the last of ``earlier``; ``on_progress`` gets how
    many decisions were computed, and of how many. Raises DecidedOtherwiseError if a decision is
    another one than the recorded, OutputError if the journal is damaged, HoldfastError if it holds
    decisions, and no observations from which they follow.
    """
    trials = RecordedTrials(
        journal, configuration, world_is_simulated=configuration.environment.object is None
    )
    finished, begun = sorted(journal.finished()), journal.unfinished()
    last = len(finished) - 1
    chosen = {finished[index] for index in (0, last // 2, last)} if finished else set()
    recorded: list[TrialResult | UnfinishedTrial] = [
        msgspec.structs.replace(each, decisions=journal.decisions(each.trial))
        for each in journal.results()
        if each.trial in chosen
    ]
    if begun is not None and any(decisions_of(begun.records)):
        recorded.insert(0, begun)
    done = itertools.count(1)
    observers = [ComparedTrial(each, lambda: on_progress(next(done), total)) for each in recorded]
    total = sum(len(each.expected) for each in observers)
    computed: list[int] = []
    started = perf_counter()
    for each, observer in zip(recorded, observers, strict=True):
        if computed and perf_counter() - started > _FINISHED_S:
            break
        if trials.run(each, observer):
            observer.require_all()
            computed.append(each.trial)
    if finished and not computed:
        raise HoldfastError("it has not kept its observations")
    known = {
        trial
        for each in earlier
        for first, last in each.finished
        for trial in range(first, last + 1)
    }
    return EarlierCode(
        holdfast=made_by,
        finished=ranges_of([trial for trial in finished if trial not in known]),
        unfinished=None
        if begun is None
        else (begun.trial, sum(1 for _ in decisions_of(begun.records))),
        computed_again=tuple(sorted(computed)),
    )
