"""Stories: what goes wrong, and all that follows from it, as text that a person can judge.

``pytest tests/scenarios --rewrite-stories`` writes the traces anew; the difference is then to be
read like any other change of behaviour.
"""

from pathlib import Path

import pytest

from holdfast_lab.simulation.schedule import parse_schedule
from holdfast_lab.simulation.story import RunOutcome, story_lines
from holdfast_lab.simulation.world import Simulator

STORIES = sorted(Path(__file__).parent.glob("*.story"))
RULE = "----\n"


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    return Simulator()


def ending(outcome: RunOutcome) -> str:
    if outcome.violation is not None:
        return f"VIOLATION: {outcome.violation}"
    if outcome.held is not None:
        return f"the robot holds still: {outcome.held}"
    return "decided as without faults"


@pytest.mark.parametrize("path", STORIES, ids=lambda path: path.stem)
def test_story(path: Path, simulator: Simulator, request: pytest.FixtureRequest) -> None:
    commands, _, expected = path.read_text(encoding="utf-8").partition(RULE)
    outcome = simulator.run(parse_schedule(commands), tell=True)
    told = "".join(f"{line}\n" for line in [*story_lines(outcome), "", ending(outcome)])
    if request.config.getoption("--rewrite-stories"):
        path.write_text(f"{commands}{RULE}{told}", encoding="utf-8")
    else:
        assert told.splitlines() == expected.splitlines()
    assert outcome.violation is None


def test_there_are_stories() -> None:
    assert len(STORIES) >= 15
