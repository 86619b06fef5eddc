"""The demo's timeline and its findings as text, without a terminal."""

import io
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from holdfast.reports.compare import Comparison, Difference
from holdfast_lab.demo.command import account
from holdfast_lab.demo.narrator import Activity, Change, DemoState, Mark
from holdfast_lab.demo.scenario import Findings
from holdfast_lab.demo.timeline import ASCII, UNICODE, legend, timeline
from holdfast_lab.testbed.fault_times import FaultTimes


def state() -> DemoState:
    """Ten seconds: the cloud is killed at 3 s and used again from 7 s on."""
    return DemoState(
        title="peg",
        expected_s=10.0,
        changes={
            "cloud": [
                Change(0.0, "starting"),
                Change(1.0, "deciding"),
                Change(3.0, "off"),
                Change(6.0, "starting"),
                Change(7.0, "deciding"),
            ],
            "local": [Change(3.0, "starting"), Change(4.0, "deciding"), Change(7.0, "ready")],
            "robot": [
                Change(0.5, "starting"),
                Change(1.0, "by_cloud"),
                Change(3.0, "by_local"),
                # Less than a cell, and within one.
                Change(3.51, "held"),
                Change(3.52, "by_local"),
                Change(7.0, "by_cloud"),
            ],
        },
        marks=[
            Mark(0.0, "cloud", "start"),
            Mark(3.0, "cloud", "kill"),
            Mark(6.0, "cloud", "start"),
        ],
    )


def drawn(now_s: float, width: int, of: DemoState | None = None) -> list[str]:
    console = Console(file=io.StringIO(), width=width + 1, color_system=None)
    with console.capture() as capture:
        console.print(timeline(of or state(), now_s, width, ASCII))
    return [line.rstrip() for line in capture.get().splitlines()]


def test_bars() -> None:
    # 40 cells of a quarter of a second.
    assert drawn(9.8, 49) == [
        "        0 s     2 s     4 s     6 s     8 s",
        "cloud   ^...########X           ^...############",
        "local               ....############------------",
        "robot     ..CCCCCCCCLL!LLLLLLLLLLLLLCCCCCCCCCCCC",
    ]


@pytest.mark.parametrize("expected_s", [1.0, 10.0, 1000.0])
def test_no_kill_and_no_start_is_lost(expected_s: float) -> None:
    """However many there are within one cell."""
    marks = [
        Mark(0.5, "robot", "start"),
        Mark(0.501, "robot", "kill"),
        Mark(0.502, "robot", "start"),
        Mark(0.503, "robot", "kill"),
    ]
    robot = drawn(0.6, 80, DemoState(expected_s=expected_s, marks=marks))[3]
    assert robot.endswith("^X^X")


def test_characters_say_as_much_as_colours() -> None:
    for characters in (UNICODE, ASCII):
        shown = [*characters.values()]
        assert len(set(shown)) == len(shown)
        assert all(len(text) == 1 for text in shown)
        said = legend(characters).plain
        assert len(said) <= 79
        activities: tuple[Activity, ...] = ("deciding", "ready", "by_cloud", "by_local", "held")
        for activity in activities:
            assert characters[activity] in said
    assert legend(ASCII).plain.isascii()


def times(kind: str, **measured: float) -> FaultTimes:
    fields: dict[str, Any] = dict.fromkeys(FaultTimes.__struct_fields__)
    return FaultTimes(**{**fields, "kind": kind, "target": "", "in_use": True, **measured})


def findings(*, identical: bool) -> Findings:
    cold = times(
        "cloud_killed",
        detection_ms=8.4,
        recovery_ms=329.4,
        longest_wait_ms=234.5,
        launch_ms=254.4,
        failback_ms=62.0,
    )
    warm = times(
        "cloud_killed", detection_ms=9.0, recovery_ms=23.0, longest_wait_ms=12.0, failback_ms=70.0
    )
    difference = Difference(what="sensing action", trial=1, step=9, first="0", second="2")
    return Findings(
        outages=(cold, warm),
        listening_ms=(190.0, 195.0),
        robot_kill=times("robot_killed", recovery_ms=417.0),
        statuses=(["standard", "local_recovery", "keep_alive"], ["standard"]),
        comparison=Comparison(
            identical=identical,
            first_run="a",
            second_run="b",
            trials=5,
            sensing_actions=51,
            task_actions=438,
            difference=None if identical else difference,
            notes=(),
        ),
    )


def test_account() -> None:
    text = account(findings(identical=True), Path("out"))
    words = [" ".join(line.split()) for line in text.splitlines()]
    assert "cloud killed -> found 8 ms 9 ms" in words
    assert "found -> first local decision 321 ms 14 ms" in words
    assert "longest wait for a decision 234 ms 12 ms" in words
    assert "local service: spawned -> up 254 ms -" in words
    assert "cloud: spawned -> listening 190 ms 195 ms" in words
    assert "cloud: listening -> used again 62 ms 70 ms" in words
    assert "robot killed -> acting again 417 ms" in words
    assert "  standard -> local_recovery -> keep_alive\n  after its restart: standard\n" in text
    assert (
        "The decisions are those of the run without kills:\n"
        "identical: 5 trials, 51 sensing actions, 438 task actions and every state digest\n"
    ) in text
    assert "  holdfast compare out/undisturbed out/killed\n" in text
    assert max(map(len, text.splitlines())) <= 80
    assert text.isascii()


def test_account_of_a_difference() -> None:
    text = account(findings(identical=False), Path("out"))
    assert "NOT those of the run without kills:\ndifferent: trial 1, step 9, sensing action" in text
    assert "identical" not in text
