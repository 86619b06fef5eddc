"""One valid specimen of everything that is decoded, made by code: what fuzzing begins from."""

from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from tests.questions import request_of

from holdfast.config import registry
from holdfast.config.source_digest import core_version, problem_digest
from holdfast.planning.inputs import (
    ActingRecord,
    LocalTookOverRecord,
    Moved,
    PausedRecord,
    Record,
    Sensed,
    encode_floats,
)
from holdfast.planning.planner import Planner, PlanningState, encode_checkpoint
from holdfast.planning.settings import (
    ActiveSensingSettings,
    ParticleFilterSettings,
    PlanningSettings,
)
from holdfast.problems.problem import Problem
from holdfast.protocol.messages import (
    CHECKSUM_SIZE,
    DIGEST_SIZE,
    Busy,
    NeedState,
    Progress,
    Refused,
    Reply,
    Request,
    SensingAnswer,
    SessionConfiguration,
    TaskAnswer,
    encode,
)
from holdfast.robot.environment import SimulatedEnvironment

PROBLEM = "capsule_robot"
"""Whose decisions are the cheapest: what is fuzzed is the way to them."""

SEED = 5

PLANNING = PlanningSettings(
    particle_filter=ParticleFilterSettings(num_particles=12),
    active_sensing=ActiveSensingSettings(
        num_observation_samples=2, num_nearest_neighbors=3, num_cores=1
    ),
    sensing_interval=2,
)

_NO_CODE_OF_ITS_OWN = problem_digest(registry.problem_class(PROBLEM))

_EXAMPLES = Path(__file__).parents[2] / "examples"


def content_of(message: Request | Reply) -> bytes:
    """Return a message as it is sent, without its checksum: nothing spoilt would get past that."""
    return encode(message)[:-CHECKSUM_SIZE]


class Turn(NamedTuple):
    """A robot that has sensed so often: its state, and the observations that led to it."""

    state: PlanningState
    observed: tuple[Sensed, ...]


def session_configuration_of(
    name: str = PROBLEM,
    seed: int = SEED,
    model: dict[str, object] | None = None,
    planning: PlanningSettings = PLANNING,
) -> SessionConfiguration:
    """Return what a robot with a problem of holdfast's, or one that is nowhere, says of its run."""
    return SessionConfiguration(
        name, model or {}, {}, planning, seed, core_version(), _NO_CODE_OF_ITS_OWN
    )


def problem_of(session_configuration: SessionConfiguration) -> Problem:
    """Build the problem that an opening names."""
    built: Problem = registry.problem_class(session_configuration.problem).from_settings(
        session_configuration.model, session_configuration.state_space_planner
    )
    return built


@cache
def turns(name: str = PROBLEM, count: int = 6, trial: int = 0) -> tuple[Turn, ...]:
    """Return the states of a robot's first turns, as the planner itself goes through them."""
    problem = problem_of(session_configuration_of(name))
    planner = Planner(problem, PLANNING)
    state = planner.init(SEED, trial)
    environment = SimulatedEnvironment(problem, SEED, trial)
    observed: tuple[Sensed, ...] = ()
    found = [Turn(state, observed)]
    while len(found) < count:
        if planner.needs_sensing(state):
            action, _ = planner.choose_sensing_action(state)
            shown = environment.perform_sensing(action)
            observed = (*observed, Sensed(state.step, action, encode_floats(shown)))
            state, _ = planner.observe(state, action, shown)
            found.append(Turn(state, observed))
        else:
            task, _ = planner.choose_task_action(state)
            environment.perform(task)
            state = planner.advance(state, task)
    return tuple(found)


def requests(session: bytes = b"s" * 16, epoch: int = 1) -> list[Request]:
    """Return requests of every shape, each of which a service can answer."""
    found: list[Request] = []
    for name in (PROBLEM, "peg_in_hole_2d"):
        session_configuration = session_configuration_of(name)
        for turn in turns(name):
            state = turn.state
            for told, restored in ((False, False), (True, False), (True, True), (False, True)):
                found.append(
                    request_of(
                        state,
                        session,
                        len(found) + 1,
                        epoch=epoch,
                        inputs=() if restored else turn.observed,
                        session_configuration=session_configuration if told else None,
                        checkpoint=encode_checkpoint(state) if restored else None,
                    )
                )
    return found


def replies() -> list[Reply]:
    """Return a reply of each kind."""
    return [
        TaskAnswer(17, 2, encode_floats(np.arange(6.0)), 250),
        SensingAnswer(17, 44, 2, b"e" * DIGEST_SIZE, 80),
        Progress(17, True),
        NeedState(17, False),
        Busy(17, 30),
        Refused(17, "stale_epoch", "epoch 1: epoch 2 was seen"),
    ]


def records() -> list[Record]:
    """Return a record of each kind."""
    return [
        Sensed(8, 1, encode_floats([0.5]), bytes(range(32)), 1.5),
        ActingRecord(8, encode_floats([0.25, -0.5])),
        Moved(8, -1.0),
        Moved(9, None),
        PausedRecord(),
        LocalTookOverRecord(2),
    ]


def checkpoints() -> list[bytes]:
    """Return states as they are encoded."""
    return [encode_checkpoint(turn.state) for turn in turns()]


def configurations() -> list[bytes]:
    """Return the configurations that come with holdfast."""
    return [path.read_bytes() for path in sorted(_EXAMPLES.glob("*.yaml"))]
