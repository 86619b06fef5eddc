"""A robot that is watched: nothing that the other process does holds it up."""

import os
import signal
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import msgspec
import pytest
from tests.recordings import configuration_of

from holdfast.errors import ViewError
from holdfast.reports import live_view
from holdfast.reports.live_follower import FollowerReport
from holdfast.reports.live_view import LiveView
from holdfast.reports.view_target import ViewTarget


def report(connection: Connection, *fields: Any) -> None:
    connection.send_bytes(msgspec.msgpack.encode(FollowerReport(*fields)))


def wait(connection: Connection, *arguments: Any) -> None:
    """Wait until the run is over."""
    report(connection)
    connection.recv_bytes()
    report(connection, None, 50, 7)


def hang(connection: Connection, *arguments: Any) -> None:
    report(connection)
    signal.pause()


def refuse(connection: Connection, *arguments: Any) -> None:
    report(connection, "there is no viewer")


def die(connection: Connection, *arguments: Any) -> None:
    report(connection)
    os.kill(os.getpid(), signal.SIGKILL)


def end(connection: Connection, *arguments: Any) -> None:
    report(connection)
    report(connection, "the viewer was closed")


@pytest.fixture
def notes() -> list[str]:
    return []


@pytest.fixture
def views(tmp_path: Path, notes: list[str]) -> Iterator[Any]:
    """Return a function that starts a view with some work."""
    made: list[LiveView] = []

    def make(work: Any) -> LiveView:
        target = ViewTarget(None, str(tmp_path / "file"))
        view = LiveView(configuration_of(tmp_path), target, tmp_path, notes.append, work)
        made.append(view)
        view.__enter__()
        return view

    yield make
    for view in made:
        view.__exit__()


def test_what_was_left_out_is_told_at_the_end(views: Any, notes: list[str]) -> None:
    view = views(wait)
    assert notes == []
    view.__exit__()
    view.__exit__()
    assert notes == [
        "the view was too slow for 7 of 50 steps and left them out; holdfast view shows all of them"
    ]


def test_a_view_that_does_not_end_is_waited_for_so_long(
    views: Any, notes: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_view, "_CLOSE_S", 0.1)
    view = views(hang)
    view.__exit__()
    view._waiting.join()
    assert notes == ["the view was not complete 0.1 s after the run"]


@pytest.mark.parametrize(
    ("work", "why"), [(die, "its process was killed by SIGKILL"), (end, "the viewer was closed")]
)
def test_a_view_that_ends_is_told_once_and_the_run_goes_on(
    work: Any, why: str, views: Any, notes: list[str]
) -> None:
    view = views(work)
    view._waiting.join()
    view.__exit__()
    assert notes == [f"the view has ended: {why}; the run goes on without it"]


def test_a_viewer_that_is_not_there_is_an_error_before_the_run(views: Any) -> None:
    with pytest.raises(ViewError, match="there is no viewer"):
        views(refuse)
