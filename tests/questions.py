"""What a robot asks in a state, as a request: the one place where tests put it together."""

from __future__ import annotations

from typing import Any

from holdfast.planning import PlanningState, digest
from holdfast.session.messages import DIGEST_SIZE, PROTOCOL_VERSION, Request

__all__ = ["request_of"]


def request_of(
    state: PlanningState, session: bytes, number: int, *, epoch: int = 1, **more: Any
) -> Request:
    """Return the question of a state; ``more`` is what else the service is told."""
    return Request(
        version=PROTOCOL_VERSION,
        session=session,
        epoch=epoch,
        number=number,
        trial=state.trial,
        step=state.step,
        sensed=state.sensed,
        digest=digest(state)[:DIGEST_SIZE],
        **more,
    )
