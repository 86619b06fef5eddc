"""The first decisions of a run by the robot's own planner, to compare a service's answers with."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import NamedTuple

from holdfast.config.loader import Configuration
from holdfast.config.user_code import describe_problem_error
from holdfast.errors import HoldfastError
from holdfast.planning import Decision, Planner, PlanningState, digest
from holdfast.protocol.messages import (
    DIGEST_SIZE,
    MAX_TASK_ACTIONS,
    Observed,
    Reply,
    SensingAnswer,
    SessionConfiguration,
    TaskAnswer,
    encode_floats,
)
from holdfast.robot.environment import SimulatedEnvironment
from holdfast.robot.session_configuration import session_configuration_of

__all__ = ["ReferenceDecisions", "ReferenceTurn"]


class ReferenceTurn(NamedTuple):
    """One decision: the state, what was sensed before it, and the time that it took."""

    state: PlanningState
    observations: tuple[Observed, ...]
    decision: Decision
    took_s: float

    def agrees_with(self, replies: Iterable[Reply]) -> bool:
        """Return whether the answers among the replies are this decision, bit for bit."""
        answered = {
            reply.actions if isinstance(reply, TaskAnswer) else (reply.sensing_action, reply.digest)
            for reply in replies
            if isinstance(reply, (TaskAnswer, SensingAnswer))
        }
        actions, sensing_action, ahead = self.decision
        expected: set[object] = {b"".join(map(encode_floats, actions))} if actions else set()
        if sensing_action is not None:
            expected.add((sensing_action, digest(ahead)[:DIGEST_SIZE]))
        return answered == expected


class ReferenceDecisions(NamedTuple):
    """The first decisions of a configuration's run, and what describes the run to a service."""

    session_configuration: SessionConfiguration
    turns: tuple[ReferenceTurn, ...]
    """Two, if the first leads to a sensing action."""

    @classmethod
    def of(cls, configuration: Configuration) -> ReferenceDecisions:
        """Decide, with a simulated world; raise a HoldfastError if the problem's code fails."""
        try:
            problem, seed = configuration.problem, configuration.simulator.seed
            planner = Planner(problem, configuration.planning)
            world = SimulatedEnvironment(problem, seed, 0)
            turns = [_turn(planner, planner.init(seed, 0), ())]
            actions, sensing_action, ahead = turns[0].decision
            if sensing_action is not None:
                for action in actions:
                    world.perform(action)
                shown = world.perform_sensing(sensing_action)
                observed = Observed(ahead.step, sensing_action, encode_floats(shown))
                state, _ = planner.observe(ahead, sensing_action, shown)
                turns.append(_turn(planner, state, (observed,)))
            return cls(session_configuration_of(configuration), tuple(turns))
        except Exception as error:  # user code may raise anything
            raise HoldfastError(
                describe_problem_error(configuration.problem_name, error)
            ) from error


def _turn(
    planner: Planner, state: PlanningState, observations: tuple[Observed, ...]
) -> ReferenceTurn:
    began = time.perf_counter()
    decision = planner.decide(state, MAX_TASK_ACTIONS)
    return ReferenceTurn(state, observations, decision, time.perf_counter() - began)
