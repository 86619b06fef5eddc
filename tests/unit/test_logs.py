"""The event log: where lines go, and that no target hurts the process that writes to it."""

import contextlib
import io
import json
import os
import signal
import subprocess
import sys
import textwrap
import threading
from pathlib import Path

import pytest
from tests.unit.test_log_lines import CHANGE

from holdfast.errors import OutputError
from holdfast.runtime.events import BoundedEventLog
from holdfast.runtime.logs import EventLog


class TestTargets:
    def test_a_closed_stream_costs_the_line_alone(self) -> None:
        stream = io.StringIO()
        log = EventLog(stream, component="robot")
        stream.close()
        log.event("status", **CHANGE)

    def test_a_reader_that_went_away_costs_the_lines_alone(self) -> None:
        reading, writing = os.pipe()
        stream = os.fdopen(writing, "w", encoding="utf-8")
        os.close(reading)
        log = EventLog(stream, component="robot")
        for _ in range(3):
            log.event("status", **CHANGE)
        log.close()
        with contextlib.suppress(BrokenPipeError):
            stream.close()

    def test_a_reader_that_does_not_read_holds_nobody_up(self) -> None:
        reading, writing = os.pipe()
        stream = os.fdopen(writing, "w", encoding="utf-8")
        log = EventLog(stream, component="robot")
        for _ in range(2_000):  # more than a pipe holds
            log.event("status", **CHANGE)
        log.close()
        os.close(reading)
        with contextlib.suppress(OSError):
            stream.close()

    @pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
    def test_a_full_disk_costs_the_line_alone(self) -> None:
        with EventLog("/dev/full", component="robot") as log:
            log.event("status", **CHANGE)

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
        assert not stream.closed
        assert stream.getvalue() == path.read_text() == ""

    def test_threads_do_not_mix_their_lines(self, tmp_path: Path) -> None:
        path = tmp_path / "events.jsonl"
        stream = io.StringIO()
        with EventLog(path, format="json", component="robot") as file_log:
            tee = BoundedEventLog(file_log, EventLog(stream, format="json", component="robot"))

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
            for number in range(3000):
                # One in each event: at an interval, they might never let a slow disk finish one.
                signal.setitimer(signal.ITIMER_REAL, 1e-6 * (1 + number % 16))
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
            print("alive")
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
        assert output == "alive\n"
        assert process.returncode == 0

    def test_it_imports_nothing_heavy(self) -> None:
        program = "import sys, holdfast.runtime.logs; print(*sys.modules)"
        done = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, check=True
        )
        loaded = set(done.stdout.split())
        assert "holdfast.runtime.logs" in loaded
        assert not loaded & {"logging", "pickle", "numpy", "rich", "prometheus_client", "yaml"}
