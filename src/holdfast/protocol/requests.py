"""Requests in flight, and what their replies say.

A question may be sent to several services, and a service may have several requests in flight: a
late answer still shows that it lives. A request is open until its answer is complete, its call has
ended or the robot abandons it; while it is open, its service owes a sign of life.

Every reply shows that its service lives. Most say more: it holds the robot's state, has lost it, is
busy, or refuses. All of a reply is checked against the question, since it may be corrupted or the
service wrong, and recorded in the request, the question and the replica. Which service is asked
next is decided by the dispatcher.
"""

from __future__ import annotations

from collections.abc import Iterator

from holdfast.errors import MessageError, StaleEpochError
from holdfast.planning.planner import Planner
from holdfast.protocol.effects import Effects
from holdfast.protocol.messages import (
    Busy,
    NeedState,
    Progress,
    Refused,
    Reply,
    SensingAnswer,
    SessionConfiguration,
    TaskAnswer,
    decode_reply,
    encode,
)
from holdfast.protocol.question import Provenance, Question
from holdfast.protocol.replica_set import Replica
from holdfast.protocol.robot_events import Abandon, RobotEffect, Send
from holdfast.protocol.verification import Verification

_MAX_CALLS = 4
"""Bound on the open requests to one service."""

_NUMBERS_OF_EPOCH = 1 << 20
_EPOCHS = 1 << 11
"""Request numbers of one epoch, and epochs after which the numbers repeat. A number fits into 32
bits even if a process makes two thousand times as many requests."""


class OpenRequest:
    """A request in flight."""

    def __init__(
        self,
        call_number: int,
        number: int,
        replica: Replica,
        question: Question,
        sent_at: float,
        *,
        opens: bool,
        restores: bool,
    ) -> None:
        self.call_number = call_number  # of its call, in effects and events
        # In the message, repeated by each reply. It is unique in the run over 2,048 processes of
        # the robot, so a reply that arrives late in another call is recognized.
        self.number = number
        self.replica = replica
        self.question = question
        self.sent_at = sent_at
        self.excused_s = 0.0  # of the wait for its first reply: the robot could not receive
        # heard, has_task_part, has_sensing_part: whether any reply has come, and that part of the
        # answer.
        self.heard = False
        # opens, restores: whether it carries the session configuration, and the state.
        self.opens = opens
        self.restores = restores
        self.has_task_part = False
        self.has_sensing_part = False

    @property
    def answered(self) -> bool:
        """Whether a part of the answer has come."""
        return self.has_task_part or self.has_sensing_part

    @property
    def lacks_sensing(self) -> bool:
        """Whether the sensing part is the next to come."""
        return self.has_task_part or self.question.task_count == 0

    @property
    def finished(self) -> bool:
        """Whether the whole answer has come."""
        question = self.question
        return self.lacks_sensing and (self.has_sensing_part or question.sensing_step is None)

    @property
    def has_everything(self) -> bool:
        """Whether it carries all that a service can lack."""
        return self.opens and self.restores


class OpenRequests:
    """Sends requests, records what their replies say, and keeps those in flight.

    They are kept in the order in which they were sent.
    """

    def __init__(
        self,
        session: bytes,
        epoch: int,
        session_configuration: SessionConfiguration,
        # From one request to the next of a service that may not hear the robot, too.
        detection_timeout_s: float,
        planner: Planner,
        verification: Verification,
        effects: Effects[RobotEffect],
    ) -> None:
        self._detection_timeout_s = detection_timeout_s
        self._action_size = planner.problem.action_size
        self._num_choices = planner.num_choices
        self._verification = verification
        self._session = session
        self._epoch = epoch
        self._session_configuration = session_configuration
        self._effects = effects
        self._open: dict[int, OpenRequest] = {}
        self._asked: Question | None = None
        self._attempts = 0
        self._number = 0
        self._first_request = epoch % _EPOCHS * _NUMBERS_OF_EPOCH

    def __iter__(self) -> Iterator[OpenRequest]:
        # Of a copy, so that they can be given up on the way.
        return iter(list(self._open.values()))

    def __len__(self) -> int:
        return len(self._open)

    def get(self, number: int) -> OpenRequest | None:
        """Return an open request; None if it is not open."""
        return self._open.get(number)

    def to(self, replica: Replica) -> list[OpenRequest]:
        """Return the requests to a service."""
        return [call for call in self._open.values() if call.replica is replica]

    def about(self, question: Question) -> list[OpenRequest]:
        """Return the requests with a question."""
        return [call for call in self._open.values() if call.question is question]

    def is_asked(self, replica: Replica, question: Question) -> bool:
        """Return whether a service has the question."""
        return any(call.replica is replica for call in self.about(question))

    def retry_at(self, replica: Replica, question: Question) -> float:
        """Return when a service that may not hear the robot is sent the question again."""
        sent_at = [call.sent_at for call in self.about(question) if call.replica is replica]
        return max([replica.retry_at, *(at + self._detection_timeout_s for at in sent_at)])

    def probe_at(self, replica: Replica, question: Question) -> float | None:
        """Return when a suspected service may be sent the question; None if it need not be."""
        if not replica.detector.present or replica.refusal is not None:
            return None
        if replica.detector.trusted and self.is_asked(replica, question):
            return None  # it is at work, and says so
        # One probe at a time, so that a service further away than a turn is long can answer.
        probes = [call.sent_at for call in self.to(replica) if not call.answered]
        return max(replica.retry_at, max(probes, default=-1e9) + self._detection_timeout_s)

    def settle(self, call: OpenRequest) -> None:
        """Close a request from which nothing is awaited."""
        if self._open.pop(call.call_number, None) is not None:
            call.replica.detector.settled()

    def abandon(self, call: OpenRequest) -> None:
        """Close a request and tell the transport."""
        self.settle(call)
        self._effects.append(Abandon(call.call_number))

    def abandon_all(self, replica: Replica) -> None:
        """Close all requests to a service."""
        for call in self.to(replica):
            self.abandon(call)

    def send(
        self,
        replica: Replica,
        question: Question,
        now: float,
        *,
        whole_state: bool = False,  # whether the service needs the whole state
        # For how long the robot has waited, to report another attempt at the question; None if
        # other services have it too.
        waited_s: float | None = None,
    ) -> None:
        """Send a question to a service, with the state information that the service lacks."""
        open_calls = self.to(replica)
        for call in open_calls[: max(0, len(open_calls) - _MAX_CALLS + 1)]:
            self.abandon(call)
        opens = not replica.opened
        self._number += 1
        call_number = self._number
        number = self._first_request + call_number
        request = question.request(
            self._session,
            self._epoch,
            number,
            replica.num_lacking(question, whole_state=whole_state),
            self._session_configuration if opens else None,
        )
        self._open[call_number] = OpenRequest(
            call_number,
            number,
            replica,
            question,
            now,
            opens=opens,
            restores=request.checkpoint is not None,
        )
        replica.detector.asked(now)
        payload = encode(request)
        if opens and not question.is_first:
            self._effects.report(
                "restore", service=replica.name, step=request.step, bytes=len(payload)
            )
        self._attempts = self._attempts + 1 if question is self._asked else 1
        self._asked = question
        if self._attempts > 1 and waited_s is not None:
            self._effects.report(
                "retry",
                service=replica.name,
                step=request.step,
                attempt=self._attempts,
                waited_ms=1e3 * waited_s,
            )
        self._effects.append(Send(replica.name, call_number, payload))

    # -- replies -----------------------------------------------------------------------------------

    def take(self, call: OpenRequest, payload: bytes, now: float) -> Reply | None:
        """Record what a reply to an open request says; return it, or None if it is invalid.

        Raises HoldfastError if another process of the robot has taken over, or the own planner
        fails.
        """
        replica = call.replica
        try:
            reply = decode_reply(payload)
            _check_number(reply, call.number)
            self._note_lateness(call, now)
            if isinstance(reply, TaskAnswer | SensingAnswer):
                self._take_answer(call, reply, now)
                return reply
        except MessageError as error:
            # Spoilt on its way, or by a service that errs: the answer is asked for again.
            self._effects.report("malformed_reply", service=replica.name, reason=str(error))
            self.abandon(call)
            replica.delay(now)
            return None
        replica.detector.heard(now)
        if isinstance(reply, Progress):
            return reply
        self.abandon(call)
        if isinstance(reply, NeedState):
            self._take_need_state(call, reply, now)
        elif isinstance(reply, Busy):
            after_s = replica.note_busy(1e-3 * reply.retry_after_ms, now)
            # However often: the writer of the log limits repetitions.
            self._effects.report(
                "busy", service=replica.name, retry_after_ms=1e3 * after_s, times=replica.num_busy
            )
        else:
            self._take_refusal(call, reply, now)
        return reply

    def _note_lateness(self, call: OpenRequest, now: float) -> None:
        """Report a service whose first replies always take longer than the timeout.

        It is given up after each question and tried again with the next one.
        """
        if call.heard:
            return
        call.heard = True
        replica = call.replica
        soonest_s = replica.note_first_reply(call.sent_at + call.excused_s, now)
        if soonest_s is not None:
            self._effects.report(
                "late_replies",
                service=replica.name,
                soonest_ms=1e3 * soonest_s,
                reason="several in a row took longer than offload.detection_timeout_ms "
                f"({1e3 * replica.late_after_s:g}), so it is given up and tried again with each "
                "turn; if it is that far away, raise the setting above the way there and back",
            )

    def _take_answer(
        self, call: OpenRequest, reply: TaskAnswer | SensingAnswer, now: float
    ) -> None:
        """Take a part of the answer; raise MessageError if it cannot answer the question."""
        replica, question = call.replica, call.question
        first = not call.answered
        sensing = isinstance(reply, SensingAnswer)
        provenance = Provenance(replica.name, now - call.sent_at, 1e-6 * reply.computed_us)
        if isinstance(reply, SensingAnswer):
            question.check_sensing(reply, self._num_choices)
            self._verification.take_sensing(question, reply, provenance)
            call.has_sensing_part = True
        else:
            actions = question.read_tasks(reply, self._action_size)
            self._verification.take_tasks(question, actions, provenance)
            call.has_task_part = True
        replica.note_answer(question, now, sensing=sensing, restored=call.restores)
        for earlier in self.to(replica):
            if earlier.call_number < call.call_number:
                # Whatever became of it, nothing is awaited of it any more.
                self.abandon(earlier)
        if first and call.opens and (call.restores or question.state.step > 0):
            restore_ms = 1e3 * (now - call.sent_at)
            self._effects.report(
                "restored", service=replica.name, step=question.state.step, restore_ms=restore_ms
            )
        if call.finished:
            replica.detector.answered()
            self.settle(call)

    def _take_need_state(self, call: OpenRequest, reply: NeedState, now: float) -> None:
        replica = call.replica
        replica.note_lost_state()
        if reply.diverged:
            replica.num_diverged += 1
            self._effects.report(
                "state_diverged",
                service=replica.name,
                trial=call.question.state.trial,
                step=call.question.state.step,
                reason="the service came to another state than the robot from the same "
                "observations, so it is handed the robot's",
            )
        if call.has_everything:
            self._note_refusal(call, "need_state", "asks again for a state that it was sent", now)

    def _take_refusal(self, call: OpenRequest, reply: Refused, now: float) -> None:
        replica = call.replica
        if reply.code == "stale_epoch":
            raise StaleEpochError(
                f"{replica.name}: {reply.text}; another process has resumed this run, "
                "so this one stops"
            )
        if reply.code == "damaged":
            replica.delay(now)
            self._effects.report("damaged_request", service=replica.name, reason=reply.text)
            return
        replica.note_lost_state()
        self._note_refusal(call, reply.code, reply.text, now)

    def _note_refusal(self, call: OpenRequest, code: str, text: str, now: float) -> None:
        replica = call.replica
        final = replica.note_refusal(code, text, now, sensing=call.lacks_sensing)
        self._effects.report("refused", service=replica.name, code=code, reason=text, final=final)


def _check_number(reply: Reply, asked: int) -> None:
    unread = reply.number == 0 and isinstance(reply, Busy | Refused)
    if reply.number != asked and not unread:
        raise MessageError("malformed", f"reply to request {reply.number}, asked was {asked}")
