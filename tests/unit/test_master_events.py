"""The guard's log: one line an event, whatever is in it."""

import io
import json

from ros1_master_guard.events import EventLog


def logged(name: str, *, as_json: bool, **fields: object) -> str:
    stream = io.StringIO()
    log = EventLog(stream, as_json=as_json)
    log.event(name, **fields)
    log.close()
    return stream.getvalue()


def test_json_has_every_field() -> None:
    line = logged("master_lost", as_json=True, reason=ValueError("a\nb"), pid=3, gone=None)
    told = json.loads(line)
    assert told.pop("time").endswith("+00:00")
    assert told.pop("component") == "ros1-guard"
    assert told == {"event": "master_lost", "reason": "a\nb", "pid": 3, "gone": None}


def test_text_is_one_line_of_what_is_there() -> None:
    line = logged("master_lost", as_json=False, reason="a\nb\x1b[0m", duration_ms=1.25, gone=None)
    assert line.count("\n") == 1
    assert line.endswith(" master lost: a\\nb\\x1b[0m, duration ms 1.2\n")
    assert len(logged("note", as_json=False, reason="x" * 9000)) <= 4001


def test_a_stream_that_is_closed_costs_the_line_alone() -> None:
    stream = io.StringIO()
    log = EventLog(stream, as_json=False)
    stream.close()
    log.event("note", reason="x")
    log.close()
