"""Recorded trials, computed again: whether the code of this process decides what the record says.

A decision is a function of seed, trial and observations. What a simulated world has shown follows
from the seed, and what a robot's own world has shown is in the journal. So a recorded trial can be
planned again, and each decision compared with the recorded one, bit for bit.

That is how a run goes on with another version of holdfast than began it. Two versions mostly
decide the same, but their sources do not tell. Their decisions do.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from time import perf_counter

import msgspec
import numpy as np

from holdfast.config.loader import Configuration
from holdfast.errors import DecidedOtherwiseError, HoldfastError
from holdfast.numerics.floating_mode import in_own_mode
from holdfast.planning.outcome import SensingDecision, TaskDecision, TrialResult
from holdfast.planning.planner import Planner, PlanningState, digest
from holdfast.protocol.records import decisions_of
from holdfast.recording.fingerprint import EarlierCode, ranges_of
from holdfast.recording.journal_reader import JournalReader, UnfinishedTrial
from holdfast.robot.environment import Environment, SimulatedEnvironment
from holdfast.robot.recorded_trial import run_recorded_trial
from holdfast.robot.trial import (
    NULL_OBSERVER,
    LateStep,
    SensingStep,
    TaskStep,
    TrialObserver,
    run_trial,
)

__all__ = ["ComparedTrial", "RecordedTrials", "compute_again"]

_FINISHED_S = 30.0
"""No further finished trial is begun after this time."""


class RecordedTrials:
    """The trials of a journal, to be run again.

    Parameters
    ----------
    world_is_simulated : bool
        Else the trials happen in the recorded world, which shows what it has shown.
    """

    def __init__(
        self, journal: JournalReader, configuration: Configuration, *, world_is_simulated: bool
    ) -> None:
        self._journal = journal
        self._simulator = configuration.simulator
        self._world_is_simulated = world_is_simulated
        self.planner = Planner(configuration.problem, configuration.planning)

    def run(self, result: TrialResult, observer: TrialObserver) -> TrialResult | None:
        """Run a finished trial again; return None if its observations were not kept.

        ``result`` has its decisions.

        Raises
        ------
        DecidedOtherwiseError
            If the recorded world has no answer to a decision.
        """
        seed, trial = self._simulator.seed, result.trial
        if self._world_is_simulated:
            assert result.decisions is not None
            return run_trial(
                self.planner,
                seed,
                trial,
                max_steps=self._simulator.max_steps,
                observer=observer,
                reinitialised_after=result.decisions.reinitialised_after(),
            )
        records = self._journal.kept_steps(trial)
        if records is None and result.steps:
            return None
        return run_recorded_trial(self.planner, seed, trial, records or [], observer, result)

    def run_unfinished(self, begun: UnfinishedTrial, observer: TrialObserver) -> None:
        """Run the unfinished trial again, as far as its records go; raises as :meth:`run` does."""
        seed, trial = self._simulator.seed, begun.trial
        simulated = None
        if self._world_is_simulated:
            simulated = SimulatedEnvironment(self.planner.problem, seed, trial)
        run_recorded_trial(self.planner, seed, trial, begun.records, observer, simulated=simulated)


class ComparedTrial(TrialObserver):
    """Observes a trial that is run again, and compares its decisions with the recorded ones.

    A decision that differs raises DecidedOtherwiseError. What is the same goes on to ``observer``.
    """

    def __init__(
        self,
        trial: int,
        expected: Sequence[SensingDecision | TaskDecision],
        result: TrialResult | None,
        observer: TrialObserver = NULL_OBSERVER,
    ) -> None:
        self._trial = trial
        self._expected = expected
        self._result = result
        self.compared = 0
        self._observer = observer

    def trial_began(self, environment: Environment, state: PlanningState) -> None:
        """Pass it on."""
        self._observer.trial_began(environment, state)

    def observed_late(self, step: LateStep) -> None:
        """Pass it on: the next decision shows the state."""
        self._observer.observed_late(step)

    def reinitialised(self, state: PlanningState) -> None:
        """Pass it on."""
        self._observer.reinitialised(state)

    @in_own_mode
    def sensed(self, step: SensingStep) -> None:
        """Compare a sensing action, and the state after its observation."""
        self._require(SensingDecision(step.before.step, step.sensing_action, digest(step.after)))
        self._observer.sensed(step)

    @in_own_mode
    def acted(self, step: TaskStep) -> None:
        """Compare a task action."""
        action = np.array(step.executed, dtype=np.float64)
        self._require(TaskDecision(step.state.step, tuple(action.tolist())))
        self._observer.acted(step)

    def trial_ended(self, state: PlanningState, result: TrialResult) -> None:
        """Compare what is no decision, too: the digests of all states."""
        if self._result is None or result.decisions != self._result.decisions:
            raise DecidedOtherwiseError(self._trial, result.steps, None)
        self._observer.trial_ended(state, result)

    def _require(self, decision: SensingDecision | TaskDecision) -> None:
        kept = self._expected[self.compared] if self.compared < len(self._expected) else None
        kind: str | None = "task" if isinstance(decision, TaskDecision) else "sensing"
        if isinstance(kept, TaskDecision) and isinstance(decision, TaskDecision):
            # By their bits: 0.0 and -0.0 are different actions.
            bits = [np.array(each.action).tobytes() for each in (kept, decision)]
            same = kept.step == decision.step and bits[0] == bits[1]
        else:
            same = kept == decision
            # A state that differs after the same choice is nobody's decision.
            kind = None if kept is not None and kept[:2] == decision[:2] else kind
        if not same:
            raise DecidedOtherwiseError(self._trial, decision.step, kind)
        self.compared += 1


class _Counting(TrialObserver):
    """Counts decisions."""

    def __init__(self, total: int, on_progress: Callable[[int, int], None]) -> None:
        self._done = 0
        self._total = total
        self._on_progress = on_progress

    def sensed(self, step: object) -> None:
        del step
        self._done += 1
        self._on_progress(self._done, self._total)

    acted = sensed


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

    Parameters
    ----------
    made_by : str
        The version that decided since the last of ``earlier``.
    on_progress : callable
        Gets how many decisions were computed, and of how many.

    Raises
    ------
    DecidedOtherwiseError
        If a decision is another one than the recorded.
    OutputError
        If the journal is damaged.
    HoldfastError
        If it holds decisions, and no observations from which they follow.
    """
    trials = RecordedTrials(
        journal, configuration, world_is_simulated=configuration.environment.object is None
    )
    finished, begun = sorted(journal.finished()), journal.unfinished()
    last = len(finished) - 1
    chosen = {finished[index] for index in (0, last // 2, last)} if finished else set()
    results = {
        each.trial: msgspec.structs.replace(each, decisions=journal.decisions(each.trial))
        for each in journal.results()
        if each.trial in chosen
    }
    expected = {trial: list(each.decisions or ()) for trial, each in results.items()}
    so_far = [] if begun is None else list(decisions_of(begun.records))
    total = len(so_far) + sum(map(len, expected.values()))
    counting = _Counting(total, on_progress)
    computed: list[int] = []
    started = perf_counter()
    if begun is not None and so_far:
        observer = ComparedTrial(begun.trial, so_far, None, counting)
        trials.run_unfinished(begun, observer)
        if observer.compared < len(so_far):
            raise DecidedOtherwiseError(begun.trial, so_far[observer.compared].step, None)
        computed.append(begun.trial)
    for trial, result in results.items():
        if computed and perf_counter() - started > _FINISHED_S:
            break
        observer = ComparedTrial(trial, expected[trial], result, counting)
        if trials.run(result, observer) is not None:
            computed.append(trial)
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
        unfinished=None if begun is None else (begun.trial, len(so_far)),
        computed_again=tuple(sorted(computed)),
    )
