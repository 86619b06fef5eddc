"""Events: sinks, and the limit on repeated ones."""

import re
from pathlib import Path
from typing import Any

from holdfast.protocol.status import Status
from holdfast.runtime.events import _ERRORS, _WARNINGS, BoundedEventLog, severity

ROOT = Path(__file__).parents[2]
REPORTS = re.compile(
    r"\b_?(?:report|event|note|on_event|write_event|bounded)\("
    r"""\s*(?:trial,\s*|"robot", |options\.name, |component, )?"(?!robot")([a-z_]+)\""""
)


def test_the_pages_have_every_event_and_no_other() -> None:
    ros1 = (ROOT / "ros" / "holdfast_ros" / "holdfast_ros").glob("ros1_*.py")
    files = (*(ROOT / "src").rglob("*.py"), *ros1)
    reported = {name for file in files for name in REPORTS.findall(file.read_text("utf-8"))}
    assert "waiting" in reported
    listed: set[str] = set()
    for page, title in (("status.md", "Events"), ("operations.md", "The log")):
        text = (ROOT / "docs" / page).read_text("utf-8").partition(f"\n## {title}\n")[2]
        rows = re.findall(r"^\| (.+?) \|", text.partition("\n## ")[0], re.MULTILINE)
        listed |= {name for row in rows for name in re.findall("`([a-z_]+)`", row)}
    assert listed == reported | _WARNINGS | _ERRORS


class RecordingSink:
    """Keeps the events that it gets."""

    def __init__(self) -> None:
        self.events: list[tuple[str, dict[str, Any]]] = []
        self.closed = False

    def event(self, name: str, /, **fields: Any) -> None:
        self.events.append((name, fields))

    def close(self) -> None:
        self.closed = True


def test_the_worse_status_is_a_warning() -> None:
    found = {status: severity("status", {"to": status.value}) for status in Status}
    assert found == {
        Status.STANDARD: "INFO",
        Status.LOCAL_RECOVERY: "WARN",
        Status.KEEP_ALIVE: "INFO",
    }


class TestRepeatedEvents:
    def test_of_each_kind_and_service_one_a_second_after_a_burst(self) -> None:
        now, reported = [0.0], RecordingSink()
        log = BoundedEventLog(reported, clock=lambda: now[0])
        for number in range(1000):
            log.event("refused", service="east", number=number)
            log.event("refused", service="west", number=number)
            log.event("status", service="east", number=number)
            log.event("holding", number=number)
        burst = [
            fields["number"] for name, fields in reported.events if fields.get("service") == "west"
        ]
        assert burst == list(range(20))
        assert sum(name == "status" for name, _ in reported.events) == 1000
        assert sum(name == "holding" for name, _ in reported.events) == 1000
        reported.events.clear()
        # The last dropped one is reported when its time has come, with the number of others.
        now[0] = 1.0
        log.event("holding", number=1000)
        assert reported.events == [
            ("refused", {"service": service, "number": 999, "similar_lines_omitted": 979})
            for service in ("east", "west")
        ] + [("holding", {"number": 1000})]
        reported.events.clear()
        log.event("refused", service="east", number=1000)
        log.event("refused", service="east", number=1001)
        now[0] = 2.5
        log.event("refused", service="east", number=1002)
        log.event("refused", service="east", number=1003)
        log.close()
        assert reported.events == [
            ("refused", {"service": "east", "number": 1001, "similar_lines_omitted": 1}),
            ("refused", {"service": "east", "number": 1003, "similar_lines_omitted": 1}),
        ]
        assert reported.closed

    def test_what_is_rare_is_reported_at_once(self) -> None:
        now, reported = [0.0], RecordingSink()
        log = BoundedEventLog(reported, clock=lambda: now[0])
        for number in range(100):
            log.event("refused", service="east", number=number)
            now[0] += 1.0
        assert reported.events == [
            ("refused", {"service": "east", "number": number}) for number in range(100)
        ]
