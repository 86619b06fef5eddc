"""The planner in the robot's process: two parts of an answer, on the loop or on a thread."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from tests.recordings import robot_configuration

from holdfast.config.loader import Configuration
from holdfast.errors import ProblemError
from holdfast.planning.planner import Planner
from holdfast.protocol.events import Halt, Plan, Planned
from holdfast.protocol.question import OWN_PLANNER, InProcessSource, Question
from holdfast.robot import in_process_planner
from holdfast.robot.in_process_planner import InProcessPlanner

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
    assert isinstance(first, Plan)
    done = in_process_planner._answer(planner, first)
    source.handle(done._replace(number=first.number - 1), 1.1)
    assert source.effects.take() == []
    source.handle(done, 1.5)
    given = asked.sensing_provenance if first.sensing else asked.task_provenance
    assert given is not None
    assert (given.service, given.round_trip_s) == (OWN_PLANNER, 0.5)
    source.drop()
    source.handle(done, 2.0)
    assert source.effects.take() == []


def test_an_error_of_the_planner_stops_the_source(configuration: Configuration) -> None:
    _, asked = question(configuration)
    source = InProcessSource()
    source.ask(asked, 0.0)
    source.effects.take()
    error = ProblemError("policy gives nan")
    source.handle(Planned(1, asked.state, error=error), 0.1)
    assert source.stopped
    assert source.effects.take() == [Halt(error)]


def _fail(error: BaseException) -> None:
    raise error


@pytest.mark.parametrize("may_be_brief", [True, False])
def test_code_of_other_people_is_always_computed_on_a_thread(
    configuration: Configuration, *, may_be_brief: bool
) -> None:
    """It may take any time at any call."""
    planner = Planner(configuration.problem, configuration.planning)
    state = planner.init(3, 0)

    async def ask() -> list[bool]:
        come: asyncio.Queue[Planned] = asyncio.Queue()
        own = InProcessPlanner(lambda: planner, come.put_nowait, _fail, may_be_brief=may_be_brief)
        on_loop = []
        for number in range(3):
            own.ask(Plan(number, state, sensing=True))
            on_loop.append(own.compute_brief())
            assert (await asyncio.wait_for(come.get(), PATIENCE_S)).number == number
        own.close()
        return on_loop

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(in_process_planner, "_BRIEF_S", PATIENCE_S)
        assert asyncio.run(ask()) == [False, may_be_brief, may_be_brief]


def test_what_was_asked_before_and_not_begun_is_not_computed(
    configuration: Configuration, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(in_process_planner, "_BRIEF_S", PATIENCE_S)
    planner = Planner(configuration.problem, configuration.planning)
    state = planner.init(3, 0)
    come: list[int] = []
    own = InProcessPlanner(
        lambda: planner,
        lambda planned: come.append(planned.number),
        _fail,
        may_be_brief=True,
    )
    own._usual[True].learn(0.0)
    own.ask(Plan(1, state, sensing=True))
    own.ask(Plan(2, state, sensing=True))
    assert own.compute_brief()
    assert not own.compute_brief()
    assert come == [2]
