"""The robot's process: one event loop, one machine, and effects carried out in order.

Everything that happens, on the wire, in the environment, to the local service, on the keyboard, is
handled on one asyncio event loop: it is told to the machine
(:class:`holdfast.session.robot.Robot`), and what the machine asks for is carried out. What is heard
from inside an effect (a simulated world answers at once) waits until the effects before it are
carried out. The loop waits for nothing but events, so a robot that moves slowly still hears at once
that a service has died.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import os
import signal
import socket
import sys
import threading
from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence
from time import monotonic
from typing import Any, NamedTuple, Protocol, TypeAlias

from holdfast import contract
from holdfast.configuration import Configuration
from holdfast.errors import HoldfastError, TrialError
from holdfast.outcome import TrialResult
from holdfast.planning import Planner, PlanningState
from holdfast.problems.problem import Problem
from holdfast.problems.registry import problem_class, problem_module
from holdfast.robot.own_decisions import OwnDecisions
from holdfast.robot.own_planning import OwnPlanning
from holdfast.runtime.environment import EnvironmentMaker
from holdfast.runtime.logs import EventSink
from holdfast.runtime.own_planner import OwnPlanner
from holdfast.runtime.performer import Performer, make_performer
from holdfast.runtime.recovery_launcher import RecoveryExited
from holdfast.runtime.robot_watch import Condition, RobotWatch
from holdfast.session.decision_source import DecisionSource
from holdfast.session.dispatcher import Dispatcher
from holdfast.session.effects import (
    Abandon,
    Act,
    Decide,
    Effect,
    EndTrial,
    Journal,
    Launch,
    Paused,
    Plan,
    Report,
    Send,
    Sense,
    Stop,
    Timing,
    Verified,
)
from holdfast.session.events import (
    Begun,
    Decided,
    EnvironmentEvent,
    EnvironmentFailed,
    Planned,
    TransportEvent,
)
from holdfast.session.messages import Opening
from holdfast.session.records import Record
from holdfast.session.robot import HeldError, History, Robot, replay
from holdfast.session.status import Status
from holdfast.settings import OffloadSettings, PlanningSettings
from holdfast.source_digest import core_version, problem_digest
from holdfast.transport.contract import RobotTransport
from holdfast.user_code import account_of_user_error, describe_problem_error

__all__ = ["Launcher", "RobotProcess", "StepJournal", "opening_of"]

_LAST_VERIFICATION_S = 10.0
"""When all trials are finished, what is still being computed again is waited for this long."""

_DEAF_S = 0.005
"""When the loop did not listen for longer than this, no service is blamed for that time."""

_TURN_S = 0.001
"""After handling events for so long, the loop looks at the wire before it handles the next one."""

_TURN_WITHOUT_WIRE_S = 0.02
"""The same without services: nothing but a signal comes from outside, and to look is not free."""

_SWITCH_INTERVAL_S = 0.0005
"""How long a thread may hold the interpreter while the one that has the answer waits for it."""


class UnfinishedTrial(Protocol):
    """What a journal holds of a trial that has not ended."""

    @property
    def trial(self) -> int:
        """Its number."""
        ...

    @property
    def records(self) -> Sequence[Record]:
        """What was written down, in order."""
        ...

    @property
    def is_complete(self) -> bool:
        """Whether these are surely all records that were ever written."""
        ...


class StepJournal(Protocol):
    """Keeps the records of the unfinished trial."""

    def session(self) -> bytes:
        """Return the 16 bytes that name the run."""
        ...

    def raise_epoch(self) -> int:
        """Return a number above all that were returned before; it is on the disk."""
        ...

    def append(self, trial: int, records: Sequence[Record]) -> None:
        """Keep records; when this returns they are safe."""
        ...

    def unfinished(self) -> UnfinishedTrial | None:
        """Return what there is of a trial that has not ended."""
        ...


class Launcher(Protocol):
    """Starts the local service."""

    def launch(self, number: int) -> None:
        """Start it, and end the one that was started before."""
        ...

    def close(self) -> None:
        """End it."""
        ...


class _Interrupted(NamedTuple):
    """The run is to end in order: a signal says so, or :meth:`RobotProcess.pause`."""

    number: int | None
    within_s: float | None = None


_Happening: TypeAlias = (
    TransportEvent | EnvironmentEvent | Decided | Planned | RecoveryExited | _Interrupted
)


def opening_of(configuration: Configuration) -> Opening:
    """Return what services are told of a configuration's run, and of the code of this process."""
    name = configuration.problem_name
    return Opening(
        name,
        dict(configuration.model),
        dict(configuration.state_space_planner),
        configuration.planning,
        configuration.simulator.seed,
        core_version(),
        problem_digest(problem_class(name, configuration.problem_directory), problem_module(name)),
    )


class RobotProcess:
    """Runs the trials of a configuration, one after another.

    Parameters
    ----------
    configuration : Configuration
    services : sequence of str
        Names of the services in order of preference, as the transport knows them.
    recovery : str or None
        Name of the local service; None if there is none.
    transport : RobotTransport or None
        Not started yet; it is closed at the end. Without one the robot's own planner decides.
    journal : StepJournal
    maker : EnvironmentMaker
    events : EventSink
        Is told what happens.
    on_result : callable
        Gets the result of each trial, and keeps it.
    on_timing : callable
        Gets the times of each decision.
    on_verified : callable
        Gets what each answer that was computed again came to.
    rate_hz : float or None
        Task actions a second; None acts as soon as possible.
    offload : OffloadSettings or None
        Instead of the configuration's.
    distrusted : collection of str
        Services that have answered wrongly in an earlier part of the run.
    make_planner : callable
        Joins the problem and the settings to the functions that lead from state to state.
    watch : RobotWatch or None
        Tells others how the robot is doing, while it runs.
    on_order : callable
        Gets each order to the environment, and the state in which it was decided. It is called on
        the event loop, so it must return at once.
    """

    def __init__(
        self,
        configuration: Configuration,
        services: Sequence[str],
        recovery: str | None,
        transport: RobotTransport | None,
        journal: StepJournal,
        maker: EnvironmentMaker,
        events: EventSink,
        on_result: Callable[[TrialResult], None],
        on_timing: Callable[[Timing], None],
        on_verified: Callable[[Verified], None],
        rate_hz: float | None = None,
        offload: OffloadSettings | None = None,
        distrusted: Collection[str] = (),
        make_planner: Callable[[Problem, PlanningSettings], Planner] = Planner,
        watch: RobotWatch | None = None,
        on_order: Callable[[PlanningState, Act | Sense], None] | None = None,
    ) -> None:
        self._watch = watch
        self._on_order = on_order
        self._configuration = configuration
        self._transport = transport
        self._turn_s = _TURN_WITHOUT_WIRE_S if transport is None else _TURN_S
        self._journal = journal
        self._maker = maker
        self._events = events
        self._on_result = on_result
        self._on_timing = on_timing
        self._on_verified = on_verified
        self._loop: asyncio.AbstractEventLoop | None = None
        # What has happened and is not handled yet, with the time at which it happened.
        self._happened: deque[tuple[float, _Happening]] = deque()
        self._handling = self._goes_on_soon = False
        self._now = monotonic()
        self._wake_at: float | None = None
        self._listens_since = self._now
        self._timer: asyncio.TimerHandle | None = None
        self._error: BaseException | None = None
        self._launcher: Launcher | None = None
        self._performer: Performer | None = None
        self._replayed: int | None = None
        self._starting: tuple[int, History, bool] | None = None
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
        if transport is None:
            dispatcher = OwnPlanning()
        else:
            dispatcher = Dispatcher(
                services,
                recovery,
                offload or configuration.offload,
                configuration.recovery,
                journal.session(),
                epoch,
                opening_of(configuration),
                problem.action_size,
                len(problem.sensing_actions),
                functools.partial(contract.executed_action, problem),
                os.urandom(32),
                distrusted,
            )

        def another_problem() -> Problem:
            return Configuration.from_plain(configuration.plain()).problem

        self._verifier = OwnDecisions(
            lambda: Planner(another_problem(), configuration.planning),
            functools.partial(describe_problem_error, configuration.problem_name),
            self.deliver,
        )
        self._own_planner = OwnPlanner(
            lambda: make_planner(another_problem(), configuration.planning),
            self._happens,
            self._fail,
            may_be_brief=":" not in configuration.problem_name,
        )
        self._planner = make_planner(problem, configuration.planning)
        self._robot = Robot(self._planner, simulator, dispatcher, rate_hz)

    @property
    def missed_ticks(self) -> int:
        """Ticks of the rate that passed while the robot was not ready."""
        return self._robot.missed_ticks

    @property
    def status(self) -> Status:
        """Who decides."""
        return self._robot.status

    @property
    def unexplained_observations(self) -> int:
        """Those of the trial that is running; 0 between two."""
        return self._robot.unexplained_observations

    def condition(self) -> Condition:
        """Return how the robot is doing."""
        robot = self._robot
        if self._interrupted is not None or self._verifying:
            return Condition("ending", False, robot.trial)
        if robot.is_holding:
            return Condition("holding still", False, robot.trial)
        if not robot.has_decided:
            return Condition("starting", False, robot.trial)
        return Condition(robot.status.value, True, robot.trial)

    def deliver(self, event: EnvironmentEvent | Decided | RecoveryExited) -> None:
        """Take an event from any thread; once the run has ended it is dropped."""
        # The loop is closed if it is too late for events.
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._happens, event, monotonic())

    def pause(self, within_s: float) -> None:
        """End the run in order, from any thread, before or while it runs; may be repeated.

        :meth:`run` returns when what is being performed has ended and everything is written down.

        Parameters
        ----------
        within_s : float
            If the environment performs for longer than this, it is left alone, and :meth:`run`
            raises a :class:`~holdfast.session.robot.HeldError`. That can be resumed, too.
        """
        self._happened.append((monotonic(), _Interrupted(None, within_s)))
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._go_on)

    def run(self, finished: Collection[int], launcher: Launcher | None = None) -> None:
        """Run all trials that are not finished, on an event loop of its own.

        Parameters
        ----------
        finished : collection of int
        launcher : Launcher or None
            Starts the local service; None if there is none.

        Raises
        ------
        HoldfastError
            If the robot holds still and cannot go on; the journal has everything to resume.
        KeyboardInterrupt
            After Ctrl-C or another signal that ends a process, once everything is written down.
            (As whoever calls handles these signals. In a thread other than the main one no signal
            is heard: see :meth:`pause`.)
        """
        self._finished = set(finished)
        self._launcher = launcher
        self._loop = loop = asyncio.new_event_loop()
        loop.set_exception_handler(self._loop_failed)
        before = sys.getswitchinterval()
        sys.setswitchinterval(_SWITCH_INTERVAL_S)
        try:
            if self._watch is not None:
                loop.run_until_complete(self._watch.start(self.condition))
            with self._signals_as_events(loop):
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
            if self._performer is not None:
                self._performer.close()
            if self._transport is not None:
                loop.run_until_complete(self._transport.close())
            self._own_planner.close()
            self._verifier.close()
            if launcher is not None:
                launcher.close()
            loop.close()
        if self._interrupted is not None and self._interrupted.number is not None:
            signal.raise_signal(self._interrupted.number)

    def _salvage(self) -> None:
        """Write down what is known to have happened, before an error ends the run."""
        with contextlib.suppress(HoldfastError):
            for effect in self._robot.salvage():
                self._journal.append(effect.trial, effect.records)

    def _where(self) -> str:
        seed = self._configuration.simulator.seed
        if self._replayed is not None:
            return f"trial {self._replayed} (seed {seed}), as the journal has it"
        if self._starting is not None:
            return f"trial {self._starting[0]} (seed {seed})"
        return f"trial {self._robot.trial} (seed {seed}), step {self._robot.step}"

    # -- on the loop -----------------------------------------------------------------------------

    def _start(self) -> None:
        with self._errors():
            if self._transport is not None:
                self._transport.start(self._hear)
            self._now = monotonic()
            self._carry_out(self._robot.start(self._now))
            self._begin_next()
        self._go_on()

    def _happens(self, event: _Happening, at: float | None = None) -> None:
        """Handle an event; if another one is being handled, after that."""
        self._happened.append((monotonic() if at is None else at, event))
        if not self._handling:
            self._go_on()

    def _hear(self, event: TransportEvent) -> None:
        """Take an event of the wire; it is handled when the link is done with what has come.

        A link's turn is short, and what the robot does with an answer is no part of it.
        """
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
        """Handle what has happened, and have the loop wake up when the machine asks for it."""
        self._goes_on_soon = False
        began = now = monotonic()
        if self._wake_at is not None:
            # This process was stopped, or another one had its core: nobody is blamed for that.
            self._was_deaf(now - max(self._wake_at, self._listens_since))
        with self._errors():
            if wake and not self._ended:
                self._now = max(self._now, now)
                self._carry_out(self._robot.wake(self._now))
            while not self._ended and (self._happened or self._own_planner.compute_brief()):
                if now - began > self._turn_s:
                    self._go_on_soon()
                    break
                at, event = self._happened.popleft()
                # When it happened, not when it is heard of: that may be long after.
                self._now = max(self._now, at)
                self._handle(event, self._now)
                before, now = now, monotonic()
                self._was_deaf(now - before)
        if self._ended:
            self._stop_loop()
            return
        self._listens_since = now
        self._wake_at = wake_at = self._robot.next_wakeup()
        # One that wakes the loop too early does no harm.
        if wake_at is not None and (self._timer is None or wake_at < self._timer.when()):
            if self._timer is not None:
                self._timer.cancel()
            self._timer = self._on_loop().call_at(wake_at, self._wake)

    def _was_deaf(self, seconds: float) -> None:
        if seconds > _DEAF_S:
            self._robot.was_deaf(seconds)

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        """Let an error end the run; it is raised by :meth:`run`."""
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

    def _end_unpaused(self, within_s: float) -> None:
        self._fail(
            HeldError(f"{self._where()}: the environment has not ended its call in {within_s:g} s")
        )

    def _raise_error(self) -> None:
        if self._error is not None:
            raise self._error

    def _end(self) -> None:
        self._ended = True
        self._stop_loop()

    def _stop_loop(self) -> None:
        if not self._closing:  # else the loop runs to close the links
            self._on_loop().stop()

    def _loop_failed(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Take an error of what else runs on the loop: nobody would wait for what it owes.

        Only a link's own code costs no more than the link, which asyncio closes.
        """
        del loop
        error = context.get("exception") or RuntimeError(context["message"])
        if "protocol" in context:
            self._events.event("link_failed", reason=repr(error))
        else:
            self._fail(error)

    def _on_loop(self) -> asyncio.AbstractEventLoop:
        assert self._loop is not None
        return self._loop

    def _handle(self, event: _Happening, now: float) -> None:
        robot = self._robot
        if isinstance(event, _Interrupted):
            self._interrupted = self._interrupted or event
            if event.within_s is not None:
                self._on_loop().call_later(event.within_s, self._end_unpaused, event.within_s)
            if self._watch is not None:
                self._watch.ending()
            self._carry_out(robot.pause(now))
        elif isinstance(event, RecoveryExited):
            self._carry_out(robot.recovery_exited(event.launch, event.reason, now))
        elif self._starting is not None and isinstance(event, Begun | EnvironmentFailed):
            trial, history, tail_is_certain = self._starting
            self._starting = None
            if isinstance(event, EnvironmentFailed):
                raise HeldError(f"trial {trial} cannot go on at step {event.step}: {event.text}")
            self._carry_out(
                robot.begin_trial(trial, history, event, now, tail_is_certain=tail_is_certain)
            )
            if self._watch is not None:
                self._watch.begun()
        elif not isinstance(event, Begun):
            self._carry_out(robot.handle(event, now))
            if self._verifying and isinstance(event, Decided):
                self._ended = not robot.num_unverified

    def _carry_out(self, effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, Journal):
                self._journal.append(effect.trial, effect.records)
            elif isinstance(effect, Act):
                assert self._performer is not None
                self._tell_order(effect)
                self._performer.perform(effect.step, effect.action)
            elif isinstance(effect, Sense):
                assert self._performer is not None
                self._tell_order(effect)
                self._performer.sense(effect.step, effect.sensing_action)
            elif isinstance(effect, Timing):
                self._on_timing(effect)
            elif isinstance(effect, Plan):
                self._own_planner.ask(effect)
            elif isinstance(effect, Send):
                assert self._transport is not None
                self._transport.call(effect.service, effect.call, effect.payload)
            elif isinstance(effect, Decide):
                self._verifier.ask(effect)
            elif isinstance(effect, Verified):
                self._on_verified(effect)
            elif isinstance(effect, Abandon):
                assert self._transport is not None
                self._transport.abandon(effect.call)
            elif isinstance(effect, Report):
                self._events.event(effect.name, **effect.fields)
            elif isinstance(effect, Launch):
                self._launch(effect)
            elif isinstance(effect, EndTrial):
                self._end_trial(effect.result)
            elif isinstance(effect, Paused):
                self._ended = True
            elif isinstance(effect, Stop):
                self._events.event("stopped", reason=str(effect.error))
                raise effect.error

    def _tell_order(self, order: Act | Sense) -> None:
        if self._on_order is not None and (state := self._robot.state) is not None:
            self._on_order(state, order)

    def _launch(self, effect: Launch) -> None:
        if self._launcher is None:
            self._happens(RecoveryExited(effect.number, "there is none to be launched"))
        else:
            self._launcher.launch(effect.number)

    def _end_trial(self, result: TrialResult) -> None:
        if self._performer is not None:
            self._performer.close()
            self._performer = None
        self._on_result(result)
        self._finished.add(result.trial)
        self._events.event(
            "trial",
            trial=result.trial,
            success=result.success,
            outcome=result.outcome,
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
                # What is being computed again is still worth knowing.
                left = self._robot.num_unverified
                if left:
                    self._events.event(
                        "verifying", reason=f"{left} answers are still being computed again"
                    )
                self._verifying = True
                self._ended = not left
                self._on_loop().call_later(_LAST_VERIFICATION_S, self._end)
                return
            trial, records, tail_is_certain = following, (), True
        self._replayed = trial
        seed = self._configuration.simulator.seed
        history = replay(self._planner, seed, trial, records)
        self._replayed = None
        self._starting = (trial, history, tail_is_certain)
        self._performer = make_performer(
            self._maker,
            trial,
            # A simulated world answers on this thread, and at once.
            self._happens if self._maker.simulated else self.deliver,
            resumed=history.begun,
            performed=history.actions,
        )
        self._performer.begin(history.state.step)

    @contextlib.contextmanager
    def _signals_as_events(self, loop: asyncio.AbstractEventLoop) -> Iterator[None]:
        """Let the first signal that ends a process end it in order; the second one ends it.

        Not by ``loop.add_signal_handler``: that hears of no signal, nor of the second one, while
        the code of a problem runs, which may never return.
        """
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        saved = {
            number: before
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
            if (before := signal.getsignal(number)) is not signal.SIG_IGN
        }

        def restore() -> None:
            for number, before in saved.items():
                signal.signal(number, before)

        def note(number: int, frame: object) -> None:
            del frame
            restore()
            # Here, not by the loop: its next turn may come when the run has ended.
            self._happened.append((monotonic(), _Interrupted(number)))
            loop.call_soon_threadsafe(self._go_on)

        # A signal that comes just before the loop sleeps wakes it by a byte in this pair.
        reader, writer = socket.socketpair()
        with reader, writer:
            for end in (reader, writer):
                end.setblocking(False)
            loop.add_reader(reader, reader.recv, 4096)
            awakened_before = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
            try:
                for number in saved:
                    signal.signal(number, note)
                yield
            finally:
                restore()
                signal.set_wakeup_fd(awakened_before)
                loop.remove_reader(reader)
