"""What a person sees of a run's progress and times."""

import pytest
from tests.recordings import result_of

from holdfast.cli.terminal import counted, duration, print_summary, progress_line
from holdfast.journal.tables import SummaryBuilder


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.25, "0.25 s"), (5.0, "5.0 s"), (185.0, "3 min 05 s"), (7260.0, "2 h 01 min")],
)
def test_a_duration(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_the_summary_says_which_mean_of_the_steps_it_has(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """``compare --outcomes`` has another, of which ratios can be taken."""
    summary = SummaryBuilder()
    for trial in (0, 1):
        summary.add(result_of(trial))
    built = summary.build(problem="peg", seed=1, version="1", trials=2, wall_time_s=1.0)
    print_summary(built)
    assert f"{built.mean_steps:.4g}  (of the steps made)" in capsys.readouterr().out


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
