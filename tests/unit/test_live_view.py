"""A robot that is watched: nothing that the other process does holds it up."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import msgspec
import pytest
from tests.recordings import configuration_of, result_of

from holdfast.config.loader import Configuration
from holdfast.errors import ViewError
from holdfast.protocol.events import Timing
from holdfast.protocol.records import PausedRecord, PerformedRecord, Record
from holdfast.recording import live_view
from holdfast.recording.live_follower import (
    EndedMessage,
    EventMessage,
    FinishMessage,
    FollowerReport,
    LostMessage,
    RecordsMessage,
    TimingMessage,
    ViewMessage,
    _messages,
)
from holdfast.recording.live_view import LiveView
from holdfast.recording.view_target import ViewTarget

_MESSAGES = msgspec.msgpack.Decoder(list[ViewMessage])


def report(connection: Connection, *fields: Any) -> None:
    connection.send_bytes(msgspec.msgpack.encode(FollowerReport(*fields)))


def keep(connection: Connection, plain: dict[str, Any], target: tuple[str | None, ...]) -> None:
    """Write all messages to the file that is the target, once a pipe beside it lets it go on."""
    report(connection)
    assert target[1] is not None
    if Path(f"{target[1]}.go").exists():
        Path(f"{target[1]}.go").read_bytes()
    with os.fdopen(connection.fileno(), "rb", closefd=False) as pipe:
        messages = list(_messages(pipe))
    Path(target[1]).write_bytes(msgspec.msgpack.encode(messages))
    report(connection, None, 50, 7)


def refuse(connection: Connection, plain: dict[str, Any], target: tuple[str | None, ...]) -> None:
    report(connection, "there is no viewer")


def die(connection: Connection, plain: dict[str, Any], target: tuple[str | None, ...]) -> None:
    report(connection)
    os.kill(os.getpid(), signal.SIGKILL)


def end(connection: Connection, plain: dict[str, Any], target: tuple[str | None, ...]) -> None:
    report(connection)
    report(connection, "the viewer was closed")


@pytest.fixture
def configuration(tmp_path: Path) -> Configuration:
    return configuration_of(tmp_path)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "messages"


@pytest.fixture
def notes() -> list[str]:
    return []


@pytest.fixture
def views(configuration: Configuration, file: Path, notes: list[str]) -> Iterator[Any]:
    """Return a function that starts a view with some work."""
    made: list[LiveView] = []

    def make(work: Any) -> LiveView:
        view = LiveView(configuration, ViewTarget(None, str(file)), notes.append, work)
        made.append(view)
        view.start()
        return view

    yield make
    for view in made:
        view.close()


def performed(step: int) -> Record:
    return PerformedRecord(step, 0.5)


def test_what_cannot_be_handed_over_ends_the_view_alone(
    views: Any, file: Path, notes: list[str]
) -> None:
    del file
    view = views(keep)
    view.records(0, [object()])
    view.records(0, [performed(0)])
    (note,) = notes
    assert "the view has ended: " in note
    assert note.endswith("; the run goes on without it")


def test_all_messages_arrive_in_their_order(views: Any, file: Path, notes: list[str]) -> None:
    view = views(keep)
    timing = Timing(0, 0, "task", "tcp/a:1", "standard", 1.0, 2.0, 3.0)
    view.timing(timing)
    view.records(0, [performed(0), PausedRecord()])
    view.event("holding", reason="no answer")
    view.ended(result_of(0))
    view.close()
    view.close()
    records, ended = [], None
    for message in _MESSAGES.decode(file.read_bytes()):
        records.append(type(message))
        if isinstance(message, TimingMessage):
            assert message.timing == timing
        elif isinstance(message, RecordsMessage):
            assert (message.trial, message.records) == (0, (performed(0), PausedRecord()))
        elif isinstance(message, EventMessage):
            assert '"event":"holding","reason":"no answer"' in message.line
        elif isinstance(message, EndedMessage):
            ended = message.result
    assert records == [TimingMessage, RecordsMessage, EventMessage, EndedMessage, FinishMessage]
    assert ended is not None
    assert (ended.digest, ended.decisions) == (result_of(0).digest, None)
    assert notes == [
        "the view was too slow for 7 of 50 steps and left them out; holdfast view shows all of them"
    ]


def test_what_waits_is_bounded(
    views: Any, file: Path, notes: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process that takes nothing does not hold the robot up, and misses the rest of a trial."""
    monkeypatch.setattr(live_view, "_MAX_WAITING_BYTES", 100_000)
    may_go_on = file.with_suffix(".go")
    os.mkfifo(may_go_on)
    view = views(keep)
    step = 0
    while not notes:
        assert step < 100_000
        view.records(0, [performed(step)])
        assert view._waiting_bytes <= 100_000
        step += 1
    for _ in range(5_000):
        view.records(0, [performed(step)])
        view.event("status", reason="that events are lost is no reason to begin a trial midway")
    view.records(0, [performed(step)])
    view.records(1, [performed(0)])
    may_go_on.write_bytes(b"")
    view.close()
    assert notes == ["the viewer takes nothing: the view goes on with the next trial"]
    messages = _MESSAGES.decode(file.read_bytes())
    lost = [place for place, message in enumerate(messages) if isinstance(message, LostMessage)]
    before, after = messages[: lost[0]], messages[lost[0] + 1 :]
    arrived = [message.records for message in before if isinstance(message, RecordsMessage)]
    assert arrived == [(performed(number),) for number in range(len(arrived))]
    assert len(arrived) < step
    assert [message.trial for message in after if isinstance(message, RecordsMessage)] == [1]


@pytest.mark.parametrize(
    ("work", "why"), [(die, "its process was killed by SIGKILL"), (end, "the viewer was closed")]
)
def test_a_view_that_ends_is_told_once_and_the_run_goes_on(
    work: Any, why: str, views: Any, notes: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    view = views(work)
    view._worker._process.join()
    explained = []

    class AtOnce:
        def __init__(self, target: Any, daemon: bool) -> None:
            explained.append(target)

        def start(self) -> None:
            explained[0]()

        def join(self, timeout: float) -> None:
            pass

    monkeypatch.setattr(threading, "Thread", AtOnce)
    for step in range(3):
        view.records(0, [performed(step)])
    view.close()
    assert notes == [f"the view has ended: {why}; the run goes on without it"]


def test_a_viewer_that_is_not_there_is_an_error_before_the_run(views: Any) -> None:
    with pytest.raises(ViewError, match="there is no viewer"):
        views(refuse)
