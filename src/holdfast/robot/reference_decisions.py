"""The first decisions of a run by the robot's own planner, to compare a service's answers with."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import NamedTuple

from holdfast.config.loader import Configuration
from holdfast.config.user_code import describe_problem_error
from holdfast.errors import HoldfastError
from holdfast.planning.inputs import Sensed, encode_floats
from holdfast.planning.planner import Decision, Planner, PlanningState, digest
from holdfast.protocol.messages import (
    DIGEST_SIZE,
    MAX_TASK_ACTIONS,
    PROTOCOL_VERSION,
    Reply,
    Request,
    SensingAnswer,
    TaskAnswer,
)
from holdfast.robot.environment import SimulatedEnvironment
from holdfast.robot.session_configuration import session_configuration_of


class ReferenceDecision(NamedTuple):
    """A decision and the time that it took."""

    request: Request
    """The same question for a service, without session and number."""
    answer: set[object]
    """What :func:`answer_in` must be of the replies."""
    took_s: float


def answer_in(replies: Iterable[Reply]) -> set[object]:
    """Return all bits of the answers among replies on which a robot acts."""
    return {
        reply.actions if isinstance(reply, TaskAnswer) else (reply.sensing_action, reply.digest)
        for reply in replies
        if isinstance(reply, (TaskAnswer, SensingAnswer))
    }


def reference_decisions(configuration: Configuration) -> list[ReferenceDecision]:
    """Decide in a simulated world: twice, if the first decision leads to a sensing action.

    Raises HoldfastError if the problem's code fails.
    """
    decisions: list[ReferenceDecision] = []

    def decide(state: PlanningState, *observations: Sensed) -> Decision:
        began = time.perf_counter()
        decision = planner.decide(state, MAX_TASK_ACTIONS)
        took_s = time.perf_counter() - began
        described = None if observations else session_configuration_of(configuration)
        place = (state.trial, state.step, state.sensed, digest(state)[:DIGEST_SIZE])
        request = Request(PROTOCOL_VERSION, b"", 1, 0, *place, observations, described)
        answer: set[object] = set()
        if decision.actions:
            answer.add(b"".join(map(encode_floats, decision.actions)))
        if decision.sensing_action is not None:
            answer.add((decision.sensing_action, digest(decision.ahead)[:DIGEST_SIZE]))
        decisions.append(ReferenceDecision(request, answer, took_s))
        return decision

    try:
        problem, seed = configuration.problem, configuration.simulator.seed
        planner = Planner(problem, configuration.planning)
        world = SimulatedEnvironment(problem, seed, 0)
        actions, sensing_action, ahead = decide(planner.init(seed, 0))
        if sensing_action is not None:
            for action in actions:
                world.perform(action)
            shown = world.perform_sensing(sensing_action)
            state, _ = planner.observe(ahead, sensing_action, shown)
            decide(state, Sensed(ahead.step, sensing_action, encode_floats(shown)))
    except Exception as error:  # user code may raise anything
        raise HoldfastError(describe_problem_error(configuration.problem_name, error)) from error
    return decisions
