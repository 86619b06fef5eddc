"""The robot's process: one event loop, one state machine, and its effects carried out in order.

Every event (of the wire, the environment, the local service, a signal) is handled on one asyncio
loop: it is passed to the state machine (:class:`holdfast.protocol.robot.Robot`), and the returned
effects are carried out. An event that arrives during an effect (a simulated world answers at once)
waits until earlier effects are carried out. The loop waits for events alone, so the robot reacts to
a dead service even while it moves slowly.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import os
import signal
import sys
from collections import deque
from collections.abc import Callable, Collection, Iterator
from time import monotonic
from typing import Any, NamedTuple, TypeAlias

from holdfast.config.loader import Configuration
from holdfast.config.user_code import account_of_user_error, describe_problem_error
from holdfast.errors import DEFECT, HeldError, HoldfastError, TrialError, defect_fields
from holdfast.journal.journal import Journal
from holdfast.planning.outcome import TrialResult
from holdfast.planning.planner import PlanningState
from holdfast.planning.tracking import Trial, replay
from holdfast.protocol.dispatcher import Dispatcher
from holdfast.protocol.effects import LogEvent
from holdfast.protocol.question import DecisionSource, InProcessSource
from holdfast.protocol.robot import Robot
from holdfast.protocol.robot_events import (
    Abandon,
    Act,
    ComputeOwnAnswer,
    EndTrial,
    EnvironmentEvent,
    EnvironmentFailed,
    EnvironmentReady,
    Halt,
    Launch,
    OwnAnswer,
    Paused,
    RecoveryExited,
    RobotEffect,
    Send,
    Sense,
    Timing,
    TransportEvent,
    VerificationNoted,
    WriteRecords,
)
from holdfast.robot.ending_signals import ending_signals
from holdfast.robot.environment_maker import EnvironmentMaker
from holdfast.robot.environment_runner import EnvironmentRunner, make_runner
from holdfast.robot.health import Condition, RobotWatch
from holdfast.robot.links import RECOVERY_SERVICE, Links
from holdfast.robot.own_planner import OwnPlanner
from holdfast.robot.session_configuration import session_configuration_of
from holdfast.runtime.events import EventSink

_LAST_VERIFICATION_S = 10.0
"""Longest wait for unfinished verifications once all trials are finished."""

_LOOP_STALL_S = 0.005
"""A longer stall of the loop is not counted against any service."""

_TURN_S = 0.001
"""After handling events for this long, the loop polls the wire before the next one."""

_TURN_WITHOUT_WIRE_S = 0.02
"""The same without services, where only signals come from outside: polling costs time."""

_SWITCH_INTERVAL_S = 0.0005
"""Longest time that a thread holds the interpreter while another one waits for it."""


class _Interrupted(NamedTuple):
    """A request to end in order, by a signal or by :meth:`RobotProcess.pause`."""

    number: int | None
    within_s: float | None = None


_Happening: TypeAlias = (
    TransportEvent | EnvironmentEvent | OwnAnswer | RecoveryExited | _Interrupted
)


class RobotProcess:
    """Runs the trials of a configuration, one after another."""

    def __init__(
        self,
        configuration: Configuration,
        # Their transport is closed at the end. Without one the robot's own planner decides.
        links: Links,
        journal: Journal,
        maker: EnvironmentMaker,
        events: EventSink,
        # on_result, on_timing, on_verified: store the result of each trial, the times of each
        # decision, and the result of each verified answer.
        on_result: Callable[[TrialResult], None],
        on_timing: Callable[[Timing], None],
        on_verified: Callable[[VerificationNoted], None],
        rate_hz: float | None = None,  # task actions a second; None acts as soon as possible
        distrusted: Collection[str] = (),  # services that answered wrongly earlier in the run
        watch: RobotWatch | None = None,
        # Gets each order to the environment and the state in which it was decided, on the event
        # loop; it must return at once.
        on_order: Callable[[PlanningState, Act | Sense], None] | None = None,
    ) -> None:
        self._watch = watch
        self._on_order = on_order
        self._configuration = configuration
        self._transport = links.transport
        self._turn_s = _TURN_WITHOUT_WIRE_S if links.transport is None else _TURN_S
        self._journal = journal
        self._maker = maker
        self._events = events
        self._on_result = on_result
        self._on_timing = on_timing
        self._on_verified = on_verified
        self._loop: asyncio.AbstractEventLoop | None = None
        # Events that are not handled yet, with their times.
        self._happened: deque[tuple[float, _Happening]] = deque()
        self._handling = self._goes_on_soon = False
        self._now = monotonic()
        self._wake_at: float | None = None
        self._listens_since = self._now
        self._timer: asyncio.TimerHandle | None = None
        self._error: BaseException | None = None
        self._launcher = links.launcher
        self._runner: EnvironmentRunner | None = None
        self._replayed: int | None = None
        self._starting: tuple[int, Trial, bool] | None = None
        self._finished: set[int] = set()
        self._numbers = iter(range(configuration.simulator.num_trials))
        self._verifying = False
        self._ended = False
        self._closing = False
        self._interrupted: _Interrupted | None = None
        problem = configuration.problem
        simulator = configuration.simulator
        epoch = journal.raise_epoch()
        dispatcher: DecisionSource
        if links.transport is None:
            dispatcher = InProcessSource()
        else:
            dispatcher = Dispatcher(
                configuration.offload.services,
                None if links.launcher is None else RECOVERY_SERVICE,
                configuration.offload,
                configuration.recovery,
                journal.session(),
                epoch,
                session_configuration_of(configuration),
                problem,
                os.urandom(32),
                distrusted,
            )

        self._own = OwnPlanner(
            lambda: links.make_planner(
                Configuration.from_plain(configuration.plain()).problem, configuration.planning
            ),
            functools.partial(describe_problem_error, configuration.problem_name),
            self._happens,
            self._fail,
            may_be_brief=":" not in configuration.problem_name,
        )
        self._planner = links.make_planner(problem, configuration.planning)
        # Who decides, the observations of the current trial that nothing explains, missed ticks.
        self.robot = Robot(self._planner, simulator, dispatcher, rate_hz, configuration.lost)

    def condition(self) -> Condition:
        """Return the robot's condition."""
        robot = self.robot
        if self._interrupted is not None or self._verifying:
            return Condition("ending", False, robot.trial)
        if robot.is_holding:
            return Condition("holding still", False, robot.trial)
        if not robot.has_decided:
            return Condition("starting", False, robot.trial)
        return Condition(robot.status.value, True, robot.trial)

    def pause(self, within_s: float) -> None:
        """End the run in order, from any thread, before or while it runs; may be repeated.

        :meth:`run` returns once the environment's call has ended and the journal is written. If
        that call takes longer than ``within_s``, it is abandoned, and :meth:`run` raises a
        :class:`~holdfast.errors.HeldError`. The run can be resumed in either case.
        """
        self._interrupt(None, within_s)

    def run(self, finished: Collection[int]) -> None:
        """Run all trials that are not finished, on a new event loop.

        Raises HoldfastError if the robot holds still and cannot go on; the journal has everything
        to resume. After Ctrl-C or another ending signal, once the journal is written, raises
        KeyboardInterrupt or what the caller's handler of that signal raises. Other threads than the
        main one use :meth:`pause`.
        """
        self._finished = set(finished)
        self._loop = loop = asyncio.new_event_loop()
        loop.set_exception_handler(self._loop_failed)
        before = sys.getswitchinterval()
        sys.setswitchinterval(_SWITCH_INTERVAL_S)
        try:
            if self._watch is not None:
                loop.run_until_complete(self._watch.start(self.condition, self.robot))
            with ending_signals(loop, self._interrupt):
                loop.call_soon(self._start)
                loop.run_forever()
                self._raise_error()
        except HoldfastError:
            self._salvage()
            raise
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            self._salvage()
            account = account_of_user_error(error, self._configuration.problem_name)
            if account is None:
                raise
            text = f"{self._where()}: {account}"
            self._events.event("stopped", reason=text)
            raise TrialError(text) from error
        finally:
            sys.setswitchinterval(before)
            self._ended = self._closing = True
            if self._watch is not None:
                loop.run_until_complete(self._watch.close())
            if self._runner is not None:
                self._runner.close()
            if self._transport is not None:
                loop.run_until_complete(self._transport.close())
            self._own.close()
            if self._launcher is not None:
                self._launcher.close()
            loop.close()
        if self._interrupted is not None and self._interrupted.number is not None:
            signal.raise_signal(self._interrupted.number)

    def _salvage(self) -> None:
        """Journal all known facts before an error ends the run."""
        with contextlib.suppress(HoldfastError):
            for effect in self.robot.salvage():
                self._journal.append(effect.trial, effect.records)

    def _where(self) -> str:
        seed = self._configuration.simulator.seed
        if self._replayed is not None:
            return f"trial {self._replayed} (seed {seed}), as the journal has it"
        if self._starting is not None:
            return f"trial {self._starting[0]} (seed {seed})"
        step = None if (state := self.robot.state) is None else state.step
        return f"trial {self.robot.trial} (seed {seed}), step {step}"

    def _interrupt(self, number: int | None, within_s: float | None = None) -> None:
        """Ask for an end in order, from any thread or a signal's handler."""
        self._happened.append((monotonic(), _Interrupted(number, within_s)))
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._go_on)

    # -- on the loop -----------------------------------------------------------------------------

    def _start(self) -> None:
        with self._errors():
            if self._transport is not None:
                self._transport.start(self._hear)
            self._now = monotonic()
            self._carry_out(self.robot.start(self._now))
            self._begin_next()
        self._go_on()

    def _happens(self, event: _Happening, at: float | None = None) -> None:
        """Handle an event, after the one that is being handled."""
        self._happened.append((monotonic() if at is None else at, event))
        if not self._handling:
            self._go_on()

    def _hear(self, event: TransportEvent) -> None:
        """Queue an event of the wire; it is handled when the link's turn, which is short, ends."""
        self._happened.append((monotonic(), event))
        if not self._handling:
            self._go_on_soon()

    def _go_on_soon(self) -> None:
        if not self._goes_on_soon:
            self._goes_on_soon = True
            self._on_loop().call_soon(self._go_on)

    def _wake(self) -> None:
        self._timer = None
        self._go_on(wake=self._wake_at is not None and monotonic() >= self._wake_at)

    def _go_on(self, *, wake: bool = False) -> None:
        """Handle queued events, and set the timer that the state machine asks for."""
        self._goes_on_soon = False
        began = now = monotonic()
        if self._wake_at is not None:
            # This process was stopped, or another one had its core: no service is to blame.
            self._event_loop_stalled(now - max(self._wake_at, self._listens_since))
        with self._errors():
            if wake and not self._ended:
                self._now = max(self._now, now)
                self._carry_out(self.robot.wake(self._now))
                before, now = now, monotonic()
                self._event_loop_stalled(now - before)
            while not self._ended and (self._happened or self._own.compute_brief()):
                if now - began > self._turn_s:
                    self._go_on_soon()
                    break
                at, event = self._happened.popleft()
                # The time of the event; its handling may be long after.
                self._now = max(self._now, at)
                self._handle(event, self._now)
                before, now = now, monotonic()
                self._event_loop_stalled(now - before)
        if self._ended:
            self._stop_loop()
            return
        self._listens_since = now
        self._wake_at = wake_at = self.robot.next_wakeup()
        # A timer that fires too early does no harm.
        if wake_at is not None and (self._timer is None or wake_at < self._timer.when()):
            if self._timer is not None:
                self._timer.cancel()
            self._timer = self._on_loop().call_at(wake_at, self._wake)

    def _event_loop_stalled(self, seconds: float) -> None:
        if seconds > _LOOP_STALL_S:
            self.robot.event_loop_stalled(seconds)

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        """End the run at an error, which :meth:`run` raises."""
        self._handling = True
        try:
            yield
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # noqa: BLE001 - the problem is anybody's code
            self._fail(error)
        finally:
            self._handling = False

    def _fail(self, error: BaseException) -> None:
        self._error = self._error or error
        self._end()

    def _raise_error(self) -> None:
        if self._error is not None:
            raise self._error

    def _abandon_call(self, within_s: float) -> None:
        self._fail(
            HeldError(f"{self._where()}: the environment has not ended its call in {within_s:g} s")
        )

    def _end(self) -> None:
        self._ended = True
        self._stop_loop()

    def _stop_loop(self) -> None:
        if not self._closing:  # else the loop runs to close the links
            self._on_loop().stop()

    def _loop_failed(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """End the run at an error of other code on the loop, for nothing else would notice it.

        An error of a link ends that link alone; asyncio closes it.
        """
        del loop
        error = context.get("exception") or RuntimeError(context["message"])
        if "protocol" in context:
            self._events.event(DEFECT, **defect_fields(error))
        else:
            self._fail(error)

    def _on_loop(self) -> asyncio.AbstractEventLoop:
        assert self._loop is not None
        return self._loop

    def _handle(self, event: _Happening, now: float) -> None:
        robot = self.robot
        if isinstance(event, _Interrupted):
            self._interrupted = self._interrupted or event
            if event.within_s is not None:
                self._on_loop().call_later(event.within_s, self._abandon_call, event.within_s)
            if self._watch is not None:
                self._watch.ending()
            self._carry_out(robot.pause(now))
        elif self._starting is not None and isinstance(event, EnvironmentReady | EnvironmentFailed):
            trial, history, tail_is_certain = self._starting
            self._starting = None
            if isinstance(event, EnvironmentFailed):
                raise HeldError(f"trial {trial} cannot go on at step {event.step}: {event.text}")
            self._carry_out(robot.begin_trial(history, event, now, tail_is_certain=tail_is_certain))
            if self._watch is not None:
                self._watch.begun()
        elif not isinstance(event, EnvironmentReady):
            self._carry_out(robot.handle(event, now))
            if self._verifying and isinstance(event, OwnAnswer):
                self._ended = not robot.num_unverified

    def _carry_out(self, effects: list[RobotEffect]) -> None:
        for effect in effects:
            if isinstance(effect, WriteRecords):
                self._journal.append(effect.trial, effect.records)
            elif isinstance(effect, Act):
                assert self._runner is not None
                self._report_order(effect)
                self._runner.perform(effect.step, effect.action)
            elif isinstance(effect, Sense):
                assert self._runner is not None
                self._report_order(effect)
                self._runner.sense(effect.step, effect.sensing_action)
            elif isinstance(effect, Timing):
                self._on_timing(effect)
                if self._watch is not None:
                    self._watch.timed(effect)
            elif isinstance(effect, Send):
                assert self._transport is not None
                self._transport.call(effect.service, effect.call, effect.payload)
            elif isinstance(effect, ComputeOwnAnswer):
                self._own.ask(effect)
            elif isinstance(effect, VerificationNoted):
                self._on_verified(effect)
            elif isinstance(effect, Abandon):
                assert self._transport is not None
                self._transport.abandon(effect.call)
            elif isinstance(effect, LogEvent):
                self._events.event(effect.name, **effect.fields)
            elif isinstance(effect, Launch):
                assert self._launcher is not None
                self._launcher.launch(effect.number, self._happens)
            elif isinstance(effect, EndTrial):
                self._end_trial(effect.result)
            elif isinstance(effect, Paused):
                self._ended = True
            elif isinstance(effect, Halt):
                self._events.event("stopped", reason=str(effect.error))
                raise effect.error

    def _report_order(self, order: Act | Sense) -> None:
        if self._on_order is not None and (state := self.robot.state) is not None:
            self._on_order(state, order)

    def _end_trial(self, result: TrialResult) -> None:
        if self._runner is not None:
            self._runner.close()
            self._runner = None
        self._on_result(result)
        if self._watch is not None:
            self._watch.ended(result)
        self._finished.add(result.trial)
        self._events.event(
            "trial",
            trial=result.trial,
            success=result.success,
            outcome=result.outcome,
            reason=result.reason or None,
            steps=result.steps,
            recoveries=result.recoveries,
            unexplained_observations=result.unexplained_observations,
            digest=result.digest[:16],
        )
        self._begin_next()

    def _begin_next(self) -> None:
        """Make the environment of the next trial; the trial begins when it is there."""
        if self._interrupted is not None:
            self._ended = True
            return
        unfinished = self._journal.unfinished()
        if unfinished is not None:
            trial, records = unfinished.trial, unfinished.records
            tail_is_certain = unfinished.is_complete
        else:
            following = next((n for n in self._numbers if n not in self._finished), None)
            if following is None:
                left = self.robot.num_unverified
                if left:
                    self._events.event(
                        "verifying", reason=f"{left} answers are still being computed again"
                    )
                self._verifying = True
                self._ended = not left
                self._on_loop().call_later(_LAST_VERIFICATION_S, self._end)
                return
            trial, records, tail_is_certain = following, [], True
        self._replayed = trial
        seed = self._configuration.simulator.seed
        rate = self._configuration.lost.false_alarm_rate
        history = replay(self._planner, seed, trial, records, rate)
        self._replayed = None
        self._starting = (trial, history, tail_is_certain)
        self._runner = make_runner(
            self._maker, trial, self._happens, resumed=history.begun, performed=history.actions
        )
        self._runner.begin(history.state.step)
