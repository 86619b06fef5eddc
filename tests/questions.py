"""What a robot asks in a state, as a request: the one place where tests put it together."""

from typing import Any

from holdfast.config.loader import Configuration
from holdfast.errors import MessageError
from holdfast.planning.inputs import Sensed, encode_floats
from holdfast.planning.planner import Planner, PlanningState, digest
from holdfast.protocol.messages import DIGEST_SIZE, PROTOCOL_VERSION, Request, decode_request
from holdfast.robot.environment import SimulatedEnvironment


def received(payload: bytes) -> tuple[Request | MessageError, int]:
    """Return the request of a message, or what is wrong with it, and the size of the message."""
    try:
        return decode_request(payload), len(payload)
    except MessageError as error:
        return error, len(payload)


def request_of(
    state: PlanningState, session: bytes, number: int, *, epoch: int = 1, **more: Any
) -> Request:
    """Return the question of a state; ``more`` is what else the service is told."""
    return Request(
        version=PROTOCOL_VERSION,
        session=session,
        epoch=epoch,
        number=number,
        trial=state.trial,
        step=state.step,
        sensed=state.sensed,
        digest=digest(state)[:DIGEST_SIZE],
        **more,
    )


def questions_of(configuration: Configuration, session: bytes) -> list[Request]:
    """Return all that the robot of a configuration asks in its first trial, in order."""
    problem, planning = configuration.problem, configuration.planning
    seed = configuration.simulator.seed
    planner = Planner(problem, planning)
    state = planner.init(seed, 0)
    environment = SimulatedEnvironment(problem, seed, 0)
    found = [request_of(state, session, 1)]
    while not environment.is_done() and state.step < configuration.simulator.max_steps:
        if planner.needs_sensing(state):
            action, _ = planner.choose_sensing_action(state)
            shown = environment.perform_sensing(action)
            observed = Sensed(state.step, action, encode_floats(shown))
            state, _ = planner.observe(state, action, shown)
            found.append(request_of(state, session, len(found) + 1, inputs=(observed,)))
        task, _ = planner.choose_task_action(state)
        environment.perform(task)
        state = planner.advance(state, task)
    return found
