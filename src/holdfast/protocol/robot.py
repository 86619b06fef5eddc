"""The robot's loop as a state machine: sense, decide, write down, act, once and in order.

The robot holds the true state: its belief, folded from what it sensed and did. Services only
compute what follows from it. Each turn takes the next decision from the current answer, orders it
from the environment and folds in the result. A task action is in the journal before it is ordered,
an observation before what follows from it is used; only a question leaves sooner, since a service
that knows more than the journal does no harm. When the answer is used up, the robot asks a new one.

While the robot performs the task actions of an answer, the next sensing action is already being
computed. It is used only if the state in which it was chosen is, bit for bit, the one in which the
robot arrives.

The machine touches nothing. Methods take an event and the time and return effects
(:mod:`holdfast.protocol.robot_events`), to be carried out in order. If nothing happens before
:meth:`Robot.next_wakeup`, the shell calls :meth:`Robot.wake`.
"""

from __future__ import annotations

from holdfast.errors import HeldError, HoldfastError, UnknownPerformanceError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.inputs import (
    ActingRecord,
    Late,
    LocalTookOverRecord,
    Moved,
    PausedRecord,
    Record,
    Reinitialised,
    Sensed,
    encode_floats,
    has_shown,
)
from holdfast.planning.outcome import Ending
from holdfast.planning.planner import Planner, PlanningState
from holdfast.planning.settings import LostSettings, SimulatorSettings
from holdfast.planning.tracking import Trial
from holdfast.protocol.messages import DIGEST_SIZE
from holdfast.protocol.observation_warnings import ObservationWarnings, held_error
from holdfast.protocol.question import DecisionSource, Provenance, Question
from holdfast.protocol.robot_events import (
    Act,
    Acted,
    EndTrial,
    EnvironmentEvent,
    EnvironmentFailed,
    EnvironmentReady,
    Halt,
    NoReading,
    OwnAnswer,
    Paused,
    RecoveryExited,
    RobotEffect,
    Sense,
    Timing,
    TransportEvent,
    WriteRecords,
)
from holdfast.protocol.status import Status

_TICKS_INTERVAL_S = 1.0
"""Missed ticks are reported at most this often."""


class Robot:
    """The loop of one robot over the trials of a run.

    ``rate_hz`` is task actions per second; None is as soon as possible.
    """

    def __init__(
        self,
        planner: Planner,
        simulator: SimulatorSettings,
        source: DecisionSource,
        rate_hz: float | None = None,
        lost: LostSettings | None = None,
    ) -> None:
        self._planner = planner
        self._simulator = simulator
        self._source = source
        self._lost = LostSettings() if lost is None else lost
        self.reports = ObservationWarnings(source.effects, self._lost)
        self._period_s = None if rate_hz is None else 1.0 / rate_hz
        # One list for both, because the order of all effects counts.
        self._effects = source.effects
        self._history: Trial | None = None
        self._ending: Ending | None = None
        self._lost_at: int | None = None
        self._awaits_environment = False
        self._sensing_action = 0
        self._computed_ms = 0.0
        self._timed_provenance: Provenance | None = None
        self._unwritten: list[Record] = []
        # has_decided: whether this process has used an answer.
        self._pausing = self._has_halted = self.has_decided = False
        self._next_tick: float | None = None
        self._asleep_until: float | None = None
        self._report_ticks_at = 0.0
        # num_performed, missed_ticks: task actions performed, and ticks of ``rate_hz`` at which the
        # robot was not ready.
        self._recoveries_counted = self._reported_ticks = self.missed_ticks = self.num_performed = 0

    @property
    def status(self) -> Status:
        """Which service decides."""
        return self._source.tracker.status

    @property
    def is_holding(self) -> bool:
        """Whether the robot holds still, because no service is usable."""
        return self._source.holding_since is not None

    @property
    def num_unverified(self) -> int:
        """Questions that the own planner still has to recompute."""
        return self._source.num_unverified

    @property
    def trial(self) -> int | None:
        """The current trial; None between trials."""
        return None if self._history is None else self._history.state.trial

    @property
    def state(self) -> PlanningState | None:
        """The current state; None between trials."""
        return None if self._history is None else self._history.state

    @property
    def unexplained_observations(self) -> int:
        """Number of unexplained observations of the current trial; 0 between trials."""
        return 0 if self._history is None else self._history.num_unexplained

    @property
    def _current_history(self) -> Trial:
        assert self._history is not None, "between trials"
        return self._history

    def start(self, now: float) -> list[RobotEffect]:
        """Begin the run: start looking for services."""
        self._source.start(now)
        return self._take()

    def begin_trial(
        self,
        # From :func:`~holdfast.planning.tracking.replay`; of no records for a new trial.
        history: Trial,
        begun: EnvironmentReady,
        now: float,
        *,
        # Whether no record can be missing: no power was cut and no file removed since the last.
        tail_is_certain: bool,
    ) -> list[RobotEffect]:
        """Begin or resume a trial."""
        self._history = history
        self._ending = begun.ending
        self._lost_at = None
        self._awaits_environment = False
        self._unwritten = []
        self._next_tick = None
        resumed = history.begun
        if resumed:
            self._effects.report("resumed_trial", trial=self.trial, step=history.state.step)
        try:
            if history.is_lost and history.pending is None and self._lost.on_lost == "reinitialise":
                # The process ended between the observation and this, or held still there.
                self._reinitialise()
            again = self._settle_pending_action(begun, resumed, tail_is_certain)
            for late in begun.late:
                self._take_late_observation(late)
            self._hold_if_lost()
        except HoldfastError as error:
            self._source.stop(error)
            return self._take()
        if again is not None and self._source.stopped_by is None:
            # It is in the journal already, and the environment says that it was not performed.
            self._awaits_environment = True
            self._write()
            self._effects.append(Act(history.state.step, again))
        else:
            self._go_on(now)
        return self._take()

    def _settle_pending_action(
        self, begun: EnvironmentReady, resumed: bool, tail_is_certain: bool
    ) -> FloatArray | None:
        """Return the pending task action if it was not performed and must be performed now."""
        history, performed = self._current_history, begun.steps_performed
        known = history.state.step
        where = f"trial {history.state.trial}, step {history.state.step}"
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
            self._effects.report("performed_unseen", trial=self.trial, step=known)
            self._fold_move(begun.last or Moved(known, None))
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
        self, event: TransportEvent | EnvironmentEvent | OwnAnswer | RecoveryExited, now: float
    ) -> list[RobotEffect]:
        """Handle an event."""
        if isinstance(event, Sensed | NoReading | Acted | EnvironmentFailed):
            # Between trials, or after a stop, whatever comes late is of no use.
            if (
                self._history is not None
                and self._awaits_environment
                and self._source.stopped_by is None
            ):
                self._awaits_environment = False
                if event.step != self._history.state.step:
                    self._source.stop(
                        HeldError(
                            f"the environment answered for step {event.step} where step "
                            f"{self._history.state.step} was asked of it; the robot holds still"
                        )
                    )
                elif isinstance(event, Sensed | NoReading):
                    self._sensed(event, now)
                elif isinstance(event, Acted):
                    self._performed(event)
                else:
                    self._failed(event)
        elif not isinstance(event, EnvironmentReady):
            self._source.handle(event, now)
        self._go_on(now)
        return self._take()

    def wake(self, now: float) -> list[RobotEffect]:
        """Handle the passing of time."""
        self._source.wake(now)
        self._go_on(now)
        return self._take()

    def event_loop_stalled(self, seconds: float) -> None:
        """Note that for so long the process could not receive, as during a slow write."""
        self._source.event_loop_stalled(seconds)

    def pause(self, now: float) -> list[RobotEffect]:
        """End in order: complete the current action, write everything down and stand still.

        If that action ends the trial, :class:`EndTrial` comes instead of :class:`Paused`; no other
        trial must be begun.
        """
        self._pausing = True
        self._go_on(now)
        return self._take()

    def salvage(self) -> list[WriteRecords]:
        """Return the records still to be written, after a method has raised."""
        self._write()
        return [effect for effect in self._effects.take() if isinstance(effect, WriteRecords)]

    def next_wakeup(self) -> float | None:
        """Return when :meth:`wake` is due if nothing happens before; None if never."""
        times = self._asleep_until, self._source.next_wakeup()
        return min((each for each in times if each is not None), default=None)

    # -- the environment -------------------------------------------------------------------------

    def _sensed(self, event: Sensed | NoReading, now: float) -> None:
        history = self._current_history
        step, sensing_action = history.state.step, self._sensing_action
        shown = b"" if isinstance(event, NoReading) else event.observation
        given = Sensed(step, sensing_action, shown, sensing_ms=self._computed_ms)
        try:
            record = history.take(given)
        except HoldfastError as error:
            self._source.stop(error)
            return
        self._unwritten.append(record)
        if isinstance(event, NoReading):
            self.reports.no_reading(history, sensing_action=sensing_action)
        state = history.state
        self._judge(step, sensing_action=sensing_action)
        self._hold_if_lost()
        if not self._pausing and self._source.stopped_by is None:
            is_new = history.state is not state  # its belief has begun anew
            self._ask(self._planner.digest(history.state) if is_new else record.digest, now)

    def _judge(self, step: int, **of_what: object) -> None:
        """Report what the last input has shown, and act if the robot is lost."""
        history = self._current_history
        on_lost = self.reports.observed(history, step, **of_what)
        if on_lost == "hold":
            self._lost_at = step
        elif on_lost == "reinitialise":
            self._reinitialise()

    def _hold_if_lost(self) -> None:
        """Hold still if that is to be done: after all that has come at once is written down."""
        if self._lost_at is not None:
            self._source.stop(held_error(self._current_history, self._lost_at))

    def _reinitialise(self) -> None:
        """Begin the belief anew, before anything else is decided."""
        history = self._current_history
        self._write()  # by itself: what it rests on is known even if this fails
        self._write(history.take(Reinitialised(history.state.step)))
        self.reports.reinitialised(history)

    def _performed(self, event: Acted) -> None:
        self._ending = event.ending
        try:
            self._fold_move(event.moved)
            for late in event.late:
                self._take_late_observation(late)
            for step in event.no_reading:
                self.reports.no_reading(self._current_history, taken=step)
            self._hold_if_lost()
        except HoldfastError as error:
            self._source.stop(error)

    def _fold_move(self, moved: Moved) -> None:
        """Fold in what a performed task action has shown."""
        self.num_performed += 1
        # Before it is written: what cannot be folded in now can never be.
        self._unwritten.append(self._current_history.take(moved))
        self._judge(moved.step, of="move")

    def _take_late_observation(self, late: Late) -> None:
        """Fold in an observation of an earlier step."""
        history = self._current_history
        if late.taken not in history.awaited:
            self.reports.late_unused(history, late.taken)
            return
        # The environment need not know at which step the robot is.
        given = Late(history.state.step, late.taken, late.observation)
        self._unwritten.append(history.take(given))
        self._judge(late.taken, of="late")

    def _failed(self, event: EnvironmentFailed) -> None:
        where = f"the robot holds still in trial {self.trial}, step {event.step}"
        if event.performed is not None:
            # What is written down now needs no environment that counts when the run goes on.
            self._performed(event.performed)
            if self._source.stopped_by is not None:
                return
            where += ", whose task action was performed"
        kind: type[HoldfastError] = HeldError
        if event.action_in_doubt and event.counts_steps:
            where += ", and whether its task action was performed is not known"
        elif event.action_in_doubt:
            kind = UnknownPerformanceError
            where += (
                ", and nobody can say whether its task action was performed, because the "
                "environment has no method steps_performed; this trial cannot be gone on with, "
                "since no action must be performed twice"
            )
        # The account of the failure comes last: it may have many lines.
        self._source.stop(kind(f"{where}: {event.text}"))

    # -- the loop --------------------------------------------------------------------------------

    def _go_on(self, now: float) -> None:
        """Do the next thing, if nothing is awaited."""
        self._asleep_until = None
        history = self._history
        if history is None or self._awaits_environment or self._source.stopped_by is not None:
            if self._pausing and history is None:
                self._effects.append(Paused())
            return
        state = history.state
        if self._ending is not None or state.step >= self._simulator.max_steps:
            # Before a pause: that the task is done, and how it ended, is in no other record.
            self._end_trial(now)
            return
        if self._pausing:
            self._write(PausedRecord())
            self._history = None
            self._source.drop()
            self._effects.append(Paused())
            return
        if self._planner.needs_sensing(state):
            self._next_sensing(state, now)
        else:
            self._next_action(state, now)

    def _next_sensing(self, state: PlanningState, now: float) -> None:
        question = self._question()
        if question is None or question.sensing_step != state.step:
            question = self._ask(self._planner.digest(state), now)
        answer, provenance = question.sensing, question.sensing_provenance
        if answer is None or provenance is None:
            self._source.await_answer(now)
            return
        if (
            question.state is not state
            and answer.digest != self._planner.digest(state)[:DIGEST_SIZE]
        ):
            # Chosen for another state than this: the service's belief has drifted from ours.
            self._effects.report("prefetch_unused", trial=self.trial, step=state.step)
            self._source.recompute()
            self._ask(self._planner.digest(state), now)
            self._source.await_answer(now)
            return
        self._computed_ms = 1e3 * provenance.computed_s
        self._timed("sensing", state, provenance, now)
        self._sensing_action = answer.sensing_action
        if answer.sensing_action == self._planner.no_sensing:
            self._sensed(Sensed(state.step, answer.sensing_action, b""), now)
            self._go_on(now)
            return
        self._awaits_environment = True
        self._write()
        self._effects.append(Sense(state.step, answer.sensing_action))

    def _next_action(self, state: PlanningState, now: float) -> None:
        question = self._question()
        offset = -1 if question is None else state.step - question.state.step
        if question is None or not 0 <= offset < question.task_count:
            question = self._ask(self._planner.digest(state), now)
            offset = 0
            if self._source.stopped_by is not None:
                return
        actions, provenance = question.task_actions, question.task_provenance
        if actions is None or provenance is None:
            self._source.await_answer(now)
            return
        if offset == len(actions):
            try:
                own = self._planner.choose_task_action(state)[0]
            except HoldfastError as error:
                self._source.stop(error)
                return
            question.follow_tasks([*actions, own], provenance)
        if offset == 0 and provenance is not self._timed_provenance:
            self._timed_provenance = provenance
            self._timed("task", state, provenance, now)
        if not self._take_tick(now):
            return
        action = question.order(offset)
        self._write(ActingRecord(state.step, encode_floats(action)))
        history = self._current_history
        history.pending = action
        self._awaits_environment = True
        self._effects.append(Act(state.step, action))

    def _question(self) -> Question | None:
        """Return the current question, unless something was shown since that it does not know."""
        question = self._source.question
        if question is None or question.num_inputs != self._current_history.num_inputs:
            return None
        return question

    def _ask(self, state_digest: bytes, now: float) -> Question:
        history = self._current_history
        question = Question(
            self._planner,
            history.state,
            state_digest,
            history.inputs,
            history.num_inputs,
            self._source.takes_tasks,
        )
        self._source.ask(question, now)
        return question

    def _take_tick(self, now: float) -> bool:
        """Return whether the next task action is due, and take its tick; else set the wakeup."""
        if self._period_s is None:
            return True
        tick = now if self._next_tick is None else self._next_tick
        if now < tick:
            self._asleep_until = tick
            return False
        missed = int((now - tick) / self._period_s)
        if missed:
            self.missed_ticks += missed
            if now >= self._report_ticks_at:
                self._report_ticks(now)
        self._next_tick = tick + (missed + 1) * self._period_s
        return True

    def _report_ticks(self, now: float) -> None:
        """Report ticks missed since the last report."""
        missed = self.missed_ticks - self._reported_ticks
        if missed:
            self._reported_ticks = self.missed_ticks
            self._report_ticks_at = now + _TICKS_INTERVAL_S
            self._effects.report("missed_ticks", missed=missed, total=self.missed_ticks)

    def _end_trial(self, now: float) -> None:
        history = self._current_history
        self._report_ticks(now)
        self._count_recoveries()
        if any(has_shown(record) for record in self._unwritten):
            self._write()
        result = history.result(self._ending)
        self._history = None
        self._unwritten = []  # the result says all of it
        self._source.drop()
        self._effects.append(EndTrial(result))

    # -- effects ---------------------------------------------------------------------------------

    def _write(self, *records: Record) -> None:
        history, is_new = self._history, self._source.tracker.recoveries > self._recoveries_counted
        if is_new and history is not None and (records or self._unwritten or history.begun):
            # A recovery alone does not begin a trial.
            self._count_recoveries()
        self._unwritten += records
        if self._unwritten and history is not None:
            # The effects that follow may rest on these records.
            self._effects.append(WriteRecords(history.state.trial, tuple(self._unwritten)))
            self._unwritten = []

    def _count_recoveries(self) -> None:
        """Count and record recoveries. Those between two trials belong to the second."""
        history = self._current_history
        times = self._source.tracker.recoveries - self._recoveries_counted
        if times:
            self._recoveries_counted = self._source.tracker.recoveries
            history.recoveries += times
            self._unwritten.append(LocalTookOverRecord(times))

    def _timed(self, kind: str, state: PlanningState, provenance: Provenance, now: float) -> None:
        self.has_decided = True
        self._effects.append(
            Timing(
                state.trial,
                state.step,
                kind,
                provenance.service,
                self._source.tracker.status.value,
                1e3 * self._source.end_wait(now),
                1e3 * provenance.round_trip_s,
                1e3 * provenance.computed_s,
            )
        )

    def _take(self) -> list[RobotEffect]:
        # Before the robot waits for whatever comes next: it may be killed while it waits.
        self._write()
        if (error := self._source.stopped_by) is not None and not self._has_halted:
            self._has_halted = True
            self._effects.append(Halt(error))
        return self._effects.take()
