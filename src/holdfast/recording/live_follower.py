"""The process that shows a run while it goes on: it folds the robot's records, and draws them.

A belief is a function of the records, so this process comes to the robot's own beliefs without
being sent any. To fold a record costs little. To compute the entropies of the alternatives again
and to draw a step costs more, so both are left out for a record that is older than three seconds.

Messages come through a pipe, each after its length. The robot's end never waits, so it writes what
the pipe takes and keeps the rest.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from typing import Any, BinaryIO, TypeAlias

import msgspec

from holdfast.config.loader import Configuration
from holdfast.errors import HoldfastError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.outcome import TrialResult
from holdfast.planning.planner import Planner, PlanningState
from holdfast.planning.tracking import Trial
from holdfast.protocol.events import Timing
from holdfast.protocol.messages import decode_floats, numbers_of
from holdfast.protocol.records import (
    ActingRecord,
    LateRecord,
    ObservedRecord,
    PerformedRecord,
    Record,
    ReinitialisedRecord,
)
from holdfast.recording.facts import (
    Decider,
    EventFact,
    FactSink,
    LateFact,
    SensingFact,
    TaskFact,
    TrialBeginFact,
    TrialEndFact,
)
from holdfast.recording.view_target import ViewTarget
from holdfast.robot.environment import SimulatedEnvironment
from holdfast.robot.trial import LateStep, SensingStep

__all__ = [
    "HEADER_BYTES",
    "EndedMessage",
    "EventMessage",
    "FinishMessage",
    "Follower",
    "FollowerReport",
    "LostMessage",
    "RecordsMessage",
    "TimingMessage",
    "ViewMessage",
    "follow",
]

_LATE_NS = 3_000_000_000
"""A step that is older than this is not drawn."""

_NICENESS = 10

HEADER_BYTES = 4
"""Size of a message's length, little-endian."""


class RecordsMessage(msgspec.Struct, array_like=True, frozen=True, tag=1):
    """Records of a trial, once they are journalled; times are in nanoseconds since 1970."""

    time_ns: int
    trial: int
    records: tuple[Record, ...]


class TimingMessage(msgspec.Struct, array_like=True, frozen=True, tag=2):
    """Who decided; it comes before the record of that decision."""

    time_ns: int
    timing: Timing


class EndedMessage(msgspec.Struct, array_like=True, frozen=True, tag=3):
    """A trial has ended, with the action of its last record."""

    time_ns: int
    result: TrialResult


class EventMessage(msgspec.Struct, array_like=True, frozen=True, tag=4):
    """An event, as a line of ``events.jsonl``."""

    time_ns: int
    line: str


class LostMessage(msgspec.Struct, array_like=True, frozen=True, tag=5):
    """What waited was too much and is lost: the next records are of another trial."""


class FinishMessage(msgspec.Struct, array_like=True, frozen=True, tag=6):
    """The run is over."""


ViewMessage: TypeAlias = (
    RecordsMessage | TimingMessage | EndedMessage | EventMessage | LostMessage | FinishMessage
)


class FollowerReport(msgspec.Struct, array_like=True, frozen=True):
    """What the process that shows a run says: once when it is ready, once at its end.

    Attributes
    ----------
    error : str or None
        Why it shows nothing any more.
    steps, left_out : int
        Task actions that it was told of, and those that there was no time to show.
    """

    error: str | None = None
    steps: int = 0
    left_out: int = 0


class Follower:
    """Makes facts of a robot's messages.

    Attributes
    ----------
    steps, left_out : int
        Task actions so far, and those that were too old to be shown.
    """

    def __init__(
        self, configuration: Configuration, sink: FactSink, clock: Callable[[], int] = time.time_ns
    ) -> None:
        self._configuration = configuration
        self._planner = Planner(configuration.problem, configuration.planning)
        self._sink = sink
        self._clock = clock
        self._trial: Trial | None = None
        self._simulated: SimulatedEnvironment | None = None
        self._pending: FloatArray | None = None
        self._deciders: dict[tuple[int, str], tuple[int, Decider]] = {}
        self._answered: Decider | None = None
        self.steps = self.left_out = 0

    def take(self, message: ViewMessage) -> None:
        """Pass on what a message says."""
        if isinstance(message, RecordsMessage):
            trial = self._trial
            if trial is None or trial.state.trial != message.trial:
                self._end(message.time_ns)
                trial = self._begin(message.trial, message.time_ns)
            for record in message.records:
                self._fold(trial, record, message.time_ns)
        elif isinstance(message, TimingMessage):
            timing = message.timing
            self._deciders[timing.step, timing.kind] = message.time_ns, Decider.of(timing)
        elif isinstance(message, EndedMessage):
            self._finish(message)
        elif isinstance(message, EventMessage):
            self._happened(message.time_ns, **json.loads(message.line))
        else:
            self._end(self._clock())

    def _happened(self, time_ns: int, /, event: str, **fields: object) -> None:
        fields.pop("time", None)
        self._sink.happened(EventFact(time_ns, event, fields))

    def _begin(self, number: int, time_ns: int) -> Trial:
        seed = self._configuration.simulator.seed
        self._trial = trial = Trial(self._planner, seed, number)
        self._pending = self._answered = None
        if self._configuration.environment.object is None:
            self._simulated = SimulatedEnvironment(self._planner.problem, seed, number)
        self._sink.trial_begins(TrialBeginFact(number, time_ns))
        return trial

    def _finish(self, message: EndedMessage) -> None:
        result = message.result
        trial = self._trial
        if trial is None or trial.state.trial != result.trial:
            self._end(message.time_ns)
            trial = self._begin(result.trial, message.time_ns)
        if self._pending is not None:
            self._fold(trial, PerformedRecord(trial.state.step, None), message.time_ns)
        self._end(message.time_ns, message)

    def _end(self, time_ns: int, message: EndedMessage | None = None) -> None:
        """End the trial, as far as its records go."""
        if self._trial is None:
            return
        state = self._trial.state
        fact = TrialEndFact(
            trial=state.trial,
            time_ns=time_ns,
            steps=state.step,
            result=None if message is None else message.result,
            belief=state.belief,
            estimate=self._planner.estimate(state),
            true_state=self._true_state,
        )
        if message is not None and message.result.steps != state.step:
            # Its records were lost.
            steps = message.result.steps
            fact = fact._replace(steps=steps, belief=None, estimate=None, true_state=None)
        self._sink.trial_ends(fact)
        self._trial = self._simulated = None
        self._deciders = {}

    @property
    def _true_state(self) -> FloatArray | None:
        return None if self._simulated is None else self._simulated.state

    def _fold(self, trial: Trial, record: Record, time_ns: int) -> None:
        is_late = self._clock() - time_ns > _LATE_NS
        if isinstance(record, ObservedRecord):
            self._sensed(trial, record, time_ns, is_late=is_late)
        elif isinstance(record, ActingRecord):
            self._pending = decode_floats(record.action, self._planner.problem.action_size)
            self.steps += 1
            self.left_out += is_late
            if not is_late:
                self._acting(trial.state, self._pending, time_ns)
        elif isinstance(record, PerformedRecord):
            assert self._pending is not None
            motion, observation = numbers_of(record.motion), numbers_of(record.observation)
            trial.move(self._pending, record.reward, motion, observation)
            if self._simulated is not None:
                self._simulated.perform(self._pending)
            self._pending = None
        elif isinstance(record, LateRecord):
            late = record.late()
            found = trial.observe_late(late)
            if found is not None and not is_late:
                self._sink.observed_late(
                    LateFact.of(LateStep(late, trial.state, found[0]), time_ns)
                )
        elif isinstance(record, ReinitialisedRecord):
            trial.reinitialise()  # an event tells of it

    def _sensed(self, trial: Trial, record: ObservedRecord, time_ns: int, *, is_late: bool) -> None:
        before = trial.state
        why = None if is_late else self._planner.choose_sensing_action(before)[1]
        observation = numbers_of(record.observation)
        info, _ = trial.observe(record.sensing_action, observation, record.sensing_ms)
        decided_ns, decider = self._deciders.pop((before.step, "sensing"), (time_ns, None))
        if why is not None:
            step = SensingStep(before, record.sensing_action, why, observation, trial.state, info)
            self._sink.sensed(SensingFact.of(step, decided_ns, time_ns, decider))

    def _acting(self, state: PlanningState, action: FloatArray, time_ns: int) -> None:
        """Show an action when it is ordered: how it went shows at the next one."""
        asked = self._deciders.pop((state.step, "task"), None)
        if asked is not None:
            # An answer has the task actions up to the next sensing step.
            self._answered = asked[1]
        info = self._planner.choose_task_action(state)[1]
        self._sink.acted(
            TaskFact(
                trial=state.trial,
                step=state.step,
                time_ns=time_ns,
                action=action,
                decider=self._answered,
                belief=state.belief,
                stage=info.stage,
                estimate=info.estimate,
                true_state=self._true_state,
            )
        )


def follow(connection: Connection, plain: dict[str, Any], target: tuple[str | None, ...]) -> None:
    """Show a run: the work of the other process."""
    # The viewer, which outlives this process, must not hold the pipe open.
    os.set_inheritable(connection.fileno(), False)
    report = FollowerReport()
    try:
        from holdfast.recording.rerun_sink import RerunSink

        configuration = Configuration.from_plain(plain)
        with RerunSink(configuration, ViewTarget(*target), has_times=True, live=True) as sink:
            follower = Follower(configuration, sink)
            _send(connection, report)
            os.nice(_NICENESS)  # the robot waits no more
            with os.fdopen(connection.fileno(), "rb", closefd=False) as pipe:
                for message in _messages(pipe):
                    follower.take(message)
                    if not sink.streams.is_open:
                        break
            report = FollowerReport(None, follower.steps, follower.left_out)
        if (lost := sink.streams.lost) is not None:
            rest = "" if target[1] is None else "; the file is complete"
            report = FollowerReport(f"the viewer {lost}{rest}")
    except HoldfastError as error:
        report = FollowerReport(str(error))
    except Exception as error:  # noqa: BLE001 - the problem is anybody's code
        report = FollowerReport(f"{type(error).__name__}: {error}")
    _send(connection, report)
    if report.error is not None:
        # Rerun's client would wait for a viewer that takes nothing.
        os._exit(1)


def _send(connection: Connection, report: FollowerReport) -> None:
    connection.send_bytes(msgspec.msgpack.encode(report))


def _messages(file: BinaryIO) -> Iterator[ViewMessage]:
    """Read messages up to the one that the run is over."""
    decode = msgspec.msgpack.Decoder(ViewMessage).decode
    while len(header := file.read(HEADER_BYTES)) == HEADER_BYTES:
        message = decode(file.read(int.from_bytes(header, "little")))
        yield message
        if isinstance(message, FinishMessage):
            return
