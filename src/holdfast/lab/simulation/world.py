"""One simulated run: a robot, its services and a schedule of what goes wrong.

The run ends when all trials have ended, when the robot holds still because nobody can know what it
did before it was killed, or with a :class:`~holdfast.lab.errors.Violation`. One of
these is that nothing comes to an end: once the last fault is over, the rest of the run must take no
longer than it does without faults, and :data:`RECOVERY_S` more.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from holdfast.config.settings import ParticleFilterSettings, PlanningSettings, SelectorSettings
from holdfast.errors import HoldfastError, IllegalTransitionError, MessageError
from holdfast.lab.errors import Violation
from holdfast.lab.simulation.checkers import WireChecker, check_size
from holdfast.lab.simulation.disk import Disk
from holdfast.lab.simulation.event_queue import Clock, EventQueue
from holdfast.lab.simulation.memo_cache import JobCache, MemoizingPlanner
from holdfast.lab.simulation.network import Network
from holdfast.lab.simulation.other_robots import OtherRobots
from holdfast.lab.simulation.reference_runs import ReferenceRuns
from holdfast.lab.simulation.robot_node import SESSION, RobotNode, RobotTask
from holdfast.lab.simulation.schedule import (
    LOCAL_SERVICE,
    NUM_TRIALS,
    Crash,
    Crowd,
    Cut,
    DiskStall,
    KillRobot,
    LaunchFault,
    MessageFault,
    OutOfMemory,
    PauseRobot,
    SimulatedFault,
    SimulationSchedule,
    Slow,
    Stop,
)
from holdfast.lab.simulation.service_node import ServiceNode
from holdfast.lab.simulation.story import RunOutcome, StoryLine
from holdfast.planning import Planner
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.protocol.events import (
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
from holdfast.protocol.messages import decode_reply

__all__ = ["FAILBACK_S", "RECOVERY_S", "STANDSTILL_S", "Simulator", "World"]

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
_MAX_MESSAGES = 5_000
"""Of a run; one without faults has about fifty."""

_CROWD_IS_FELT_S = 1.0
"""So long after its end our robot may still wait, because it was told to come back later."""

_IS_ASKED_AGAIN_S = 1.0
"""So long after it has memory again a service may still be left alone."""

_LAUNCH_TIMEOUT_S = 5.0
"""Of the first launch that is never seen; the robot is more patient with each that follows."""

_SIZES_EACH = 500
"""Events between two checks of the sizes of all tables."""

_MOMENTS = {WriteRecords: "journal", Send: "send", Sense: "sense", Act: "act"}
"""Effects before which a schedule can kill the robot's process, by their names there."""

_MAX_HAPPENINGS = 20_000
"""Of a run; one without faults has about two hundred."""


class Simulator:
    """Runs schedules; what does not depend on them is made once."""

    def __init__(self) -> None:
        problem = PegInHole2D()
        planning = PlanningSettings(
            particle_filter=ParticleFilterSettings(num_particles=_NUM_PARTICLES),
            selector=SelectorSettings(method="action_entropy", estimator="nearest_neighbor"),
        )
        self._references = ReferenceRuns(problem, planning, _SEED)
        self._planner = MemoizingPlanner(Planner(problem, planning))
        self._jobs = JobCache()
        self._others = OtherRobots(self._planner, _SEED)

    def run(self, schedule: SimulationSchedule, *, tell: bool = False) -> RunOutcome:
        """Run a schedule."""
        task = RobotTask(self._planner, schedule.run, _SEED, _MAX_STEPS)
        return World(schedule, task, self._references, self._jobs, self._others, tell=tell).run()


class World:
    """One run; see :class:`Simulator`."""

    def __init__(
        self,
        schedule: SimulationSchedule,
        task: RobotTask,
        references: ReferenceRuns,
        jobs: JobCache,
        others: OtherRobots,
        *,
        tell: bool,
    ) -> None:
        run = schedule.run
        self._schedule = schedule
        self._run = run
        self._others = others
        self._tell = tell
        self._story: list[StoryLine] = []
        self._queue = queue = EventQueue()
        self._disk = Disk(forces_out=run.journal_survives == "power_cut")
        self._checker = WireChecker()
        messages = [fault for fault in schedule.faults if isinstance(fault, MessageFault)]
        self._network = Network(run, queue, messages, self._checker, self._deliver, self._happened)
        self._services: dict[str, ServiceNode] = {}
        for name in (*run.services, LOCAL_SERVICE):
            clock = Clock(queue, run.services_clock_offset_s, run.services_clock_rate)
            service = ServiceNode(
                name, run, queue, clock, self._network, task.planner.problem, jobs
            )
            self._services[name] = service
            self._network.add(service)
        clock = Clock(queue, run.robot_clock_offset_s, run.robot_clock_rate)
        self._robot = RobotNode(
            task, run, queue, clock, self._disk, self._network, references, self
        )
        self._launches = 0
        self._launch_number = 0
        self._launcher = 0
        self._boundaries = 0
        self._kills: dict[int, KillRobot] = {}
        self._aimed: list[KillRobot] = []
        self._launch_faults: dict[int, LaunchFault] = {}
        self._stalls: list[DiskStall] = []
        self._gone: set[str] = set()
        self._faults: dict[str, int] = {}
        self._injected: set[int] = set()
        self._crowds = 0
        self._crowded_until: dict[str, float] = {}
        self._silent_launches = 0
        self._stopped_until: dict[str, float] = {}
        self._slownesses: dict[str, list[float]] = {}
        self._decided_by = ""
        self._status = ""
        self._down_s = 0.0
        self._faults_end_at = 0.0
        self._arrange(schedule)

    # -- the run ---------------------------------------------------------------------------------

    def run(self) -> RunOutcome:
        """Run to an end."""
        violation = None
        try:
            for name in self._run.services:
                self._start_service(name)
            self._robot.start()
            self._go()
            self._check_sizes()
            self._check_failback()
            self._let_services_end()
        except Violation as found:
            violation = str(found)
        except (HoldfastError, IllegalTransitionError) as error:
            violation = f"{type(error).__name__}: {error}"
        except Exception as error:  # noqa: BLE001 - whatever a machine raises is what we look for
            violation = f"{type(error).__name__} raised: {error}"
        held = self._robot.stopped_by
        now = self._queue.now
        if violation is not None:
            self.note("world", f"VIOLATION: {violation}")
        return RunOutcome(
            violation,
            None if held is None or violation is not None else str(held),
            now,
            now - min(now, self._faults_end_at),
            self._network.messages,
            self._faults,
            self._story,
            self._never_happened(),
        )

    def _go(self) -> None:
        queue, robot, network = self._queue, self._robot, self._network
        run = self._run
        step_s = max(run.act_s, 0.0 if run.rate_hz is None else 1.0 / run.rate_hz) + 0.001
        turn_s = 2 * run.latency_s + run.jitter_s + run.task_s + run.sensing_s + run.sense_s
        nominal_s = _MAX_STEPS * (step_s + turn_s) / min(1.0, run.robot_clock_rate)
        happenings = 0
        while not robot.finished and robot.stopped_by is None:
            happenings += 1
            if happenings % _SIZES_EACH == 0:
                self._check_sizes()
            if not self._happens():
                raise Violation("nothing will ever happen again, and the run has not ended")
            if queue.now > self._faults_end_at + nominal_s + RECOVERY_S:
                raise Violation(
                    f"stuck: {queue.now - self._faults_end_at:.1f} s after the last fault the run "
                    f"has not ended"
                )
            if network.messages > _MAX_MESSAGES:
                raise Violation(f"{network.messages} messages: allowed are {_MAX_MESSAGES}")

    def _happens(self) -> bool:
        """Let the next thing happen; False if there is none."""
        if self._queue.count > _MAX_HAPPENINGS:
            raise Violation("somebody wakes again and again, and no time passes")
        return self._queue.step()

    def _let_services_end(self) -> None:
        """Make sure that the services end all calls of a robot that is gone."""
        if self._robot.process:
            self._robot.kill()
        until = max(self._queue.now, self._faults_end_at) + RECOVERY_S
        while left := [
            (service.name, count)
            for service in self._services.values()
            if service.up and (count := self._checker.unended(service.name, service.incarnation))
        ]:
            if not self._happens() or self._queue.now > until:
                name, count = left[0]
                raise Violation(f"{name} has not ended {count} calls of a robot that is gone")

    def _check_sizes(self) -> None:
        check_size("the robot", self._robot.machine)
        for service in self._services.values():
            if service.machine is not None:
                check_size(service.name, service.machine)

    def _check_failback(self) -> None:
        """Make sure that the first service that is there decides, if there was time for that."""
        if not self._robot.finished or self._queue.now < self._faults_end_at + FAILBACK_S:
            return
        there = [name for name in self._run.services if name not in self._gone]
        if not there:
            return
        # With a deadline whoever answers first decides.
        is_back = self._run.deadline_ms is not None or self._decided_by == there[0]
        if self._status == "local_recovery" or not is_back:
            raise Violation(
                f"{self._queue.now - self._faults_end_at:.1f} s after the last fault "
                f"{self._decided_by} decides ({self._status}), and not {there[0]}"
            )

    def _deliver(self, process: int, event: TransportEvent) -> None:
        if self._tell and isinstance(event, ReplyReceived | CallEnded):
            heard = _kind_of(event.payload) if isinstance(event, ReplyReceived) else "its end"
            self.note("robot", "hears of call %s: %s", event.call, heard)
        self._robot.deliver(process, event)

    # -- faults ----------------------------------------------------------------------------------

    def _arrange(self, schedule: SimulationSchedule) -> None:
        timed: dict[type, Callable[[Any], None]] = {
            Crash: self._crash,
            Stop: self._stop,
            Slow: self._slow,
            OutOfMemory: self._exhaust,
            Cut: self._cut,
            Crowd: self._crowd,
            PauseRobot: self._pause,
            KillRobot: self._kill,
        }
        for fault in schedule.faults:
            if isinstance(fault, MessageFault):
                continue  # most are; the network has them
            if isinstance(fault, DiskStall):
                self._stalls.append(fault)
            elif isinstance(fault, LaunchFault):
                self._launch_faults.setdefault(fault.number, fault)
            elif isinstance(fault, KillRobot) and fault.at is None:
                self._kills.setdefault(fault.boundary, fault)
            else:
                assert fault.at is not None
                self._queue.at(fault.at, timed[type(fault)], fault)
        self._stalls.sort(key=lambda fault: -fault.at)

    def _happened(self, fault: SimulatedFault, seconds: float) -> None:
        """Take note of a fault that is not over before some time has passed."""
        self._faults[fault.kind] = self._faults.get(fault.kind, 0) + 1
        self._injected.add(id(fault))
        self._lasts(seconds)

    def _never_happened(self) -> tuple[SimulatedFault, ...]:
        if not self._tell:
            return ()
        return tuple(fault for fault in self._schedule.faults if id(fault) not in self._injected)

    def _lasts(self, seconds: float) -> None:
        self._faults_end_at = max(self._faults_end_at, self._queue.now + seconds)

    def _start_service(self, name: str, *, keeps_memory: bool = False) -> None:
        service = self._services[name]
        self._stopped_until.pop(name, None)
        service.start(keeps_memory=keeps_memory)
        self.note(name, "starts, process %s", service.incarnation)
        self._network.review(service)

    def _crash(self, fault: Crash) -> None:
        service = self._services[fault.service]
        local = fault.service == LOCAL_SERVICE
        if fault.for_good and not local:
            self._gone.add(fault.service)
        if not service.up:
            if fault.for_good and not local:
                self._injected.add(id(fault))  # it is not started again
            return
        self.note(fault.service, "is killed" + (" for good" if fault.for_good else ""))
        self._happened(fault, self._run.lease_s + (0.0 if local else fault.down_s))
        if local:
            self._end_local("was ended by SIGKILL")
        else:
            service.end(keeps_memory=fault.keeps_memory)
            self._network.service_died(service, fault.found_after_s)
            self._queue.after(fault.down_s, self._restart, fault)

    def _restart(self, fault: Crash) -> None:
        if not self._services[fault.service].up and fault.service not in self._gone:
            self._start_service(fault.service, keeps_memory=fault.keeps_memory)

    def _stop(self, fault: Stop) -> None:
        is_robot = fault.node == "robot"
        if not (self._robot.process if is_robot else self._services[fault.node].up):
            return
        self._happened(fault, fault.for_s)
        self.note(fault.node, "is stopped")
        until = self._queue.now + fault.for_s
        self._stopped_until[fault.node] = max(until, self._stopped_until.get(fault.node, 0.0))
        if is_robot:
            self._robot.stop()
            self._queue.at(until, self._robot_goes_on, self._robot.process)
            return
        service = self._services[fault.node]
        self._crowd_takes_longer(service, fault.for_s)
        service.stop()
        self._network.review(service)
        self._queue.at(until, self._service_goes_on, service, service.incarnation)

    def _is_still_stopped(self, node: str) -> bool:
        return self._queue.now < self._stopped_until.get(node, 0.0)

    def _robot_goes_on(self, process: int) -> None:
        if process and process == self._robot.process and not self._is_still_stopped("robot"):
            self.note("robot", "goes on")
            self._robot.go_on()

    def _service_goes_on(self, service: ServiceNode, incarnation: int) -> None:
        if (
            service.incarnation == incarnation
            and service.up
            and not self._is_still_stopped(service.name)
        ):
            self.note(service.name, "goes on")
            service.go_on()
            self._network.review(service)

    def _slow(self, fault: Slow) -> None:
        service = self._services[fault.service]
        if not service.up:
            return
        # What was begun in it takes its time beyond it.
        self._happened(fault, fault.for_s + fault.factor * (self._run.task_s + self._run.sensing_s))
        self.note(fault.service, "computes %g times as long", fault.factor)
        slownesses = self._slownesses.setdefault(fault.service, [])
        slownesses.append(fault.factor)
        slower = max(slownesses) / service.slowness
        service.slowness = max(slownesses)
        left_s = self._crowded_until.get(service.name, 0.0) - self._queue.now
        self._crowd_takes_longer(service, (slower - 1.0) * left_s)
        self._queue.after(fault.for_s, self._quicken, service, fault.factor)

    def _quicken(self, service: ServiceNode, factor: float) -> None:
        slownesses = self._slownesses[service.name]
        slownesses.remove(factor)
        service.slowness = max(slownesses, default=1.0)

    def _exhaust(self, fault: OutOfMemory) -> None:
        service = self._services[fault.service]
        self._happened(fault, fault.for_s + _IS_ASKED_AGAIN_S)
        self.note(fault.service, "has no memory for %s parts", fault.part)
        service.lacks_memory_for.append(fault.part)
        self._queue.after(fault.for_s, self._relieve, service, fault.part)

    def _relieve(self, service: ServiceNode, part: str) -> None:
        service.lacks_memory_for.remove(part)
        self.note(service.name, "has memory for %s parts again", part)

    def _cut(self, fault: Cut) -> None:
        self._happened(fault, fault.for_s + self._run.lease_s)
        self.note(fault.service, "is cut off (%s)", fault.direction)
        for way in ("to", "from"):
            if fault.direction in (way, "both"):
                self._network.cut(fault.service, way)
                self._queue.after(fault.for_s, self._network.heal, fault.service, way)

    def _crowd(self, fault: Crowd) -> None:
        service = self._services[fault.service]
        if not service.up:
            return
        # Each of them is served in turn, after those of an earlier crowd that still wait.
        begin = max(self._queue.now, self._crowded_until.get(service.name, 0.0))
        end = begin + fault.robots * service.slowness * self._run.sensing_s
        self._crowded_until[service.name] = end
        self._happened(fault, end - self._queue.now + _CROWD_IS_FELT_S)
        self.note(fault.service, "is asked by %s other robots", fault.robots)
        self._checker.crowded(fault.robots)
        for number in range(fault.robots):
            self._crowds += 1
            payload = self._others.first_request(self._crowds, number % NUM_TRIALS)
            if self._run.certificates and number == 0:
                payload = self._others.impostors_request(SESSION, self._crowds % NUM_TRIALS)
            self._network.call_of_another(service, payload)

    def _crowd_takes_longer(self, service: ServiceNode, seconds: float) -> None:
        """Take note that what is left of a crowd is served later, if anything is."""
        end = self._crowded_until.get(service.name, 0.0)
        if seconds > 0.0 and end > self._queue.now:
            self._crowded_until[service.name] = end + seconds
            self._lasts(end + seconds - self._queue.now + _CROWD_IS_FELT_S)

    def _pause(self, fault: PauseRobot) -> None:
        if self._robot.process:
            self._happened(fault, fault.down_s)
            self.note("robot", "is asked to end")
            self._down_s = fault.down_s
            self._robot.pause()

    def _kill(self, fault: KillRobot) -> None:
        if not self._robot.process:
            return
        self._happened(fault, fault.down_s)
        self.note("robot", "is killed" + (" by a power cut" if fault.power_cut else ""))
        self._robot.kill(
            lost_appends=fault.lost_appends if fault.power_cut else None,
            body_goes_on=fault.body_goes_on,
        )
        self._end_local(None)
        self._queue.after(fault.down_s, self._restart_robot)

    def _restart_robot(self) -> None:
        if not self._robot.process:
            self._stopped_until.pop("robot", None)
            self.note("robot", "is started again")
            self._robot.start()

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
                self._kill(aimed)
                return

    def robot_ended(self) -> None:
        """Take note that the robot's process has ended in order."""
        self.note("robot", "has ended in order")
        self._end_local(None)
        self._lasts(self._down_s)
        self._queue.after(self._down_s, self._restart_robot)

    def stall_s(self) -> float:
        """Return how long this write to the journal takes."""
        if self._stalls and self._stalls[-1].at <= self._queue.now:
            fault = self._stalls.pop()
            stall_s = fault.for_s
            self._happened(fault, stall_s)
            self.note("robot", "writes to its journal for %g s", stall_s)
            return stall_s
        return 0.0

    def launch(self, number: int) -> None:
        """Start the local service."""
        self._end_local(None)
        self._launches += 1
        self._launch_number = number
        self._launcher = process = self._robot.process
        fault = self._launch_faults.get(self._launches)
        wait_s = self._run.launch_s
        self.note(LOCAL_SERVICE, "is launched")
        if fault is None:
            self._queue.after(wait_s, self._launched, process, number)
            return
        self._happened(fault, wait_s + fault.seconds)
        if fault.what == "fails":
            reason = "ended with exit code 1"
            self._queue.after(fault.seconds, self._robot.recovery_exited, process, number, reason)
        elif fault.what == "late":
            self._queue.after(wait_s + fault.seconds, self._launched, process, number)
        else:
            # Found by the launch's own limit, after which the next launch follows.
            self._lasts(_LAUNCH_TIMEOUT_S * 2**self._silent_launches)
            self._silent_launches += 1

    def _launched(self, process: int, number: int) -> None:
        if process == self._robot.process and number == self._launch_number:
            self._start_service(LOCAL_SERVICE)

    def _end_local(self, reason: str | None) -> None:
        """End the local service; with a reason, the robot learns of it."""
        local = self._services[LOCAL_SERVICE]
        number, process = self._launch_number, self._launcher
        self._launch_number = 0
        if local.up:
            local.end()
            self._network.service_died(local, 0.001)
            if reason is not None:
                self._queue.after(0.002, self._robot.recovery_exited, process, number, reason)

    def decided(self, timing: Timing) -> None:
        """Take note of whose decision is carried out, and how long the robot stood still for it."""
        now = self._queue.now
        self._decided_by, self._status = timing.service, timing.status
        waited_s = 1e-3 * timing.waited_ms / self._run.robot_clock_rate
        since = max(now - waited_s, self._faults_end_at)
        # Or the local service is launched first.
        allowed_s = STANDSTILL_S + self._run.launch_s
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
            self._story.append(StoryLine(self._queue.now, actor, text % values if values else text))


def _kind_of(payload: bytes) -> str:
    try:
        return type(decode_reply(payload)).__name__
    except MessageError as error:
        return error.code


def _short(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
