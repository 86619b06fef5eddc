"""Lines of the log: the same event for a person and for a program, always one bounded line."""

import io
import json
import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from holdfast.runtime.log_lines import MAX_LINE_BYTES, LogFormat
from holdfast.runtime.logs import EventLog

NOON_NS = 1_784_980_984_123_456_789  # 2026-07-25T12:03:04.123456789Z

CHANGE: dict[str, object] = {
    "from": "standard",
    "to": "local_recovery",
    "reason": "cloud is gone: link broken",
    "trial": 3,
    "duration_ms": 12.345678,
}

EXAMPLES: dict[str, dict[str, object]] = {
    "status": CHANGE,
    "launch": {"service": "recovery"},
    "launched": {"launch_ms": 241.52},
    "launch_failed": {"reason": "not seen after 5000 ms"},
    "recovery_exited": {"reason": "signal 9"},
    "retry": {"service": "cloud", "retry_in_ms": 2.5},
    "hedge": {"step": 9, "waited_ms": 50.0},
    "restore": {"service": "cloud", "step": 9, "size_bytes": 4096},
    "service_appeared": {"service": "cloud", "boot": "a1b2"},
    "service_vanished": {"service": "cloud"},
    "service_suspected": {"service": "cloud", "reason": "no progress for 250 ms"},
    "late_replies": {"service": "cloud", "soonest_ms": 401.0, "reason": "several took longer"},
    "holding": {"step": 9, "reason": "cloud: is not there"},
    "resumed": {"held_ms": 812.0},
    "refused": {"service": "cloud", "code": "stale_epoch", "reason": "epoch 1 < 2", "final": True},
    "disagreement": {"service": "cloud", "kind": "sensing"},
    "trial": {"trial": 3, "success": True, "outcome": "succeeded", "steps": 41, "warm": False},
    "missed_ticks": {"missed": 2, "total": 5},
    "ready": {"endpoints": ["tcp/127.0.0.1:7447"], "idle_s": 0.25},
    "session_opened": {"session": b"\xab" * 16},
    "session_taken_over": {"session": b"\xab" * 16, "epoch": 3},
    "restored": {"session": b"\xab" * 16, "trial": 1},
    "busy": {"retry_after_ms": 30},
    "evicted": {"session": b"\xab" * 16},
    "stopping": {},
    "something_new": {"rate_hz": 12.5, "pi": 3.14159265, "nothing": None},
}


def line_of(style: LogFormat, name: str, /, **fields: object) -> str:
    stream = io.StringIO()
    EventLog(stream, format=style, component="robot", clock=lambda: NOON_NS).event(name, **fields)
    text = stream.getvalue()
    assert text.endswith("\n")
    return text[:-1]


def object_of(name: str, /, **fields: object) -> dict[str, Any]:
    line = line_of("json", name, **fields)
    assert "\n" not in line
    decoded = json.loads(line, parse_constant=pytest.fail)
    assert isinstance(decoded, dict)
    return decoded


class TestJson:
    def test_a_line_is_time_component_event_and_the_fields_in_order(self) -> None:
        assert line_of("json", "status", **CHANGE) == (
            '{"time":"2026-07-25T12:03:04.123456Z","component":"robot","event":"status",'
            '"from":"standard","to":"local_recovery","reason":"cloud is gone: link broken",'
            '"trial":3,"duration_ms":12.346}'
        )

    @pytest.mark.parametrize(
        ("value", "expected"),
        [
            (np.float64(0.5), 0.5),
            (np.int64(7), 7),
            (np.array([3.0]), 3.0),
            (np.bool_(True), True),
            (2**80, str(2**80)),
            (b"\x01\xff", "01ff"),
            (Path("a/b"), "a/b"),
            (ValueError("no"), "ValueError: no"),
            ((1, {"a_ms": 1.23456}), [1, {"a_ms": 1.235}]),
            ("lone \ud800", "lone \\ud800"),
            ("two\nlines", "two\nlines"),
        ],
    )
    def test_values_become_plain_data(self, value: object, expected: object) -> None:
        assert object_of("event", field=value)["field"] == expected

    def test_a_field_cannot_take_the_place_of_the_lines_own(self) -> None:
        decoded = object_of("event", time=1, event="other", component="liar", name="n", self=2)
        assert decoded["time"] == "2026-07-25T12:03:04.123456Z"
        assert decoded["event"] == "event"
        assert decoded["component"] == "robot"
        assert (decoded["time_"], decoded["event_"], decoded["component_"]) == (1, "other", "liar")
        assert (decoded["name"], decoded["self"]) == ("n", 2)


class TestText:
    @pytest.mark.parametrize(
        ("name", "expected"),
        [
            ("status", "standard -> local_recovery (cloud is gone: link broken), trial 3, 12.3 ms"),
            ("launched", "launch 242 ms"),
            ("launch_failed", "not seen after 5000 ms"),
            ("retry", "cloud, retry in 2.50 ms"),
            ("restore", "cloud, step 9, size 4096 bytes"),
            ("service_appeared", "cloud, boot a1b2"),
            ("holding", "cloud: is not there, step 9"),
            ("refused", "cloud (epoch 1 < 2), code stale_epoch, final"),
            ("trial", "trial 3, outcome succeeded, steps 41, not warm"),
            ("ready", 'endpoints ["tcp/127.0.0.1:7447"], idle 0.25 s'),
            ("session_taken_over", "session abababab…, epoch 3"),
            ("something_new", "rate 12.5 Hz, pi 3.14159"),
        ],
    )
    def test_fields_become_a_sentence(self, name: str, expected: str) -> None:
        line = line_of("text", name, **EXAMPLES[name])
        event = name.replace("_", " ").ljust(18)
        assert re.fullmatch(r"2026-07-2\dT\d\d:\d\d:04\.123[+-]\d\d:\d\d robot    ", line[:39])
        assert line[39:] == f"{event} {expected}"

    @pytest.mark.parametrize("name", EXAMPLES)
    def test_every_event_is_one_short_aligned_line(self, name: str) -> None:
        line = line_of("text", name, **EXAMPLES[name])
        assert line.isprintable()
        assert len(line) <= 157
        assert line[:58].rstrip().endswith(name.replace("_", " "))
        assert line[57:58] in ("", " ")

    @pytest.mark.parametrize(
        ("zone", "expected"),
        [
            ("UTC", "2026-07-25T12:03:04.123+00:00 "),
            ("IST-5:30", "2026-07-25T17:33:04.123+05:30 "),
            ("AST4", "2026-07-25T08:03:04.123-04:00 "),
        ],
    )
    def test_the_time_is_local_with_date_and_zone(
        self, zone: str, expected: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        try:
            with monkeypatch.context() as patched:
                patched.setenv("TZ", zone)
                time.tzset()
                assert line_of("text", "launch").startswith(expected)
        finally:
            time.tzset()

    def test_a_service_cannot_write_a_line_of_its_own_or_move_the_cursor(self) -> None:
        line = line_of("text", "refused", reason="no\n12:00:00 robot well\x1b[2J\x9b1A\u2028")
        assert line.isprintable()
        assert "\\x1b[2J\\x9b1A" in line


class TestBounds:
    @pytest.mark.parametrize("style", ["json", "text"])
    @pytest.mark.parametrize(
        "fields",
        [
            {"reason": "é" * 1_000_000},
            {f"field_{i}": "\U0001f600" * 500 for i in range(50)},
            {"values": list(range(1_000_000))},
            {"table": {f"key{i}": "v" * 1000 for i in range(1000)}},
            {"k" * 100_000: 1},
        ],
        ids=["text", "fields", "list", "mapping", "key"],
    )
    def test_a_line_has_a_bound_and_stays_whole(
        self, style: LogFormat, fields: dict[str, object]
    ) -> None:
        line = line_of(style, "event", **fields)
        assert len(line.encode()) < MAX_LINE_BYTES
        if style == "json":
            assert json.loads(line)["event"] == "event"

    @pytest.mark.parametrize("style", ["json", "text"])
    def test_a_field_that_cannot_be_written_costs_only_the_fields(self, style: LogFormat) -> None:
        class Broken:
            def __str__(self) -> str:
                raise ZeroDivisionError

        line = line_of(style, "event", field=Broken())
        assert "ZeroDivisionError" in line
