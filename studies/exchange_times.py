"""What it costs to ask a service, beside what it computes and the path to it.

A robot's questions are put to a real service: ``holdfast serve`` as a process of its own, over TCP
on this machine. Of the time until each part of an answer has come, the service itself says how much
it computed; the rest is the exchange: encoding, two processes woken, digests, the answer decoded. A
path adds its round trip to that.
"""

from __future__ import annotations

import asyncio
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import pandas as pd

from holdfast.config.registry import problem_class, problem_module
from holdfast.config.source_digest import core_version, problem_digest
from holdfast.planning.planner import Planner, digest
from holdfast.planning.settings import ParticleFilterSettings, PlanningSettings, SelectorSettings
from holdfast.protocol.events import CallEnded, ReplyReceived, ServiceAppeared, TransportEvent
from holdfast.protocol.messages import (
    DIGEST_SIZE,
    PROTOCOL_VERSION,
    Observed,
    Progress,
    Reply,
    Request,
    SensingAnswer,
    SessionConfiguration,
    TaskAnswer,
    decode_reply,
    encode,
    encode_floats,
)
from holdfast.transport.contract import RobotTransport
from holdfast.transport.robot_end import StreamRobotTransport
from holdfast_lab.errors import NoProgressError, ProcessEndedError
from holdfast_lab.testbed.driver import Testbed
from holdfast_lab.testbed.processes import free_port
from studies.errors import TaskError
from studies.sensing_times import Sensed, history_of
from studies.tables import Cell
from studies.trial_batches import problem_of

__all__ = ["COLUMNS", "Exchange", "measure_exchange"]

COLUMNS = ("trial", "step", "task_ms", "task_computed_ms", "sensing_ms", "computed_ms")
"""Of the table: a row for each question. ``task_ms`` and ``sensing_ms`` are the times until the
task actions and until the sensing action had come, ``computed_ms`` what the service computed for
both."""

_PATIENCE_S = 20.0
_SWITCH_INTERVAL_S = 0.0005

_LEASE_MS = 30_000.0
"""Of both ends: a machine that stands still for a moment does not end the study."""


class Exchange(msgspec.Struct, frozen=True, kw_only=True):
    """What is asked: all questions of some trials."""

    problem: str
    particles: int = 100
    num_trials: int = 3
    seed: int = 0


class _Turn(NamedTuple):
    """A question as it crosses the wire, and the right answer."""

    trial: int
    step: int
    sensed: bool
    digest: bytes
    observations: tuple[Observed, ...]
    sensing_action: int


def measure_exchange(**exchange: Any) -> pd.DataFrame:
    """Put questions and time the answers; the function of tasks of the kind ``exchange_times``.

    It gets the fields of :class:`Exchange`, and returns a table with the columns of
    :data:`COLUMNS`. TaskError if the service does not start, does not answer, or answers something
    else than what the same question comes to in this process.
    """
    wanted = msgspec.convert(exchange, Exchange)
    settings = PlanningSettings(
        particle_filter=ParticleFilterSettings(num_particles=wanted.particles),
        selector=SelectorSettings(method="action_entropy", estimator="nearest_neighbor"),
    )
    code = (
        core_version(),
        problem_digest(problem_class(wanted.problem), problem_module(wanted.problem)),
    )
    session_configuration = SessionConfiguration(
        wanted.problem, {}, {}, settings, wanted.seed, *code
    )
    turns = [turn for trial in range(wanted.num_trials) for turn in _turns(wanted, settings, trial)]
    switch_interval_s = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_INTERVAL_S)  # as a robot's process does
    try:
        with (
            tempfile.TemporaryDirectory(prefix="holdfast-") as directory,
            Testbed(Path(directory)) as testbed,
        ):
            options = ("--lease-ms", str(_LEASE_MS), "--problem", wanted.problem)
            service = testbed.add_service(f"tcp/127.0.0.1:{free_port()}", *options)
            testbed.start_services()
            rows = asyncio.run(_asked(service.endpoint, turns, session_configuration))
    except (NoProgressError, ProcessEndedError) as error:
        raise TaskError(str(error)) from error
    finally:
        sys.setswitchinterval(switch_interval_s)
    return pd.DataFrame(rows, columns=list(COLUMNS))


async def _asked(
    service: str, turns: list[_Turn], session_configuration: SessionConfiguration
) -> list[tuple[Cell, ...]]:
    """Return a row for each question but the first: for that, the problem is loaded."""
    rows: list[tuple[Cell, ...]] = []
    transport = StreamRobotTransport({service: service}, lease_ms=_LEASE_MS)
    try:
        asking = _Asking(service, transport)
        await asking.start()
        for number, turn in enumerate(turns, 1):
            row = await asking.ask(number, turn, session_configuration if number == 1 else None)
            rows.append((turn.trial, turn.step, *row))
    finally:
        await transport.close()
    return rows[1:]


def _turns(wanted: Exchange, settings: PlanningSettings, trial: int) -> Iterator[_Turn]:
    """Yield all questions that the robot of a trial would ask, with the answers."""
    problem = problem_of(wanted.problem)
    planner = Planner(problem, settings)
    state = planner.init(wanted.seed, trial)
    asked, sensing_action = state, -1
    last: tuple[Observed, ...] = ()
    for event in history_of(problem, settings, wanted.seed, trial):
        if not isinstance(event, Sensed):
            state = planner.advance(state, event)
            continue
        sensing_action, _ = planner.choose_sensing_action(state)
        yield _Turn(
            trial,
            asked.step,
            asked.sensed,
            digest(asked)[:DIGEST_SIZE],
            last,
            sensing_action,
        )
        last = (Observed(state.step, event.sensing_action, encode_floats(event.observation)),)
        state, _ = planner.observe(state, *event)
        asked = state


class _Asking:
    """Puts one question at a time, as one robot."""

    def __init__(self, service: str, transport: RobotTransport) -> None:
        self._service = service
        self._transport = transport
        self._events: asyncio.Queue[TransportEvent] = asyncio.Queue()
        self._session = os.urandom(16)

    async def start(self) -> None:
        """Wait until the service is there."""
        self._transport.start(self._events.put_nowait)
        while not isinstance(await self._next(), ServiceAppeared):
            pass

    async def ask(
        self, number: int, turn: _Turn, session_configuration: SessionConfiguration | None
    ) -> tuple[Cell, ...]:
        """Return the times of an answer."""
        start = time.perf_counter()
        request = Request(
            PROTOCOL_VERSION,
            self._session,
            1,
            number,
            turn.trial,
            turn.step,
            turn.sensed,
            turn.digest,
            turn.observations,
            session_configuration,
        )
        self._transport.call(self._service, number, encode(request))
        task_ms = task_computed_ms = None
        answer: SensingAnswer | None = None
        said: list[Reply] = []
        computed_ms = sensing_ms = 0.0
        while not isinstance(event := await self._next(), CallEnded):
            if not isinstance(event, ReplyReceived):
                continue
            reply = decode_reply(event.payload)
            elapsed_ms = 1e3 * (time.perf_counter() - start)
            if isinstance(reply, TaskAnswer):
                task_ms, task_computed_ms = elapsed_ms, 1e-3 * reply.computed_us
                computed_ms += task_computed_ms
            elif isinstance(reply, SensingAnswer):
                sensing_ms, answer = elapsed_ms, reply
                computed_ms += 1e-3 * reply.computed_us
            if not isinstance(reply, Progress):
                said.append(reply)
        if answer is None or answer.sensing_action != turn.sensing_action:
            raise TaskError(
                f"trial {turn.trial}, step {turn.step}: the service answered "
                f"{said or 'nothing'}, which is not sensing action {turn.sensing_action}"
            )
        return task_ms, task_computed_ms, sensing_ms, computed_ms

    async def _next(self) -> TransportEvent:
        try:
            async with asyncio.timeout(_PATIENCE_S):
                return await self._events.get()
        except TimeoutError:
            raise TaskError(f"the service has not answered for {_PATIENCE_S:g} s") from None
