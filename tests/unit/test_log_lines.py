"""Lines of the log: the same event for a person and for a program, always one bounded line."""

import io
import json
import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.answers import answers_in

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
    @pytest.mark.parametrize(("example", "expected"), answers_in("log_lines.txt"))
    def test_every_event_is_one_short_aligned_line(self, example: str, expected: str) -> None:
        name, _, text = example.partition(" ")
        fields = json.loads(text)
        if "session" in fields:
            fields["session"] = bytes.fromhex(fields["session"])
        line = line_of("text", name, **fields)
        assert re.fullmatch(r"2026-07-2\dT\d\d:\d\d:04\.123[+-]\d\d:\d\d robot    ", line[:39])
        assert line[39:] == expected
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
