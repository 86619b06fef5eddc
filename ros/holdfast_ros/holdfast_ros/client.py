"""The robot's side of the typed service: the thesis's algorithm, without losing the belief.

The cloud decides. If it does not answer in time, the recovery service on the robot decides (*local
recovery*), and each request also goes to the cloud in the background. The cloud's first answer in
time makes it decide again, while the recovery service stays ready (*keep alive*). If neither
answers, the robot holds still and both are asked repeatedly. The state is in every request, so a
change of the service loses nothing.

Each service gets one request at a time, from a task of its own. A decision waits for these tasks
with a deadline, and never for a socket.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from time import monotonic
from typing import Protocol, Self

from holdfast.errors import HoldfastError, InvalidValueError, TransportError
from holdfast.protocol.status import Cause, Status, next_status
from holdfast_ros.active_sensing import (
    ANOTHER_MAY_ANSWER,
    DecisionAnswer,
    DecisionRequest,
    ErrorCode,
)
from holdfast_ros.loop_thread import LoopThread

_AGAIN_S = 0.05
"""A service that failed at once is not asked again before this time has passed."""

_MAX_DEADLINE_S = 3600.0


class DecisionService(Protocol):
    """A client of one service; ``name`` is the service's, for messages."""

    name: str

    async def ask(self, request: DecisionRequest, deadline_s: float) -> DecisionAnswer:
        """Ask, and wait at most ``deadline_s``; raise TransportError if there is no answer."""


class _Asker:
    """Asks one service, one request at a time.

    The deadline of a last resort doubles with each request that misses it, since asking anew would
    take even longer.
    """

    def __init__(
        self, service: DecisionService, deadline_s: float, *, is_last_resort: bool = False
    ) -> None:
        self.service = service
        self._deadline_s = deadline_s
        self._is_last_resort = is_last_resort
        self.task: asyncio.Task[DecisionAnswer | None] | None = None
        self.number = 0
        self.reason = ""
        self.took_s = 0.0
        self._not_before = 0.0

    def ask(self, number: int, request: DecisionRequest) -> None:
        """Ask, unless an earlier request is open or the last one has just failed."""
        if self.task is None and monotonic() >= self._not_before:
            self.number = number
            self.task = asyncio.create_task(self._work(request))

    async def _work(self, request: DecisionRequest) -> DecisionAnswer | None:
        began = monotonic()
        try:
            answer = await self.service.ask(request, self._deadline_s)
        except HoldfastError as error:
            self.reason = str(error)
        except Exception as error:  # noqa: BLE001 - whatever it is, the other service may answer
            self.reason = f"{type(error).__name__}: {error}"
        else:
            self.took_s = monotonic() - began
            if answer.error not in ANOTHER_MAY_ANSWER:
                return answer
            self.reason = f"{answer.error.name}: {answer.message}"
        self._not_before = monotonic() + _AGAIN_S
        if self._is_last_resort and monotonic() - began >= self._deadline_s:
            self._deadline_s = min(2 * self._deadline_s, _MAX_DEADLINE_S)
        return None


class ActiveSensingClient:
    """Asks the cloud, and the recovery service when the cloud does not answer.

    Both are asked on ``thread``, which is closed with the client. The cloud has ``deadline_s``, at
    most an hour, for an answer. ``on_event`` gets each change as ``on_event(name, **fields)``, on
    that thread: ``status`` (``status``, ``reason``) and ``holding`` (``reason``) while no service
    answers. By default they are logged as warnings of ``rosout.holdfast_ros``. ``decided_by`` is
    the name of the service whose answer was returned last.
    """

    def __init__(
        self,
        cloud: DecisionService,
        recovery: DecisionService,
        thread: LoopThread,
        deadline_s: float = 0.5,
        on_event: Callable[..., None] | None = None,
    ) -> None:
        if not 0 < deadline_s <= _MAX_DEADLINE_S:
            raise InvalidValueError(
                f"deadline_s {deadline_s}: it must be above 0 and at most {_MAX_DEADLINE_S:g} s"
            )
        self.status = Status.STANDARD
        self.decided_by = ""
        self._thread = thread
        self._deadline_s = deadline_s
        self._on_event = on_event or _log_event
        self._number = 0
        self._cloud = _Asker(cloud, deadline_s)
        self._recovery = _Asker(recovery, deadline_s, is_last_resort=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """End all requests; an open :meth:`decide` raises TransportError. May be repeated."""
        self._thread.close(self._deadline_s)

    def decide(self, request: DecisionRequest, give_up_s: float | None = None) -> DecisionAnswer:
        """Return a service's answer; while none answers, wait, at most ``give_up_s`` if given.

        Raises InvalidValueError if the request is invalid or the problem failed; the message gives
        the reason. Raises TransportError if no service has answered in time, or this is closed.
        """
        return self._thread.run(self._decide(request, give_up_s))

    async def _decide(self, request: DecisionRequest, give_up_s: float | None) -> DecisionAnswer:
        self._number += 1
        began = monotonic()
        held = False
        while True:
            for asker in (self._cloud, self._recovery):
                if (answer := self._taken(asker)) is not None:
                    return answer
            waited = monotonic() - began
            if give_up_s is not None and waited >= give_up_s:
                raise TransportError(f"nobody has answered in {give_up_s:g} s: {self._reasons()}")
            if self._cloud_decides and waited >= self._deadline_s:
                self._cloud.reason = f"no answer in {self._deadline_s:g} s"
                self._change(Cause.CLOUD_LOST, self._cloud.reason)
            if waited >= 2 * self._deadline_s and not held:
                held = True
                self._on_event("holding", reason=self._reasons())
            self._cloud.ask(self._number, request)
            if not self._cloud_decides:
                self._recovery.ask(self._number, request)
            left = self._deadline_s - waited
            pause_s = 0.01 if held else min(_AGAIN_S, left) if left > 0 else _AGAIN_S
            tasks = [each.task for each in (self._cloud, self._recovery) if each.task is not None]
            if tasks:
                await asyncio.wait(tasks, timeout=pause_s, return_when=asyncio.FIRST_COMPLETED)
            else:
                await asyncio.sleep(pause_s)

    @property
    def _cloud_decides(self) -> bool:
        return self.status is not Status.LOCAL_RECOVERY

    def _taken(self, asker: _Asker) -> DecisionAnswer | None:
        """Take a service's outcome if there is one; return it if it is the wanted answer."""
        if asker.task is None or not asker.task.done():
            return None
        answer, asker.task = asker.task.result(), None
        is_wanted = asker.number == self._number
        if asker is self._cloud:
            in_time = is_wanted or asker.took_s <= self._deadline_s
            if answer is None and self._cloud_decides:
                self._change(Cause.CLOUD_LOST, asker.reason)
            elif answer is not None and in_time and not self._cloud_decides:
                self._change(Cause.CLOUD_ANSWERED, "")
        if answer is None or not is_wanted:
            return None
        self.decided_by = asker.service.name
        if answer.error is not ErrorCode.OK:
            raise InvalidValueError(f"{self.decided_by}: {answer.error.name}: {answer.message}")
        return answer

    def _change(self, cause: Cause, reason: str) -> None:
        self.status = next_status(self.status, cause)
        self._on_event("status", status=self.status.value, reason=reason)

    def _reasons(self) -> str:
        return "; ".join(
            f"{asker.service.name}: {asker.reason or 'no answer yet'}"
            for asker in (self._cloud, self._recovery)
        )


def _log_event(name: str, **fields: object) -> None:
    words = " ".join(f"{key}={value}" for key, value in fields.items() if value)
    # A node of rospy shows what is below rosout, on its terminal and in /rosout.
    logging.getLogger("rosout.holdfast_ros").warning("%s: %s", name, words)
