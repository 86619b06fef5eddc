"""The robot's side of the typed service: the thesis's algorithm, without losing the belief.

The cloud decides. If it does not answer in time, the recovery service on the robot decides (*local
recovery*), and each request also goes to the cloud in the background. The cloud's first answer in
time makes it decide again, while the recovery service stays ready (*keep alive*). If neither
answers, the robot holds still and both are asked repeatedly. The state is in every request, so a
change of the service loses nothing.

One thread for each service sends the requests, one at a time. A decision waits for these threads
and never for a socket, so no call exceeds its deadline.
"""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable
from time import monotonic
from typing import NamedTuple, Protocol, Self

from holdfast.errors import HoldfastError, InvalidValueError, TransportError
from holdfast.protocol.status import Cause, Status, next_status
from holdfast_ros.active_sensing import (
    ANOTHER_MAY_ANSWER,
    DecisionAnswer,
    DecisionRequest,
    ErrorCode,
)

__all__ = ["ActiveSensingClient", "DecisionService"]

_AGAIN_S = 0.05
"""A service that failed at once is not asked again before this time has passed."""

_MAX_DEADLINE_S = 3600.0


class DecisionService(Protocol):
    """A client of one service."""

    @property
    def name(self) -> str:
        """Name of the service, for messages."""

    def ask(self, request: DecisionRequest, deadline_s: float) -> DecisionAnswer:
        """Ask, and wait at most ``deadline_s`` for the answer.

        Raises
        ------
        TransportError
            If there is no answer; the message gives the reason.
        """

    def close(self) -> None:
        """End all requests; may be called from another thread, and repeated."""


class _Outcome(NamedTuple):
    asker: _Asker
    number: int
    answer: DecisionAnswer | None
    reason: str
    took_s: float


class _Asker:
    """Asks one service on its own thread, one request at a time.

    The deadline of a last resort doubles with each request that misses it, since asking anew would
    take even longer.
    """

    def __init__(
        self,
        service: DecisionService,
        deadline_s: float,
        outcomes: queue.SimpleQueue[_Outcome | None],
        *,
        is_last_resort: bool = False,
    ) -> None:
        self.service = service
        self._deadline_s = deadline_s
        self._is_last_resort = is_last_resort
        self._outcomes = outcomes
        self._requests: queue.SimpleQueue[tuple[int, DecisionRequest] | None] = queue.SimpleQueue()
        self.busy = False
        self.reason = ""
        self.not_before = 0.0
        self._thread = threading.Thread(target=self._work, name=service.name, daemon=True)
        self._thread.start()

    def ask(self, number: int, request: DecisionRequest) -> None:
        """Ask, unless an earlier request is open or the last one has just failed."""
        if not self.busy and monotonic() >= self.not_before:
            self.busy = True
            self._requests.put((number, request))

    def take(self, outcome: _Outcome) -> None:
        """Note an outcome of this service."""
        self.busy = False
        self.reason = outcome.reason
        self.not_before = 0.0 if outcome.answer is not None else monotonic() + _AGAIN_S

    def close(self) -> None:
        """End the thread."""
        self._requests.put(None)
        self.service.close()
        self._thread.join(self._deadline_s)

    def _work(self) -> None:
        while (asked := self._requests.get()) is not None:
            number, request = asked
            began = monotonic()
            answer: DecisionAnswer | None = None
            reason = ""
            try:
                answer = self.service.ask(request, self._deadline_s)
            except HoldfastError as error:
                reason = str(error)
            except Exception as error:  # noqa: BLE001 - a thread that ends would never answer
                reason = f"{type(error).__name__}: {error}"
            if answer is not None and answer.error in ANOTHER_MAY_ANSWER:
                reason = f"{answer.error.name}: {answer.message}"
                answer = None
            took_s = monotonic() - began
            if answer is None and self._is_last_resort and took_s >= self._deadline_s:
                self._deadline_s = min(2 * self._deadline_s, _MAX_DEADLINE_S)
            self._outcomes.put(_Outcome(self, number, answer, reason, took_s))


class ActiveSensingClient:
    """Asks the cloud, and the recovery service when the cloud does not answer.

    Parameters
    ----------
    cloud, recovery : Service
        They are closed with the client.
    deadline_s : float
        The cloud's time for an answer. After a miss it decides again once it answers within this
        time. The recovery service, the last resort, gets more with each request that takes longer.
    on_event : callable or None
        Gets each change as ``on_event(name, **fields)``: ``status`` (``status``, ``reason``) and
        ``holding`` (``reason``) while no service answers. By default they are logged as warnings
        of ``holdfast_ros``.

    Attributes
    ----------
    decided_by : str
        Name of the service whose answer was returned last.

    Raises
    ------
    InvalidValueError
        If ``deadline_s`` is not above 0 and at most 3600.
    """

    def __init__(
        self,
        cloud: DecisionService,
        recovery: DecisionService,
        deadline_s: float = 0.5,
        on_event: Callable[..., None] | None = None,
    ) -> None:
        if not 0 < deadline_s <= _MAX_DEADLINE_S:
            raise InvalidValueError(
                f"deadline_s {deadline_s}: it must be above 0 and at most {_MAX_DEADLINE_S:g} s"
            )
        self.status = Status.STANDARD
        self.decided_by = ""
        self._deadline_s = deadline_s
        self._on_event = on_event or _log
        self._number = 0
        self._closed = False
        self._outcomes: queue.SimpleQueue[_Outcome | None] = queue.SimpleQueue()
        self._cloud = _Asker(cloud, deadline_s, self._outcomes)
        self._recovery = _Asker(recovery, deadline_s, self._outcomes, is_last_resort=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """End all requests; an open :meth:`decide` raises TransportError. May be repeated."""
        self._closed = True
        self._outcomes.put(None)
        self._cloud.close()
        self._recovery.close()

    def decide(self, request: DecisionRequest, give_up_s: float | None = None) -> DecisionAnswer:
        """Return a service's answer; while none answers, wait.

        Parameters
        ----------
        give_up_s : float or None
            Longest wait; None waits until a service answers.

        Raises
        ------
        InvalidValueError
            If the request is invalid or the problem failed; the message gives the reason.
        TransportError
            If no service has answered in time, or this is closed.
        """
        self._number += 1
        began = monotonic()
        until = began + self._deadline_s
        held = False
        self._hear(0.0)
        while True:
            if self._cloud_decides and monotonic() >= until:
                self._cloud_is_lost(f"no answer in {self._deadline_s:g} s")
            self._cloud.ask(self._number, request)
            if not self._cloud_decides:
                self._recovery.ask(self._number, request)
            # Time itself matters when the deadline is over.
            left = until - monotonic()
            answer = self._hear(0.01 if held else min(_AGAIN_S, left) if left > 0 else _AGAIN_S)
            if answer is not None:
                return answer
            waited = monotonic() - began
            if give_up_s is not None and waited >= give_up_s:
                raise TransportError(f"nobody has answered in {give_up_s:g} s: {self._reasons()}")
            if waited >= 2 * self._deadline_s and not held:
                held = True
                self._on_event("holding", reason=self._reasons())

    @property
    def _cloud_decides(self) -> bool:
        return self.status is not Status.LOCAL_RECOVERY

    def _hear(self, timeout_s: float) -> DecisionAnswer | None:
        """Take the available outcomes, after waiting for one; stop at the wanted answer."""
        block = timeout_s > 0
        while True:
            try:
                outcome = self._outcomes.get(block, max(timeout_s, 0.0) if block else None)
            except queue.Empty:
                return None
            block = False
            if outcome is None or self._closed:
                self._outcomes.put(None)  # for the next caller
                raise TransportError("this client is closed")
            outcome.asker.take(outcome)
            answered = outcome.answer is not None
            if outcome.asker is self._cloud:
                is_wanted = outcome.number == self._number or outcome.took_s <= self._deadline_s
                if answered and is_wanted and not self._cloud_decides:
                    self._change(Cause.CLOUD_ANSWERED, "")
                elif not answered and self._cloud_decides:
                    self._cloud_is_lost(outcome.reason)
            if outcome.answer is not None and outcome.number == self._number:
                self.decided_by = outcome.asker.service.name
                if outcome.answer.error is not ErrorCode.OK:
                    raise InvalidValueError(
                        f"{self.decided_by}: {outcome.answer.error.name}: {outcome.answer.message}"
                    )
                return outcome.answer

    def _cloud_is_lost(self, reason: str) -> None:
        self._cloud.reason = reason
        self._change(Cause.CLOUD_LOST, reason)

    def _change(self, cause: Cause, reason: str) -> None:
        self.status = next_status(self.status, cause)
        self._on_event("status", status=self.status.value, reason=reason)

    def _reasons(self) -> str:
        return "; ".join(
            f"{asker.service.name}: {asker.reason or 'no answer yet'}"
            for asker in (self._cloud, self._recovery)
        )


def _log(name: str, **fields: object) -> None:
    """Log an event, by default as a line on the standard error."""
    words = " ".join(f"{key}={value}" for key, value in fields.items() if value)
    logging.getLogger("holdfast_ros").warning("%s: %s", name, words)
