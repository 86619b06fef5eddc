"""A robot's questions and their right answers, made before anything is asked.

A *turn* is what a robot asks at a time: from a state on, the task actions up to the next sensing
step and the sensing action there. Trials are run in process, with the same planning functions that
a service uses but none of its code; so whatever a service answers can be held against it.
"""

from __future__ import annotations

import asyncio
from time import perf_counter
from typing import NamedTuple, Self

from benchmarks.beliefs import MAX_STEPS, SEED
from holdfast.planning.inputs import Sensed, decode_floats, encode_floats
from holdfast.planning.planner import Planner, PlanningState, digest, encode_checkpoint
from holdfast.planning.settings import PlanningSettings
from holdfast.problems.problem import Problem
from holdfast.protocol.messages import (
    DIGEST_SIZE,
    PROTOCOL_VERSION,
    Reply,
    Request,
    SensingAnswer,
    SessionConfiguration,
    TaskAnswer,
    decode_reply,
    encode,
)
from holdfast.protocol.robot_events import CallEnded, ReplyReceived, ServiceAppeared, TransportEvent
from holdfast.robot.environment import SimulatedEnvironment
from holdfast.transport.endpoints import TlsFiles
from holdfast.transport.robot_end import StreamRobotTransport

__all__ = ["Asked", "Asker", "Caller", "Turn", "decided_in_process", "recorded_turns"]

_PATIENCE_S = 30.0


class Turn(NamedTuple):
    """A question and its answer.

    Attributes
    ----------
    state : PlanningState
        In which it is asked: before the first sensing action of a trial, else after one.
    digest : bytes
        Of the state, as it is sent.
    observations : tuple of Sensed
        All of the trial that led to the state.
    before : PlanningState or None
        Before the last of them.
    actions : bytes
        The task actions up to the next sensing step.
    sensing_state : PlanningState
        At that step.
    sensing_digest : bytes
        Of that state.
    """

    state: PlanningState
    digest: bytes
    checkpoint: bytes
    observations: tuple[Sensed, ...]
    before: PlanningState | None
    actions: bytes
    sensing_step: int
    sensing_state: PlanningState
    sensing_digest: bytes
    sensing_action: int

    def is_right(self, reply: TaskAnswer | SensingAnswer) -> bool:
        """Tell whether a part of an answer is the one that was made in process."""
        if isinstance(reply, TaskAnswer):
            return reply.actions == self.actions
        return (reply.step, reply.sensing_action, reply.digest) == (
            self.sensing_step,
            self.sensing_action,
            self.sensing_digest,
        )


def recorded_turns(problem: Problem, settings: PlanningSettings, trial: int) -> list[Turn]:
    """Run a trial in process and return all questions that its robot would ask."""
    environment = SimulatedEnvironment(problem, SEED, trial)
    planner = Planner(problem, settings)
    state = planner.init(SEED, trial)
    observations: tuple[Sensed, ...] = ()
    turns = [_turn(problem, settings, state, observations, None)]
    while not environment.is_done() and state.step < MAX_STEPS:
        if planner.needs_sensing(state):
            before, sensing_action = state, turns[-1].sensing_action
            observation = environment.perform_sensing(sensing_action)
            state, _ = planner.observe(state, sensing_action, observation)
            last = Sensed(state.step, sensing_action, encode_floats(observation))
            observations = (*observations, last)
            turns.append(_turn(problem, settings, state, observations, before))
        action, _ = planner.choose_task_action(state)
        environment.perform(action)
        state = planner.advance(state, action)
    return turns


def _turn(
    problem: Problem,
    settings: PlanningSettings,
    state: PlanningState,
    observations: tuple[Sensed, ...],
    before: PlanningState | None,
) -> Turn:
    ahead, actions = _rolled(problem, settings, state)
    sensing_action, _ = Planner(problem, settings).choose_sensing_action(ahead)
    return Turn(
        state,
        digest(state)[:DIGEST_SIZE],
        encode_checkpoint(state),
        observations,
        before,
        b"".join(actions),
        ahead.step,
        ahead,
        digest(ahead)[:DIGEST_SIZE],
        sensing_action,
    )


def _rolled(
    problem: Problem, settings: PlanningSettings, state: PlanningState
) -> tuple[PlanningState, list[bytes]]:
    """Return the state at the next sensing step, and the task actions that lead there."""
    actions = []
    planner = Planner(problem, settings)
    while not planner.needs_sensing(state):
        action, _ = planner.choose_task_action(state)
        state = planner.advance(state, action)
        actions.append(encode_floats(action))
    return state, actions


def decided_in_process(problem: Problem, settings: PlanningSettings, turn: Turn) -> int:
    """Compute what a service computes for a turn, and nothing else; return the sensing action."""
    state = turn.state
    planner = Planner(problem, settings)
    if turn.before is not None:
        last = turn.observations[-1]
        observation = decode_floats(last.observation, len(last.observation) // 8)
        state, _ = planner.observe(turn.before, last.sensing_action, observation)
    ahead, _ = _rolled(problem, settings, state)
    return planner.choose_sensing_action(ahead)[0]


class Asked(NamedTuple):
    """An answer, and the seconds from before its question was encoded until it was decoded.

    Attributes
    ----------
    task_s, sensing_s : float
        Until that part was there; 0 if it was none.
    """

    task: TaskAnswer | None
    sensing: SensingAnswer | None
    task_s: float
    sensing_s: float


class Caller:
    """The robot's own end of the wire to one service, for one call at a time.

    Its event loop runs as long as one of its methods does, so a link is kept alive over a pause by
    :meth:`pause` alone.
    """

    def __init__(self, endpoint: str, tls: TlsFiles | None = None) -> None:
        self._transport = StreamRobotTransport({endpoint: endpoint}, tls=tls)
        self._endpoint = endpoint
        self._number = 0
        self._replies: list[tuple[float, Reply]] = []
        self._runner = asyncio.Runner()

    def __enter__(self) -> Self:
        self._runner.run(self._connect())
        return self

    def __exit__(self, *_: object) -> None:
        self._runner.run(self._transport.close())
        self._runner.close()

    def call(self, request: Request | bytes) -> list[tuple[float, Reply]]:
        """Send a request; return its replies, once the call has ended.

        Before each of them stand the seconds from before the request was encoded until the reply
        was decoded.
        """
        return self._runner.run(self._call(request))

    def pause(self, seconds: float) -> None:
        """Do nothing, but keep the link."""
        self._runner.run(asyncio.sleep(seconds))

    async def _connect(self) -> None:
        self._changed = asyncio.Event()
        self._transport.start(self._deliver)
        await asyncio.wait_for(self._changed.wait(), _PATIENCE_S)

    async def _call(self, request: Request | bytes) -> list[tuple[float, Reply]]:
        self._changed.clear()
        self._replies = []
        self._number += 1
        self._sent_at = perf_counter()
        payload = request if isinstance(request, bytes) else encode(request)
        self._transport.call(self._endpoint, self._number, payload)
        await asyncio.wait_for(self._changed.wait(), _PATIENCE_S)
        return self._replies

    def _deliver(self, event: TransportEvent) -> None:
        if isinstance(event, ReplyReceived):
            reply = decode_reply(event.payload)
            self._replies.append((perf_counter() - self._sent_at, reply))
        elif isinstance(event, ServiceAppeared | CallEnded):
            self._changed.set()


class Asker(Caller):
    """Asks one service one question at a time, as one robot.

    Parameters
    ----------
    session : bytes
        Of 16 bytes.
    """

    def __init__(
        self,
        endpoint: str,
        session_configuration: SessionConfiguration,
        session: bytes,
        tls: TlsFiles | None = None,
    ) -> None:
        super().__init__(endpoint, tls)
        self._session_configuration: SessionConfiguration | None = session_configuration
        self._session = session

    def ask(
        self,
        state: PlanningState,
        state_digest: bytes,
        observations: tuple[Sensed, ...] = (),
        checkpoint: bytes | None = None,
    ) -> Asked:
        """Ask, and wait for the end of the call."""
        request = Request(
            PROTOCOL_VERSION,
            self._session,
            1,
            self._number + 1,
            state.trial,
            state.step,
            state.sensed,
            state_digest,
            observations,
            self._session_configuration,
            checkpoint,
        )
        asked = Asked(None, None, 0.0, 0.0)
        for seconds, reply in self.call(request):
            if isinstance(reply, TaskAnswer):
                asked = asked._replace(task=reply, task_s=seconds)
            elif isinstance(reply, SensingAnswer):
                asked = asked._replace(sensing=reply, sensing_s=seconds)
        self._session_configuration = None
        return asked
