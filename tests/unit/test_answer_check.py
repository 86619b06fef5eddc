"""The thread that recomputes answers: order, errors and its end."""

from __future__ import annotations

import asyncio
import threading

from holdfast.planning.planner import Decision, Planner, PlanningState
from holdfast.planning.settings import ParticleFilterSettings, PlanningSettings
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.protocol.events import ComputeOwnAnswer, OwnAnswer
from holdfast.robot.answer_check import AnswerChecker

PATIENCE_S = 30.0
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


def question(number: int, state: PlanningState, *, urgent: bool = False) -> ComputeOwnAnswer:
    return ComputeOwnAnswer(number, state, urgent, again=False)


def checker() -> tuple[AnswerChecker, GatedPlanner, asyncio.Queue[OwnAnswer | BaseException]]:
    planner = GatedPlanner()
    come: asyncio.Queue[OwnAnswer | BaseException] = asyncio.Queue()
    return (
        AnswerChecker(lambda: planner, repr, come.put_nowait, come.put_nowait),
        planner,
        come,
    )


async def next_of(come: asyncio.Queue[OwnAnswer | BaseException]) -> OwnAnswer:
    answer = await asyncio.wait_for(come.get(), PATIENCE_S)
    assert isinstance(answer, OwnAnswer)
    return answer


async def test_urgent_questions_come_first_and_once() -> None:
    checks, planner, answers = checker()
    state = planner.init(3, 0)
    checks.ask(question(0, state))
    assert planner.begun.acquire(timeout=PATIENCE_S)
    for number in (1, 2):
        checks.ask(question(number, state))
    checks.ask(question(2, state, urgent=True))
    for _ in range(3):
        planner.may.release()
    assert [(await next_of(answers)).number for _ in range(3)] == [0, 2, 1]
    checks.close(PATIENCE_S)
    assert answers.empty()


async def test_an_error_is_an_answer() -> None:
    checks, planner, answers = checker()
    planner.fails = True
    planner.may.release()
    checks.ask(question(5, planner.init(3, 0)))
    answer = await next_of(answers)
    assert (answer.number, answer.failure) == (5, "ZeroDivisionError('a defect')")
    checks.close(PATIENCE_S)


async def test_nothing_is_answered_after_the_end() -> None:
    checks, planner, answers = checker()
    for number in range(2):
        checks.ask(question(number, planner.init(3, 0)))
    assert planner.begun.acquire(timeout=PATIENCE_S)
    checks.close(0.0)
    planner.may.release()
    checks.close(PATIENCE_S)
    await asyncio.sleep(0)
    assert answers.empty()
