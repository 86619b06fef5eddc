"""``holdfast ros1-serve`` starts only if all that it is to offer can be offered."""

import sys
from pathlib import Path

import pytest
from tests.command_line import Workplace

from holdfast_ros import messages

EXAMPLE = Path(__file__).parents[2] / "examples" / "peg_in_hole_2d.yaml"


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ([], "--configuration is missing"),
        (["--configuration", "x.yaml", "--processes", "2"], "--processes 2: a node of ROS 1 is"),
        (["--configuration", "none.yaml"], "there is no such file"),
        (["--configuration", str(EXAMPLE), "--ros1-name", "a-b"], "--ros1-name: 'a-b' is no name"),
        (["--configuration", str(EXAMPLE), "--workers", "0"], "from 1 to 256"),
    ],
)
def test_it_says_why(
    arguments: list[str], text: str, workplace: Workplace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_HOSTNAME", "127.0.0.1")
    assert text in workplace.fails("ros1-serve", *arguments)


def test_an_address_that_others_reach_is_refused(
    workplace: Workplace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_IP", "192.0.2.1")
    monkeypatch.delenv("ROS_HOSTNAME", raising=False)
    said = workplace.fails("ros1-serve", "--configuration", str(EXAMPLE))
    assert "no peer proves its identity" in said


def test_it_says_what_it_lacks(workplace: Workplace, monkeypatch: pytest.MonkeyPatch) -> None:
    messages.typestore.cache_clear()
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    monkeypatch.setenv("ROS_HOSTNAME", "127.0.0.1")
    said = workplace.fails("ros1-serve", "--configuration", str(EXAMPLE))
    assert "ROS messages need rosbags: pip install rosbags" in said
