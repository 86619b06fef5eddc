"""What a reply says of the service that it comes from, and what is left of it for the question.

Every reply shows that its service lives. Most say more: that it holds the robot's state now, or has
lost it, wants to be left alone, or refuses. All that is noted here, where it stands: in the
question, the call, and what is known of the service. What follows for the choice of whom to ask is
not decided here; it is returned as :class:`News`.

A reply may be spoilt, or come from a service that errs. So nothing of it is kept before all of it
has been checked against the question.
"""

from __future__ import annotations

import enum

import numpy as np

from holdfast.errors import HoldfastError
from holdfast.protocol.verification import Verification
from holdfast.session.calls import Call, Calls
from holdfast.session.effects import Effect, Report
from holdfast.session.known_services import KnownService
from holdfast.session.messages import (
    Busy,
    MessageError,
    NeedState,
    Progress,
    Refused,
    Reply,
    SensingAnswer,
    TaskAnswer,
    decode_reply,
)
from holdfast.session.question import Provenance

__all__ = ["News", "Replies", "StaleEpochError"]


class StaleEpochError(HoldfastError):
    """Another process has taken this run over: this robot must not go on."""


class News(enum.Enum):
    """What a reply comes to for the question of its call."""

    NOTHING = enum.auto()
    """No answer comes of this call: the service is busy, refuses or errs."""

    AT_WORK = enum.auto()
    """An answer is on its way."""

    ANSWERED = enum.auto()
    """The first part of the answer has come."""

    ANSWERED_MORE = enum.auto()
    """A part has come after another."""

    LACKS = enum.auto()
    """The service would answer if it were told what it lacks."""

    LACKS_STATE = enum.auto()
    """It would if it were handed the state; nothing else will do."""

    @property
    def at_work(self) -> bool:
        """Whether somebody works on the question, or has done so."""
        return self in (News.AT_WORK, News.ANSWERED, News.ANSWERED_MORE)


class Replies:
    """Takes note of replies.

    Parameters
    ----------
    calls : Calls
    action_size, num_sensing_actions : int
        Of the problem, to check the answers.
    verification : Verification
        Is told of every answer.
    effects : list of Effect
        What is to be given up and told is added to it.
    """

    def __init__(
        self,
        calls: Calls,
        action_size: int,
        num_sensing_actions: int,
        verification: Verification,
        effects: list[Effect],
    ) -> None:
        self._calls = calls
        self._verification = verification
        self._action_size = action_size
        self._num_sensing_actions = num_sensing_actions
        self._effects = effects

    def take(self, call: Call, payload: bytes, now: float) -> News:
        """Take note of a reply to an open call.

        Parameters
        ----------
        call : Call
        payload : bytes
        now : float

        Raises
        ------
        StaleEpochError
            If the service says that the robot has been replaced.
        """
        service = call.service
        try:
            reply = decode_reply(payload)
            _check_number(reply, call.request_number)
            self._note_lateness(call, now)
            if isinstance(reply, TaskAnswer | SensingAnswer):
                self._take_answer(call, reply, now)
                return self._was_answered(call, reply, now)
        except MessageError as error:
            # Spoilt on its way, or by a service that errs: the answer is asked for again.
            self._report("malformed_reply", service=service.name, reason=str(error))
            self._calls.abandon(call)
            service.delay(now)
            return News.NOTHING
        service.detector.heard(now)
        if isinstance(reply, Progress):
            return News.AT_WORK
        self._calls.abandon(call)
        if isinstance(reply, NeedState):
            return self._need_state(call, reply, now)
        if isinstance(reply, Busy):
            self._was_busy(service, reply, now)
        else:
            self._was_refused(call, reply, now)
        return News.NOTHING

    def _note_lateness(self, call: Call, now: float) -> None:
        """Say so when a service is too far away for the timeout: each turn would change hands."""
        if call.heard:
            return
        call.heard = True
        service = call.service
        soonest_s = service.note_first_reply(call.sent_at, now)
        if soonest_s is not None:
            self._report(
                "late_replies",
                service=service.name,
                soonest_ms=1e3 * soonest_s,
                reason="several in a row took longer than offload.detection_timeout_ms "
                f"({1e3 * service.late_after_s:g}), so it is given up and tried again with each "
                "turn; if it is that far away, raise the setting above the way there and back",
            )

    # -- answers ---------------------------------------------------------------------------------

    def _take_answer(self, call: Call, reply: TaskAnswer | SensingAnswer, now: float) -> None:
        question, name = call.question, call.service.name
        if isinstance(reply, TaskAnswer):
            given = question.read_tasks(reply, self._action_size, name)
            assert given.tasks is not None
            outside = self._verification.outside_limits(np.array(given.tasks))
            given.outside_limits = outside is not None
        else:
            given = question.read_sensing(reply, self._num_sensing_actions, name)
            outside = None
        source = Provenance(name, now - call.sent_at, 1e-6 * reply.computed_us)
        agrees = question.take(given, source)
        if not agrees:
            if not question.disputed and question.own is None:
                why = outside or "two answers to one question differ"
                self._report(
                    "disagreement",
                    service=name,
                    step=question.state.step,
                    kind=given.kind,
                    reason=f"{why}; the robot's own planner decides",
                )
            self._verification.dispute(question, name)
        self._verification.answered(question, name)

    def _was_answered(self, call: Call, reply: TaskAnswer | SensingAnswer, now: float) -> News:
        service, question = call.service, call.question
        first = not call.answered
        if isinstance(reply, TaskAnswer):
            call.task = True
        else:
            call.sensing = True
        sensing = isinstance(reply, SensingAnswer)
        service.note_answer(question, now, sensing=sensing, restored=call.restores)
        for earlier in self._calls.to(service):
            if earlier.number < call.number:
                # Whatever became of it, nothing is awaited of it any more.
                self._calls.abandon(earlier)
        if first and call.opens and (call.restores or question.state.step > 0):
            restore_ms = 1e3 * (now - call.sent_at)
            self._report(
                "restored", service=service.name, step=question.state.step, restore_ms=restore_ms
            )
        if call.finished:
            service.detector.answered()
            self._calls.settle(call)
        return News.ANSWERED if first else News.ANSWERED_MORE

    # -- anything else ---------------------------------------------------------------------------

    def _need_state(self, call: Call, reply: NeedState, now: float) -> News:
        service = call.service
        service.note_lost_state(differs=reply.differs)
        if reply.diverged:
            self._report(
                "state_diverged",
                service=service.name,
                trial=call.question.state.trial,
                step=call.question.state.step,
                reason="the service came to another state than the robot from the same "
                "observations, so it is handed the robot's",
            )
        if call.opens and call.restores:
            # It was handed everything and asks for it again.
            self._refusal(call, "need_state", "asks again for a state that it was sent", now)
            return News.NOTHING
        # Told everything but the state, it came to another one: only the state will do.
        return News.LACKS_STATE if reply.differs or call.opens else News.LACKS

    def _was_busy(self, service: KnownService, reply: Busy, now: float) -> None:
        after_s = service.note_busy(1e-3 * reply.retry_after_ms, now)
        # However often: whoever writes a log bounds it.
        self._report(
            "busy", service=service.name, retry_after_ms=1e3 * after_s, times=service.num_busy
        )

    def _was_refused(self, call: Call, reply: Refused, now: float) -> None:
        service = call.service
        if reply.code == "stale_epoch":
            raise StaleEpochError(
                f"{service.name}: {reply.text}; another process has resumed this run, "
                "so this one stops"
            )
        if reply.code == "damaged":
            service.delay(now)
            self._report("damaged_request", service=service.name, reason=reply.text)
            return
        service.note_lost_state(differs=False)
        self._refusal(call, reply.code, reply.text, now)

    def _refusal(self, call: Call, code: str, text: str, now: float) -> None:
        service = call.service
        final = service.note_refusal(code, text, now, sensing=call.lacks_sensing)
        self._report("refused", service=service.name, code=code, reason=text, final=final)

    def _report(self, name: str, **fields: object) -> None:
        self._effects.append(Report(name, fields))


def _check_number(reply: Reply, asked: int) -> None:
    unread = reply.number == 0 and isinstance(reply, Busy | Refused)
    if reply.number != asked and not unread:
        raise MessageError("malformed", f"reply to request {reply.number}, asked was {asked}")
