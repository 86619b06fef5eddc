"""One simulated run: a robot, its services and a schedule of what goes wrong.

The run ends when all trials have ended, when the robot holds still because nobody can know what it
did before it was killed, or with a :class:`~holdfast_lab.errors.Violation`. One of these is that
nothing comes to an end: once the last fault is over, the rest of the run must take no longer than
it does without faults, and :data:`RECOVERY_S` more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from holdfast.errors import HoldfastError, IllegalTransitionError, MessageError
from holdfast.planning.settings import ParticleFilterSettings, PlanningSettings, SelectorSettings
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.protocol.messages import (
    DIGEST_SIZE,
    PROTOCOL_VERSION,
    Request,
    SessionConfiguration,
    decode_reply,
    encode,
)
from holdfast.protocol.robot_events import (
    Act,
    CallEnded,
    ReplyReceived,
    RobotEffect,
    Send,
    Sense,
    Timing,
    TransportEvent,
    WriteRecords,
)
from holdfast_lab.errors import Violation
from holdfast_lab.simulation.checked_memo import CheckedPlanner, JobCache, Memo
from holdfast_lab.simulation.checkers import WireChecker, check_size
from holdfast_lab.simulation.event_queue import EventQueue
from holdfast_lab.simulation.network import Network
from holdfast_lab.simulation.peg_with_encoders import PegWithEncoders
from holdfast_lab.simulation.reference_runs import ReferenceRuns
from holdfast_lab.simulation.robot_node import SESSION, RobotNode
from holdfast_lab.simulation.schedule import (
    LOCAL_SERVICE,
    NUM_TRIALS,
    Crash,
    Crowd,
    Cut,
    DiskStall,
    KillRobot,
    Late,
    LaunchFault,
    MessageFault,
    OutOfMemory,
    PauseRobot,
    RunSettings,
    SimulatedFault,
    SimulationSchedule,
    Slow,
    Stop,
)
from holdfast_lab.simulation.service_node import ServiceNode
from holdfast_lab.simulation.story import RunOutcome, StoryLine

STANDSTILL_S = 1.5
"""How long the robot may stand still for a decision once the last fault is over."""

FAILBACK_S = 2.5
"""So long after the last fault the first service that is there must decide again: after the longest
pause between two tries, a turn, and the way."""

RECOVERY_S = 3.0
"""How much longer than without faults a run may take once the last fault is over."""

_SEED = 20_260
_NUM_PARTICLES = 30
_MAX_STEPS = 40
_NATS_PER_COST = 0.3
"""Where not to sense is a choice: it is the better one now and then."""

_MAX_MESSAGES = 5_000
"""Messages of a run; one without faults has about fifty."""

_CROWD_IS_FELT_S = 1.0
"""So long after one of a crowd was served our robot may still wait: it was told to come back."""

_IS_ASKED_AGAIN_S = 1.0
"""So long after it has memory again a service may still be left alone."""

_LAUNCH_TIMEOUT_S = 5.0
"""Timeout of the first launch that is never seen; each that follows gets a longer one."""

_EVENTS_PER_CHECK = 500
"""Events between two checks of the sizes of all tables."""

_MOMENTS = {WriteRecords: "journal", Send: "send", Sense: "sense", Act: "act"}
"""Effects before which a schedule can kill the robot's process, by their names there."""

_MAX_EVENTS = 20_000
"""Events of a run; one without faults has about two hundred."""


class Simulator:
    """Runs schedules; what does not depend on them is made once."""

    def __init__(self) -> None:
        self.seed = _SEED
        self.max_steps = _MAX_STEPS
        self._setups: dict[tuple[bool, bool], Setup] = {}

    def setup(self, run: RunSettings) -> Setup:
        """Return what a run has in common with others of its problem and settings."""
        key = run.moves_show, run.sensing_is_optional
        if key not in self._setups:
            self._setups[key] = Setup(*key)
        return self._setups[key]

    def run(self, schedule: SimulationSchedule, *, tell: bool = False) -> RunOutcome:
        """Run a schedule."""
        return World(self, schedule, tell=tell).go()


class Setup:
    """A problem and its settings, and what is known of them from the runs before."""

    def __init__(self, moves_show: bool, sensing_is_optional: bool) -> None:
        problem = PegWithEncoders() if moves_show else PegInHole2D()
        planning = PlanningSettings(
            particle_filter=ParticleFilterSettings(num_particles=_NUM_PARTICLES),
            selector=SelectorSettings(
                method="action_entropy",
                estimator="nearest_neighbor",
                sensing_is_optional=sensing_is_optional,
                nats_per_cost=_NATS_PER_COST if sensing_is_optional else 0.0,
            ),
        )
        self.references = ReferenceRuns(problem, planning, _SEED)
        self.planner = CheckedPlanner(problem, planning)
        self.jobs = JobCache()
        self.session_configuration = SessionConfiguration(problem.name, {}, {}, planning, _SEED)
        self._requests: Memo[tuple[int, int], bytes] = Memo(5_000)

    def request_of_another(self, robot: int, trial: int) -> bytes:
        """Return the first request of another robot, numbered from 1, for the start of a trial."""
        session = robot.to_bytes(16, "big")
        return self._requests.get((robot, trial), lambda: self.first_request(session, trial, 1))

    def first_request(self, session: bytes, trial: int, epoch: int) -> bytes:
        """Return the request of a session for the first sensing action of a trial."""
        return encode(
            Request(
                PROTOCOL_VERSION,
                session,
                epoch=epoch,
                number=1,
                trial=trial,
                step=0,
                sensed=False,
                digest=self.planner.digest(self.planner.init(_SEED, trial))[:DIGEST_SIZE],
                session_configuration=self.session_configuration,
            )
        )


class World:
    """One run; see :class:`Simulator`.

    Nothing is expected of anybody before ``faults_end_at``, until when the faults so far are felt.
    """

    def __init__(self, simulator: Simulator, schedule: SimulationSchedule, *, tell: bool) -> None:
        self.simulator = simulator
        self.run = run = schedule.run
        self.setup = simulator.setup(run)
        self._schedule = schedule
        self._tell = tell
        self._story: list[StoryLine] = []
        self.queue = EventQueue()
        self.checker = WireChecker(services_forget=run.services_forget)
        self.services = {name: ServiceNode(name, self) for name in (*run.services, LOCAL_SERVICE)}
        faults = schedule.faults
        self._late = [each for each in faults if isinstance(each, Late)]
        self.robot = RobotNode(self)
        self.network = Network(self, [each for each in faults if isinstance(each, MessageFault)])
        self._nodes: dict[str, RobotNode | ServiceNode] = {"robot": self.robot, **self.services}
        self._launches = 0
        self._launch = (0, 0)
        self._silent_launches = 0
        self._boundaries = 0
        self._kills: dict[int, KillRobot] = {}
        self._aimed: list[KillRobot] = []
        self._launch_faults: dict[int, LaunchFault] = {}
        self._stalls: list[DiskStall] = []
        self._gone: set[str] = set()
        self._counts: dict[str, int] = {}
        self._injected: set[int] = set()
        self._num_others = 0
        self._decided_by = ""
        self._status = ""
        self._down_s = 0.0
        self.faults_end_at = 0.0
        self._scripts: dict[type, Callable[[Any], Iterator[float]]] = {
            Crash: self._crash,
            Stop: self._stop,
            Slow: self._slow,
            OutOfMemory: self._exhaust,
            Cut: self._cut,
            Crowd: self._crowd,
            PauseRobot: self._pause,
            KillRobot: self._kill,
        }
        for fault in faults:
            if isinstance(fault, MessageFault | Late):
                continue  # most are; the network and the robot's body have them
            if isinstance(fault, DiskStall):
                self._stalls.append(fault)
            elif isinstance(fault, LaunchFault):
                self._launch_faults.setdefault(fault.number, fault)
            elif isinstance(fault, KillRobot) and fault.at is None:
                self._kills.setdefault(fault.boundary, fault)
            else:
                assert fault.at is not None
                self.queue.at(fault.at, self._inject, fault)
        self._stalls.sort(key=lambda fault: -fault.at)

    # -- the run ---------------------------------------------------------------------------------

    def go(self) -> RunOutcome:
        """Run to an end."""
        violation = None
        try:
            for name in self.run.services:
                self._start_service(name)
            self.robot.start()
            self._run_to_the_end()
            self._check_sizes()
            self._check_failback()
            self._let_services_end()
        except Violation as found:
            violation = str(found)
        except (HoldfastError, IllegalTransitionError) as error:
            violation = f"{type(error).__name__}: {error}"
        except Exception as error:  # noqa: BLE001 - whatever a machine raises is what we look for
            violation = f"{type(error).__name__} raised: {error}"
        held = self.robot.stopped_by
        now = self.queue.now
        if violation is not None:
            self.note("world", f"VIOLATION: {violation}")
        never_happened: tuple[SimulatedFault, ...] = ()
        if self._tell:
            faults = self._schedule.faults
            never_happened = tuple(each for each in faults if id(each) not in self._injected)
        return RunOutcome(
            violation,
            None if held is None or violation is not None else str(held),
            now,
            now - min(now, self.faults_end_at),
            self.network.messages,
            self._counts,
            self._story,
            never_happened,
        )

    def _run_to_the_end(self) -> None:
        run = self.run
        step_s = max(run.act_s, 0.0 if run.rate_hz is None else 1.0 / run.rate_hz) + 0.001
        turn_s = 2 * run.latency_s + run.jitter_s + run.task_s + run.sensing_s + run.sense_s
        if run.moves_show:
            # Each step is a turn then, and a service that forgets is asked twice.
            turn_s *= 2
        nominal_s = _MAX_STEPS * (step_s + turn_s) / min(1.0, run.robot_clock_rate)
        events = 0
        while not self.robot.finished and self.robot.stopped_by is None:
            events += 1
            if events % _EVENTS_PER_CHECK == 0:
                self._check_sizes()
            if not self._step():
                raise Violation("nothing will ever happen again, and the run has not ended")
            since_s = self.queue.now - self.faults_end_at
            if since_s > nominal_s + RECOVERY_S:
                raise Violation(
                    f"stuck: {since_s:.1f} s after the last fault the run has not ended"
                )
            if self.network.messages > _MAX_MESSAGES:
                raise Violation(f"{self.network.messages} messages: allowed are {_MAX_MESSAGES}")

    def _step(self) -> bool:
        """Let the next thing happen; False if there is none."""
        if self.queue.count > _MAX_EVENTS:
            raise Violation("somebody wakes again and again, and no time passes")
        return self.queue.step()

    def _let_services_end(self) -> None:
        """Make sure that the services end all calls of a robot that is gone."""
        if self.robot.up:
            self.robot.kill()
        until = max(self.queue.now, self.faults_end_at) + RECOVERY_S
        while left := [
            (service.name, count)
            for service in self.services.values()
            if service.up and (count := self.checker.unended(service.name, service.incarnation))
        ]:
            if not self._step() or self.queue.now > until:
                name, count = left[0]
                raise Violation(f"{name} has not ended {count} calls of a robot that is gone")

    def _check_sizes(self) -> None:
        for name, node in self._nodes.items():
            if node.machine is not None:
                check_size("the robot" if name == "robot" else name, node.machine)

    def _check_failback(self) -> None:
        """Make sure that the first service that is there decides, if there was time for that."""
        if not self.robot.finished or self.queue.now < self.faults_end_at + FAILBACK_S:
            return
        there = [name for name in self.run.services if name not in self._gone]
        if not there:
            return
        # With a deadline whoever answers first decides.
        is_back = self.run.deadline_ms is not None or self._decided_by == there[0]
        if self._status == "local_recovery" or not is_back:
            raise Violation(
                f"{self.queue.now - self.faults_end_at:.1f} s after the last fault "
                f"{self._decided_by} decides ({self._status}), and not {there[0]}"
            )

    def deliver(self, process: int, event: TransportEvent) -> None:
        """Hand what has come over the wire to the robot's process that it is for."""
        if self._tell and isinstance(event, ReplyReceived | CallEnded):
            heard = _kind_of(event.payload) if isinstance(event, ReplyReceived) else "its end"
            self.note("robot", "hears of call %s: %s", event.call, heard)
        self.robot.deliver(process, event)

    # -- faults ----------------------------------------------------------------------------------
    # Each is a script: it does something, yields for how long, and undoes it.

    def _inject(self, fault: SimulatedFault) -> None:
        self._advance(self._scripts[type(fault)](fault))

    def _advance(self, script: Iterator[float]) -> None:
        seconds = next(script, None)
        if seconds is not None:
            self.queue.after(seconds, self._advance, script)

    def happened(self, fault: SimulatedFault, seconds: float) -> None:
        """Take note of a fault that is not over before some time has passed."""
        self._counts[fault.kind] = self._counts.get(fault.kind, 0) + 1
        self._injected.add(id(fault))
        self.lasts(seconds)

    def lasts(self, seconds: float) -> None:
        """Take note that a fault is felt for some time from now on."""
        self.faults_end_at = max(self.faults_end_at, self.queue.now + seconds)

    def other_was_served(self) -> None:
        """Take note that a service has ended a call of another robot."""
        self.lasts(_CROWD_IS_FELT_S)

    def _start_service(self, name: str, *, keeps_memory: bool = False) -> None:
        service = self.services[name]
        service.start(keeps_memory=keeps_memory)
        self.note(name, "starts, process %s", service.incarnation)
        self.network.review(service)

    def _crash(self, fault: Crash) -> Iterator[float]:
        service = self.services[fault.service]
        is_local = fault.service == LOCAL_SERVICE
        if fault.for_good and not is_local:
            self._gone.add(fault.service)
            self._injected.add(id(fault))  # if it is down, it is not started again
        if not service.up:
            return
        self.note(fault.service, "is killed" + (" for good" if fault.for_good else ""))
        self.happened(fault, self.run.lease_s + (0.0 if is_local else fault.down_s))
        if is_local:
            self._end_local("was ended by SIGKILL")
            return
        service.end(keeps_memory=fault.keeps_memory)
        self.network.service_died(service, fault.found_after_s)
        yield fault.down_s
        if not self.services[fault.service].up and fault.service not in self._gone:
            self._start_service(fault.service, keeps_memory=fault.keeps_memory)

    def _stop(self, fault: Stop) -> Iterator[float]:
        node = self._nodes[fault.node]
        if not node.up:
            return
        self.happened(fault, fault.for_s)
        self.note(fault.node, "is stopped")
        process = node.incarnation
        node.stop(self.queue.now + fault.for_s)
        self.network.review_all()
        yield fault.for_s
        if node.up and node.incarnation == process and self.queue.now >= node.stopped_until:
            self.note(fault.node, "goes on")
            node.go_on()
            self.network.review_all()

    def _slow(self, fault: Slow) -> Iterator[float]:
        service = self.services[fault.service]
        if not service.up:
            return
        # What was begun in it takes its time beyond it.
        self.happened(fault, fault.for_s + fault.factor * (self.run.task_s + self.run.sensing_s))
        self.note(fault.service, "computes %g times as long", fault.factor)
        service.slownesses.append(fault.factor)
        yield fault.for_s
        service.slownesses.remove(fault.factor)

    def _exhaust(self, fault: OutOfMemory) -> Iterator[float]:
        service = self.services[fault.service]
        self.happened(fault, fault.for_s + _IS_ASKED_AGAIN_S)
        self.note(fault.service, "has no memory for %s parts", fault.part)
        service.lacks_memory_for.append(fault.part)
        yield fault.for_s
        service.lacks_memory_for.remove(fault.part)
        self.note(fault.service, "has memory for %s parts again", fault.part)

    def _cut(self, fault: Cut) -> Iterator[float]:
        self.happened(fault, fault.for_s + self.run.lease_s)
        self.note(fault.service, "is cut off (%s)", fault.direction)
        self.network.cut(fault.service, fault.direction)
        yield fault.for_s
        self.network.heal(fault.service, fault.direction)

    def _crowd(self, fault: Crowd) -> Iterator[float]:
        service = self.services[fault.service]
        if service.up:
            # It lasts until all of them are served.
            self.happened(fault, _CROWD_IS_FELT_S)
            self.note(fault.service, "is asked by %s other robots", fault.robots)
            self.checker.crowded(fault.robots)
            for number in range(fault.robots):
                self._num_others += 1
                other = self._num_others
                if self.run.certificates and number == 0:
                    # An impostor: our session, as our robot's next process would ask.
                    payload = self.setup.first_request(SESSION, other % NUM_TRIALS, 2**31)
                else:
                    payload = self.setup.request_of_another(other, number % NUM_TRIALS)
                self.network.call_of_another(service, payload)
        return iter(())

    def _pause(self, fault: PauseRobot) -> Iterator[float]:
        if self.robot.up:
            self.happened(fault, fault.down_s)
            self.note("robot", "is asked to end")
            self._down_s = fault.down_s
            self.robot.pause()
        return iter(())

    def _kill(self, fault: KillRobot) -> Iterator[float]:
        if not self.robot.up:
            return
        self.happened(fault, fault.down_s)
        self.note("robot", "is killed" + (" by a power cut" if fault.power_cut else ""))
        if fault.power_cut:
            self.checker.robot_forgets()
        self.robot.kill(
            lost_appends=fault.lost_appends if fault.power_cut else None,
            body_goes_on=fault.body_goes_on,
        )
        self._end_local(None)
        yield fault.down_s
        self._restart_robot()

    def _restart_robot(self) -> None:
        if not self.robot.up:
            self.note("robot", "is started again")
            self.robot.start()

    def lateness(self) -> dict[int, tuple[int | None, ...]]:
        """Return by step after how many task actions its observation comes."""
        steps = {fault.step for fault in self._late}
        return {
            step: tuple(fault.moves for fault in self._late if fault.step == step) for step in steps
        }

    def sensed_late(self, step: int) -> None:
        """Take note that the observation of a step does not come at once."""
        for fault in self._late:
            if fault.step == step:
                self._counts[fault.kind] = self._counts.get(fault.kind, 0) + 1
                self._injected.add(id(fault))

    # -- what the robot's process asks of its machine --------------------------------------------

    def boundary(self, effect: type[RobotEffect]) -> None:
        """Take note that an effect comes next, and of which kind."""
        fault = self._kills.pop(self._boundaries, None)
        self._boundaries += 1
        if fault is not None:
            self._aimed.append(fault)
        for aimed in self._aimed:
            if aimed.before in ("anything", _MOMENTS.get(effect)):
                self._aimed.remove(aimed)
                self._inject(aimed)
                return

    def robot_ended(self) -> None:
        """Take note that the robot's process has ended in order."""
        self.note("robot", "has ended in order")
        self._end_local(None)
        self.lasts(self._down_s)
        self.queue.after(self._down_s, self._restart_robot)

    def stall_s(self) -> float:
        """Return how long this write to the journal takes."""
        if self._stalls and self._stalls[-1].at <= self.queue.now:
            fault = self._stalls.pop()
            self.happened(fault, fault.for_s)
            self.note("robot", "writes to its journal for %g s", fault.for_s)
            return fault.for_s
        return 0.0

    def launch(self, number: int) -> None:
        """Start the local service."""
        self._end_local(None)
        self._launches += 1
        process = self.robot.incarnation
        self._launch = launch = (process, number)
        fault = self._launch_faults.get(self._launches)
        wait_s = self.run.launch_s
        self.note(LOCAL_SERVICE, "is launched")
        if fault is None:
            self.queue.after(wait_s, self._launched, launch)
            return
        self.happened(fault, wait_s + fault.seconds)
        if fault.what == "fails":
            reason = "ended with exit code 1"
            self.queue.after(fault.seconds, self.robot.recovery_exited, process, number, reason)
        elif fault.what == "late":
            self.queue.after(wait_s + fault.seconds, self._launched, launch)
        else:
            # Found by the launch's own limit, after which the next launch follows.
            self.lasts(_LAUNCH_TIMEOUT_S * 2**self._silent_launches)
            self._silent_launches += 1

    def _launched(self, launch: tuple[int, int]) -> None:
        if launch == self._launch:
            self._start_service(LOCAL_SERVICE)

    def _end_local(self, reason: str | None) -> None:
        """End the local service; with a reason, the robot learns of it."""
        local = self.services[LOCAL_SERVICE]
        process, number = self._launch
        self._launch = (0, 0)
        if local.up:
            local.end()
            self.network.service_died(local, 0.001)
            if reason is not None:
                self.queue.after(0.002, self.robot.recovery_exited, process, number, reason)

    def decided(self, timing: Timing) -> None:
        """Take note of whose decision is carried out, and how long the robot stood still for it."""
        now = self.queue.now
        self._status = timing.status
        if timing.kind == "sensing":
            self._decided_by = timing.service
        waited_s = 1e-3 * timing.waited_ms / self.run.robot_clock_rate
        since = max(now - waited_s, self.faults_end_at)
        # Or the local service is launched first.
        allowed_s = STANDSTILL_S + self.run.launch_s
        if now - since > allowed_s:
            raise Violation(
                f"the robot stood still for {now - since:.2f} s after the last fault: allowed are "
                f"{allowed_s:g} s"
            )

    # -- the story -------------------------------------------------------------------------------

    def log_event(self, name: str, fields: dict[str, object]) -> None:
        """Take note of an event of the robot's log."""
        if self._tell:
            shown = " ".join(f"{key}={_short(value)}" for key, value in fields.items())
            self.note("robot", f"{name} {shown}".rstrip())

    def note(self, actor: str, text: str, *values: object) -> None:
        """Take note of what was done."""
        if self._tell:
            self._story.append(StoryLine(self.queue.now, actor, text % values if values else text))


def _kind_of(payload: bytes) -> str:
    try:
        return type(decode_reply(payload)).__name__
    except MessageError as error:
        return error.code


def _short(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
