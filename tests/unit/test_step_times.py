"""The clock of a recorded run: recorded times are kept, others are spread evenly."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from holdfast.errors import OutputError
from holdfast.journal.run_clock import RunClock
from holdfast.journal.timings import TimingRow, rows_by_trial
from holdfast.protocol.robot_events import Timing
from holdfast.reports.step_times import MOMENTS, NS_PER_S, StepClock, dated, read_events, trial_ends


def row(step: int, kind: str, time_ns: int) -> TimingRow:
    return TimingRow(Timing(0, step, kind, "local", "standard", 0.0, 0.0, 0.0), time_ns)


def test_without_times_every_step_takes_the_same() -> None:
    clock = StepClock(NS_PER_S)
    first = clock.next_trial(3, {}, None)
    assert np.array_equal(np.diff(first), np.full(4 * MOMENTS - 1, NS_PER_S // MOMENTS))
    assert clock.next_trial(1, {}, None)[0] == first[3 * MOMENTS] + NS_PER_S


def test_recorded_times_are_kept_and_the_others_are_between_them() -> None:
    start = 1_700_000_000 * NS_PER_S
    rows = {
        (0, "sensing"): row(0, "sensing", start),
        (2, "task"): row(2, "task", start + 10 * NS_PER_S),
    }
    times = StepClock(NS_PER_S).next_trial(3, rows, start + 12 * NS_PER_S)
    assert times[0] == start
    assert times[2 * MOMENTS + 2] == start + 10 * NS_PER_S
    assert times[3 * MOMENTS] == start + 12 * NS_PER_S
    assert times[MOMENTS + 1] == start + 5 * NS_PER_S


def test_a_clock_that_was_set_back_is_not_followed() -> None:
    start = 1_700_000_000 * NS_PER_S
    rows = {
        (0, "sensing"): row(0, "sensing", start),
        (1, "sensing"): row(1, "sensing", start - NS_PER_S),
        (2, "sensing"): row(2, "sensing", start + 2 * NS_PER_S),
    }
    times = StepClock(NS_PER_S).next_trial(3, rows, None)
    assert np.all(np.diff(times) > 0)
    assert times[MOMENTS] == start + NS_PER_S


def test_what_is_no_file_is_not_waited_for(tmp_path: Path) -> None:
    """In somebody else's run; and a line has its bound."""
    path = tmp_path / "events.jsonl"
    os.mkfifo(path)
    with pytest.raises(OutputError, match="it is no file"):
        read_events(path)
    with pytest.raises(OutputError, match="it is no file"):
        rows_by_trial(path)
    path.unlink()
    path.write_text("[" * 3_000_000 + '\n{"time": "2023-11-14T22:13:21Z", "event": "trial"}\n')
    assert [event.name for event in read_events(path)] == ["trial"]


def test_events_in_order_without_the_damaged_ones(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    assert read_events(path) == []
    lines = [
        {"time": "2023-11-14T22:13:21Z", "event": "trial", "trial": 0},
        {"time": "2023-11-14T22:13:20Z", "event": "status", "status": "standard"},
        {"time": "yesterday", "event": "status"},
    ]
    path.write_text("\n".join([*map(json.dumps, lines), '{"time": "2023']))
    events = read_events(path)
    assert [event.name for event in dated(events, RunClock([]))] == ["status", "trial"]
    assert trial_ends(events) == {0: 1_700_000_001 * NS_PER_S}
