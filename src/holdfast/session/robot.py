"""The robot's loop as a machine: sense, decide, write down, act, once and in order.

The robot holds the truth: its belief, folded from what it sensed and did. Services only compute
what follows from it. So each turn is: take the next decision from the answer to the last question,
write it down, carry it out, fold in what came of it; and when the answer is used up, ask again.

While the robot moves through the task actions of an answer, the sensing action that comes after
them is already being computed; it is used only if the state in which it was chosen is, bit for bit,
the one in which the robot arrives.

The machine touches nothing. Each method takes what happened and the time and returns effects
(:mod:`holdfast.session.effects`), which the shell carries out in their order; when
:meth:`Robot.next_wakeup` is reached before anything else happens, it calls :meth:`Robot.wake`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from holdfast import contract
from holdfast.belief import UNEXPLAINED_DEVIATIONS_SQUARED
from holdfast.errors import HoldfastError, InvalidValueError
from holdfast.outcome import DecisionLog, Done, TrialResult, with_reward
from holdfast.planning import ObservationInfo, Planner, PlanningState
from holdfast.session.decision_source import DecisionSource
from holdfast.session.effects import (
    Act,
    Effect,
    EndTrial,
    Journal,
    Paused,
    Report,
    Sense,
    Stop,
    Timing,
)
from holdfast.session.events import (
    Acted,
    Begun,
    Decided,
    EnvironmentEvent,
    EnvironmentFailed,
    Planned,
    Sensed,
    TransportEvent,
)
from holdfast.session.messages import (
    DIGEST_SIZE,
    MAX_OBSERVATIONS,
    MessageError,
    Observed,
    numbers_from,
    numbers_to,
)
from holdfast.session.question import Provenance, Question, same_actions
from holdfast.session.records import (
    ActingRecord,
    ObservedRecord,
    PausedRecord,
    PerformedRecord,
    Record,
    RecordError,
    RecoveredRecord,
)
from holdfast.session.status import Status
from holdfast.settings import SimulatorSettings

__all__ = ["HeldError", "History", "Robot", "UnknownPerformanceError", "replay"]

FloatArray = npt.NDArray[np.float64]


_OF_THE_BODY = (Sensed, Acted, EnvironmentFailed)
"""What comes of an order to the environment."""

_TICKS_INTERVAL_S = 1.0
"""Missed ticks are reported at most this often; all of them are counted."""

_DIVERGENCE_RUN = 5
"""So many unexplained observations in a row are no outliers: the filter has diverged. (A sensor in
which one of a hundred is an outlier shows five in a row once in 10^10 observations.)"""

_MOST_TOLD = 10
"""Of each kind of event about unexplained observations, for each trial; all of them are counted."""


class HeldError(HoldfastError):
    """The robot holds still: its environment failed. The run can be resumed."""


class UnknownPerformanceError(HoldfastError):
    """After a crash nobody can say whether the last task action was performed."""


class History:
    """An unfinished trial, folded from its records.

    Attributes
    ----------
    state : PlanningState
        After everything that is known to have been performed.
    observations : tuple of Observed
        The last ones, as many as a request can carry.
    num_observations : int
        All of this trial.
    log : DecisionLog
        Of the same.
    actions : list of array
        Task actions that the records show to be performed, in order.
    total_reward : float or None
        None as long as no step had a reward, and sensing has no prices.
    pending : array or None
        A task action that was written down and of which nothing more is known.
    paused : bool
        Whether the process before ended in order.
    num_unexplained : int
        Observations that no particle explained.
    unexplained_in_a_row : int
        The last so many observations.
    num_divergences : int
        Times that these have become so many that the filter is said to have diverged.
    sensing_ms : list of float
        How long each sensing action that was performed had been computed.
    recoveries : int
        Times that another service took over.
    """

    def __init__(self, planner: Planner, seed: int, trial: int) -> None:
        self.state = planner.initial_state(seed, trial)
        self.observations: tuple[Observed, ...] = ()
        self.num_observations = 0
        self.log = DecisionLog(planner.problem.action_size)
        self._costs = contract.sensing_costs(planner.problem)
        self.actions: list[FloatArray] = []
        self.total_reward = contract.first_reward(planner.problem)
        self.pending: FloatArray | None = None
        self.paused = False
        self.num_unexplained = 0
        self.unexplained_in_a_row = 0
        self.num_divergences = 0
        self.sensing_ms: list[float] = []
        self.recoveries = 0

    @property
    def begun(self) -> bool:
        """Whether anything has happened yet."""
        return self.num_observations > 0 or self.state.step > 0 or self.pending is not None

    def observed(self, record: ObservedRecord, after: PlanningState, *, explained: bool) -> None:
        """Fold in an observation that led to a state."""
        kept = Observed(record.step, record.sensing_action, record.observation)
        self.observations = (*self.observations, kept)[-MAX_OBSERVATIONS:]
        self.num_observations += 1
        self.num_unexplained += not explained
        self.unexplained_in_a_row = 0 if explained else self.unexplained_in_a_row + 1
        self.num_divergences += self.unexplained_in_a_row == _DIVERGENCE_RUN
        self.sensing_ms.append(record.sensing_ms)
        self.log.sensed(record.step, record.sensing_action, record.digest)
        cost = float(self._costs[record.sensing_action])
        if cost > 0.0:
            self.total_reward = with_reward(self.total_reward, -cost)
        self.state = after

    def performed(self, planner: Planner, reward: float | None) -> None:
        """Fold in that the pending task action has been performed."""
        assert self.pending is not None
        self.log.acted(self.state.step, self.pending)
        self.state = planner.advance(self.state, self.pending)
        self.total_reward = with_reward(self.total_reward, reward)
        self.pending = None


def replay(planner: Planner, seed: int, trial: int, records: Sequence[Record]) -> History:
    """Fold the records of an unfinished trial.

    Parameters
    ----------
    planner : Planner
    seed, trial : int
    records : sequence of Record
        In the order in which they were written.

    Returns
    -------
    History

    Raises
    ------
    RecordError
        If a record does not follow from those before it, or leads to another state than it did.
    """
    history = History(planner, seed, trial)
    for position, record in enumerate(records):
        history.paused = isinstance(record, PausedRecord)
        try:
            _replay_record(planner, history, record)
        except (RecordError, MessageError, InvalidValueError) as error:
            raise RecordError(f"trial {trial}: record {position} of its journal {error}") from error
    return history


def _replay_record(planner: Planner, history: History, record: Record) -> None:
    if isinstance(record, PausedRecord):
        return
    if isinstance(record, RecoveredRecord):
        history.recoveries += record.times
        return
    state = history.state
    if not isinstance(record, PerformedRecord) and history.pending is not None:
        raise RecordError("comes before the action of that step is known to be performed")
    if record.step != state.step:
        raise RecordError(f"is of step {record.step}, where step {state.step} is due")
    if isinstance(record, ObservedRecord):
        _replay_observation(planner, history, record)
    elif isinstance(record, ActingRecord):
        if planner.needs_sensing(state):
            raise RecordError("is a task action where an observation is due")
        history.pending = numbers_from(record.action, planner.problem.action_size)
    elif history.pending is None:
        raise RecordError("is of a performance of which no action was written down")
    else:
        history.actions.append(history.pending)
        history.performed(planner, record.reward)


def _replay_observation(planner: Planner, history: History, record: ObservedRecord) -> None:
    state = history.state
    if not planner.needs_sensing(state):
        raise RecordError("is an observation where a task action is due")
    observation = numbers_from(record.observation, len(record.observation) // 8)
    after, info = planner.observe(state, record.sensing_action, observation)
    reached = planner.digest(after)
    if reached != record.digest:
        raise RecordError(
            "leads to another state than it did when it was written: the problem is not "
            "deterministic, its code has changed, or the journal is damaged"
        )
    history.observed(record, after, explained=info.explained)


class Robot:
    """The loop of one robot over the trials of a run.

    Parameters
    ----------
    planner : Planner
    simulator : SimulatorSettings
        Seed, and the number of steps after which a trial has failed.
    dispatcher : DecisionSource
        Gets the questions answered; it is this robot's alone.
    rate_hz : float or None
        Task actions a second; None acts as soon as it can.

    Attributes
    ----------
    missed_ticks : int
        Ticks of ``rate_hz`` that passed while the robot was not ready.
    has_decided : bool
        Whether an answer has been used yet, in this process.
    """

    def __init__(
        self,
        planner: Planner,
        simulator: SimulatorSettings,
        dispatcher: DecisionSource,
        rate_hz: float | None = None,
    ) -> None:
        self._planner = planner
        self._simulator = simulator
        self._dispatcher = dispatcher
        self._period_s = None if rate_hz is None else 1.0 / rate_hz
        # One list for both, because the order of all effects counts.
        self._effects = dispatcher.effects
        self._history: History | None = None
        self._trial = 0
        self._done: Done = False
        self._in_environment = False
        self._sensing_action = 0
        self._computed_ms = 0.0
        self._unwritten: list[Record] = []
        self._pausing = False
        self._stopped = False
        self._next_tick: float | None = None
        self._asleep_until: float | None = None
        self._recoveries_counted = 0
        self._told_ticks = 0
        self._tell_ticks_at = 0.0
        self.missed_ticks = 0
        self.has_decided = False

    @property
    def status(self) -> Status:
        """Who decides."""
        return self._dispatcher.status

    @property
    def is_holding(self) -> bool:
        """Whether the robot holds still because nobody can be asked."""
        return self._dispatcher.is_holding

    @property
    def num_unverified(self) -> int:
        """Answers that the robot's own planner still has to compute again."""
        return self._dispatcher.num_unverified

    @property
    def trial(self) -> int | None:
        """The trial that is running, None between two."""
        return None if self._history is None else self._trial

    @property
    def step(self) -> int | None:
        """The step of the trial that is running, None between two."""
        return None if self._history is None else self._history.state.step

    @property
    def state(self) -> PlanningState | None:
        """The state of the trial that is running, None between two."""
        return None if self._history is None else self._history.state

    @property
    def unexplained_observations(self) -> int:
        """Those of the trial that is running; 0 between two."""
        return 0 if self._history is None else self._history.num_unexplained

    def start(self, now: float) -> list[Effect]:
        """Begin the run: from now on services are looked for."""
        self._dispatcher.start(now)
        return self._take()

    def begin_trial(
        self, trial: int, history: History, begun: Begun, now: float, *, tail_is_certain: bool
    ) -> list[Effect]:
        """Begin a trial, or go on with one.

        Parameters
        ----------
        trial : int
        history : History
            From :func:`replay`; of no records for a new trial.
        begun : Begun
            What the environment says: whether the task is done or has failed and, if it can tell,
            how many task actions it has performed in this trial.
        now : float
        tail_is_certain : bool
            Whether the records are surely all that were ever written: no power was cut since, and
            none of the journal's files.
        """
        self._trial = trial
        self._history = history
        self._done = begun.done
        self._in_environment = False
        self._unwritten = []
        self._next_tick = None
        resumed = history.begun
        if resumed:
            self._report("resumed_trial", trial=trial, step=history.state.step)
        try:
            again = self._settle_performance(begun.steps_performed, resumed, tail_is_certain)
        except UnknownPerformanceError as error:
            self._stop(error)
            return self._take()
        if again is not None:
            # It is in the journal already, and the environment says that it was not performed.
            self._in_environment = True
            self._effects.append(Act(history.state.step, again))
        else:
            self._go_on(now)
        return self._take()

    def _settle_performance(
        self, performed: int | None, resumed: bool, tail_is_certain: bool
    ) -> FloatArray | None:
        """Find out whether the last action written down was performed; return it if it was not."""
        history = self._history
        assert history is not None
        known = history.state.step
        where = f"trial {self._trial}, step {history.state.step}"
        if performed is None:
            if not resumed or (history.pending is None and (history.paused or tail_is_certain)):
                return None
            what = (
                "the journal ends with a task action and does not say whether it was performed"
                if history.pending is not None
                else "the journal may lack its last records (the machine was restarted, or a file "
                "of the journal removed or cut)"
            )
            raise UnknownPerformanceError(
                f"{where}: {what}, and the environment has no method steps_performed that could "
                "tell; nothing is performed, because it must never be performed twice. Begin that "
                "trial anew in another directory (--out)"
            )
        if history.pending is not None and performed == known + 1:
            self._unwritten.append(PerformedRecord(known, None))
            self._report("performed_unseen", trial=self._trial, step=known)
            history.performed(self._planner, None)
            return None
        if performed != known:
            raise UnknownPerformanceError(
                f"{where}: the environment says that {performed} task actions were performed in "
                f"this trial, the journal has {known}"
                f"{' and one that may have been' if history.pending is not None else ''}; "
                "they do not belong together, so nothing is performed"
            )
        return history.pending

    # -- what happens ----------------------------------------------------------------------------

    def handle(
        self, event: TransportEvent | EnvironmentEvent | Decided | Planned, now: float
    ) -> list[Effect]:
        """Take note of what a transport, the environment or the robot's own planner delivered."""
        if isinstance(event, Decided):
            self._dispatcher.decided(event, self._num_ordered(), now)
        elif isinstance(event, _OF_THE_BODY):
            # Between trials, or after a stop, whatever comes late is of no use.
            if self._history is not None and self._in_environment and not self._stopped:
                self._in_environment = False
                if event.step != self._history.state.step:
                    self._stop(
                        HeldError(
                            f"the environment answered for step {event.step} where step "
                            f"{self._history.state.step} was asked of it; the robot holds still"
                        )
                    )
                elif isinstance(event, Sensed):
                    self._sensed(event, now)
                elif isinstance(event, Acted):
                    self._acted(event)
                else:
                    self._failed(event)
        elif not isinstance(event, Begun):
            self._dispatcher.handle(event, now)
        self._go_on(now)
        return self._take()

    def _num_ordered(self) -> int:
        """Return how many task actions of the question's answer are performed, or ordered."""
        question, history = self._dispatcher.question, self._history
        if question is None or history is None:
            return 0
        return history.state.step - question.state.step + (history.pending is not None)

    def recovery_exited(self, launch: int, reason: str, now: float) -> list[Effect]:
        """Take note that a process of the local service has ended, or could not be started."""
        self._dispatcher.recovery_exited(launch, reason, now)
        self._go_on(now)
        return self._take()

    def wake(self, now: float) -> list[Effect]:
        """Take note of the time."""
        self._dispatcher.wake(now)
        self._go_on(now)
        return self._take()

    def was_deaf(self, seconds: float) -> None:
        """Take note that for this long nothing that came could be heard.

        A write to a slow disk, a stopped process: whoever was silent in that time is not to blame.
        """
        self._dispatcher.was_deaf(seconds)

    def pause(self, now: float) -> list[Effect]:
        """End in order: after what is being performed, write everything down and stand still.

        If that was the end of a trial, :class:`EndTrial` comes instead of :class:`Paused`, and no
        other trial must be begun.
        """
        self._pausing = True
        self._go_on(now)
        return self._take()

    def salvage(self) -> list[Journal]:
        """Return what is still to be written down, after a method of this machine has raised."""
        self._write()
        return [effect for effect in self._dispatcher.take() if isinstance(effect, Journal)]

    def next_wakeup(self) -> float | None:
        """Return when :meth:`wake` must be called if nothing happens before."""
        asleep_until, due = self._asleep_until, self._dispatcher.next_wakeup()
        if asleep_until is None or due is None:
            return due if asleep_until is None else asleep_until
        return min(asleep_until, due)

    # -- the environment -------------------------------------------------------------------------

    def _sensed(self, event: Sensed, now: float) -> None:
        history = self._history
        assert history is not None
        state = history.state
        try:
            after, info = self._planner.observe(state, self._sensing_action, event.observation)
        except HoldfastError as error:
            self._stop(error)
            return
        reached = self._planner.digest(after)
        record = ObservedRecord(
            state.step,
            self._sensing_action,
            numbers_to(event.observation),
            reached,
            self._computed_ms,
        )
        history.observed(record, after, explained=info.explained)
        self._write(record)
        if not info.explained:
            self._tell_unexplained(state.step, info)
        if not self._pausing:
            self._ask(reached, now)

    def _tell_unexplained(self, step: int, info: ObservationInfo) -> None:
        """Say that the last observation was unexplained, and if it is one too many in a row."""
        history = self._history
        assert history is not None
        gate = f"{UNEXPLAINED_DEVIATIONS_SQUARED**0.5:g} standard deviations"
        if history.num_unexplained <= _MOST_TOLD:
            distance = info.mahalanobis_distance
            fields: dict[str, object] = {} if distance is None else {"deviations": distance}
            more = history.num_unexplained == _MOST_TOLD
            self._report(
                "unexplained",
                trial=self._trial,
                step=step,
                sensing_action=self._sensing_action,
                **fields,
                reason=(
                    "no particle can have made it"
                    if distance is None
                    else f"outside the validation gate of every particle ({gate})"
                )
                + ("; further ones of this trial are counted only" if more else ""),
            )
        if (
            history.unexplained_in_a_row == _DIVERGENCE_RUN
            and history.num_divergences <= _MOST_TOLD
        ):
            self._report(
                "filter_diverged",
                trial=self._trial,
                step=step,
                reason=f"the last {_DIVERGENCE_RUN} observations were unexplained: the belief has "
                "lost the state, or the problem's model is wrong; the robot goes on",
            )

    def _acted(self, event: Acted) -> None:
        self._done = event.done
        self._performed(event.reward)

    def _performed(self, reward: float | None) -> None:
        history = self._history
        assert history is not None
        self._unwritten.append(PerformedRecord(history.state.step, reward))
        try:
            history.performed(self._planner, reward)
        except HoldfastError as error:
            self._stop(error)

    def _failed(self, event: EnvironmentFailed) -> None:
        where = f"the robot holds still in trial {self._trial}, step {event.step}"
        if event.performed:
            # What is written down now needs no environment that counts when the run goes on.
            self._performed(event.reward)
            if self._stopped:
                return
            where += ", whose task action was performed"
        # The account of the failure comes last: it may have many lines.
        if not event.performance_unknown:
            self._stop(HeldError(f"{where}: {event.text}"))
        elif event.counts:
            self._stop(
                HeldError(
                    f"{where}, and whether its task action was performed is not known: {event.text}"
                )
            )
        else:
            self._stop(
                UnknownPerformanceError(
                    f"{where}, and nobody can say whether its task action was performed, because "
                    "the environment has no method steps_performed; this trial cannot be gone on "
                    f"with, since no action must be performed twice: {event.text}"
                )
            )

    # -- the loop --------------------------------------------------------------------------------

    def _go_on(self, now: float) -> None:
        """Do the next thing if nothing has to be waited for."""
        self._asleep_until = None
        history = self._history
        self._stopped = self._stopped or self._dispatcher.stopped
        if history is None or self._in_environment or self._stopped:
            if self._pausing and history is None:
                self._effects.append(Paused())
            return
        state = history.state
        if self._done or state.step >= self._simulator.max_steps:
            # Before a pause: that the task is done, and how it ended, is in no other record.
            self._end_trial(now)
            return
        if self._pausing:
            self._write(PausedRecord())
            self._history = None
            self._dispatcher.drop()
            self._effects.append(Paused())
            return
        if self._planner.needs_sensing(state):
            self._next_sensing(state, now)
        else:
            self._next_action(state, now)

    def _next_sensing(self, state: PlanningState, now: float) -> None:
        question = self._dispatcher.question
        if question is None or question.sensing_step != state.step:
            self._ask(self._planner.digest(state), now)
            question = self._dispatcher.question
            assert question is not None
        answer = question.sensing
        if answer is None or question.disputed:
            self._dispatcher.need(now)
            return
        if (
            question.state is not state
            and answer.digest != self._planner.digest(state)[:DIGEST_SIZE]
        ):
            # Chosen for another state than this: the service's belief has drifted from ours.
            self._report("prefetch_unused", trial=self._trial, step=state.step)
            self._dispatcher.check()
            self._ask(self._planner.digest(state), now)
            self._dispatcher.need(now)
            return
        source = question.sensing_source
        assert source is not None
        self._computed_ms = 1e3 * source.computed_s
        self._timed("sensing", question, source, now)
        self._sensing_action = answer.sensing_action
        self._in_environment = True
        self._write()
        self._effects.append(Sense(state.step, answer.sensing_action))

    def _next_action(self, state: PlanningState, now: float) -> None:
        question = self._dispatcher.question
        offset = -1 if question is None else state.step - question.state.step
        if question is None or question.task_count == 0 or not 0 <= offset < question.task_count:
            self._ask(self._planner.digest(state), now)
            question = self._dispatcher.question
            assert question is not None
            offset = 0
        if question.tasks is None or question.disputed:
            self._dispatcher.need(now)
            return
        if offset == 0 and question.task_source is not None:
            self._timed("task", question, question.task_source, now)
            question.task_source = None
            self._dispatcher.go_on()
        if not self._is_due(now):
            return
        action = question.tasks[offset]
        if not self._dispatcher.limits_tell and question.own is None:
            own = self._planner.choose_task_action(state)
            if not same_actions([own], [action]):
                self._dispatcher.dispute()
                self._dispatcher.need(now)
                return
        self._write(ActingRecord(state.step, numbers_to(action)))
        history = self._history
        assert history is not None
        history.pending = action
        self._in_environment = True
        self._effects.append(Act(state.step, action))

    def _ask(self, state_digest: bytes, now: float) -> None:
        history = self._history
        assert history is not None
        self._write()
        question = Question(
            self._planner.settings,
            history.state,
            state_digest,
            history.observations,
            history.num_observations,
        )
        self._dispatcher.ask(question, now)

    def _is_due(self, now: float) -> bool:
        """Tell whether it is time for the next task action; if not, sleep until it is."""
        if self._period_s is None:
            return True
        tick = now if self._next_tick is None else self._next_tick
        if now < tick:
            self._asleep_until = tick
            return False
        missed = int((now - tick) / self._period_s)
        if missed:
            self.missed_ticks += missed
            if now >= self._tell_ticks_at:
                self._tell_ticks(now)
        self._next_tick = tick + (missed + 1) * self._period_s
        return True

    def _tell_ticks(self, now: float) -> None:
        """Report ticks missed since the last time, if there are any."""
        missed = self.missed_ticks - self._told_ticks
        if missed:
            self._told_ticks = self.missed_ticks
            self._tell_ticks_at = now + _TICKS_INTERVAL_S
            self._report("missed_ticks", missed=missed, total=self.missed_ticks)

    def _end_trial(self, now: float) -> None:
        history = self._history
        assert history is not None
        state = history.state
        self._tell_ticks(now)
        history.log.ended(state.step, self._planner.digest(state))
        decisions = history.log.decisions()
        self._count_recoveries()
        sensing_ms = tuple(history.sensing_ms)
        result = TrialResult(
            trial=self._trial,
            seed=self._simulator.seed,
            success=self._done is True,
            failed=self._done == "failed",
            steps=state.step,
            reward=history.total_reward if state.step else 0.0,
            sensing_decisions=history.num_observations,
            mean_sensing_ms=sum(sensing_ms) / len(sensing_ms) if sensing_ms else 0.0,
            recoveries=history.recoveries,
            unexplained_observations=history.num_unexplained,
            digest=decisions.digest(),
            sensing_ms=sensing_ms,
            decisions=decisions,
        )
        self._history = None
        self._unwritten = []  # the result says all of it
        self._dispatcher.drop()
        self._effects.append(EndTrial(result))

    # -- effects ---------------------------------------------------------------------------------

    def _write(self, *records: Record) -> None:
        history = self._history
        if history is not None and (records or self._unwritten or history.begun):
            # A trial of which there is nothing else has not begun.
            self._count_recoveries()
        self._unwritten += records
        if self._unwritten:
            # What the dispatcher wants to send may rest on these records, so they go first.
            self._effects.append(Journal(self._trial, tuple(self._unwritten)))
            self._unwritten = []

    def _count_recoveries(self) -> None:
        """Count, and write down, that another service had to take over.

        What happens between two trials counts for the second one.
        """
        history = self._history
        assert history is not None
        times = self._dispatcher.recoveries - self._recoveries_counted
        if times:
            self._recoveries_counted = self._dispatcher.recoveries
            history.recoveries += times
            self._unwritten.append(RecoveredRecord(times))

    def _timed(self, kind: str, question: Question, source: Provenance, now: float) -> None:
        self.has_decided = True
        waited_s = 0.0 if question.needed_at is None else now - question.needed_at
        step = question.state.step if kind == "task" else question.sensing_step
        self._effects.append(
            Timing(
                self._trial,
                step if step is not None else question.state.step,
                kind,
                source.service,
                self._dispatcher.status.value,
                1e3 * waited_s,
                1e3 * source.round_trip_s,
                1e3 * source.computed_s,
            )
        )

    def _report(self, name: str, **fields: object) -> None:
        self._effects.append(Report(name, fields))

    def _stop(self, error: HoldfastError) -> None:
        self._stopped = True
        self._write()
        self._effects.append(Stop(error))

    def _take(self) -> list[Effect]:
        # Before the robot waits for whatever comes next: it may be killed while it waits.
        self._write()
        return self._dispatcher.take()
