"""The robot's machine against small services of this file's own, under a virtual clock."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pytest

from holdfast.outcome import TrialResult
from holdfast.planning import (
    Planner,
    PlanningState,
    advance,
    check_state,
    choose_sensing_action,
    choose_task_action,
    decode_checkpoint,
    digest,
    initial_state,
    needs_sensing,
    observe,
)
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.recording.recorder import Recorder
from holdfast.runtime.environment import SimulatedEnvironment
from holdfast.runtime.trial import run_trial
from holdfast.session.dispatcher import Dispatcher, ServiceRefusedError
from holdfast.session.effects import (
    Abandon,
    Act,
    Decide,
    Effect,
    EndTrial,
    Journal,
    Launch,
    Paused,
    Report,
    Send,
    Sense,
    Stop,
    Timing,
    Verified,
)
from holdfast.session.events import (
    Acted,
    Appeared,
    Begun,
    Decided,
    Ended,
    EnvironmentFailed,
    Replied,
    Sensed,
    Vanished,
)
from holdfast.session.messages import (
    DIGEST_SIZE,
    MAX_TASK_ACTIONS,
    Busy,
    NeedState,
    Opening,
    Progress,
    Refused,
    Reply,
    Request,
    SensingAnswer,
    TaskAnswer,
    decode_request,
    encode,
    numbers_from,
    numbers_to,
)
from holdfast.session.records import ActingRecord, ObservedRecord, PerformedRecord, Record
from holdfast.session.replies import StaleEpochError
from holdfast.session.robot import HeldError, Robot, UnknownPerformanceError, replay
from holdfast.session.status import Status
from holdfast.settings import (
    OffloadSettings,
    ParticleFilterSettings,
    PlanningSettings,
    RecoverySettings,
    SimulatorSettings,
)

PROBLEM = PegInHole2D()
PLANNING = PlanningSettings(
    particle_filter=ParticleFilterSettings(num_particles=30), sensing_interval=3
)
SIMULATOR = SimulatorSettings(num_trials=2, max_steps=40, seed=11)
OPENING = Opening("peg_in_hole_2d", {}, {}, PLANNING, SIMULATOR.seed)
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
        if not needs_sensing(PLANNING, state):
            actions: list[np.ndarray] = []
            while len(actions) < MAX_TASK_ACTIONS and not needs_sensing(PLANNING, state):
                action, _ = choose_task_action(PROBLEM, PLANNING, state)
                actions.append(action)
                state = advance(PROBLEM, PLANNING, state, action)
            replies.append(TaskAnswer(number, len(actions), numbers_to(actions), 1))
        index, _ = choose_sensing_action(PROBLEM, PLANNING, state)
        replies.append(SensingAnswer(number, state.step, index, digest(state)[:DIGEST_SIZE], 1))
        return replies

    def _state(self, request: Request) -> PlanningState | None:
        if request.checkpoint is not None:
            state = decode_checkpoint(request.checkpoint)
            check_state(PROBLEM, PLANNING, state)
        elif request.session not in self.states and request.opening is None:
            return None
        else:
            kept = self.states.get(request.session)
            if kept is None or kept.trial != request.trial:
                kept = initial_state(PROBLEM, PLANNING, SIMULATOR.seed, request.trial)
            state = kept
            for item in request.observations:
                while state.step < item.step:
                    action, _ = choose_task_action(PROBLEM, PLANNING, state)
                    state = advance(PROBLEM, PLANNING, state, action)
                shown = numbers_from(item.observation, len(item.observation) // 8)
                state, _ = observe(PROBLEM, PLANNING, state, item.sensing_action, shown)
        return state if digest(state)[:DIGEST_SIZE] == request.digest else None


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
        deadline_ms: float | None = None,
        rate_hz: float | None = None,
        planning: PlanningSettings = PLANNING,
        simulator: SimulatorSettings = SIMULATOR,
        verify_share: float = 0.05,
        distrusted: tuple[str, ...] = (),
    ) -> None:
        self.now = 0.0
        self.offload = OffloadSettings(
            services=services, decision_deadline_ms=deadline_ms, verify_share=verify_share
        )
        self.services = {name: SmallService() for name in (*services, LOCAL)}
        self.services[LOCAL].up = False
        self.launchable = True
        self.launch_s = 0.2
        recovery = RecoverySettings(launch=launch)  # type: ignore[arg-type]
        dispatcher = Dispatcher(
            services,
            LOCAL,
            self.offload,
            recovery,
            b"s" * 16,
            1,
            OPENING,
            PROBLEM.action_size,
            len(PROBLEM.sensing_actions),
            lambda actions: self.limited(actions),
            b"secret",
            distrusted,
        )
        self.limited = PROBLEM.execute
        self.own_s = 0.005
        self.own = self.decide
        self.verified: list[Verified] = []
        self.planner, self.simulator = Planner(PROBLEM, planning), simulator
        self.robot = Robot(self.planner, simulator, dispatcher, rate_hz)
        self.environment = SimulatedEnvironment(PROBLEM, simulator.seed, 0)
        self.heap: list[tuple[float, int, Callable[[], list[Effect]]]] = []
        self.count = 0
        self.trace: list[tuple[float, Effect]] = []
        self.journal: list[Record] = []
        self.sent: list[Sent] = []
        self.calls: dict[int, str] = {}
        self.results: list[TrialResult] = []
        self.stopped: Stop | None = None
        self.ended = False
        self.acted: list[tuple[int, np.ndarray]] = []
        self.on_act: Callable[[int], None] = lambda _: None
        self.on_the_way: Callable[[int, bytes], bytes] = lambda _, payload: payload

    # -- faults ----------------------------------------------------------------------------------

    def kill(self, name: str, found_after_s: float = 0.01) -> None:
        service = self.services[name]
        if not service.up:
            return
        service.up = False
        service.states.clear()
        boot = str(service.boot)
        lost = [call for call, asked in self.calls.items() if asked == name]
        self.after(found_after_s, lambda: self.robot.handle(Vanished(name, boot), self.now))
        for call in lost:
            self.after(found_after_s, lambda call=call: self.end(call))  # type: ignore[misc]

    def bring_up(self, name: str, after_s: float = 0.0) -> None:
        def appear() -> list[Effect]:
            service = self.services[name]
            service.up = True
            service.boot += 1
            return self.robot.handle(Appeared(name, str(service.boot)), self.now)

        self.after(after_s, appear)

    # -- running ---------------------------------------------------------------------------------

    def after(self, seconds: float, do: Callable[[], list[Effect]]) -> None:
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
        history = replay(self.planner, self.simulator.seed, trial, self.journal)
        self.environment = self.environment_class(PROBLEM, self.simulator.seed, trial)
        for action in history.actions:
            self.environment.perform(action)
        begun = Begun(self.environment.is_done(), self.environment.step)
        self.carry_out(
            self.robot.begin_trial(trial, history, begun, self.now, tail_is_certain=True)
        )

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

    def carry_out(self, effects: list[Effect]) -> None:
        for effect in effects:
            self.trace.append((self.now, effect))
            if isinstance(effect, Journal):
                self.journal += effect.records
            elif isinstance(effect, Send):
                self.send(effect)
            elif isinstance(effect, Abandon):
                self.calls.pop(effect.call, None)
            elif isinstance(effect, Sense):
                shown = self.environment.perform_sensing(effect.sensing_action)
                self.after(0.001, self.later(Sensed(effect.step, shown)))
            elif isinstance(effect, Act):
                self.act(effect)
            elif isinstance(effect, Launch):
                self.launch(effect)
            elif isinstance(effect, Decide):
                decided = self.own(effect)
                self.after(self.own_s, lambda it=decided: self.robot.handle(it, self.now))  # type: ignore[misc]
            elif isinstance(effect, Verified):
                self.verified.append(effect)
            elif isinstance(effect, EndTrial):
                self.results.append(effect.result)
                self.journal = []
                if len(self.results) == self.simulator.num_trials:
                    self.ended = True
                else:
                    self.begin(len(self.results))
            elif isinstance(effect, Stop):
                self.stopped = effect
            elif isinstance(effect, Paused):
                self.ended = True

    def decide(self, effect: Decide) -> Decided:
        actions, sensing_action, ahead = self.planner.decide(effect.state, MAX_TASK_ACTIONS)
        return Decided(effect.number, actions, sensing_action, digest(ahead), self.own_s)

    def later(self, event: Sensed | Acted) -> Callable[[], list[Effect]]:
        return lambda: self.robot.handle(event, self.now)

    def act(self, effect: Act) -> None:
        last = self.journal[-1]
        assert isinstance(last, ActingRecord), "acted without having written it down"
        assert last.step == effect.step
        self.acted.append((effect.step, effect.action))
        reward = self.environment.perform(effect.action)
        self.on_act(effect.step)
        self.after(0.01, self.later(Acted(effect.step, reward, self.environment.is_done())))

    def launch(self, effect: Launch) -> None:
        self.kill(LOCAL)
        if self.launchable:
            self.bring_up(LOCAL, self.launch_s)
        else:
            self.after(
                0.01,
                lambda: self.robot.recovery_exited(effect.number, "no such program", self.now),
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

    def reply(self, call: int, reply: Reply) -> list[Effect]:
        name = self.calls.get(call)
        if name is None or not self.services[name].up:
            return []
        payload = self.on_the_way(call, encode(reply))
        return self.robot.handle(Replied(call, payload), self.now)

    def end(self, call: int) -> list[Effect]:
        if self.calls.pop(call, None) is None:
            return []
        return self.robot.handle(Ended(call), self.now)

    # -- looking ---------------------------------------------------------------------------------

    def reports(self, name: str) -> list[dict[str, object]]:
        return [e.fields for _, e in self.trace if isinstance(e, Report) and e.name == name]

    def statuses(self) -> list[object]:
        return [fields["to"] for fields in self.reports("status")]

    def longest_wait_ms(self) -> float:
        return max(e.waited_ms for _, e in self.trace if isinstance(e, Timing))

    def assert_same_as_without_faults(self) -> None:
        assert len(self.results) == self.simulator.num_trials
        for result in self.results:
            expected = run_trial(PROBLEM, self.planner.settings, self.simulator, result.trial)
            assert result.digest == expected.digest
            assert result.reward == expected.reward
            assert (result.success, result.steps) == (expected.success, expected.steps)
            assert result.sensing_decisions == expected.sensing_decisions
            assert result.unexplained_observations == expected.unexplained_observations


def test_without_faults_it_decides_as_in_process_with_one_request_per_sensing_step() -> None:
    world = World()
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == []
    asked = [sent.request for sent in world.sent]
    # The first question of a trial is for its first sensing action; then one for each observation.
    decisions = sum(result.sensing_decisions for result in world.results)
    assert len(asked) == decisions + len(world.results)
    assert [request.opening is not None for request in asked].count(True) == 1
    assert all(request.checkpoint is None for request in asked)
    assert all(len(request.observations) <= 1 for request in asked)


def test_the_prefetched_sensing_action_is_there_before_it_is_needed() -> None:
    world = World()
    world.start()
    world.run()
    waits = [e for _, e in world.trace if isinstance(e, Timing) and e.kind == "sensing"]
    assert all(wait.waited_ms == 0.0 for wait in waits if wait.step > 0)


@pytest.mark.parametrize("step", range(13))
@pytest.mark.parametrize("launch", ["on_failure", "at_start"])
def test_killed_at_any_step_and_back_again(step: int, launch: str) -> None:
    world = World(launch=launch)
    if launch == "at_start":
        world.launch_s = 0.0

    def fault(performed: int) -> None:
        if performed == step and not world.results and world.services["cloud"].boot == 1:
            world.kill("cloud")
            world.bring_up("cloud", 0.5)

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == ["local_recovery", "keep_alive"]
    limit_s = 0.01 + (world.launch_s if launch == "on_failure" else 0.0) + 0.02
    assert world.longest_wait_ms() <= 1e3 * limit_s


def test_dead_before_the_first_request() -> None:
    world = World()
    world.start(present=False)
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == ["local_recovery"]
    lost_at = next(at for at, e in world.trace if isinstance(e, Report) and e.name == "status")
    assert lost_at == pytest.approx(1e-3 * world.offload.startup_timeout_ms)


def test_stopped_for_longer_than_the_timeout_is_found_by_its_silence() -> None:
    world = World()

    def fault(performed: int) -> None:
        world.services["cloud"].stopped = not world.results and 3 <= performed < 20

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == ["local_recovery", "keep_alive"]
    assert any("no sign" in str(f["reason"]) for f in world.reports("service_suspected"))


def test_kill_again_after_failback() -> None:
    world = World()
    times = iter([2, 14, 25])
    following = next(times)

    def fault(performed: int) -> None:
        nonlocal following
        if performed == following and not world.results:
            following = next(times, -1)
            world.kill("cloud")
            world.bring_up("cloud", 0.012)

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == ["local_recovery", "keep_alive"] * 3
    assert sum(result.recoveries for result in world.results) == 3


def test_a_cloud_that_appears_again_is_asked_what_the_local_service_was_asked() -> None:
    """Not only with the next turn: while the robot moves, the cloud comes to hold its state."""
    world = World()

    def fault(performed: int) -> None:
        if performed == 4 and not world.results:
            world.kill("cloud")
            # The robot has been answered for the steps that follow, and is in the midst of them.
            world.bring_up("cloud", 0.392)

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    appeared_at = [
        at for at, e in world.trace if isinstance(e, Report) and e.name == "service_appeared"
    ]
    assert len(appeared_at) == 2
    asked = [sent for sent in world.sent if sent.at >= appeared_at[1]]
    assert (asked[0].service, asked[0].at) == ("cloud", appeared_at[1])
    last = [sent.request for sent in world.sent if sent.at < appeared_at[1]][-1]
    assert asked[0].request.digest == last.digest
    assert world.statuses() == ["local_recovery", "keep_alive"]


def test_a_given_up_service_sees_the_next_question_also_while_another_decides() -> None:
    """Only an answer of its own brings it back, so it must be asked although nobody needs it."""
    world = World(services=("first", "second"))
    first = world.services["first"]

    def fault(performed: int) -> None:
        # It is asked one question that it never answers; then it is as before.
        first.stopped = not world.results and performed == 3

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    suspected_at = next(
        at for at, e in world.trace if isinstance(e, Report) and e.name == "service_suspected"
    )
    after = [sent for sent in world.sent if sent.at >= suspected_at]
    tries = [sent.at for sent in after if sent.service == "first"]
    assert len(tries) > 2
    # One try at a time, since it may be far away; with its answer it decides alone.
    assert tries[1] >= tries[0] + 1e-3 * world.offload.detection_timeout_ms
    assert {sent.service for sent in after if sent.at < tries[1]} == {"first", "second"}
    assert {sent.service for sent in after if sent.at > tries[1]} == {"first"}
    assert world.statuses() == []


def test_a_preferred_service_that_is_back_is_asked_while_the_other_takes_its_time() -> None:
    """The robot stands still for the second, which says that it is at work; the first could do."""
    world = World(services=("first", "second"))
    second = world.services["second"]

    def takes_for_ever(request: Request) -> list[Reply]:
        return [Progress(request.number, False)] * 4000

    second.rule = takes_for_ever
    second.latency_s = 0.01

    def fault(performed: int) -> None:
        if performed == 3 and not world.results:
            world.kill("first")
            world.bring_up("first", 0.05)

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert {sent.service for sent in world.sent} == {"first", "second"}
    # Two timeouts at most: until the decision is late, and the next look.
    assert world.longest_wait_ms() <= 2 * world.offload.detection_timeout_ms
    assert world.statuses() == []


def test_cloud_and_recovery_killed_together() -> None:
    world = World()

    def fault(performed: int) -> None:
        if performed == 4 and not world.results:
            world.kill("cloud")
        if performed == 10 and not world.results:
            world.kill(LOCAL)

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == ["local_recovery"]
    assert len([e for _, e in world.trace if isinstance(e, Launch)]) == 2


def test_two_replicas_killed_in_turn_stay_standard_until_both_are_dead() -> None:
    world = World(services=("first", "second"))

    def fault(performed: int) -> None:
        if world.results:
            return
        if performed == 4:
            world.kill("first")
        if performed == 12:
            world.kill("second")
            world.bring_up("first", 0.3)

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == ["local_recovery", "keep_alive"]
    assert {sent.service for sent in world.sent} == {"first", "second", LOCAL}


def test_without_recovery_it_holds_says_why_and_goes_on() -> None:
    world = World(launch="never")

    def fault(performed: int) -> None:
        if performed == 4 and not world.results:
            world.kill("cloud")
            world.bring_up("cloud", 3.0)

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == []
    (held,) = world.reports("holding")
    assert "cloud: is not there" in str(held["reason"])
    (resumed,) = world.reports("resumed")
    assert 2500.0 < float(str(resumed["held_ms"])) < 3100.0


def test_recovery_that_cannot_be_launched_holds_the_robot_until_anything_answers() -> None:
    world = World()
    world.launchable = False

    def fault(performed: int) -> None:
        if performed == 4 and not world.results:
            world.kill("cloud")
            world.bring_up("cloud", 5.0)

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == ["local_recovery", "keep_alive"]
    launches = [e for _, e in world.trace if isinstance(e, Launch)]
    assert 3 < len(launches) < 12


def test_a_lost_reply_is_asked_for_again() -> None:
    world = World(launch="never")
    cloud = world.services["cloud"]
    dropped = 0

    def lose_some(request: Request) -> list[Reply] | None:
        nonlocal dropped
        if nth(request) in (2, 3, 7):
            dropped += 1
            return []
        return None

    cloud.rule = lose_some
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert dropped == 3


@pytest.mark.parametrize("damaged", [1, 2, 5])
def test_a_damaged_reply_is_asked_for_again_and_nobody_is_blamed(damaged: int) -> None:
    """The line has flipped a bit: the service is as good as before, and is asked again at once."""
    world = World()
    spoilt: list[tuple[float, int]] = []

    def flip_a_bit(call: int, payload: bytes) -> bytes:
        if len(spoilt) == 0 and len(world.sent) == damaged:
            spoilt.append((world.now, call))
            return payload[:-9] + bytes([payload[-9] ^ 16]) + payload[-8:]
        return payload

    world.on_the_way = flip_a_bit
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    ((at, call),) = spoilt
    (told,) = world.reports("malformed_reply")
    assert told["service"] == "cloud"
    # What else comes in that call is not to be believed, nor is its end news of the service.
    assert (at, Abandon(call)) in world.trace
    asked, again = world.sent[damaged - 1 : damaged + 1]
    assert again.service == "cloud"
    assert (again.request.digest, again.request.step) == (asked.request.digest, asked.request.step)
    assert at < again.at <= at + 0.021
    assert world.reports("service_suspected") == []
    assert world.statuses() == []


def test_swallowed_requests_are_sent_again_after_the_timeout() -> None:
    world = World(launch="never")
    cloud = world.services["cloud"]

    def fault(performed: int) -> None:
        cloud.stopped = performed == 3 and not world.results
        if cloud.stopped:
            world.after(2.0, wake_up)

    def wake_up() -> list[Effect]:
        cloud.stopped = False
        return []

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()


def test_a_service_that_lost_the_session_is_handed_the_state() -> None:
    world = World()
    cloud = world.services["cloud"]

    def fault(performed: int) -> None:
        if performed in (5, 6):
            cloud.states.clear()

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == []
    assert any(request.checkpoint is not None for request in cloud.requests)


def test_busy_is_waited_for_if_short_and_evaded_if_long() -> None:
    world = World()
    cloud = world.services["cloud"]
    cloud.rule = lambda r: [Busy(r.number, 20)] if nth(r) in (3, 4) else None
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == []

    world = World()
    cloud = world.services["cloud"]
    cloud.rule = lambda r: [Busy(r.number, 5000)] if nth(r) == 3 else None
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses()[0] == "local_recovery"


def test_progress_keeps_a_slow_service_trusted() -> None:
    world = World()
    cloud = world.services["cloud"]
    cloud.latency_s = 0.1

    def slow(request: Request) -> list[Reply] | None:
        if nth(request) != 3:
            return None
        cloud.rule = lambda _: None
        signs: list[Reply] = [Progress(request.number, False) for _ in range(10)]
        replies = cloud.answer(encode(request))
        cloud.rule = slow
        return signs + replies

    cloud.rule = slow
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == []


def test_deadline_hedges_within_its_budget() -> None:
    world = World(launch="at_start", deadline_ms=20.0)
    cloud = world.services["cloud"]
    world.start()
    world.services["cloud"].latency_s = 0.1
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == []
    hedged = len(world.reports("hedge"))
    questions = len({sent.request.digest for sent in world.sent})
    assert 1 <= hedged <= 3 + 0.1 * questions
    assert cloud.requests


@pytest.mark.parametrize("comes", [True, False])
def test_at_the_start_one_that_refuses_makes_nobody_give_up_those_to_come(comes: bool) -> None:
    world = World(services=("older", "current"))
    startup_s = 1e-3 * world.offload.startup_timeout_ms
    world.services["older"].rule = lambda request: [
        Refused(request.number, "other_code", "another copy of the problem")
    ]
    world.services["current"].up = False
    world.start(present=False)
    world.bring_up("older")
    if comes:
        world.bring_up("current", 0.9 * startup_s)
    world.run()
    world.assert_same_as_without_faults()
    assert [fields["final"] for fields in world.reports("refused")] == [True]
    lost = [at for at, e in world.trace if isinstance(e, Report) and e.name == "status"]
    assert lost == ([] if comes else [startup_s])
    assert {sent.service for sent in world.sent} == {"older", "current" if comes else LOCAL}


@pytest.mark.parametrize("services", [("older",), ("older", "gone")])
def test_at_the_start_nobody_is_waited_for_where_the_others_refuse_or_were_there(
    services: tuple[str, ...],
) -> None:
    world = World(services=services)
    world.services["older"].rule = lambda request: [
        Refused(request.number, "other_code", "another copy of the problem")
    ]
    world.start(present=False)
    world.bring_up("older")
    world.carry_out(world.robot.handle(Appeared("gone", "1"), world.now))
    world.carry_out(world.robot.handle(Vanished("gone", "1"), world.now))
    world.run()
    world.assert_same_as_without_faults()
    (launch,) = [at for at, e in world.trace if isinstance(e, Launch)]
    assert launch < 1e-3 * world.offload.startup_timeout_ms


def test_a_problem_that_every_service_refuses_stops_the_robot() -> None:
    world = World()

    def refuse(request: Request) -> list[Reply] | None:
        return [Refused(request.number, "failed", "policy gives nan")]

    world.services["cloud"].rule = refuse
    world.services[LOCAL].rule = refuse
    world.start()
    world.run()
    assert world.stopped is not None
    assert isinstance(world.stopped.error, ServiceRefusedError)
    assert "policy gives nan" in str(world.stopped.error)


def fails_in_its_sensing_part(service: SmallService, code: str, calls: int = 10**9) -> None:
    """Let a service give the task part and refuse the sensing part after it, for so many calls."""
    left = [calls]

    def rule(request: Request) -> list[Reply] | None:
        service.rule = lambda _: None
        replies = service.answer(encode(request))
        service.requests.pop()
        service.rule = rule
        if left[0] > 0 and isinstance(replies[0], TaskAnswer):
            left[0] -= 1
            return [replies[0], Refused(request.number, code, "observation_mean raised")]
        return replies

    service.rule = rule


@pytest.mark.parametrize("code", ["failed", "out_of_memory"])
@pytest.mark.parametrize("launch", ["on_failure", "never"])
def test_a_sensing_part_that_fails_after_its_task_part_stops_the_robot(
    code: str, launch: str
) -> None:
    world = World(launch=launch)
    for service in world.services.values():
        fails_in_its_sensing_part(service, code)
    world.start()
    world.run()
    assert world.stopped is not None
    assert isinstance(world.stopped.error, ServiceRefusedError)
    asked = ["cloud"] if launch == "never" else ["cloud", LOCAL]
    for name in asked:
        assert f"{name}: {code}: observation_mean raised" in str(world.stopped.error)
        told = [each for each in world.reports("refused") if each["service"] == name]
        assert [each["final"] for each in told] == [False] * (len(told) - 1) + [True]
        assert len(told) <= 5
    # What was not refused was performed, and nobody guessed the rest.
    assert [step for step, _ in world.acted] == list(range(4))


def test_who_fails_in_its_sensing_part_leaves_the_rest_to_another_service() -> None:
    world = World(services=("broken", "sound"))
    fails_in_its_sensing_part(world.services["broken"], "failed")
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    told = world.reports("refused")
    assert [(each["service"], each["final"]) for each in told] == [
        ("broken", False),
        ("broken", False),
        ("broken", True),
    ]
    assert world.statuses() == []


def test_out_of_memory_for_a_while_is_asked_again_ever_later() -> None:
    world = World(launch="never")
    fails_in_its_sensing_part(world.services["cloud"], "out_of_memory", calls=4)
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    told = [at for at, e in world.trace if isinstance(e, Report) and e.name == "refused"]
    waits = [after - before for before, after in itertools.pairwise(told)]
    assert len(waits) == 3
    assert all(later > 1.5 * wait for wait, later in itertools.pairwise(waits))
    assert waits[0] > 0.1
    reasons = {str(each["reason"]) for each in world.reports("holding")}
    assert reasons == {"cloud: out_of_memory: observation_mean raised"}


def test_an_answer_clears_earlier_refusals_of_the_same_part() -> None:
    world = World(launch="never")
    refuse = {5, 6, 8, 9, 11, 12}
    world.services["cloud"].rule = lambda r: (
        [Refused(r.number, "failed", "policy gives nan")] if nth(r) in refuse else None
    )
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert len(world.reports("refused")) == len(refuse)


def test_a_stale_epoch_stops_the_robot() -> None:
    world = World()
    world.services["cloud"].rule = lambda r: (
        [Refused(r.number, "stale_epoch", "epoch 1, seen was 2")] if nth(r) == 3 else None
    )
    world.start()
    world.run()
    assert world.stopped is not None
    assert isinstance(world.stopped.error, StaleEpochError)


@pytest.mark.parametrize("number", range(1, 8))
def test_a_reply_to_another_request_is_not_taken(number: int) -> None:
    world = World()
    cloud = world.services["cloud"]

    def confuse(request: Request) -> list[Reply] | None:
        if nth(request) != number:
            return None
        return [TaskAnswer(request.number + 1, 4, bytes(8 * 12), 1)]

    cloud.rule = confuse
    world.start()
    world.run()
    world.assert_same_as_without_faults()


def test_wrong_answers_are_refused() -> None:
    world = World()
    cloud = world.services["cloud"]

    def lie(request: Request) -> list[Reply] | None:
        lies: dict[int, Reply] = {
            2: TaskAnswer(request.number, 3, bytes(8 * 9), 1),
            4: TaskAnswer(request.number, 4, numbers_to([np.nan] * 12), 1),
            6: SensingAnswer(request.number, 8, 17, b"d" * DIGEST_SIZE, 1),
            8: SensingAnswer(request.number, 1, 0, b"d" * DIGEST_SIZE, 1),
        }
        return [lies[nth(request)]] if nth(request) in lies else None

    cloud.rule = lie
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.reports("malformed_reply")


def test_a_sensing_action_for_another_state_is_not_followed() -> None:
    world = World()
    cloud = world.services["cloud"]

    def drift(request: Request) -> list[Reply] | None:
        if nth(request) != 3:
            return None
        cloud.rule = lambda _: None
        replies = cloud.answer(encode(request))
        cloud.rule = drift
        return [
            reply
            if isinstance(reply, TaskAnswer)
            else SensingAnswer(request.number, request.step + 4, 2, b"x" * DIGEST_SIZE, 1)
            for reply in replies
        ]

    cloud.rule = drift
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert len(world.reports("prefetch_unused")) == 1


# -- the robot's own death ------------------------------------------------------------------------


def recorded() -> tuple[list[tuple[Record, ...]], World]:
    """Return what the journal held at each moment of a run without faults."""
    world = World(simulator=SimulatorSettings(num_trials=1, max_steps=14, seed=11))
    stages: list[tuple[Record, ...]] = [()]
    world.start()
    carry_out = world.carry_out

    def watching(effects: list[Effect]) -> None:
        for effect in effects:
            carry_out([effect])
            if isinstance(effect, Journal):
                stages.append(tuple(world.journal))

    world.carry_out = watching  # type: ignore[method-assign]
    world.run()
    return stages, world


@pytest.mark.parametrize("performed", [True, False])
def test_resumed_from_any_moment(performed: bool) -> None:
    stages, whole = recorded()
    for records in stages:
        world = World(simulator=SimulatorSettings(num_trials=1, max_steps=14, seed=11))
        history = replay(Planner(PROBLEM, PLANNING), 11, 0, records)
        world.journal = list(records)
        world.environment = SimulatedEnvironment(PROBLEM, 11, 0)
        for action in history.actions:
            world.environment.perform(action)
        pending = history.pending
        if pending is not None and performed:
            world.environment.perform(pending)
        world.carry_out(world.robot.start(0.0))
        world.bring_up("cloud")
        begun = Begun(world.environment.is_done(), world.environment.step)
        world.carry_out(world.robot.begin_trial(0, history, begun, 0.0, tail_is_certain=False))
        world.run()
        (result,) = world.results
        (expected,) = whole.results
        assert result.digest == expected.digest
        missing = 1 if pending is not None and performed else 0
        steps = [step for step, _ in world.acted]
        assert steps == list(range(14 - len(steps), 14))
        assert len(history.actions) + missing + len(steps) == 14


def test_what_earlier_processes_did_counts_in_the_result() -> None:
    """Each sensing decision with its time, and each time that another service took over."""

    def resumed(records: list[Record], lost_at: int | None, dies_at: int | None) -> World:
        world = World(simulator=SimulatorSettings(num_trials=1, max_steps=30, seed=11))
        cloud = world.services["cloud"]
        answer = cloud.answer

        def timed(payload: bytes) -> list[Reply]:
            return [
                msgspec.structs.replace(reply, computed_us=1000 * reply.step)
                if isinstance(reply, SensingAnswer)
                else reply
                for reply in answer(payload)
            ]

        cloud.answer = timed  # type: ignore[method-assign]
        world.services[LOCAL].answer = timed  # type: ignore[method-assign]

        def fault(step: int) -> None:
            if step == lost_at:
                world.kill("cloud")
                world.bring_up("cloud", 0.012)
            if step == dies_at:
                world.heap.clear()
                world.ended = True

        world.on_act = fault
        world.start(records=tuple(records))
        world.run()
        return world

    first = resumed([], 5, 12)
    second = resumed(first.journal, 16, 20)
    third = resumed(second.journal, None, None)
    (result,) = third.results
    assert result.recoveries == 2
    assert result.sensing_decisions == 8
    assert result.sensing_ms == pytest.approx([4.0 * number for number in range(8)])
    assert result.mean_sensing_ms == pytest.approx(14.0)
    assert result.digest == run_trial(PROBLEM, PLANNING, third.simulator, 0).digest


def test_a_recovery_alone_begins_no_trial_and_counts_in_the_next_one() -> None:
    world = World(simulator=SimulatorSettings(num_trials=1, max_steps=14, seed=11))
    written: list[Record] = []
    world.launchable = False
    world.start(present=False)
    world.run(until_s=3.0)
    assert world.statuses() == ["local_recovery"]
    written = world.journal.copy()
    assert written == []
    world.bring_up("cloud")
    world.run()
    assert world.results[0].recoveries == 1


def test_a_pause_is_the_last_that_is_written_down() -> None:
    """Although another service took over since the record before."""
    world = World(simulator=SimulatorSettings(num_trials=1, max_steps=14, seed=11))

    def fault(step: int) -> None:
        if step == 6:
            world.kill("cloud", 0.001)
            world.after(0.002, lambda: world.robot.pause(world.now))

    world.on_act = fault
    world.start()
    world.run()
    assert world.statuses() == ["local_recovery"]
    history = replay(Planner(PROBLEM, PLANNING), 11, 0, world.journal)
    assert history.paused
    assert history.recoveries == 1


def begin_after(
    records: tuple[Record, ...], steps_performed: int | None, *, tail_is_certain: bool = True
) -> World:
    world = World()
    history = replay(Planner(PROBLEM, PLANNING), 11, 0, records)
    world.journal = list(records)
    world.environment = SimulatedEnvironment(PROBLEM, 11, 0)
    for action in history.actions:
        world.environment.perform(action)
    world.carry_out(
        world.robot.begin_trial(
            0, history, Begun(False, steps_performed), 0.0, tail_is_certain=tail_is_certain
        )
    )
    return world


def test_an_unknown_performance_stops_unless_the_environment_can_tell() -> None:
    stages, _ = recorded()
    pending = next(s for s in stages if s and isinstance(s[-1], ActingRecord) and len(s) > 6)
    known = len([r for r in pending if isinstance(r, PerformedRecord)])
    stopped = begin_after(pending, None).stopped
    assert stopped is not None
    assert isinstance(stopped.error, UnknownPerformanceError)
    assert f"step {known}" in str(stopped.error)
    for count in (known - 1, known + 2):
        stopped = begin_after(pending, count).stopped
        assert stopped is not None
        assert isinstance(stopped.error, UnknownPerformanceError)
    for count in (known, known + 1):
        assert begin_after(pending, count).stopped is None


def test_a_tail_that_may_be_lost_stops_unless_the_environment_can_tell() -> None:
    stages, _ = recorded()
    settled = next(s for s in stages if s and isinstance(s[-1], ObservedRecord) and len(s) > 6)
    known = len([r for r in settled if isinstance(r, PerformedRecord)])
    assert begin_after(settled, None, tail_is_certain=True).stopped is None
    assert begin_after(settled, None, tail_is_certain=False).stopped is not None
    assert begin_after(settled, known, tail_is_certain=False).stopped is None
    assert begin_after(settled, known + 1, tail_is_certain=False).stopped is not None


@pytest.mark.parametrize(
    ("counts", "expected"), [(True, HeldError), (False, UnknownPerformanceError)]
)
def test_an_environment_that_fails_holds_the_robot(counts: bool, expected: type) -> None:
    # One that counts can say later whether the action was performed; else nobody ever can.
    world = World()
    world.start()

    def fail(step: int) -> None:
        if step == 5:
            world.heap.clear()
            failure = EnvironmentFailed(5, "perform", "the arm is stuck", True, counts=counts)
            world.after(0.1, lambda: world.robot.handle(failure, world.now))

    world.on_act = fail
    act = world.act

    def act_or_fail(effect: Act) -> None:
        act(effect)
        if effect.step == 5:
            # What the environment would have delivered never comes.
            world.heap = [item for item in world.heap if item[0] - world.now > 0.05]
            heapq.heapify(world.heap)

    world.act = act_or_fail  # type: ignore[method-assign]
    world.run()
    assert world.stopped is not None
    assert type(world.stopped.error) is expected
    assert str(world.stopped.error).endswith(": the arm is stuck")
    assert ("steps_performed" in str(world.stopped.error)) is not counts
    assert isinstance(world.journal[-1], ActingRecord)


@pytest.mark.parametrize("counts", [True, False])
def test_what_fails_after_an_action_was_performed_leaves_it_in_the_journal(counts: bool) -> None:
    world = World()
    world.start()
    act = world.act

    def act_and_fail(effect: Act) -> None:
        act(effect)
        if effect.step == 5:
            failure = EnvironmentFailed(5, "is_done", "returned None", False, True, -2.5)
            world.heap = []
            world.after(0.1, lambda: world.robot.handle(failure, world.now))

    world.act = act_and_fail  # type: ignore[method-assign]
    world.run()
    assert world.stopped is not None
    assert type(world.stopped.error) is HeldError
    assert "step 5, whose task action was performed: returned None" in str(world.stopped.error)
    assert world.journal[-1] == PerformedRecord(5, -2.5)
    # The effects come in this order: what is to be written down is, before the robot stops.
    resumed = begin_after(tuple(world.journal), None)
    assert resumed.stopped is None
    assert resumed.robot.step == 6


def test_pause_writes_everything_down_and_a_new_robot_goes_on() -> None:
    world = World(simulator=SimulatorSettings(num_trials=1, max_steps=14, seed=11))
    world.on_act = lambda step: (
        world.after(0.0001, lambda: world.robot.pause(world.now)) if step == 6 else None
    )
    world.start()
    world.run()
    assert world.ended
    assert not world.results
    history = replay(Planner(PROBLEM, PLANNING), 11, 0, world.journal)
    assert history.paused
    assert history.pending is None
    assert history.state.step == 7
    begun = begin_after(tuple(world.journal), None, tail_is_certain=False)
    assert begun.stopped is None


class TestFailedTask:
    """An environment says that the task has failed: the trial ends, and not with success."""

    def world(self) -> World:
        world = World(simulator=SimulatorSettings(num_trials=1, max_steps=14, seed=11))
        world.environment_class = FailingWorld
        return world

    def assert_failed(self, world: World) -> None:
        (result,) = world.results
        assert (result.outcome, result.success, result.failed) == ("failed", False, True)
        assert result.steps == FailingWorld.fails_at
        expected = run_trial(
            PROBLEM, PLANNING, world.simulator, 0, FailingWorld(PROBLEM, world.simulator.seed, 0)
        )
        assert (result.digest, result.outcome) == (expected.digest, expected.outcome)

    def test_ends_the_trial(self) -> None:
        world = self.world()
        world.start()
        world.run()
        self.assert_failed(world)

    def test_out_of_steps_is_no_failure(self) -> None:
        world = World(simulator=SimulatorSettings(num_trials=1, max_steps=14, seed=11))
        world.start()
        world.run()
        assert world.results[0].outcome == "truncated"

    def test_is_still_so_for_a_robot_that_was_killed_right_after(self) -> None:
        killed = self.world()
        killed.on_act = lambda step: setattr(killed, "ended", step == FailingWorld.fails_at - 1)
        killed.start()
        killed.run()
        assert not killed.results
        assert isinstance(killed.journal[-1], ActingRecord)
        resumed = self.world()
        resumed.carry_out(resumed.robot.start(0.0))
        history = replay(resumed.planner, 11, 0, killed.journal)
        begun = Begun(killed.environment.is_done(), killed.environment.step)
        resumed.carry_out(resumed.robot.begin_trial(0, history, begun, 0.0, tail_is_certain=True))
        self.assert_failed(resumed)

    @pytest.mark.parametrize("environment_class", [FailingWorld, SimulatedEnvironment])
    def test_is_kept_when_the_robot_is_asked_to_end_in_the_last_action(
        self, environment_class: type[SimulatedEnvironment]
    ) -> None:
        """Nobody may be there to say it again."""
        world = self.world()
        world.environment_class = environment_class
        last = (FailingWorld.fails_at if environment_class is FailingWorld else 14) - 1
        world.on_act = lambda step: (
            world.after(0.0001, lambda: world.robot.pause(world.now)) if step == last else None
        )
        world.start()
        world.run()
        (result,) = world.results
        assert result.outcome == ("failed" if environment_class is FailingWorld else "truncated")
        assert result.steps == last + 1


class TestUnexplainedObservations:
    def world(self, lies: set[int], num_sensing: int, records: tuple[Record, ...] = ()) -> World:
        class Lying(Misleading):
            pass

        Lying.lies = frozenset(lies)
        world = World(simulator=SimulatorSettings(num_trials=1, max_steps=4 * num_sensing, seed=11))
        world.environment_class = Lying
        world.start(records=records)
        world.run()
        return world

    def test_each_is_told(self) -> None:
        world = self.world({2, 4}, 6)
        recorder = Recorder(trial=0)
        alike = world.environment_class(PROBLEM, world.simulator.seed, 0)
        run_trial(PROBLEM, PLANNING, world.simulator, 0, alike, recorder)
        unexplained = [each for each in recorder.record.sensing if not each.explained]
        told = world.reports("unexplained")
        assert [(fields["step"], fields["sensing_action"]) for fields in told] == [
            (each.step, each.sensing_action) for each in unexplained
        ]
        assert {2 * 4, 4 * 4} <= {each.step for each in unexplained}
        assert len(unexplained) == world.results[0].unexplained_observations < 5
        for fields in told:
            assert fields["trial"] == 0
            assert isinstance(fields["deviations"], float)
            assert fields["deviations"] > 8.0
        assert not world.reports("filter_diverged")

    def test_none_is_told_where_all_are_explained(self) -> None:
        world = self.world(set(), 6)
        assert world.results[0].unexplained_observations == 0
        assert not world.reports("unexplained")

    def test_a_run_of_them_is_told_once_and_the_lines_are_bounded(self) -> None:
        world = self.world(set(range(1, 40)), 40)
        assert len(world.reports("unexplained")) == 10
        (diverged,) = world.reports("filter_diverged")
        assert diverged["step"] == 4 * 5
        assert world.results[0].unexplained_observations == 39
        assert "counted only" in str(world.reports("unexplained")[-1]["reason"])

    def test_a_robot_that_was_restarted_counts_on(self) -> None:
        first = World(simulator=SimulatorSettings(num_trials=1, max_steps=32, seed=11))

        class Lying(Misleading):
            lies = frozenset(range(20))

        first.environment_class = Lying
        first.on_act = lambda step: setattr(first, "ended", step == 10)
        first.start()
        first.run()
        assert len(first.reports("unexplained")) == 3
        assert not first.reports("filter_diverged")
        second = self.world(set(range(20)), 8, tuple(first.journal[:-1]))
        (diverged,) = second.reports("filter_diverged")
        assert diverged["step"] == 4 * 4
        assert len(second.reports("unexplained")) == 5
        assert second.results[0].unexplained_observations == 8


def test_rate_paces_the_steps_and_counts_missed_ticks() -> None:
    world = World(rate_hz=20.0, launch="never")

    def fault(performed: int) -> None:
        if performed == 8 and not world.results:
            world.kill("cloud")
            world.bring_up("cloud", 0.42)

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    times = [at for at, e in world.trace if isinstance(e, Act)][:20]
    gaps = np.diff(times)
    assert np.count_nonzero(np.abs(gaps - 0.05) < 1e-9) >= 17
    assert 3 <= world.robot.missed_ticks <= 6
    assert sum(int(str(f["missed"])) for f in world.reports("missed_ticks")) == (
        world.robot.missed_ticks
    )


def test_effects_before_sending_are_written() -> None:
    world = World()
    world.start()
    world.run()
    written = 0
    for _, effect in world.trace:
        if isinstance(effect, Journal):
            written += len([r for r in effect.records if isinstance(r, ObservedRecord)])
        if isinstance(effect, Send):
            request = decode_request(effect.payload)
            if request.sensed:
                assert written >= 1
    assert world.robot.status is Status.STANDARD


# -- found in review -------------------------------------------------------------------------------


def test_a_performance_is_written_down_before_the_robot_waits_for_anything() -> None:
    world = World(rate_hz=10.0)
    waits = 0

    def watch(step: int) -> None:
        def look() -> list[Effect]:
            nonlocal waits
            waits += 1
            last = world.journal[-1] if world.journal else None
            assert not isinstance(last, ActingRecord), "killed now, nobody would know"
            return []

        world.after(0.05, look)  # between the performance and the next tick

    world.on_act = watch
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert waits >= 75


def test_a_performance_is_written_down_before_the_robot_stops() -> None:
    world = World(launch="never")
    cloud = world.services["cloud"]
    cloud.rule = lambda r: [Refused(r.number, "version", "no")] if r.step >= 8 else None
    world.start()
    world.run()
    assert world.stopped is not None
    history = replay(Planner(PROBLEM, PLANNING), 11, 0, world.journal)
    assert history.pending is None


def test_an_observation_of_the_wrong_size_stops_the_robot_resumably() -> None:
    world = World(launch="never")
    later = world.later

    def spoil(event: Sensed | Acted) -> Callable[[], list[Effect]]:
        if isinstance(event, Sensed) and event.step >= 4:
            event = event._replace(observation=np.zeros(7))
        return later(event)

    world.later = spoil  # type: ignore[method-assign]
    world.start()
    world.run()
    assert world.stopped is not None
    history = replay(Planner(PROBLEM, PLANNING), 11, 0, world.journal)
    assert history.pending is None
    assert history.state.step == 4


def test_an_answer_for_another_step_than_was_asked_of_the_environment_stops_the_robot() -> None:
    world = World()
    later = world.later

    def spoil(event: Sensed | Acted) -> Callable[[], list[Effect]]:
        if isinstance(event, Acted) and event.step == 6:
            event = event._replace(step=5)
        return later(event)

    world.later = spoil  # type: ignore[method-assign]
    world.start()
    world.run()
    assert world.stopped is not None
    assert "step 5 where step 6" in str(world.stopped.error)


def test_a_service_that_begins_otherwise_is_sent_the_state_and_not_asked_for_ever() -> None:
    world = World(launch="never")
    cloud = world.services["cloud"]

    def begins_otherwise(request: Request) -> list[Reply] | None:
        if request.checkpoint is None:
            return [NeedState(request.number, False)]
        return None

    cloud.rule = begins_otherwise
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    turns = sum(result.sensing_decisions for result in world.results) + len(world.results)
    assert len(world.sent) <= 3 * turns


def test_a_service_that_always_needs_the_state_is_given_up() -> None:
    world = World()
    world.services["cloud"].rule = lambda r: [NeedState(r.number, True)]
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == ["local_recovery"]
    assert len([sent for sent in world.sent if sent.service == "cloud"]) < 20


def test_a_state_that_came_out_otherwise_is_told() -> None:
    world = World()
    told: list[Request] = []

    def rule(request: Request) -> list[Reply] | None:
        if request.checkpoint is None and request.step > 0 and not told:
            told.append(request)
            return [NeedState(request.number, True, diverged=True)]
        return None

    world.services["cloud"].rule = rule
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    (fields,) = world.reports("state_diverged")
    assert (fields["service"], fields["step"]) == ("cloud", told[0].step)


def test_the_machine_sleeps_while_nothing_can_be_done() -> None:
    # The local service is up before the cloud was ever seen; World.run asserts the rest.
    world = World(launch="at_start")
    world.launch_s = 0.1
    world.start(present=False)
    world.run()
    world.assert_same_as_without_faults()

    world = World(services=("busy", "dying"))
    told: list[int] = []

    def busy_once(request: Request) -> list[Reply] | None:
        if request.step >= 4 and not told:
            told.append(request.number)
            return [Busy(request.number, 200)]
        return None

    world.services["busy"].rule = busy_once
    world.services["dying"].rule = lambda _: []
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert told


def test_no_service_is_blamed_for_the_time_in_which_the_robot_was_deaf() -> None:
    world = World()
    carry_out = world.carry_out

    def slow_disk(effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, Journal) and isinstance(effect.records[-1], ObservedRecord):
                world.now += 0.3
                world.robot.was_deaf(0.3)
            carry_out([effect])

    world.carry_out = slow_disk  # type: ignore[method-assign]
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == []


def test_a_long_wait_is_told_although_the_service_shows_life() -> None:
    world = World()
    cloud = world.services["cloud"]
    cloud.latency_s = 0.1

    def slow(request: Request) -> list[Reply] | None:
        if nth(request) != 3:
            return None
        cloud.rule = lambda _: None
        signs: list[Reply] = [Progress(request.number, False) for _ in range(20)]
        replies = cloud.answer(encode(request))
        cloud.rule = slow
        return signs + replies

    cloud.rule = slow
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    (told,) = world.reports("waiting")
    assert told["service"] == "cloud"
    assert float(str(told["waited_ms"])) >= 1000.0


def test_events_say_how_long_things_took() -> None:
    world = World()

    def fault(performed: int) -> None:
        if performed == 5 and not world.results:
            world.kill("cloud")
            world.bring_up("cloud", 0.4)

    world.on_act = fault
    world.start()
    world.run()
    lost, answered = world.reports("status")
    assert "silent_ms" in lost
    assert "outage_ms" in answered
    assert all("restore_ms" in fields for fields in world.reports("restored"))
    assert world.reports("restored")
    assert all("launch_ms" in fields for fields in world.reports("launched"))


def test_a_robot_that_waits_for_a_silent_local_service_asks_the_cloud_again() -> None:
    """Found by the simulator: it waited for the local one alone, for many seconds."""
    world = World()

    def fault(performed: int) -> None:
        if performed == 4 and not world.results:
            world.services["cloud"].stopped = True
        if performed == 8 and not world.results:
            # The cloud answers again, but only what it is asked from now on.
            world.services[LOCAL].stopped = True
            world.services["cloud"].stopped = False

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    timeout_ms = world.offload.detection_timeout_ms
    assert world.longest_wait_ms() < 2 * timeout_ms + 300.0
