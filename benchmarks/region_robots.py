"""Robots of a region: the production machines, each with a body and a local service of its own.

A robot's body takes virtual or real time, whichever its :class:`Scheduler` has, and its requests go
over whatever wire it is given. So the same robots are simulated by the ten thousand
(region_world.py) and hold real links by the thousand (region_client.py). What each of them senses
and does is compared, as it happens, with the trial that no service and no fault has touched.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from typing import Any, Protocol

from holdfast.errors import HoldfastError
from holdfast.planning.inputs import Moved, Sensed, encode_floats
from holdfast.planning.outcome import ending_of
from holdfast.planning.planner import Planner
from holdfast.planning.settings import (
    OffloadSettings,
    PlanningSettings,
    RecoverySettings,
    SimulatorSettings,
)
from holdfast.planning.tracking import replay
from holdfast.problems.problem import Problem
from holdfast.protocol.dispatcher import Dispatcher
from holdfast.protocol.effects import LogEvent
from holdfast.protocol.messages import SessionConfiguration, decode_request
from holdfast.protocol.robot import Robot
from holdfast.protocol.robot_events import (
    Abandon,
    Act,
    Acted,
    CallEnded,
    EndTrial,
    EnvironmentReady,
    Halt,
    Launch,
    ReplyReceived,
    RobotEffect,
    Send,
    Sense,
    ServiceAppeared,
    Timing,
)
from holdfast.protocol.service import Service
from holdfast.protocol.service_jobs import EndCall, Job, SendReply, ServiceEffect
from holdfast.protocol.service_limits import ServiceLimits
from holdfast_lab.simulation.checked_memo import CheckedPlanner, JobCache
from holdfast_lab.simulation.environment_model import EnvironmentModel
from holdfast_lab.simulation.reference_runs import ReferenceRuns

__all__ = ["CLOUD", "LOCAL", "MachineShell", "RegionRobot", "Scheduler", "Setup", "Wire"]

CLOUD, LOCAL = "cloud", "local"

_NUM_TRIALS = 16
_MAX_STEPS = 40
_LOCAL_WAY_S = 0.0001
_LOCAL_COST_S = {"task": 0.001, "sensing": 0.003}
_SENSE_S = 0.02


class Scheduler(Protocol):
    """Time: virtual, or an event loop's."""

    @property
    def now(self) -> float: ...
    def after(self, seconds: float, do: Callable[..., None], *arguments: Any) -> None: ...


class Wire(Protocol):
    """A robot's way to the cloud; what comes back goes to :meth:`RegionRobot.hear`."""

    def call(self, service: str, call: int, payload: bytes) -> None: ...
    def abandon(self, call: int) -> None: ...


class Setup:
    """What all robots share: a problem, and what is known of its trials and decisions."""

    def __init__(
        self, problem: Problem, planning: PlanningSettings, described: SessionConfiguration
    ) -> None:
        self.problem = problem
        self.described = described
        self.seed = described.seed
        self.references = ReferenceRuns(problem, planning, self.seed)
        self.planner: Planner = CheckedPlanner(problem, planning)
        self.jobs = JobCache()


class MachineShell:
    """A service's machine, and a processor that takes its time.

    ``cost_s`` is what a job of each kind takes, ``slowness`` by how much longer it takes now.
    """

    def __init__(
        self,
        setup: Setup,
        scheduler: Scheduler,
        limits: ServiceLimits,
        cost_s: dict[str, float],
        reply: Callable[[int, bytes], None],
        end: Callable[[int], None],
        slowness: Callable[[], float] = lambda: 1.0,
    ) -> None:
        self.machine = Service(lambda _: setup.problem, 1, limits)
        self._setup = setup
        self._scheduler = scheduler
        self._cost_s = cost_s
        self._reply, self._end, self._slowness = reply, end, slowness
        self._wakes_at = math.inf
        self._free_at = 0.0
        self.busy_s = 0.0
        self.up = True

    def receive(self, call: int, payload: bytes, owner: str | None) -> None:
        """Take a request."""
        if self.up:
            request = decode_request(payload)
            now = self._scheduler.now
            self._carry_out(self.machine.receive(call, request, len(payload), now, owner))

    def gone(self, call: int) -> None:
        """Take note that whoever has called is gone."""
        if self.up:
            self._carry_out(self.machine.gone(call))

    def _carry_out(self, effects: list[ServiceEffect]) -> None:
        for effect in (*effects, *self.machine.next_jobs(self._scheduler.now)):
            if isinstance(effect, SendReply):
                self._reply(effect.call, effect.payload)
            elif isinstance(effect, EndCall):
                self._end(effect.call)
            elif isinstance(effect, Job):
                self._begin(effect)
        due = self.machine.next_wakeup()
        if due is not None and due < self._wakes_at:
            self._wakes_at = due
            self._scheduler.after(max(0.0, due - self._scheduler.now), self._tick, due)

    def _begin(self, job: Job) -> None:
        job.interruption.most_s = math.inf  # it takes virtual time
        now = self._scheduler.now
        cost_s = self._slowness() * self._cost_s[job.kind]
        self._free_at = max(self._free_at, now) + cost_s
        self.busy_s += cost_s
        self.machine.started(job, self._free_at - cost_s)
        self._scheduler.after(self._free_at - now, self._finish, job)

    def _finish(self, job: Job) -> None:
        if self.up:
            now = self._scheduler.now
            self._carry_out(self.machine.finished(job, self._setup.jobs.outcome(job), now))

    def _tick(self, due: float) -> None:
        if self.up and due == self._wakes_at:
            self._wakes_at = math.inf
            self._carry_out(self.machine.tick(max(due, self._scheduler.now)))


class RegionRobot:
    """One robot at work, trial after trial.

    Attributes
    ----------
    standstills : list of (float, float, str, float)
        Of each sensing decision: when it was used, how long the robot stood still for it, who made
        it, and the time from question to answer; in seconds.
    statuses : list of (float, str)
        Changes of its status.
    decided_by : dict of str to float
        When a sensing action of each service was last used.
    """

    def __init__(
        self,
        number: int,
        setup: Setup,
        scheduler: Scheduler,
        *,
        act_s: float,
        launch_s: float,
        launch: str = "on_failure",
    ) -> None:
        self._setup = setup
        self._scheduler = scheduler
        self._act_s = act_s
        self._launch_s = launch_s
        self._random = random.Random(number)
        self._trial = number % _NUM_TRIALS
        self._environment: EnvironmentModel | None = None
        self._local: MachineShell | None = None
        self._local_calls: set[int] = set()
        self._launch_number = 0
        self._wakes_at: float | None = None
        self._wire: Wire | None = None
        self.number = number
        self.standstills: list[tuple[float, float, str, float]] = []
        self.statuses: list[tuple[float, str]] = []
        self.decided_by: dict[str, float] = {}
        self.launches = self.trials = 0
        self._machine = Robot(
            setup.planner,
            SimulatorSettings(num_trials=_NUM_TRIALS, max_steps=_MAX_STEPS, seed=setup.seed),
            Dispatcher(
                (CLOUD,),
                LOCAL,
                OffloadSettings(services=(CLOUD,), verify_share=0.0),
                RecoverySettings(launch=launch),  # type: ignore[arg-type]
                number.to_bytes(16, "big"),
                1,
                setup.described,
                setup.problem,
                b"which are computed again",
            ),
        )

    @property
    def status(self) -> str:
        """Which service decides."""
        return self._machine.status.value

    def start(self, wire: Wire) -> None:
        """Begin the run."""
        self._wire = wire
        self._carry_out(self._machine.start(self._scheduler.now))
        self._begin_trial()

    def waits_since(self) -> float:
        """Return since when the robot stands still for a decision; infinity if it does not."""
        source = self._machine._source
        question, needed_at = source.question, source.needed_at
        if question is None or question.complete or needed_at is None:
            return math.inf
        return needed_at

    def hear(self, event: Any) -> None:
        """Take what has come over the wire."""
        self._carry_out(self._machine.handle(event, self._scheduler.now))

    def _begin_trial(self) -> None:
        setup, trial = self._setup, self._trial
        self._environment = EnvironmentModel(
            trial, _MAX_STEPS, setup.references, shows_the_same=False
        )
        history = replay(setup.planner, setup.seed, trial, [], 0.001)
        begun = EnvironmentReady(ending_of(self._environment.done), 0)
        self._carry_out(
            self._machine.begin_trial(history, begun, self._scheduler.now, tail_is_certain=True)
        )

    def _carry_out(self, effects: list[RobotEffect]) -> None:
        scheduler, wire = self._scheduler, self._wire
        assert wire is not None
        for effect in effects:
            if isinstance(effect, Act):
                scheduler.after(self._act_s, self._acted, effect)
            elif isinstance(effect, Sense):
                scheduler.after(_SENSE_S, self._sensed, effect)
            elif isinstance(effect, Send):
                if effect.service == CLOUD:
                    wire.call(effect.service, effect.call, effect.payload)
                else:
                    self._local_calls.add(effect.call)
                    scheduler.after(_LOCAL_WAY_S, self._ask_local, effect)
            elif isinstance(effect, Abandon):
                if effect.call in self._local_calls:
                    self._local_calls.discard(effect.call)
                else:
                    wire.abandon(effect.call)
            elif isinstance(effect, Timing):
                self._decided(effect)
            elif isinstance(effect, Launch):
                self.launches += 1
                self._launch_number = effect.number
                if self._local is not None:
                    self._local.up = False
                scheduler.after(self._launch_s, self._launched, effect.number)
            elif isinstance(effect, LogEvent):
                if effect.name == "status":
                    self.statuses.append((scheduler.now, str(effect.fields["to"])))
            elif isinstance(effect, EndTrial):
                assert self._environment is not None
                self._environment.check_end(effect.result, rewards_are_known=True)
                self.trials += 1
                self._trial = (self._trial + 1) % _NUM_TRIALS
                scheduler.after(self._act_s, self._begin_trial)
            elif isinstance(effect, Halt):
                raise HoldfastError(f"robot {self.number} holds still for good: {effect.error}")
        due = self._machine.next_wakeup()
        if due is not None and due != self._wakes_at:
            scheduler.after(max(0.0, due - scheduler.now), self._wake, due)
        self._wakes_at = due

    def _wake(self, due: float) -> None:
        if due == self._wakes_at:
            self._wakes_at = None
            self._carry_out(self._machine.wake(max(due, self._scheduler.now)))

    def _decided(self, timing: Timing) -> None:
        if timing.kind == "sensing":
            now = self._scheduler.now
            self.standstills.append(
                (now, 1e-3 * timing.waited_ms, timing.service, 1e-3 * timing.round_trip_ms)
            )
            self.decided_by[timing.service] = now

    # -- its body --------------------------------------------------------------------------------

    def _sensed(self, effect: Sense) -> None:
        assert self._environment is not None
        shown = self._environment.sense(*effect)
        self.hear(Sensed(*effect, encode_floats(shown)))

    def _acted(self, effect: Act) -> None:
        assert self._environment is not None
        shown = self._environment.act(effect.step, effect.action)
        moved = Moved(
            effect.step, shown.reward, encode_floats(shown.motion), encode_floats(shown.shown)
        )
        self.hear(Acted(moved, ending_of(shown.done)))

    # -- its local service -----------------------------------------------------------------------

    def _launched(self, number: int) -> None:
        if number != self._launch_number:
            return
        scheduler = self._scheduler
        self._local = MachineShell(
            self._setup,
            scheduler,
            ServiceLimits(),
            _LOCAL_COST_S,
            lambda call, payload: scheduler.after(
                _LOCAL_WAY_S, self._hear_local, ReplyReceived(call, payload)
            ),
            lambda call: scheduler.after(_LOCAL_WAY_S, self._hear_local, CallEnded(call)),
        )
        self.hear(ServiceAppeared(LOCAL, f"local-{number}"))

    def _ask_local(self, effect: Send) -> None:
        if self._local is not None:
            self._local.receive(effect.call, effect.payload, None)
        else:
            self._hear_local(CallEnded(effect.call))

    def _hear_local(self, event: ReplyReceived | CallEnded) -> None:
        if event.call in self._local_calls:
            if isinstance(event, CallEnded):
                self._local_calls.discard(event.call)
            self.hear(event)
