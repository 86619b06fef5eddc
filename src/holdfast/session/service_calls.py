"""What the robots that wait are told: the parts of their answers, and between these a sign of life.

A call is one request of a robot. It waits for a work, and may go on from one to the next: from the
task part to the sensing part that follows. As long as it waits it is told now and then that it is
not forgotten, for a robot takes silence as a sign that whoever it asked hangs. The end of a call
without an answer tells it that none will come.
"""

from __future__ import annotations

import hashlib
import math
from collections import OrderedDict

from holdfast.session.messages import (
    Busy,
    NeedState,
    Progress,
    Refused,
    SensingAnswer,
    TaskAnswer,
    encode,
)
from holdfast.session.service_effects import Answer, Effect, End, Noted
from holdfast.session.service_limits import ServiceLimits, ServiceStatistics
from holdfast.session.service_sessions import Part, WaitingCall, Work

__all__ = ["MAX_WORD", "Calls"]

MAX_WORD = 2**32 - 1
"""The largest number of milliseconds or microseconds in a reply."""

_MAX_TEXT = 4000

_PROGRESS_TOGETHER = 0.8
"""Calls this far into the interval are told with those that are due: fewer wake-ups."""

_FEW_CALLS = 64
"""When more wait, each is told less often, down to half as often: signs of life take their turn
from the answers that the robots wait for."""

_RETRY_SPREAD = 0.25
"""By up to this share robots are to come back later than they could, each by its own."""


class Calls:
    """The calls that wait, and the replies to any call.

    Parameters
    ----------
    limits : ServiceLimits
    statistics : ServiceStatistics
        What calls were told is counted there.
    effects : list of Effect
        Replies are added to it.
    """

    def __init__(
        self, limits: ServiceLimits, statistics: ServiceStatistics, effects: list[Effect]
    ) -> None:
        self._max_calls = limits.max_calls_per_request
        self._progress_s = 1e-3 * limits.progress_interval_ms
        self._statistics = statistics
        self._effects = effects
        # No sign for the longest first.
        self._calls: OrderedDict[int, WaitingCall] = OrderedDict()

    def __len__(self) -> int:
        return len(self._calls)

    # -- calls that wait -------------------------------------------------------------------------

    def attach(self, work: Work, call: int, number: int, now: float) -> None:
        """Let a call wait for a work."""
        record = WaitingCall(call, number, work, now)
        self._calls[call] = record
        work.calls[call] = record
        if len(work.calls) > self._max_calls:
            oldest = next(iter(work.calls))
            del work.calls[oldest], self._calls[oldest]
            self._effects.append(End(oldest))

    def pass_on(self, work: Work, rest: Work) -> None:
        """Let the calls of one work wait for another."""
        calls = list(work.calls.values())
        work.calls.clear()
        for record in calls:
            record.work = rest
            rest.calls[record.call] = record

    def released(self, work: Work) -> list[WaitingCall]:
        """Return the calls of a work, to be ended by whoever takes them."""
        released = list(work.calls.values())
        work.calls.clear()
        for record in released:
            del self._calls[record.call]
        return released

    def end(self, work: Work) -> None:
        """End the calls of a work."""
        self._effects += [End(record.call) for record in self.released(work)]

    # -- replies to calls that go on -------------------------------------------------------------

    def answer_task(self, work: Work, part: Part, now: float) -> None:
        """Tell the calls of a work the task part."""
        for record in work.calls.values():
            self._reply(record, _task_answer(record.number, part), now)

    def tell_progress(self, now: float) -> None:
        """Tell those that were told nothing for long that they still wait, or are in work."""
        due_at = self.progress_at()
        if due_at is None or due_at > now:
            return
        since = now - _PROGRESS_TOGETHER * self._interval_s()
        due = []
        for record in self._calls.values():
            if record.signed_at > since:
                break
            due.append(record)
        for record in due:
            self._reply(record, encode(Progress(record.number, not record.work.running)), now)

    def progress_at(self) -> float | None:
        """Return when the next call is to be told something; None if none waits."""
        first = next(iter(self._calls.values()), None)
        return None if first is None else first.signed_at + self._interval_s()

    def _interval_s(self) -> float:
        """Return how often a call is told that it still waits."""
        return self._progress_s * min(2.0, max(1.0, len(self._calls) / _FEW_CALLS))

    def _reply(self, record: WaitingCall, payload: bytes, now: float) -> None:
        self._effects.append(Answer(record.call, payload))
        record.signed_at = now
        self._calls.move_to_end(record.call)

    # -- replies to calls that do not wait, or no more -------------------------------------------

    def tell_task(self, call: int, number: int, part: Part) -> None:
        """Tell a call a task part that was known before."""
        self._effects.append(Answer(call, _task_answer(number, part)))

    def tell_sensing(self, call: int, number: int, digest: bytes, part: Part) -> None:
        """Tell a call a sensing part, and end it."""
        payload = encode(
            SensingAnswer(number, part.step, part.sensing_action, digest, part.computed_us)
        )
        self._effects += (Answer(call, payload), End(call))

    def need_state(self, call: int, number: int, *, differs: bool, diverged: bool = False) -> None:
        """End a call with the wish for the state."""
        self._statistics.state_requests += 1
        self._effects += (Answer(call, encode(NeedState(number, differs, diverged))), End(call))

    def turn_away(self, call: int, number: int, key: bytes, wait_ms: float, waiting: int) -> None:
        """End a call for lack of capacity.

        Parameters
        ----------
        call, number : int
        key : bytes
            Of the robot's session.
        wait_ms : float
            It is to come back no sooner.
        waiting : int
            Works that wait, for the log.
        """
        self._statistics.busy += 1
        # Robots that were turned away together shall not come back together.
        share = int.from_bytes(hashlib.blake2b(key, digest_size=2).digest(), "big") / 2**16
        spread = 1.0 + _RETRY_SPREAD * share
        retry_after_ms = min(MAX_WORD, math.ceil(wait_ms * spread))
        self._effects += (
            Answer(call, encode(Busy(number, retry_after_ms))),
            End(call),
            Noted("busy", {"waiting": waiting, "retry_after_ms": retry_after_ms}),
        )

    def refuse(self, call: int, number: int, code: str, text: str) -> None:
        """End a call with the reason why it is not answered."""
        refusals = self._statistics.refusals
        refusals[code] = refusals.get(code, 0) + 1
        # Texts of other people's errors may hold anything.
        text = text.encode("utf-8", "replace").decode()
        if len(text) > _MAX_TEXT:
            text = f"{text[: _MAX_TEXT - 3]}..."
        self._effects += (
            Answer(call, encode(Refused(number, code, text))),
            End(call),
            Noted("refused", {"code": code, "reason": text}),
        )


def _task_answer(number: int, part: Part) -> bytes:
    return encode(TaskAnswer(number, part.num_actions, part.actions, part.computed_us))
