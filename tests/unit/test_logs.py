"""The event log: the same story for a person and for a program, and nothing that hurts the run."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import signal
import subprocess
import sys
import textwrap
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from holdfast.files import OutputError
from holdfast.runtime.logs import (
    MAX_LINE_BYTES,
    BoundedEventLog,
    EventLog,
    EventSink,
    LogFormat,
    NullEventLog,
    TeeEventLog,
)

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
    "trial": {
        "trial": 3,
        "success": True,
        "outcome": "succeeded",
        "steps": 41,
        "warm": False,
    },
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

    @pytest.mark.parametrize("value", [float("nan"), float("inf"), np.float64("-inf")])
    def test_what_is_not_finite_is_null(self, value: float) -> None:
        decoded = object_of("hedge", waited_ms=value, nested=[value])
        assert decoded["waited_ms"] is None
        assert decoded["nested"] == [None]

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

    def test_only_durations_are_rounded(self) -> None:
        decoded = object_of("event", wait_ms=0.123456, share=0.123456)
        assert decoded["wait_ms"] == 0.123
        assert decoded["share"] == 0.123456

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
            (
                "status",
                "standard -> local_recovery (cloud is gone: link broken), trial 3, 12.3 ms",
            ),
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
        assert re.fullmatch(r"\d\d:\d\d:\d\d\.123 robot    ", line[:22])
        assert line[22:] == f"{event} {expected}"

    @pytest.mark.parametrize("name", EXAMPLES)
    def test_every_event_is_one_short_aligned_line(self, name: str) -> None:
        line = line_of("text", name, **EXAMPLES[name])
        assert line.isprintable()
        assert len(line) <= 140
        assert line[:41].rstrip().endswith(name.replace("_", " "))
        assert line[40:41] in ("", " ")

    def test_a_service_cannot_write_a_line_of_its_own_or_move_the_cursor(self) -> None:
        line = line_of("text", "refused", reason="no\n12:00:00 robot well\x1b[2J\x9b1A\u2028")
        assert line.isprintable()
        assert "\\x1b[2J\\x9b1A\\u2028" in line

    def test_not_a_number_is_said(self) -> None:
        line = line_of("text", "hedge", waited_ms=float("nan"), share=float("inf"))
        assert line.endswith("waited nan ms, share inf")


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

    def test_a_line_says_when_fields_were_left_out(self) -> None:
        decoded = object_of("event", **{f"field_{i}": "x" * 700 for i in range(9)})
        assert decoded["truncated"] is True
        assert decoded["field_0"] == "x" * 700
        assert "field_8" not in decoded

    @pytest.mark.parametrize("style", ["json", "text"])
    def test_a_field_that_cannot_be_written_costs_only_the_fields(self, style: LogFormat) -> None:
        class Broken:
            def __str__(self) -> str:
                raise ZeroDivisionError

        line = line_of(style, "event", field=Broken())
        assert "ZeroDivisionError" in line


class TestTargets:
    def test_a_closed_stream_costs_the_line_alone(self) -> None:
        stream = io.StringIO()
        log = EventLog(stream, component="robot")
        stream.close()
        log.event("status", **CHANGE)
        assert log.lost == 1

    def test_a_reader_that_went_away_costs_the_lines_alone(self) -> None:
        reading, writing = os.pipe()
        stream = os.fdopen(writing, "w", encoding="utf-8")
        os.close(reading)
        log = EventLog(stream, component="robot")
        for _ in range(3):
            log.event("status", **CHANGE)
        log.close()
        assert log.lost == 3
        with contextlib.suppress(BrokenPipeError):
            stream.close()

    def test_a_reader_that_does_not_read_holds_nobody_up(self) -> None:
        reading, writing = os.pipe()
        stream = os.fdopen(writing, "w", encoding="utf-8")
        log = EventLog(stream, component="robot")
        for _ in range(2_000):  # more than a pipe holds
            log.event("status", **CHANGE)
        log.close()
        assert 0 < log.lost < 2_000
        os.close(reading)
        with contextlib.suppress(OSError):
            stream.close()

    @pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
    def test_a_full_disk_costs_the_line_alone(self) -> None:
        with EventLog("/dev/full", component="robot") as log:
            log.event("status", **CHANGE)
            assert log.lost == 1

    def test_a_terminal_without_the_letters_gets_escapes(self) -> None:
        raw = io.BytesIO()
        stream = io.TextIOWrapper(raw, encoding="ascii")
        EventLog(stream, component="robot").event("retry", reason="é", wait_us=3)
        assert b"\\xe9, wait 3 \\xb5s\n" in raw.getvalue()

    def test_a_file_is_appended_to_on_a_line_of_its_own(self, tmp_path: Path) -> None:
        path = tmp_path / "events.jsonl"
        path.write_text('{"event":"first"}\n{"event":"cut')
        for number in (1, 2):
            with EventLog(path, format="json", component="robot") as log:
                log.event("next", number=number)
        lines = path.read_text().split("\n")
        assert lines[:2] == ['{"event":"first"}', '{"event":"cut']
        assert [json.loads(line)["number"] for line in lines[2:-1]] == [1, 2]

    def test_a_file_that_cannot_be_opened_is_named(self, tmp_path: Path) -> None:
        with pytest.raises(OutputError, match=r"none/events\.jsonl: cannot be written: No such"):
            EventLog(tmp_path / "none" / "events.jsonl", component="robot")

    def test_after_close_nothing_is_written_and_a_stream_stays_open(self, tmp_path: Path) -> None:
        stream = io.StringIO()
        path = tmp_path / "events.jsonl"
        for log in (EventLog(stream, component="robot"), EventLog(path, component="robot")):
            log.close()
            log.close()
            log.event("late")
            assert log.lost == 0
        assert not stream.closed
        assert stream.getvalue() == path.read_text() == ""

    def test_threads_do_not_mix_their_lines(self, tmp_path: Path) -> None:
        path = tmp_path / "events.jsonl"
        stream = io.StringIO()
        with EventLog(path, format="json", component="robot") as file_log:
            tee = TeeEventLog(file_log, EventLog(stream, format="json", component="robot"))

            def report(thread: int) -> None:
                for number in range(200):
                    tee.event("count", thread=thread, number=number, padding="x" * 200)

            threads = [threading.Thread(target=report, args=(i,)) for i in range(4)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
        for text in (path.read_text(), stream.getvalue()):
            decoded = [json.loads(line) for line in text.splitlines()]
            for number in range(4):
                own = [line["number"] for line in decoded if line["thread"] == number]
                assert own == list(range(200))

    def test_a_signals_handler_may_report_too(self, tmp_path: Path) -> None:
        path = tmp_path / "events.jsonl"
        log = EventLog(path, format="json", component="robot")
        # A handler runs between any two instructions of the main thread, also in mid-event.
        before = signal.signal(signal.SIGALRM, lambda *_: log.event("handler"))
        try:
            signal.setitimer(signal.ITIMER_REAL, 0.001, 0.0005)
            for number in range(3000):
                log.event("main", number=number)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, before)
            log.close()
        decoded = [json.loads(line) for line in path.read_text().splitlines()]
        assert [line["number"] for line in decoded if line["event"] == "main"] == list(range(3000))
        assert {line["event"] for line in decoded} <= {"main", "handler"}

    def test_the_end_of_a_terminal_does_not_end_the_process(self) -> None:
        # As after SIGHUP: the process goes on, but its terminal is gone.
        program = textwrap.dedent("""
            import sys
            from holdfast.runtime.logs import EventLog
            log = EventLog(sys.stderr, component="robot")
            log.event("before")
            sys.stdin.readline()
            log.event("after")
            log.close()
            print("alive", log.lost)
        """)
        leader, follower = os.openpty()
        # Unbuffered: of what stays in a buffer, Python itself complains at the end (status 120).
        with subprocess.Popen(
            [sys.executable, "-u", "-c", program],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=follower,
            text=True,
        ) as process:
            os.close(follower)
            assert b"before" in os.read(leader, 200)
            os.close(leader)
            output, _ = process.communicate("\n", timeout=60)
        assert output == "alive 1\n"
        assert process.returncode == 0


class Told:
    """Keeps what is handed on."""

    def __init__(self) -> None:
        self.events: list[tuple[str, dict[str, object]]] = []
        self.closed = False

    def event(self, name: str, /, **fields: object) -> None:
        self.events.append((name, fields))

    def close(self) -> None:
        self.closed = True


class TestRepeatedEvents:
    def test_of_each_kind_and_service_one_a_second_after_a_burst(self) -> None:
        now, told = [0.0], Told()
        log = BoundedEventLog(told, lambda: now[0])
        for number in range(1000):
            log.event("refused", service="east", number=number)
            log.event("refused", service="west", number=number)
            log.event("status", service="east", number=number)
            log.event("holding", number=number)
        burst = [
            fields["number"] for name, fields in told.events if fields.get("service") == "west"
        ]
        assert burst == list(range(20))
        assert sum(name == "status" for name, _ in told.events) == 1000
        assert sum(name == "holding" for name, _ in told.events) == 1000
        told.events.clear()
        # The last that was left out is told when its time has come, with the number of the others.
        now[0] = 1.0
        log.event("holding", number=1000)
        assert told.events == [
            ("refused", {"service": service, "number": 999, "similar_lines_omitted": 979})
            for service in ("east", "west")
        ] + [("holding", {"number": 1000})]
        told.events.clear()
        log.event("refused", service="east", number=1000)
        log.event("refused", service="east", number=1001)
        now[0] = 2.5
        log.event("refused", service="east", number=1002)
        log.event("refused", service="east", number=1003)
        log.close()
        assert told.events == [
            ("refused", {"service": "east", "number": 1001, "similar_lines_omitted": 1}),
            ("refused", {"service": "east", "number": 1003, "similar_lines_omitted": 1}),
        ]
        assert told.closed

    def test_what_is_rare_is_told_at_once(self) -> None:
        now, told = [0.0], Told()
        log = BoundedEventLog(told, lambda: now[0])
        for number in range(100):
            log.event("refused", service="east", number=number)
            now[0] += 1.0
        assert told.events == [
            ("refused", {"service": "east", "number": number}) for number in range(100)
        ]


class TestOthers:
    def test_all_take_events_and_close(self) -> None:
        stream = io.StringIO()
        sinks: list[EventSink] = [
            NullEventLog(),
            EventLog(stream, component="robot"),
            TeeEventLog(NullEventLog(), EventLog(stream, component="robot")),
        ]
        for sink in sinks:
            sink.event("trial", trial=1)
            sink.close()
            sink.event("trial", trial=2)
            sink.close()
        assert stream.getvalue().count("trial 1") == 2
        assert "trial 2" not in stream.getvalue()

    def test_it_imports_nothing_heavy(self) -> None:
        program = "import sys, holdfast.runtime.logs; print(*sys.modules)"
        done = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, check=True
        )
        loaded = set(done.stdout.split())
        assert "holdfast.runtime.logs" in loaded
        assert not loaded & {"logging", "numpy", "rich", "typer", "prometheus_client", "yaml"}
