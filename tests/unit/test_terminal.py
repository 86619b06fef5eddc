"""What a person sees of a run's progress and times."""

from __future__ import annotations

import pytest

from holdfast.cli.terminal import counted, duration, progress_line


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.25, "0.25 s"), (5.0, "5.0 s"), (185.0, "3 min 05 s"), (7260.0, "2 h 01 min")],
)
def test_a_duration(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_a_count() -> None:
    assert [counted(number, "trial") for number in (0, 1, 1000)] == [
        "0 trials",
        "1 trial",
        "1,000 trials",
    ]


@pytest.mark.parametrize("quiet", [True, False])
def test_progress_without_a_terminal(quiet: bool, capsys: pytest.CaptureFixture[str]) -> None:
    line = progress_line(10, quiet=quiet)
    line.start("ten trials in \x1b[2J", 0, "no success")
    line.show(1, "no success")  # too soon after the start for a line of its own
    line.say("a note")
    line.stop()
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err == ("" if quiet else "ten trials in \\x1b[2J\na note\n")
