"""The service's machine: what it answers, in which order, and what it never does.

The reference is planning itself: a robot here folds its own state with the functions of
``holdfast.planning``, and every answer of the machine must be what these say of that state.
"""

import asyncio
import math
from collections import deque
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.questions import received, request_of

from holdfast.config import registry
from holdfast.config.source_digest import core_version, problem_digest
from holdfast.errors import (
    ConfigurationError,
    MessageError,
    OtherCodeError,
    ProblemError,
    UnknownProblemError,
)
from holdfast.planning.inputs import Sensed, decode_floats, encode_floats
from holdfast.planning.planner import (
    Planner,
    PlanningState,
    digest,
    encode_checkpoint,
    needs_sensing,
)
from holdfast.planning.settings import (
    ActiveSensingSettings,
    ParticleFilterSettings,
    PlanningSettings,
    SelectorSettings,
)
from holdfast.problems.capsule_robot import CapsuleRobot
from holdfast.problems.problem import Problem
from holdfast.protocol.effects import LogEvent
from holdfast.protocol.messages import (
    DIGEST_SIZE,
    MAX_TASK_ACTIONS,
    Busy,
    NeedState,
    Progress,
    Refused,
    Reply,
    Request,
    SensingAnswer,
    SessionConfiguration,
    TaskAnswer,
    decode_reply,
    encode,
)
from holdfast.protocol.service import Service
from holdfast.protocol.service_jobs import EndCall, Job, SendReply, ServiceEffect
from holdfast.protocol.service_limits import ServiceLimits
from holdfast.protocol.service_sessions import SHORT_S
from holdfast.robot.environment import SimulatedEnvironment

CODE = core_version(), problem_digest(object)
"""Digests of a problem that is one of holdfast's."""


def planning_of(interval: int = 3, particles: int = 20, **sensing: Any) -> PlanningSettings:
    sensing = {"num_observation_samples": 2, "num_nearest_neighbors": 3, **sensing}
    return PlanningSettings(
        particle_filter=ParticleFilterSettings(num_particles=particles),
        active_sensing=ActiveSensingSettings(**sensing),
        selector=SelectorSettings(method="action_entropy", estimator="nearest_neighbor"),
        sensing_interval=interval,
    )


def make_problem(session_configuration: SessionConfiguration) -> Problem:
    built: Problem = registry.problem_class(session_configuration.problem).from_settings(
        session_configuration.model, session_configuration.state_space_planner
    )
    return built


class Bench:
    """Carries effects out; jobs wait until they are run."""

    def __init__(
        self,
        make: Callable[[SessionConfiguration], Problem] = make_problem,
        workers: int = 1,
        **limits: Any,
    ) -> None:
        self.service = Service(make, workers, ServiceLimits(**limits))
        self.workers = workers
        self.now = 100.0
        self.jobs: deque[Job] = deque()
        self.replies: dict[int, list[Reply]] = {}
        self.ended: set[int] = set()
        self.notes: list[LogEvent] = []
        self.trace: list[tuple[str, int]] = []

    def apply(self, effects: list[ServiceEffect]) -> None:
        for effect in (*effects, *self.service.next_jobs(self.now)):
            if isinstance(effect, SendReply):
                assert effect.call not in self.ended
                reply = decode_reply(effect.payload)
                self.replies[effect.call].append(reply)
                self.trace.append((type(reply).__name__, effect.call))
            elif isinstance(effect, EndCall):
                assert effect.call not in self.ended
                self.ended.add(effect.call)
            elif isinstance(effect, Job):
                self.jobs.append(effect)
                self.trace.append((f"run {effect.kind}", -1))
            elif isinstance(effect, LogEvent):
                self.notes.append(effect)
        threads = [job for job in self.jobs if job.interruption.most_s > 5 * SHORT_S]
        assert len(threads) <= self.service.max_running

    def send(self, message: Request | bytes, owner: str | None = None) -> int:
        call = len(self.replies)
        self.replies[call] = []
        payload = message if isinstance(message, bytes) else encode(message)
        self.apply(self.service.receive(call, *received(payload), self.now, owner))
        return call

    def run(self, index: int = 0) -> None:
        """Run one of the jobs that were handed out."""
        job = self.jobs[index]
        del self.jobs[index]
        outcome = job.run()
        self.apply(self.service.finished(job, outcome, self.now))

    def run_all(self) -> None:
        while self.jobs:
            self.run()

    def ask(self, message: Request | bytes, owner: str | None = None) -> list[Reply]:
        call = self.send(message, owner)
        self.run_all()
        assert call in self.ended
        return self.replies[call]

    def assert_right(self, robot: "Robot", request: Request) -> None:
        assert content(self.ask(request)) == robot.right_answer()

    def assert_refused(self, request: Request, code: str, *words: str) -> None:
        reply = refused(self.ask(request))
        assert reply.code == code
        assert all(each in reply.text for each in words), reply.text

    def known(self, *keys: int, owner: str | None = None) -> "list[Robot]":
        """Return robots that were served, and have sensed since."""
        robots = [Robot(key=key) for key in keys]
        for robot in robots:
            self.ask(robot.request(), owner)
            robot.sense()
        self.trace.clear()
        return robots

    def kinds(self, call: int) -> list[str]:
        return [type(reply).__name__ for reply in self.replies[call]]


class Robot:
    """Keeps the true state, makes requests, and knows the right answers."""

    def __init__(
        self,
        problem: str = "capsule_robot",
        planning: PlanningSettings | None = None,
        key: int = 1,
        seed: int = 5,
    ) -> None:
        planning = planning or planning_of()
        self.session_configuration = SessionConfiguration(problem, {}, {}, planning, seed, *CODE)
        self.problem = make_problem(self.session_configuration)
        self.session = key.to_bytes(16, "big")
        self.epoch = 1
        self.number = 0
        self.begin(0)

    def begin(self, trial: int) -> None:
        self.state = Planner(self.problem, self.planning).init(
            self.session_configuration.seed, trial
        )
        self.environment = SimulatedEnvironment(
            self.problem, self.session_configuration.seed, trial
        )
        self.observed: list[Sensed] = []

    @property
    def planning(self) -> PlanningSettings:
        return self.session_configuration.planning

    def request(
        self, *, session_configuration: bool = True, since: int = 0, **changes: Any
    ) -> Request:
        """Return the question of now; ``since`` counts the observations that are known already."""
        self.number += 1
        request = request_of(
            self.state,
            self.session,
            self.number,
            epoch=self.epoch,
            inputs=tuple(self.observed[since:]),
            session_configuration=self.session_configuration if session_configuration else None,
        )
        return msgspec.structs.replace(request, **changes)

    def restore(self, **changes: Any) -> Request:
        changes = {"checkpoint": encode_checkpoint(self.state), **changes}
        return self.request(inputs=(), **changes)

    def sense(self) -> None:
        planner = Planner(self.problem, self.planning)
        index, _ = planner.choose_sensing_action(self.state)
        observation = self.environment.perform_sensing(index)
        self.observed.append(Sensed(self.state.step, index, encode_floats(observation)))
        self.state, _ = planner.observe(self.state, index, observation)

    def act(self) -> None:
        planner = Planner(self.problem, self.planning)
        action, _ = planner.choose_task_action(self.state)
        self.environment.perform(action)
        self.state = planner.advance(self.state, action)

    def act_until_sensing(self) -> None:
        while not needs_sensing(self.planning, self.state):
            self.act()

    def right_answer(self) -> list[tuple[Any, ...]]:
        """Return what a service has to say, but for the number and the time."""
        state: PlanningState = self.state
        actions: list[Any] = []
        planner = Planner(self.problem, self.planning)
        while len(actions) < MAX_TASK_ACTIONS and not planner.needs_sensing(state):
            action, _ = planner.choose_task_action(state)
            actions.append(action)
            state = planner.advance(state, action)
        answer: list[tuple[Any, ...]] = []
        if actions:
            answer.append(("task", len(actions), b"".join(map(encode_floats, actions))))
        if planner.needs_sensing(state):
            index, _ = planner.choose_sensing_action(state)
            answer.append(("sensing", state.step, index, digest(state)[:DIGEST_SIZE]))
        return answer


def content(replies: list[Reply]) -> list[tuple[Any, ...]]:
    found: list[tuple[Any, ...]] = []
    for reply in replies:
        if isinstance(reply, TaskAnswer):
            found.append(("task", reply.count, reply.actions))
        elif isinstance(reply, SensingAnswer):
            found.append(("sensing", reply.step, reply.sensing_action, reply.digest))
        elif not isinstance(reply, Progress):
            found.append((reply,))
    return found


def only(replies: list[Reply]) -> Reply:
    assert len(replies) == 1, replies
    return replies[0]


def refused(replies: list[Reply]) -> Refused:
    reply = only(replies)
    assert isinstance(reply, Refused), reply
    return reply


class TestAnswers:
    def test_time_of_an_answer_is_that_of_its_job(self) -> None:
        bench, robot = Bench(), Robot()
        call = bench.send(robot.request())
        bench.now += 0.25
        bench.run_all()
        reply = only(bench.replies[call])
        assert isinstance(reply, SensingAnswer)
        assert reply.computed_us == 250_000


class TestRollingForward:
    def test_missing_observation(self) -> None:
        bench, robot = Bench(), Robot()
        for _ in range(3):
            robot.sense()
            robot.act_until_sensing()
        request = robot.request(since=1)
        assert bench.ask(request) == [NeedState(request.number, differs=False)]
        bench.assert_right(robot, robot.restore(session_configuration=False))

    def test_robot_that_is_behind(self) -> None:
        bench, robot = Bench(), Robot()
        robot.sense()
        behind = robot.state, list(robot.observed)
        for _ in range(2):
            robot.act_until_sensing()
            robot.sense()
        bench.ask(robot.request())
        robot.state, robot.observed = behind
        request = robot.request(session_configuration=False, since=1)
        assert bench.ask(request) == [NeedState(request.number, differs=True)]
        bench.assert_right(robot, robot.restore())
        assert bench.service.statistics.states_diverged == 0, "it only is where it was before"

    def test_other_digest(self) -> None:
        bench, robot = Bench(), Robot()
        robot.sense()
        bench.ask(robot.request())
        robot.act_until_sensing()
        robot.sense()
        last = robot.observed[-1]
        other = decode_floats(last.observation, len(last.observation) // 8) + 0.5
        changed = msgspec.structs.replace(last, observation=encode_floats(other))
        request = robot.request(session_configuration=False, inputs=(changed,))
        assert bench.ask(request) == [NeedState(request.number, True, diverged=True)]
        assert bench.service.statistics.states_diverged == 1
        told = [note.fields for note in bench.notes if note.name == "state_diverged"]
        assert [(each["trial"], each["step"]) for each in told] == [(0, robot.state.step)]
        # The state from before is still there.
        bench.assert_right(robot, robot.request(session_configuration=False, since=1))

    def test_far_ahead_of_what_is_bearable(self) -> None:
        bench, robot = Bench(max_steps=100), Robot(planning=planning_of(10**6))
        robot.sense()
        bench.ask(robot.request())
        request = robot.request(
            session_configuration=False, since=1, step=4_000_000_000, sensed=False, digest=bytes(16)
        )
        assert bench.ask(request) == [NeedState(request.number, differs=True)]

    @pytest.mark.parametrize(
        ("changes", "name"),
        [
            ({"step": 5}, "step"),
            ({"trial": 1}, "trial"),
            ({"sensed": False, "step": 1}, "step"),
            ({"digest": bytes(16)}, ""),
            ({"checkpoint": b"rubbish"}, ""),
            (
                {"checkpoint": encode_checkpoint(Robot(planning=planning_of(particles=30)).state)},
                "30 particles",
            ),
        ],
        ids=["step", "trial", "sensed", "digest", "rubbish", "size"],
    )
    def test_checkpoint_of_another_state(self, changes: dict[str, Any], name: str) -> None:
        bench, robot = Bench(), Robot()
        robot.sense()
        bench.assert_refused(robot.restore(**changes), "invalid", name)


class TestOnce:
    def computed(self, bench: Bench) -> tuple[int, int]:
        statistics = bench.service.statistics
        return statistics.task_parts, statistics.sensing_parts

    def test_calls_that_wait_for_one_answer_are_bounded(self) -> None:
        bench, robot = Bench(max_calls_per_request=3), Robot()
        robot.sense()
        request = robot.request()
        calls = [bench.send(request) for _ in range(5)]
        assert bench.ended == set(calls[:2])
        bench.run_all()
        for call in calls[2:]:
            assert content(bench.replies[call]) == robot.right_answer()

    def test_digest_of_a_known_state_with_another_step(self) -> None:
        bench, robot = Bench(), Robot()
        robot.sense()
        bench.ask(robot.request())
        bench.assert_refused(robot.request(step=1, sensed=False), "invalid")

    def test_prefetch_that_was_dropped_is_taken_up_again(self) -> None:
        bench = Bench()
        robot, other = bench.known(1, 2)
        call = bench.send(robot.request())
        bench.send(other.request())
        bench.run()
        # The robot's next process asks the same: what the one before waited for is dropped.
        robot.epoch += 1
        again = bench.send(robot.request())
        assert call in bench.ended
        assert bench.kinds(again) == ["TaskAnswer"]
        bench.run_all()
        assert content(bench.replies[again]) == robot.right_answer()
        assert self.computed(bench) == (2, 4)
        assert bench.service.statistics.superseded == 1


class TestOrder:
    def test_newer_request_supersedes(self) -> None:
        bench, robot, other = Bench(), Robot(), Robot(key=2)
        bench.send(other.request())
        robot.sense()
        older = bench.send(robot.request())
        robot.act()
        newer = bench.send(robot.request())
        assert older in bench.ended
        assert bench.replies[older] == []
        bench.run_all()
        assert content(bench.replies[newer]) == robot.right_answer()
        assert bench.service.statistics.task_parts == 1

    def test_request_that_comes_late_is_ended(self) -> None:
        bench, robot = Bench(), Robot()
        robot.sense()
        early = robot.request()
        robot.act()
        bench.ask(robot.request())
        call = bench.send(early)
        assert bench.replies[call] == []
        assert call in bench.ended
        assert not bench.jobs


class TestEpochs:
    def test_other_settings_under_the_same_epoch(self) -> None:
        bench, robot = Bench(), Robot()
        bench.ask(robot.request())
        robot.session_configuration = msgspec.structs.replace(robot.session_configuration, seed=99)
        bench.assert_refused(robot.request(), "invalid")

    def test_other_settings_under_a_higher_epoch(self) -> None:
        bench, robot = Bench(), Robot()
        bench.ask(robot.request())
        robot.session_configuration = msgspec.structs.replace(robot.session_configuration, seed=99)
        robot.epoch = 2
        robot.begin(0)
        bench.assert_right(robot, robot.request())


class BrokenProblem(CapsuleRobot):
    """Fails in its own way where it is told to."""

    name = "broken"

    def __init__(self, where: str, error: BaseException) -> None:
        super().__init__()
        self._where = where
        self._error = error

    def policy(self, states: Any, stage: Any) -> Any:
        if self._where == "policy":
            raise self._error
        return super().policy(states, stage)

    def observation_mean(self, states: Any, sensing_action: int) -> Any:
        if self._where == "observation_mean":
            raise self._error
        return super().observation_mean(states, sensing_action)


class Panic(BaseException):
    """As an extension in Rust raises it."""


class UnspeakableError(Exception):
    def __str__(self) -> str:
        raise KeyboardInterrupt


class OurUnspeakableError(ProblemError):
    def __str__(self) -> str:
        raise ValueError("no words")


class TestRefusals:
    @pytest.mark.parametrize(
        ("error", "code", "text"),
        [
            (ValueError("out of order"), "failed", "ValueError: out of order"),
            (ProblemError("policy is odd"), "failed", "policy is odd"),
            (SystemExit(3), "failed", "SystemExit: 3"),
            (KeyboardInterrupt(), "failed", "KeyboardInterrupt"),
            (asyncio.CancelledError(), "failed", "CancelledError"),
            (GeneratorExit(), "failed", "GeneratorExit"),
            (Panic("in Rust"), "failed", "Panic: in Rust"),
            (UnspeakableError(), "failed", "UnspeakableError, which cannot be put into words"),
            (
                OurUnspeakableError(),
                "failed",
                "OurUnspeakableError, which cannot be put into words",
            ),
            (RuntimeError("\ud800 half a pair"), "failed", "RuntimeError: ? half a pair"),
            (ValueError("x" * 10_000), "failed", "ValueError: xxx"),
            (
                MemoryError("Unable to allocate 7 GiB"),
                "out_of_memory",
                "out of memory for a decision of selector.method action_entropy, "
                "particle_filter.num_particles 20, active_sensing.num_observation_samples 2, "
                "2 sensing actions, active_sensing.num_nearest_neighbors 3, "
                "active_sensing.horizon 1, sensing_interval 3: MemoryError: Unable to allocate "
                "7 GiB",
            ),
        ],
    )
    @pytest.mark.parametrize("where", ["policy", "observation_mean"])
    def test_failing_problem(self, error: BaseException, code: str, text: str, where: str) -> None:
        def make(session_configuration: SessionConfiguration) -> Problem:
            if session_configuration.problem == "broken":
                return BrokenProblem(where, error)
            return make_problem(session_configuration)

        bench, broken, sound = Bench(make), Robot(key=1), Robot(key=2)
        broken.session_configuration = msgspec.structs.replace(
            broken.session_configuration, problem="broken"
        )
        call = bench.send(sound.request())
        reply = refused(bench.ask(broken.request()))
        assert reply.code == code
        assert reply.text.startswith(text)
        bench.run_all()
        assert content(bench.replies[call]) == sound.right_answer()
        sound.sense()
        bench.assert_right(sound, sound.request(session_configuration=False))
        # It is not computed from what is left of the failed attempt.
        bench.assert_refused(broken.request(), code)

    def test_sensing_part_that_fails_leaves_the_task_part(self) -> None:
        problem = CapsuleRobot()
        bench, robot = Bench(lambda _: problem), Robot()
        robot.sense()
        call = bench.send(robot.request())
        bench.run()
        problem.observation_mean = None  # type: ignore[assignment, method-assign]
        bench.run()
        assert bench.kinds(call) == ["TaskAnswer", "Refused"]
        assert call in bench.ended

    def test_unknown_problem(self) -> None:
        def make(session_configuration: SessionConfiguration) -> Problem:
            raise UnknownProblemError(
                f"problem {session_configuration.problem}: known are this and that"
            )

        bench = Bench(make)
        bench.assert_refused(Robot().request(), "unknown_problem", "this and that")
        statistics = bench.service.statistics
        assert statistics.refusals == {"unknown_problem": 1}
        counted = statistics.sessions, statistics.sessions_opened, statistics.sessions_evicted
        assert counted == (0, 0, 0)

    def test_a_problem_is_not_lent_to_a_robot_with_other_code(self) -> None:
        def make(asked: SessionConfiguration) -> Problem:
            if (asked.core_version, asked.problem_digest) != ("1", "2"):
                raise OtherCodeError("deploy the same version")
            return make_problem(asked)

        bench = Bench(make)
        session_configuration = msgspec.structs.replace(
            Robot().session_configuration, core_version="1", problem_digest="2"
        )
        robot = Robot(key=1)
        robot.session_configuration = session_configuration
        bench.assert_right(robot, robot.request())
        for key, changes in ((2, {"core_version": "0"}), (3, {"problem_digest": "0"})):
            other = Robot(key=key)
            other.session_configuration = msgspec.structs.replace(session_configuration, **changes)
            bench.assert_refused(other.request(), "other_code")

    def test_model_that_does_not_fit(self) -> None:
        def make(session_configuration: SessionConfiguration) -> Problem:
            raise ConfigurationError("model.robot_radius is -1")

        Bench(make).assert_refused(Robot().request(), "invalid")

    def test_too_many_particles(self) -> None:
        bench, robot = Bench(max_particles=10), Robot()
        words = "particle_filter.num_particles 20", "10 (max_particles)"
        bench.assert_refused(robot.request(), "invalid", *words)
        assert bench.service.statistics.sessions == 0

    def test_too_much_work(self) -> None:
        bench, robot = Bench(max_decision_s=0.002), Robot()
        bench.ask(robot.request())  # leaves the problem, ready built
        words = "num_observation_samples 1000", "at most 0.002 s (--max-decision-s)"
        for key, problem in ((2, "capsule_robot"), (3, "peg_in_hole_2d")):
            greedy = Robot(problem, planning_of(num_observation_samples=1000), key=key)
            bench.assert_refused(greedy.request(), "invalid", *words)

    def test_settings_that_do_not_fit_the_problem(self) -> None:
        robot = Robot(planning=planning_of(num_nearest_neighbors=3))
        robot.session_configuration = msgspec.structs.replace(
            robot.session_configuration, planning=planning_of(num_nearest_neighbors=20)
        )
        Bench().assert_refused(robot.request(), "invalid", "num_nearest_neighbors is 20")

    @pytest.mark.parametrize(
        ("observed", "code"),
        [
            (Sensed(0, 0, encode_floats(np.zeros(7))), "invalid"),
            (Sensed(0, 10**6, encode_floats(np.zeros(1))), "invalid"),
            (Sensed(0, 0, b"123"), "malformed"),
            (Sensed(0, 0, encode_floats([np.nan])), "malformed"),
        ],
    )
    def test_observation_that_is_none(self, observed: Sensed, code: str) -> None:
        bench, robot = Bench(), Robot()
        robot.sense()
        bench.assert_refused(robot.request(inputs=(observed,)), code)

    def test_other_version(self) -> None:
        Bench().assert_refused(Robot().request(version=99), "version")


class TestCapacity:
    def test_beyond_the_longest_line(self) -> None:
        bench = Bench(max_waiting=4)  # half of it is for those who were served before
        calls = [bench.send(Robot(key=key).request()) for key in range(1, 6)]
        assert [len(bench.replies[call]) for call in calls] == [0, 0, 0, 1, 1]
        reply = only(bench.replies[calls[-1]])
        assert isinstance(reply, Busy)
        assert reply.retry_after_ms >= 1
        assert bench.service.statistics.busy == 2
        assert bench.service.statistics.sessions == 3
        bench.run_all()
        assert bench.ended == set(calls)

    def test_newcomers_turn_nobody_away_who_was_served_before(self) -> None:
        """To be somebody new costs nothing: one client can be thousands of them."""
        bench = Bench(max_wait_ms=10.0)
        known = Robot(key=1)
        bench.ask(known.request())
        known.sense()
        newcomers = [Robot(key=key) for key in range(2, 60)]
        calls = [bench.send(robot.request()) for robot in newcomers]
        assert any(bench.replies[call] for call in calls)
        right = known.right_answer()
        call = bench.send(known.request())
        assert bench.replies[call] == []
        # It does not wait for those who came before it either.
        bench.run()
        bench.run()
        assert content(bench.replies[call]) == right[:1]
        bench.run_all()
        assert content(bench.replies[call]) == right

    def test_newcomers_have_their_turn(self) -> None:
        bench = Bench(max_wait_ms=100.0)
        known = [Robot(key=key) for key in range(1, 6)]
        for robot in known:
            bench.ask(robot.request())
            robot.sense()
        calls = [bench.send(robot.request()) for robot in known]
        newcomer = bench.send(Robot(key=9).request())
        bench.now += 0.11
        late = bench.send(known[0].request(digest=bytes(16)))
        while newcomer not in bench.ended:
            assert late not in bench.ended
            bench.run()
        bench.run_all()
        assert set(calls) <= bench.ended

    def test_nor_for_states_from_outside(self) -> None:
        """A checkpoint may hold anything; its request begins with those of newcomers."""
        bench = Bench()
        robot, other = bench.known(1, 2)
        bench.send(robot.restore())
        call = bench.send(other.request())
        assert len(bench.jobs) == 2
        bench.run_all()
        assert content(bench.replies[call]) == other.right_answer()

    def test_one_job_that_was_held_up_turns_nobody_away(self) -> None:
        bench = Bench(max_wait_ms=100.0)
        first = Robot(key=1)
        bench.ask(first.request())
        first.sense()
        bench.send(first.request())
        bench.now += 60.0  # the process was stopped
        bench.run_all()
        calls = [bench.send(Robot(key=key).request()) for key in range(2, 8)]
        assert all(not bench.replies[call] for call in calls)

    def test_one_more_robot_than_workers_is_never_too_many(self) -> None:
        bench = Bench(max_wait_ms=1.0, max_waiting=1)
        bench.send(Robot(key=1).request())
        bench.now += 30.0
        bench.run()
        bench.send(Robot(key=4).request())
        second = bench.send(Robot(key=2).request())
        assert bench.replies[second] == []
        third = bench.send(Robot(key=3).request())
        assert isinstance(only(bench.replies[third]), Busy)

    def test_oldest_session_is_forgotten(self) -> None:
        bench = Bench(max_sessions=2)
        robots = [Robot(key=key) for key in (1, 2, 3)]
        for robot in (robots[0], robots[1], robots[0], robots[2]):
            bench.ask(robot.request())
        statistics = bench.service.statistics
        assert (statistics.sessions_opened, statistics.sessions_evicted) == (3, 1)
        request = robots[1].request(session_configuration=False)
        assert bench.ask(request) == [NeedState(request.number, differs=False)]
        bench.assert_right(robots[0], robots[0].request(session_configuration=False))

    def test_no_room_is_not_asked_for_again_at_once(self) -> None:
        bench = Bench(max_sessions=2, max_waiting=1000, max_wait_ms=1e6)
        for key in (1, 2):
            bench.send(Robot(key=key).request())
        delays = []
        for key in range(3, 103):
            reply = only(bench.replies[bench.send(Robot(key=key).request())])
            assert isinstance(reply, Busy)
            delays.append(reply.retry_after_ms)
        assert 100 <= min(delays) < 110
        assert 115 < max(delays) <= 126
        # Each robot has its own delay, and it is the same in every run.
        again = only(bench.replies[bench.send(Robot(key=3).request())])
        assert isinstance(again, Busy)
        assert again.retry_after_ms == delays[0]
        assert len(set(delays)) > 15

    def test_request_that_was_decoded_before(self) -> None:
        bench, robot = Bench(), Robot()
        robot.sense()
        request = robot.request()
        bench.replies[0] = []
        bench.apply(bench.service.receive(0, request, len(encode(request)), bench.now))
        bench.run_all()
        assert content(bench.replies[0]) == robot.right_answer()
        bench.replies[1] = []
        error = MessageError("malformed", "no request")
        bench.apply(bench.service.receive(1, error, 9, bench.now))
        assert refused(bench.replies[1]) == Refused(0, "malformed", "no request")

    def test_bytes_of_states(self) -> None:
        robots = [Robot(key=key) for key in range(1, 6)]
        size = robots[0].state.belief.states.nbytes + robots[0].state.belief.weights.nbytes
        bench = Bench(max_state_bytes=5 * size)
        for robot in robots:
            robot.sense()
            bench.ask(robot.request())
            assert bench.service.statistics.state_bytes <= 5 * size
        assert bench.service.statistics.sessions == 2
        bench.assert_right(robots[-1], robots[-1].request(session_configuration=False))

    def test_requests_that_wait_hold_no_opening(self) -> None:
        bench = Bench()
        first = Robot(key=2)
        bench.send(first.request())
        robot = Robot()
        robot.sense()
        bench.send(robot.request())
        waiting = bench.service._sessions.get((None, robot.session))
        assert waiting is not None
        assert [
            work.request and work.request.session_configuration for work in waiting.pending.values()
        ] == [None]
        bench.run_all()

    def test_equal_problems_are_shared(self) -> None:
        built = []

        def make(session_configuration: SessionConfiguration) -> Problem:
            built.append(session_configuration.problem)
            return make_problem(session_configuration)

        bench = Bench(make)
        for key in range(1, 5):
            bench.ask(Robot(key=key, seed=key).request())
        bench.ask(Robot("peg_in_hole_2d", key=9).request())
        assert built == ["capsule_robot", "peg_in_hole_2d"]


class TestProgress:
    def test_signs_while_waiting_and_in_work(self) -> None:
        bench, robot, other = Bench(progress_interval_ms=50.0), Robot(), Robot(key=2)
        assert bench.service.next_wakeup() is None
        running = bench.send(robot.request())
        waiting = bench.send(other.request())
        start = bench.now
        for turn in range(1, 4):
            due = bench.service.next_wakeup()
            assert due is not None
            assert due == pytest.approx(start + 0.05 * turn)
            bench.apply(bench.service.tick(due - 0.001))
            assert len(bench.replies[running]) == turn - 1
            bench.now = due
            bench.apply(bench.service.tick(due))
        assert bench.replies[running] == [Progress(robot.number, waiting=False)] * 3
        assert bench.replies[waiting] == [Progress(other.number, waiting=True)] * 3

    @pytest.mark.parametrize(("count", "interval_s"), [(64, 0.05), (96, 0.075), (300, 0.1)])
    def test_where_many_wait_each_is_told_less_often(self, count: int, interval_s: float) -> None:
        bench = Bench(progress_interval_ms=50.0, max_wait_ms=1e6)
        request = Robot().request()
        for key in range(count):
            session = (key + 1).to_bytes(16, "big")
            bench.send(msgspec.structs.replace(request, session=session))
        assert bench.service.next_wakeup() == pytest.approx(bench.now + interval_s)
        for turn in range(1, 4):
            bench.now += interval_s
            bench.apply(bench.service.tick(bench.now))
            assert {len(replies) for replies in bench.replies.values()} == {turn}


def test_with_no_worker_there_is_no_service() -> None:
    with pytest.raises(ValueError, match="workers 0"):
        Service(make_problem, 0)


def runs_of(service: Service, call: int, request: Request, now: float) -> list[float]:
    """Have a request answered; return how long each of its jobs was expected to take."""
    expected = []
    service.receive(call, request, len(encode(request)), now)
    while jobs := [each for each in service.next_jobs(now) if isinstance(each, Job)]:
        (job,) = jobs
        expected.append(job.expected_s)
        service.started(job, now)
        now += 0.001
        service.finished(job, job.run(), now)
    return expected


def test_only_what_was_measured_of_a_robot_is_expected_to_be_brief() -> None:
    service = Service(make_problem, 1)
    light = Robot(key=1)
    found = []
    for call in range(1, 5):
        found.append(
            runs_of(service, call, light.request(since=max(0, len(light.observed) - 1)), call)
        )
        light.act_until_sensing()
        light.sense()
    assert found[0] == [math.inf]  # the problem is to be built
    assert found[1][0] == math.inf  # the first task part of this robot
    assert all(expected_s == pytest.approx(0.001) for expected_s in found[3])
    # Another robot with the same problem may have other settings: nothing is known of it.
    heavy = Robot(key=2, planning=planning_of(particles=500))
    assert runs_of(service, 10, heavy.request(), 20.0) == [math.inf]
    # Neither of a request that takes more than one observation to answer, or a whole state.
    for _ in range(2):
        light.act_until_sensing()
        light.sense()
    assert runs_of(service, 11, light.request(since=len(light.observed) - 3), 21.0)[0] == math.inf


def test_the_first_question_of_a_trial_is_as_brief_as_those_before() -> None:
    service, robot = Service(make_problem, 1), Robot()
    expected = []
    for trial in range(3):
        robot.begin(trial)
        expected += runs_of(service, trial, robot.request(), trial)
    # The first one also builds the problem.
    assert expected == [math.inf, math.inf, pytest.approx(0.001)]
