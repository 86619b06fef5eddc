"""``holdfast ros1-guard`` before it starts a master; tests/ros has the rest."""

import pytest
from tests.command_line import Workplace


@pytest.mark.parametrize("log", ["text", "json"])
def test_a_master_at_no_address_is_refused(
    log: str, workplace: Workplace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_MASTER_URI", "nowhere")
    said = workplace.run("ros1-guard", "--log", log)
    assert said.code == 2
    assert "ROS_MASTER_URI is 'nowhere'; expected http://HOST:PORT" in said.stderr
