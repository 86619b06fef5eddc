"""The robot's own planner: parts of answers on the loop or a thread, and whole ones in order."""

import asyncio
import itertools
import threading
from pathlib import Path

import pytest
from tests.recordings import robot_configuration

from holdfast.config.loader import Configuration
from holdfast.planning.planner import Decision, Planner, PlanningState
from holdfast.planning.settings import ParticleFilterSettings, PlanningSettings
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.protocol.question import OWN_PLANNER, InProcessSource, Question
from holdfast.protocol.robot_events import ComputeOwnAnswer, OwnAnswer
from holdfast.robot import own_planner
from holdfast.robot.own_planner import OwnPlanner

PATIENCE_S = 30.0
"""Longest wait for an event that certainly comes; it measures nothing."""


@pytest.fixture
def configuration(tmp_path: Path) -> Configuration:
    return robot_configuration(tmp_path, num_trials=1)


def question(configuration: Configuration) -> tuple[Planner, Question]:
    planner = Planner(configuration.problem, configuration.planning)
    state = planner.init(3, 0)
    return planner, Question(planner, state, planner.digest(state), (), 0)


def test_the_source_asks_for_the_second_part_when_the_first_has_come(
    configuration: Configuration,
) -> None:
    planner, asked = question(configuration)
    source = InProcessSource()
    source.ask(asked, 1.0)
    (first,) = source.effects.take()
    assert isinstance(first, ComputeOwnAnswer)
    done = own_planner._answer(planner, first)
    source.handle(done._replace(number=first.number - 1), 1.1)
    assert source.effects.take() == []
    source.handle(done, 1.5)
    given = asked.sensing_provenance if first.part == "sensing" else asked.task_provenance
    assert given is not None
    assert (given.service, given.round_trip_s) == (OWN_PLANNER, 0.5)
    source.drop()
    source.handle(done, 2.0)
    assert source.effects.take() == []


def _fail(error: BaseException) -> None:
    raise error


@pytest.mark.parametrize("may_be_brief", [True, False])
def test_code_of_other_people_is_always_computed_on_a_thread(
    configuration: Configuration, *, may_be_brief: bool
) -> None:
    """It may take any time at any call. What is ours counts with its processor time."""
    planner = Planner(configuration.problem, configuration.planning)
    state = planner.init(3, 0)

    async def ask() -> list[bool]:
        come: asyncio.Queue[OwnAnswer] = asyncio.Queue()
        own = OwnPlanner(lambda: planner, repr, come.put_nowait, _fail, may_be_brief=may_be_brief)
        on_loop = []
        for number in range(3):
            own.ask(ComputeOwnAnswer(number, state, part="sensing"))
            on_loop.append(own.compute_brief())
            assert (await asyncio.wait_for(come.get(), PATIENCE_S)).number == number
        own.close()
        return on_loop

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(own_planner, "_BRIEF_S", PATIENCE_S)
        patch.setattr(own_planner, "perf_counter", itertools.count(0.0, 2 * PATIENCE_S).__next__)
        assert asyncio.run(ask()) == [False, may_be_brief, may_be_brief]


def test_what_was_asked_before_and_not_begun_is_not_computed(
    configuration: Configuration, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(own_planner, "_BRIEF_S", PATIENCE_S)
    planner = Planner(configuration.problem, configuration.planning)
    state = planner.init(3, 0)
    come: list[int] = []
    own = OwnPlanner(
        lambda: planner, repr, lambda planned: come.append(planned.number), _fail, may_be_brief=True
    )
    own._usual["sensing"].learn(0.0)
    own.ask(ComputeOwnAnswer(1, state, part="sensing"))
    own.ask(ComputeOwnAnswer(2, state, part="sensing"))
    assert own.compute_brief()
    assert not own.compute_brief()
    assert come == [2]


SETTINGS = PlanningSettings(particle_filter=ParticleFilterSettings(num_particles=20))


class GatedPlanner(Planner):
    """Waits before each decision, and may fail in it."""

    def __init__(self) -> None:
        super().__init__(PegInHole2D(), SETTINGS)
        self.begun = threading.Semaphore(0)
        self.may = threading.Semaphore(0)
        self.fails = False

    def decide(self, state: PlanningState, max_actions: int) -> Decision:
        self.begun.release()
        assert self.may.acquire(timeout=PATIENCE_S)
        if self.fails:
            raise ZeroDivisionError("a defect")
        return super().decide(state, max_actions)


def whole(number: int, state: PlanningState, *, again: bool = False) -> ComputeOwnAnswer:
    return ComputeOwnAnswer(number, state, again)


def checker() -> tuple[OwnPlanner, GatedPlanner, asyncio.Queue[OwnAnswer | BaseException]]:
    planner = GatedPlanner()
    come: asyncio.Queue[OwnAnswer | BaseException] = asyncio.Queue()
    return (
        OwnPlanner(lambda: planner, repr, come.put_nowait, come.put_nowait, may_be_brief=False),
        planner,
        come,
    )


async def next_of(come: asyncio.Queue[OwnAnswer | BaseException]) -> OwnAnswer:
    answer = await asyncio.wait_for(come.get(), PATIENCE_S)
    assert isinstance(answer, OwnAnswer)
    return answer


async def test_what_is_asked_again_comes_first() -> None:
    checks, planner, answers = checker()
    state = planner.init(3, 0)
    checks.ask(whole(0, state))
    assert planner.begun.acquire(timeout=PATIENCE_S)
    for number in (1, 2):
        checks.ask(whole(number, state))
    checks.ask(whole(3, state, again=True))
    for _ in range(4):
        planner.may.release()
    assert [(await next_of(answers)).number for _ in range(4)] == [0, 3, 1, 2]
    checks.close(PATIENCE_S)
    assert answers.empty()


async def test_an_error_is_an_answer() -> None:
    checks, planner, answers = checker()
    planner.fails = True
    planner.may.release()
    checks.ask(whole(5, planner.init(3, 0)))
    answer = await next_of(answers)
    assert (answer.number, str(answer.failure)) == (5, "ZeroDivisionError('a defect')")
    checks.close(PATIENCE_S)


async def test_nothing_is_answered_after_the_end() -> None:
    checks, planner, answers = checker()
    for number in range(2):
        checks.ask(whole(number, planner.init(3, 0)))
    assert planner.begun.acquire(timeout=PATIENCE_S)
    checks.close(0.0)
    planner.may.release()
    checks.close(PATIENCE_S)
    await asyncio.sleep(0)
    assert answers.empty()
