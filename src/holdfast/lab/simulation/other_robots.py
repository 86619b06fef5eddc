"""Robots beside the one that is looked at: all that they do is ask."""

from __future__ import annotations

from holdfast.lab.simulation.memo_cache import Memo
from holdfast.planning import Planner
from holdfast.protocol.messages import (
    DIGEST_SIZE,
    PROTOCOL_VERSION,
    Request,
    SessionConfiguration,
    encode,
)

__all__ = ["OtherRobots"]

_MOST = 5_000


class OtherRobots:
    """What other robots ask: the same in every run, so it is put into bytes once."""

    def __init__(self, planner: Planner, seed: int) -> None:
        self._planner = planner
        self._seed = seed
        self._session_configuration = SessionConfiguration(
            planner.problem.name, {}, {}, planner.settings, seed
        )
        self._requests: Memo[tuple[int, int], bytes] = Memo(_MOST)

    def first_request(self, robot: int, trial: int) -> bytes:
        """Return the request of a robot, numbered from 1, for the start of a trial."""
        session = robot.to_bytes(16, "big")
        return self._requests.get((robot, trial), lambda: self._encoded(session, trial))

    def impostors_request(self, session: bytes, trial: int) -> bytes:
        """Return the same for a session that is another's, as its next process would ask."""
        return self._encoded(session, trial, epoch=2**31)

    def _encoded(self, session: bytes, trial: int, epoch: int = 1) -> bytes:
        state = self._planner.init(self._seed, trial)
        return encode(
            Request(
                PROTOCOL_VERSION,
                session,
                epoch=epoch,
                number=1,
                trial=trial,
                step=0,
                sensed=False,
                digest=self._planner.digest(state)[:DIGEST_SIZE],
                session_configuration=self._session_configuration,
            )
        )
