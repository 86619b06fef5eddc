"""The typed service in ROS 1 while it is asked for more than it can do, and at its end."""

import asyncio
import threading
from pathlib import Path

import pytest

from holdfast.config.loader import load
from holdfast_ros import messages, ros1_service
from holdfast_ros.active_sensing import DecisionRequest, ErrorCode, RequestKind
from holdfast_ros.messages import decode_answer, encode_request
from holdfast_ros.ros1_environment import RosEnvironment
from holdfast_ros.ros1_service import Ros1Server

EXAMPLE = Path(__file__).parents[2] / "examples" / "peg_in_hole_2d.yaml"
PATIENCE_S = 30.0


async def test_too_many_are_refused_and_what_is_owed_is_answered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    may_answer = threading.Event()
    answer = messages.answer_message

    def held(*arguments: object) -> bytes:
        assert may_answer.wait(PATIENCE_S)
        return answer(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(ros1_service, "answer_message", held)
    monkeypatch.setattr(ros1_service, "MAX_WAITING", 1)
    server = Ros1Server(load(EXAMPLE), ros_environment=RosEnvironment("http://x:1", "x", "x", "/"))
    asked = encode_request(DecisionRequest(RequestKind.INITIALIZE, seed=1))
    owed = [asyncio.create_task(server._answer(asked)) for _ in range(2)]
    await asyncio.sleep(0)
    refused = decode_answer(await server._answer(asked))
    assert (refused.error, refused.message) == (ErrorCode.BUSY, "1 requests are waiting already")
    server.take_no_more()
    is_busy = [server.is_busy]
    may_answer.set()
    assert [decode_answer(each).error for each in await asyncio.gather(*owed)] == [ErrorCode.OK] * 2
    assert [*is_busy, server.is_busy] == [True, False]
    late = decode_answer(await server._answer(asked))
    assert (late.error, late.message) == (ErrorCode.BUSY, "this service ends")
