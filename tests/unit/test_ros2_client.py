"""A client of a typed service on ROS 2's wire, and a service in this process that answers it."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.ports import free_port

from holdfast.config.loader import load
from holdfast.errors import InvalidValueError, TransportError
from holdfast.ros.active_sensing import ActiveSensing, DecisionRequest, ErrorCode, RequestKind
from holdfast.ros.ros2_client import Ros2Service
from holdfast.ros.ros2_service import Ros2Server

EXAMPLE = Path(__file__).parents[2] / "examples" / "peg_in_hole_2d.yaml"
BEGIN = DecisionRequest(RequestKind.INITIALIZE, seed=1)
PATIENCE_S = 30.0


def test_answers_and_refusals_come_back() -> None:
    port = free_port()
    answers = ActiveSensing(load(EXAMPLE))
    server = Ros2Server(answers, "cloud", 3, f"tcp/127.0.0.1:{port}", listens=True)
    server.start()
    with Ros2Service("/cloud", 3, f"tcp/127.0.0.1:{port}") as client:
        assert client.name == "cloud"
        answer = client.ask(BEGIN, PATIENCE_S)
        assert answer.error is ErrorCode.OK
        assert answer.configuration == answers.configuration
        other = client.ask(BEGIN._replace(configuration="another"), PATIENCE_S)
        assert other.error is ErrorCode.OTHER_CONFIGURATION
        server.take_no_more()
        assert client.ask(BEGIN, PATIENCE_S).error is ErrorCode.BUSY
    server.close(PATIENCE_S)


def test_without_a_service_the_reason_is_told() -> None:
    port = free_port()
    with (
        Ros2Service("cloud", 0, f"tcp/127.0.0.1:{port}") as client,
        pytest.raises(TransportError, match=f"tcp/127.0.0.1:{port}: "),
    ):
        client.ask(BEGIN, 0.0)
    with pytest.raises(TransportError, match="closed"):
        client.ask(BEGIN, PATIENCE_S)


@pytest.mark.parametrize(("name", "domain"), [("a b", 0), ("cloud", 233)])
def test_a_name_or_domain_that_ros_does_not_have_is_refused(name: str, domain: int) -> None:
    with pytest.raises(InvalidValueError):
        Ros2Service(name, domain)
