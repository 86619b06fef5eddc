"""A robot's machine, with small services and an environment, under a virtual clock."""

import heapq
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np

from holdfast.numerics.arrays import FloatArray
from holdfast.planning.inputs import ActingRecord, Moved, Record, Sensed, encode_floats, numbers_of
from holdfast.planning.outcome import MoveResult, TrialResult, ending_of
from holdfast.planning.planner import Planner, PlanningState, decode_checkpoint, digest
from holdfast.planning.settings import (
    LostSettings,
    OffloadSettings,
    OnLost,
    ParticleFilterSettings,
    PlanningSettings,
    RecoverySettings,
    SimulatorSettings,
)
from holdfast.planning.tracking import replay
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.protocol.dispatcher import Dispatcher
from holdfast.protocol.effects import LogEvent
from holdfast.protocol.messages import (
    DIGEST_SIZE,
    MAX_TASK_ACTIONS,
    NeedState,
    Progress,
    Reply,
    Request,
    SensingAnswer,
    SessionConfiguration,
    TaskAnswer,
    decode_request,
    encode,
)
from holdfast.protocol.robot import Robot
from holdfast.protocol.robot_events import (
    Abandon,
    Act,
    Acted,
    CallEnded,
    ComputeOwnAnswer,
    EndTrial,
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
    ServiceAppeared,
    ServiceVanished,
    VerificationNoted,
    WriteRecords,
)
from holdfast.robot.environment import SimulatedEnvironment
from holdfast.robot.trial import run_trial

PROBLEM = PegInHole2D()
PLANNING = PlanningSettings(
    particle_filter=ParticleFilterSettings(num_particles=30), sensing_interval=3
)
SIMULATOR = SimulatorSettings(num_trials=2, max_steps=40, seed=11)
OPENING = SessionConfiguration("peg_in_hole_2d", {}, {}, PLANNING, SIMULATOR.seed)
LOCAL = "local"


def nth(request: Request) -> int:
    """Return which of its process's requests it is: the numbers of all processes are different."""
    return request.number % (1 << 20)


class SmallService:
    """Answers from a table of states; ``rule`` may answer a request in its place."""

    def __init__(self, latency_s: float = 0.001) -> None:
        self.states: dict[bytes, PlanningState] = {}
        self.latency_s = latency_s
        self.up = True
        self.boot = 0
        self.stopped = False
        self.requests: list[Request] = []
        self.rule: Callable[[Request], list[Reply] | None] = lambda _: None

    def answer(self, payload: bytes) -> list[Reply]:
        request = decode_request(payload)
        self.requests.append(request)
        special = self.rule(request)
        if special is not None:
            return special
        number = request.number
        state = self._state(request)
        if state is None:
            return [NeedState(number, request.session in self.states)]
        self.states[request.session] = state
        replies: list[Reply] = []
        planner = Planner(PROBLEM, PLANNING)
        if not planner.needs_sensing(state):
            actions: list[np.ndarray] = []
            while len(actions) < MAX_TASK_ACTIONS and not planner.needs_sensing(state):
                action, _ = planner.choose_task_action(state)
                actions.append(action)
                state = planner.advance(state, action)
            replies.append(TaskAnswer(number, len(actions), encode_floats(actions), 1))
        index, _ = planner.choose_sensing_action(state)
        replies.append(SensingAnswer(number, state.step, index, digest(state)[:DIGEST_SIZE], 1))
        return replies

    def _state(self, request: Request) -> PlanningState | None:
        planner = Planner(PROBLEM, PLANNING)
        if request.checkpoint is not None:
            state = decode_checkpoint(request.checkpoint)
            planner.check(state)
        elif request.session not in self.states and request.session_configuration is None:
            return None
        else:
            kept = self.states.get(request.session)
            if kept is None or kept.trial != request.trial:
                kept = planner.init(SIMULATOR.seed, request.trial)
            state = kept
            for item in request.inputs:
                assert isinstance(item, Sensed)
                while state.step < item.step:
                    action, _ = planner.choose_task_action(state)
                    state = planner.advance(state, action)
                shown = numbers_of(item.observation)
                state, _ = planner.observe(state, item.sensing_action, shown)
        return state if digest(state)[:DIGEST_SIZE] == request.digest else None


def answer_third_slowly(service: SmallService, *, num_signs: int) -> None:
    """Have the third request answered after so many signs of life, 0.1 s each."""
    service.latency_s = 0.1

    def slow(request: Request) -> list[Reply] | None:
        if nth(request) != 3:
            return None
        service.rule = lambda _: None
        signs: list[Reply] = [Progress(request.number, False) for _ in range(num_signs)]
        replies = service.answer(encode(request))
        service.rule = slow
        return signs + replies

    service.rule = slow


class Sent(NamedTuple):
    at: float
    service: str
    request: Request


class FailingWorld(SimulatedEnvironment):
    """Whose task has failed once so many task actions were performed."""

    fails_at = 6

    def is_done(self) -> Any:
        return "failed" if self.step >= self.fails_at else super().is_done()


class Misleading(SimulatedEnvironment):
    """What it shows in these sensing actions, counted from 0, no particle can explain."""

    lies: frozenset[int] = frozenset()

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.sensed = 0

    def perform_sensing(self, sensing_action: int) -> np.ndarray:
        shown = super().perform_sensing(sensing_action)
        self.sensed += 1
        return shown + 100.0 if self.sensed - 1 in self.lies else shown


class World:
    """A robot, its services, its environment and a clock."""

    environment_class: type[SimulatedEnvironment] = SimulatedEnvironment

    def __init__(
        self,
        *,
        services: tuple[str, ...] = ("cloud",),
        launch: str = "on_failure",
        rate_hz: float | None = None,
        planning: PlanningSettings = PLANNING,
        simulator: SimulatorSettings = SIMULATOR,
        verify_share: float = 0.05,
        distrusted: tuple[str, ...] = (),
        what: Literal["sensing", "all"] = "all",
        on_lost: OnLost = "continue",
    ) -> None:
        self.now = 0.0
        self.lost = LostSettings(on_lost=on_lost)
        self.offload = OffloadSettings(services=services, what=what, verify_share=verify_share)
        self.services = {name: SmallService() for name in (*services, LOCAL)}
        self.services[LOCAL].up = False
        self.launchable = True
        self.launch_s = 0.2
        recovery = RecoverySettings(launch=launch)  # type: ignore[arg-type]
        self.dispatcher = Dispatcher(
            services,
            LOCAL,
            self.offload,
            recovery,
            b"s" * 16,
            1,
            OPENING,
            PROBLEM,
            b"secret",
            distrusted,
        )
        self.own_s = 0.005
        self.own = self.decide
        self.verified: list[VerificationNoted] = []
        self.planner, self.simulator = Planner(PROBLEM, planning), simulator
        self.robot = Robot(self.planner, simulator, self.dispatcher, rate_hz, self.lost)
        self.environment = SimulatedEnvironment(PROBLEM, simulator.seed, 0)
        self.heap: list[tuple[float, int, Callable[[], list[RobotEffect]]]] = []
        self.count = 0
        self.trace: list[tuple[float, RobotEffect]] = []
        self.journal: list[Record] = []
        self.sent: list[Sent] = []
        self.calls: dict[int, str] = {}
        self.results: list[TrialResult] = []
        self.stopped: Halt | None = None
        self.ended = False
        self.acted: list[tuple[int, np.ndarray]] = []
        self.on_act: Callable[[int], None] = lambda _: None

    # -- faults ----------------------------------------------------------------------------------

    def kill(self, name: str, found_after_s: float = 0.01) -> None:
        service = self.services[name]
        if not service.up:
            return
        service.up = False
        service.states.clear()
        boot = str(service.boot)
        lost = [call for call, asked in self.calls.items() if asked == name]
        self.after(found_after_s, lambda: self.robot.handle(ServiceVanished(name, boot), self.now))
        for call in lost:
            self.after(found_after_s, lambda call=call: self.end(call))  # type: ignore[misc]

    def bring_up(self, name: str, after_s: float = 0.0) -> None:
        def appear() -> list[RobotEffect]:
            service = self.services[name]
            service.up = True
            service.boot += 1
            return self.robot.handle(ServiceAppeared(name, str(service.boot)), self.now)

        self.after(after_s, appear)

    def lose_the_cloud_for_a_while(self) -> None:
        """Have the cloud die in the task action of step 8, and come back 0.42 s later."""

        def fault(performed: int) -> None:
            if performed == 8 and not self.results:
                self.kill("cloud")
                self.bring_up("cloud", 0.42)

        self.on_act = fault

    # -- running ---------------------------------------------------------------------------------

    def after(self, seconds: float, do: Callable[[], list[RobotEffect]]) -> None:
        self.count += 1
        heapq.heappush(self.heap, (self.now + seconds, self.count, do))

    def start(self, *, present: bool = True, records: tuple[Record, ...] = ()) -> None:
        self.carry_out(self.robot.start(self.now))
        if present:
            for name in self.offload.services:
                self.bring_up(name)
        self.journal = list(records)
        self.begin(0)

    def begin(self, trial: int) -> None:
        rate = self.lost.false_alarm_rate
        history = replay(self.planner, self.simulator.seed, trial, self.journal, rate)
        self.environment = self.environment_class(PROBLEM, self.simulator.seed, trial)
        for action in history.actions:
            self.environment.perform(action)
        ending = ending_of(self.environment.is_done())
        begun = EnvironmentReady(ending, self.environment.step)
        self.carry_out(self.robot.begin_trial(history, begun, self.now, tail_is_certain=True))

    def run(self, until_s: float = 60.0) -> None:
        while not self.ended and self.stopped is None:
            wake = self.robot.next_wakeup()
            event_at = self.heap[0][0] if self.heap else None
            if event_at is None and wake is None:
                raise AssertionError(f"nothing will ever happen again at {self.now}")
            if event_at is None or (wake is not None and wake < event_at):
                assert wake is not None
                self.now = max(self.now, wake)
                self.carry_out(self.robot.wake(self.now))
                following = self.robot.next_wakeup()
                assert following is None or following > self.now or self.ended or self.stopped, (
                    "the machine asks to be woken at a time that has passed"
                )
            else:
                self.now, _, do = heapq.heappop(self.heap)
                self.carry_out(do())
            if self.now > until_s:
                return

    def carry_out(self, effects: list[RobotEffect]) -> None:
        for effect in effects:
            self.trace.append((self.now, effect))
            if isinstance(effect, WriteRecords):
                self.journal += effect.records
            elif isinstance(effect, Send):
                self.send(effect)
            elif isinstance(effect, Abandon):
                self.calls.pop(effect.call, None)
            elif isinstance(effect, Sense):
                shown: FloatArray | None = self.environment.perform_sensing(effect.sensing_action)
                sensed = Sensed(effect.step, effect.sensing_action, encode_floats(shown))
                self.after(0.001, self.later(NoReading(effect.step) if shown is None else sensed))
            elif isinstance(effect, Act):
                self.act(effect)
            elif isinstance(effect, Launch):
                self.launch(effect)
            elif isinstance(effect, ComputeOwnAnswer):
                decided = self.own(effect)
                self.after(self.own_s, lambda it=decided: self.robot.handle(it, self.now))  # type: ignore[misc]
            elif isinstance(effect, VerificationNoted):
                self.verified.append(effect)
            elif isinstance(effect, EndTrial):
                self.results.append(effect.result)
                self.journal = []
                if len(self.results) == self.simulator.num_trials:
                    self.ended = True
                else:
                    self.begin(len(self.results))
            elif isinstance(effect, Halt):
                assert effect is effects[-1], "the shell carries out nothing after it"
                self.stopped = effect
            elif isinstance(effect, Paused):
                self.ended = True

    def decide(self, effect: ComputeOwnAnswer) -> OwnAnswer:
        actions, sensing_action, ahead = self.planner.decide(effect.state, MAX_TASK_ACTIONS)
        return OwnAnswer(effect.number, actions, sensing_action, digest(ahead), self.own_s)

    def later(self, event: Sensed | NoReading | Acted) -> Callable[[], list[RobotEffect]]:
        return lambda: self.robot.handle(event, self.now)

    def act(self, effect: Act) -> None:
        last = self.journal[-1]
        assert isinstance(last, ActingRecord), "acted without having written it down"
        assert last.step == effect.step
        self.acted.append((effect.step, effect.action))
        shown = self.environment.perform(effect.action)
        result = shown if isinstance(shown, MoveResult) else MoveResult(shown)
        self.on_act(effect.step)
        ending = ending_of(self.environment.is_done())
        shows = encode_floats(result.motion), encode_floats(result.observation)
        moved = Moved(effect.step, result.reward, *shows)
        self.after(0.01, self.later(Acted(moved, ending)))

    def launch(self, effect: Launch) -> None:
        self.kill(LOCAL)
        if self.launchable:
            self.bring_up(LOCAL, self.launch_s)
        else:
            self.after(
                0.01,
                lambda: self.robot.handle(
                    RecoveryExited(effect.number, "no such program"), self.now
                ),
            )

    def send(self, effect: Send) -> None:
        service = self.services[effect.service]
        self.sent.append(Sent(self.now, effect.service, decode_request(effect.payload)))
        self.calls[effect.call] = effect.service
        if not service.up:
            self.after(0.0001, lambda: self.end(effect.call))
            return
        if service.stopped:
            return
        delay = service.latency_s
        for reply in service.answer(effect.payload):
            delay += service.latency_s
            self.after(delay, lambda reply=reply: self.reply(effect.call, reply))  # type: ignore[misc]
        self.after(delay + 0.0001, lambda: self.end(effect.call))

    def reply(self, call: int, reply: Reply) -> list[RobotEffect]:
        name = self.calls.get(call)
        if name is None or not self.services[name].up:
            return []
        return self.robot.handle(ReplyReceived(call, encode(reply)), self.now)

    def end(self, call: int) -> list[RobotEffect]:
        if self.calls.pop(call, None) is None:
            return []
        return self.robot.handle(CallEnded(call), self.now)

    # -- looking ---------------------------------------------------------------------------------

    def reports(self, name: str) -> list[dict[str, object]]:
        return [e.fields for _, e in self.trace if isinstance(e, LogEvent) and e.name == name]

    def statuses(self) -> list[object]:
        return [fields["to"] for fields in self.reports("status")]

    def start_and_run(self) -> None:
        self.start()
        self.run()

    def complete(self) -> None:
        """Run from the start to the end, and compare with the run without faults."""
        self.start_and_run()
        self.assert_same_as_without_faults()

    def assert_same_as_without_faults(self) -> None:
        assert len(self.results) == self.simulator.num_trials
        for result in self.results:
            expected = run_trial(
                Planner(PROBLEM, self.planner.settings),
                self.simulator.seed,
                result.trial,
                max_steps=self.simulator.max_steps,
            )
            assert result.digest == expected.digest
            assert result.reward == expected.reward
            assert (result.success, result.steps) == (expected.success, expected.steps)
            assert result.sensing_decisions == expected.sensing_decisions
            assert result.unexplained_observations == expected.unexplained_observations
