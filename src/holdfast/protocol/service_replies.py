"""Replies to robots: parts of answers, and signs of life in between.

A call is one request of a robot. It waits for a task, and may move on from the task part to the
sensing part that follows. While it waits the robot is told so regularly, since a robot takes
silence for a hung process. A call that ends without an answer tells the robot that none will come.
"""

from __future__ import annotations

import hashlib
import math
from collections import OrderedDict

from holdfast.protocol.effects import Effects
from holdfast.protocol.messages import (
    MAX_TEXT,
    MAX_WORD,
    Busy,
    NeedState,
    Progress,
    Refused,
    Reply,
    SensingAnswer,
    TaskAnswer,
    encode,
)
from holdfast.protocol.service_jobs import EndCall, SendReply, ServiceEffect
from holdfast.protocol.service_limits import ServiceLimits, ServiceStatistics
from holdfast.protocol.service_sessions import CachedAnswer, PendingTask

_PROGRESS_TOGETHER = 0.8
"""Calls this far into the interval get their progress together with those due: fewer wakeups."""

_FEW_CALLS = 64
"""With more calls each gets progress up to half as often, to save time for answers."""

_RETRY_SPREAD = 0.25
"""Robots are told to retry up to this share later, each by its own amount."""


class WaitingCall:
    """A call (one request of a robot) that waits for a task, and when it got its last reply."""

    def __init__(self, call: int, number: int, task: PendingTask, last_sign_at: float) -> None:
        self.call = call
        self.number = number
        self.task = task
        self.last_sign_at = last_sign_at


class WaitingCalls:
    """The calls that wait, and the replies to any call."""

    def __init__(
        self, limits: ServiceLimits, statistics: ServiceStatistics, effects: Effects[ServiceEffect]
    ) -> None:
        self._max_calls = limits.max_calls_per_request
        self._progress_s = 1e-3 * limits.progress_interval_ms
        self._statistics = statistics
        self._effects = effects
        # No sign for the longest first.
        self._calls: OrderedDict[int, WaitingCall] = OrderedDict()
        self._of: dict[PendingTask, dict[int, WaitingCall]] = {}

    def __len__(self) -> int:
        return len(self._calls)

    # -- calls that wait -------------------------------------------------------------------------

    def is_awaited(self, task: PendingTask) -> bool:
        """Return whether a call waits for a task."""
        return task in self._of

    def attach(self, task: PendingTask, call: int, number: int, now: float) -> None:
        """Let a call wait for a task."""
        calls = self._of.setdefault(task, {})
        calls[call] = self._calls[call] = WaitingCall(call, number, task, now)
        if len(calls) > self._max_calls:
            oldest = next(iter(calls))
            del calls[oldest], self._calls[oldest]
            self._effects.append(EndCall(oldest))

    def move(self, task: PendingTask, rest: PendingTask) -> None:
        """Let the calls of one task wait for another."""
        calls = self._of.pop(task)
        for record in calls.values():
            record.task = rest
        self._of.setdefault(rest, {}).update(calls)

    def detach(self, task: PendingTask) -> list[WaitingCall]:
        """Remove and return the calls of a task; the caller ends them."""
        detached = list(self._of.pop(task, {}).values())
        for record in detached:
            del self._calls[record.call]
        return detached

    def end(self, task: PendingTask) -> None:
        """End the calls of a task."""
        self._effects += [EndCall(record.call) for record in self.detach(task)]

    def drop(self, call: int) -> PendingTask | None:
        """Remove a call that has ended by itself; return its task if no other waits for that."""
        record = self._calls.pop(call, None)
        if record is None:
            return None
        del self._of[record.task][call]
        if self._of[record.task]:
            return None
        del self._of[record.task]
        return record.task

    # -- replies to calls that go on -------------------------------------------------------------

    def send_task_to_all(self, task: PendingTask, answer: CachedAnswer, now: float) -> None:
        """Send a task part to all calls of a task."""
        for record in self._of.get(task, {}).values():
            self._reply(record, _task_answer(record.number, answer), now)

    def send_progress(self, now: float) -> None:
        """Send progress to the calls that got no reply for long."""
        due_at = self.progress_at()
        if due_at is None or due_at > now:
            return
        since = now - _PROGRESS_TOGETHER * self._interval_s()
        due = []
        for record in self._calls.values():
            if record.last_sign_at > since:
                break
            due.append(record)
        for record in due:
            self._reply(record, encode(Progress(record.number, not record.task.running)), now)

    def progress_at(self) -> float | None:
        """Return when progress is due; None if no call waits."""
        first = next(iter(self._calls.values()), None)
        return None if first is None else first.last_sign_at + self._interval_s()

    def _interval_s(self) -> float:
        """Return the time between two signs of life."""
        return self._progress_s * min(2.0, max(1.0, len(self._calls) / _FEW_CALLS))

    def _reply(self, record: WaitingCall, payload: bytes, now: float) -> None:
        self._effects.append(SendReply(record.call, payload))
        record.last_sign_at = now
        self._calls.move_to_end(record.call)

    # -- replies to calls that do not wait, or no more -------------------------------------------

    def send_task(self, call: int, number: int, answer: CachedAnswer) -> None:
        """Send a cached task part."""
        self._effects.append(SendReply(call, _task_answer(number, answer)))

    def send_sensing(self, call: int, number: int, digest: bytes, answer: CachedAnswer) -> None:
        """Send a sensing part, and end the call."""
        self._end_with(
            call,
            SensingAnswer(number, answer.step, answer.sensing_action, digest, answer.computed_us),
        )

    def send_need_state(
        self, call: int, number: int, *, differs: bool, diverged: bool = False
    ) -> None:
        """Ask for the state, and end the call."""
        self._statistics.state_requests += 1
        self._end_with(call, NeedState(number, differs, diverged))

    def send_busy(self, call: int, number: int, key: bytes, wait_ms: float, waiting: int) -> None:
        """Turn a request of a session away, for at least ``wait_ms``, and end the call."""
        self._statistics.busy += 1
        # Robots that were turned away together shall not come back together.
        share = int.from_bytes(hashlib.blake2b(key, digest_size=2).digest(), "big") / 2**16
        spread = 1.0 + _RETRY_SPREAD * share
        retry_after_ms = min(MAX_WORD, math.ceil(wait_ms * spread))
        self._end_with(call, Busy(number, retry_after_ms))
        self._effects.report("busy", waiting=waiting, retry_after_ms=retry_after_ms)

    def send_refused(self, call: int, number: int, code: str, text: str) -> None:
        """Refuse a request, and end the call."""
        refusals = self._statistics.refusals
        refusals[code] = refusals.get(code, 0) + 1
        # Texts of other people's errors may hold anything.
        text = text.encode("utf-8", "replace").decode()
        if len(text) > MAX_TEXT:
            text = f"{text[: MAX_TEXT - 3]}..."
        self._end_with(call, Refused(number, code, text))
        self._effects.report("refused", code=code, reason=text)

    def _end_with(self, call: int, reply: Reply) -> None:
        self._effects += (SendReply(call, encode(reply)), EndCall(call))


def _task_answer(number: int, answer: CachedAnswer) -> bytes:
    return encode(TaskAnswer(number, answer.num_actions, answer.actions, answer.computed_us))
