"""The robot's process: the production machine, its journal, its body, and a life that may end.

Effects are carried out one by one, as the real process does it, and between any two of them the
process may die. What it was about to do is lost with it; what it has written down and what its body
has done are not.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

from holdfast.errors import HoldfastError, UnknownPerformanceError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.inputs import Late, Moved, Record, Sensed, encode_floats
from holdfast.planning.outcome import ending_of
from holdfast.planning.planner import Planner
from holdfast.planning.settings import (
    LostSettings,
    OffloadSettings,
    RecoverySettings,
    SimulatorSettings,
)
from holdfast.planning.tracking import Trial, replay
from holdfast.protocol.dispatcher import Dispatcher
from holdfast.protocol.effects import LogEvent
from holdfast.protocol.messages import MAX_TASK_ACTIONS
from holdfast.protocol.robot import Robot
from holdfast.protocol.robot_events import (
    Abandon,
    Act,
    Acted,
    ComputeOwnAnswer,
    EndTrial,
    EnvironmentEvent,
    EnvironmentReady,
    Halt,
    Launch,
    NoReading,
    OwnAnswer,
    Paused,
    RecoveryExited,
    ReplyReceived,
    RobotEffect,
    Send,
    Sense,
    Timing,
    TransportEvent,
    VerificationNoted,
    WriteRecords,
)
from holdfast_lab.errors import Violation
from holdfast_lab.simulation.checkers import StatusChecker
from holdfast_lab.simulation.disk import Disk
from holdfast_lab.simulation.environment_model import EnvironmentModel
from holdfast_lab.simulation.event_queue import Clock
from holdfast_lab.simulation.reference_runs import ReferenceStep
from holdfast_lab.simulation.schedule import LOCAL_SERVICE

if TYPE_CHECKING:
    from holdfast_lab.simulation.world import World


SESSION = bytes(range(16))
"""Session of the robot under test."""
_PERFORMS_AFTER_S = 0.0002
"""From the order until the body moves: the process may die in between."""

_BEGINS_AFTER_S = 0.001
_DECIDES_AFTER_S = 0.003
"""What the robot's own planner takes for a question."""

_SECRET = b"which answers are computed again"
_STALL_S = 0.005
"""As the real process: a loop that did not listen for longer blames nobody for that time."""


_WITHOUT_CONSEQUENCES = (LogEvent, Timing, ComputeOwnAnswer, VerificationNoted)
"""Effects before which the process need not die: nothing outside it changes by them."""


class RobotNode:
    """The robot, over all lives of its process."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._run = run = world.run
        self._queue = world.queue
        self._planner: Planner = world.setup.planner
        self._clock = Clock(world.queue, run.robot_clock_offset_s, run.robot_clock_rate)
        self._disk = Disk(forces_out=run.journal_survives == "power_cut")
        self._trials = range(run.trial, run.trial + run.num_trials)
        self._simulator = SimulatorSettings(
            num_trials=self._trials.stop,
            max_steps=max(1, world.simulator.max_steps // run.num_trials),
            seed=world.simulator.seed,
        )
        self._offload = OffloadSettings(
            services=run.services,
            what=run.what,
            lease_ms=max(50.0, 1e3 * run.lease_s),
            decision_deadline_ms=run.deadline_ms,
        )
        self._lost = LostSettings(on_lost=run.on_lost)
        if run.on_lost == "reinitialise":
            # The test itself is not what is looked at here: at this rate each observation outside
            # the gate raises its alarm.
            self._lost = LostSettings(false_alarm_rate=1.0, on_lost="reinitialise")
        self._recovery = RecoverySettings(launch=run.launch, journal_survives=run.journal_survives)
        self._environment: EnvironmentModel | None = None
        self._lateness = world.lateness()
        self._statuses = StatusChecker()
        self._asked: dict[int, str] = {}
        self._todo: deque[RobotEffect] = deque()
        # Each with the time at which it came, if that is known.
        self._deferred: deque[tuple[float | None, Callable[..., None], tuple[Any, ...]]] = deque()
        self._came_at: float | None = None
        self._last_time = float("-inf")
        self._is_ending = False
        self._rewards_are_known = True
        self._is_stalled = False
        self._wakes_at: float | None = None
        self._obeyed = 0
        self._may_doubt = False
        self._is_in_doubt = False
        self._does: dict[type, Callable[[Any], None]] = {
            WriteRecords: self._append,
            Act: self._act,
            Sense: self._sense,
            Send: self._send,
            Abandon: lambda effect: world.network.abandon(effect.call),
            LogEvent: self._report,
            Timing: world.decided,
            ComputeOwnAnswer: self._decide,
            VerificationNoted: self._verified,
            Launch: lambda effect: world.launch(effect.number),
            EndTrial: self._end_trial,
            Paused: lambda _: self._end_in_order(),
            Halt: self._hold_still,
        }
        self.machine: Robot | None = None  # of the process that lives
        self.incarnation = 0  # of the process; 0 before the first
        self.stopped = False
        self.stopped_until = 0.0
        self.finished = False  # whether all trials are
        self.stopped_by: HoldfastError | None = None  # why the process holds still for good

    @property
    def up(self) -> bool:
        """Whether a process lives."""
        return self.machine is not None

    # -- its life --------------------------------------------------------------------------------

    def start(self) -> None:
        """Start a new process, which goes on where the journal ends."""
        self.incarnation += 1
        self.stopped = self._is_stalled = self._is_ending = False
        self.stopped_until = 0.0
        self._wakes_at = None
        self._statuses = StatusChecker()
        self._asked.clear()
        dispatcher = Dispatcher(
            self._run.services,
            LOCAL_SERVICE,
            self._offload,
            self._recovery,
            SESSION,
            self._disk.opened(),
            self._world.setup.session_configuration,
            self._planner.problem,
            _SECRET,
        )
        self.machine = Robot(
            self._planner, self._simulator, dispatcher, self._run.rate_hz, self._lost
        )
        self._world.network.review_all()
        self._carry_out(self.machine.start(self._now()))
        if self.up:  # else it was killed meanwhile
            self._begin_next()

    def kill(self, *, lost_appends: int | None = None, body_goes_on: bool = False) -> None:
        """End the process at once.

        Parameters
        ----------
        lost_appends : int, optional
            The whole machine dies, and so many of the last appends to the journal are lost.
        body_goes_on : bool
            An order that the body was given is carried out all the same, unless the world is only
            simulated and dies, too.
        """
        if lost_appends is not None:
            self._disk.cut_power(lost_appends)
        if body_goes_on and self._run.environment != "simulated":
            self._obeyed = self.incarnation
        self._may_doubt = True
        self._end()

    def pause(self) -> None:
        """Ask the process to end in order."""
        self._happens(self.incarnation, self._pause)

    def stop(self, until: float) -> None:
        """Stop the process where it is."""
        self.stopped = True
        self.stopped_until = max(self.stopped_until, until)

    def go_on(self) -> None:
        """Let a stopped process go on."""
        if self.stopped:
            self.stopped = False
            if not self._is_stalled:
                self._catch_up()

    def _end(self) -> None:
        self.machine = None
        self.stopped = self._is_stalled = False
        self._todo.clear()
        self._deferred.clear()
        self._world.network.robot_ended()

    def _end_in_order(self) -> None:
        self._end()
        self._world.robot_ended()

    # -- what happens to it ----------------------------------------------------------------------

    def deliver(self, process: int, event: TransportEvent) -> None:
        """Deliver what happened on the wire to the process that it is for."""
        self._happens(process, self._heard, event)

    def recovery_exited(self, process: int, launch: int, reason: str) -> None:
        """Tell the process that started it that a local service has ended."""
        self._happens(process, self._heard, RecoveryExited(launch, reason))

    def _is_gone(self, process: int) -> bool:
        return process != self.incarnation or self.machine is None

    def _happens(self, process: int, do: Callable[..., None], *arguments: Any) -> None:
        if self._is_gone(process):
            return
        if self.stopped or self._is_stalled:
            # What comes during a write is heard of later; to a process that is stopped nothing
            # comes before it goes on.
            came_at = None if self.stopped else self._clock.now()
            self._deferred.append((came_at, do, arguments))
        else:
            do(*arguments)

    def _now(self) -> float:
        """Return the time of what happens: when it came, not when it is heard of."""
        shown = self._clock.now() if self._came_at is None else self._came_at
        self._last_time = max(self._last_time, shown)
        return self._last_time

    def _catch_up(self) -> None:
        """Let everything happen that came while the process did not listen."""
        robot = self.machine
        assert robot is not None
        wake_at, now = robot.next_wakeup(), self._clock.now()
        if not self._deferred and wake_at is not None and wake_at <= now:
            robot.event_loop_stalled(now - wake_at)
            self._wake(wake_at)
        while self._deferred and not self._is_stalled and not self.stopped:
            self._came_at, do, arguments = self._deferred.popleft()
            do(*arguments)
            self._came_at = None
        if self.machine is not None and not self._is_stalled:
            self._set_alarm()

    def _heard(self, event: TransportEvent | EnvironmentEvent | OwnAnswer | RecoveryExited) -> None:
        assert self.machine is not None
        if isinstance(event, ReplyReceived):
            self._statuses.heard(self._asked[event.call], event.payload)
        self._carry_out(self.machine.handle(event, self._now()))

    def _pause(self) -> None:
        assert self.machine is not None
        self._is_ending = True
        self._carry_out(self.machine.pause(self._now()))

    def _alarm(self, process: int, due: float) -> None:
        if not self._is_gone(process) and due == self._wakes_at:
            self._wakes_at = None
            if not self.stopped and not self._is_stalled:
                self._wake(due)

    def _wake(self, due: float) -> None:
        assert self.machine is not None
        self._last_time = max(self._last_time, self._clock.reached(due))
        self._carry_out(self.machine.wake(self._last_time))

    def _set_alarm(self) -> None:
        robot = self.machine
        if robot is None:
            return
        due = robot.next_wakeup()
        if due is not None and due != self._wakes_at:
            self._wakes_at = due
            self._queue.after(self._clock.until(due), self._alarm, self.incarnation, due)
        elif due is None:
            self._wakes_at = None

    # -- what it does ----------------------------------------------------------------------------

    def _carry_out(self, effects: Iterable[RobotEffect]) -> None:
        """Carry out effects in order, up to the end of the process or a slow write."""
        todo = self._todo
        todo += effects
        while todo and not self._is_stalled:
            effect = todo[0]
            kind = type(effect)
            if kind not in _WITHOUT_CONSEQUENCES:
                self._world.boundary(kind)
                if not todo:
                    return  # killed
            todo.popleft()
            do = self._does.get(kind)
            if do is not None:
                do(effect)
        if not self._is_stalled:
            self._set_alarm()

    def _append(self, effect: WriteRecords) -> None:
        self._disk.append(effect.trial, effect.records)
        stall_s = self._world.stall_s()
        if stall_s:
            self._is_stalled = True
            self._queue.after(stall_s, self._written, self.incarnation, stall_s)

    def _act(self, effect: Act) -> None:
        self._world.note("robot", "performs task action %s", effect.step)
        self._queue.after(
            _PERFORMS_AFTER_S, self._performs, self.incarnation, effect.step, effect.action
        )

    def _sense(self, effect: Sense) -> None:
        step, sensing_action = effect
        self._world.note("robot", "performs sensing action %s of step %s", sensing_action, step)
        self._queue.after(self._run.sense_s, self._senses, self.incarnation, step, sensing_action)

    def _send(self, effect: Send) -> None:
        self._asked[effect.call] = effect.service
        self._world.note("robot", "asks %s, call %s", effect.service, effect.call)
        self._world.network.call(effect.service, effect.call, effect.payload)

    def _report(self, effect: LogEvent) -> None:
        if effect.name == "status":
            self._statuses.changed(effect.fields["from"], effect.fields["to"])
        elif effect.name == "performed_unseen":
            self._rewards_are_known = self._rewards_are_known and self._run.remembers
        elif effect.name == "late_unused":
            assert self._environment is not None
            taken = effect.fields["taken"]
            assert isinstance(taken, int)
            self._environment.is_useless(taken)
        self._world.log_event(effect.name, effect.fields)

    def _decide(self, effect: ComputeOwnAnswer) -> None:
        actions, sensing_action, ahead = self._planner.decide(effect.state, MAX_TASK_ACTIONS)
        digest = self._planner.digest(ahead)
        event = OwnAnswer(effect.number, actions, sensing_action, digest, _DECIDES_AFTER_S)
        self._queue.after(_DECIDES_AFTER_S, self._happens, self.incarnation, self._heard, event)

    def _verified(self, effect: VerificationNoted) -> None:
        if effect.verdict not in ("asked", "same"):
            raise Violation(f"{effect.service} is said to have answered wrongly: {effect}")

    def _end_trial(self, effect: EndTrial) -> None:
        result = effect.result
        assert self._environment is not None
        self._environment.check_end(result, rewards_are_known=self._rewards_are_known)
        self._rewards_are_known = True
        self._disk.add(result)
        self._world.note("robot", "ends trial %s after %s steps", result.trial, result.steps)
        self._begin_next()

    def _hold_still(self, effect: Halt) -> None:
        """Make sure that the process had a reason to hold still for good."""
        self.stopped_by = error = effect.error
        if not (isinstance(error, UnknownPerformanceError) and self._is_in_doubt):
            raise Violation(f"the robot holds still: {error}")

    def _written(self, process: int, stall_s: float) -> None:
        if self._is_gone(process):
            return
        if self.stopped:
            self._deferred.appendleft((None, self._written, (process, stall_s)))
            self._is_stalled = False  # what comes waits for the process now, not for the disk
            return
        self._is_stalled = False
        self._carry_out(())
        if self.machine is not None:
            if stall_s > _STALL_S:
                self.machine.event_loop_stalled(stall_s)
            if not self._is_stalled:
                self._catch_up()

    def _begin_next(self) -> None:
        if self._is_ending:
            # It was asked to while it performed the last action of a trial.
            self._end_in_order()
            return
        unfinished = self._disk.unfinished()
        if unfinished is not None:
            trial, records, is_complete = unfinished
        else:
            following = next((n for n in self._trials if n not in self._disk.results), None)
            if following is None:
                self.finished = True
                return
            trial, records, is_complete = following, [], True
        rate = self._lost.false_alarm_rate
        history = replay(self._planner, self._simulator.seed, trial, records, rate)
        begin = (self.incarnation, self._begin, trial, history, records, is_complete)
        self._queue.after(_BEGINS_AFTER_S, self._happens, *begin)

    def _begin(self, trial: int, history: Trial, records: list[Record], is_complete: bool) -> None:
        robot = self.machine
        assert robot is not None
        simulated = self._run.environment == "simulated"
        if self._environment is None or self._environment.trial != trial:
            self._environment = EnvironmentModel(
                trial,
                self._simulator.max_steps,
                self._world.setup.references,
                shows_the_same=simulated,
                lateness=self._lateness,
                remembers=self._run.remembers,
                senses_on=self._run.senses_on,
                reinitialises=self._run.on_lost == "reinitialise",
            )
        environment = self._environment
        resumed = environment.resumed(records, may_lack=not is_complete)
        if simulated:
            environment.begin_again(history.actions)
        counts = self._run.environment != "not_counting"
        known = history.state.step
        pending = history.pending is not None
        # A process that has ended in order leaves none. Nor does one that was killed in a world
        # that counts: what it did and what it wrote are at most the last action apart.
        self._is_in_doubt = self._may_doubt and (
            not is_complete and environment.performed not in (known, known + pending)
            if counts
            else pending or not is_complete
        )
        self._may_doubt = False
        performed = environment.performed if counts else None
        ending = ending_of(environment.done)
        last = None
        if performed and resumed.last is not None:
            last = _moved(performed - 1, resumed.last)
        begun = EnvironmentReady(ending, performed, last, resumed.late)
        self._world.note("robot", "begins trial %s at step %s", trial, known)
        self._note_late(resumed.late)
        self._carry_out(robot.begin_trial(history, begun, self._now(), tail_is_certain=is_complete))

    def _note_late(self, late: tuple[Late, ...]) -> None:
        for each in late:
            self._world.note("robot", "is shown what was sensed in step %s", each.taken)

    # -- its body --------------------------------------------------------------------------------

    def _senses(self, process: int, step: int, sensing_action: int) -> None:
        if self._is_gone(process):
            return
        assert self._environment is not None
        shown = self._environment.sense(step, sensing_action)
        if shown is None:
            self._world.sensed_late(step)
        sensed: Sensed | NoReading = Sensed(step, sensing_action, encode_floats(shown))
        if shown is None and not self._environment.will_come(step):
            sensed = NoReading(step)
        self._happens(process, self._heard, sensed)

    def _performs(self, process: int, step: int, action: FloatArray) -> None:
        if self._is_gone(process):
            if process == self._obeyed and self._environment is not None:
                self._world.note("robot", "'s body performs task action %s all the same", step)
                self._environment.act(step, action)
            return
        if self.stopped:
            self._deferred.append((None, self._performs, (process, step, action)))
            return
        assert self._environment is not None
        shown = self._environment.act(step, action)
        late = self._environment.come()
        self._note_late(late)
        event = Acted(_moved(step, shown), ending_of(shown.done), late)
        self._queue.after(self._run.act_s, self._happens, process, self._heard, event)


def _moved(step: int, done: ReferenceStep) -> Moved:
    return Moved(step, done.reward, encode_floats(done.motion), encode_floats(done.shown))
