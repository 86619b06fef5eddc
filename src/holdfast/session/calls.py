"""The requests that are on their way: which service was asked what, and when.

One question may be on its way to several services, and one service may have several questions open:
one that has not answered the last yet may still do so, and is then known to live. A call is open
until its answer is whole, it has ended, or nobody wants to hear of it any more; as long as it is,
something is awaited from its service.
"""

from __future__ import annotations

from collections.abc import Iterator

from holdfast.session.effects import Abandon, Effect, Report, Send
from holdfast.session.known_services import KnownService
from holdfast.session.messages import PROTOCOL_VERSION, Opening, Request, encode
from holdfast.session.question import Question

__all__ = ["Call", "Calls"]

_MAX_CALLS = 4
"""Bound on the calls to one service that may be open at a time."""

_NUMBERS_OF_EPOCH = 1 << 20
_EPOCHS = 1 << 11
"""So many requests until the numbers of the next epoch begin, and epochs until those begin again; a
number fits into 32 bits even if a process makes two thousand times as many."""


class Call:
    """One request that is on its way.

    Attributes
    ----------
    number : int
        Names it in effects and events.
    request_number : int
        Of its request. A reply repeats it, and might come late and go astray; so no two requests
        of a run have the same, even if other processes of the robot have made them.
    service : KnownService
    question : Question
    sent_at : float
    heard : bool
        Whether anything has come of it.
    opens, restores : bool
        Whether it carries the opening, and the state.
    task, sensing : bool
        Whether that part of the answer has come.
    """

    __slots__ = (
        "heard",
        "number",
        "opens",
        "question",
        "request_number",
        "restores",
        "sensing",
        "sent_at",
        "service",
        "task",
    )

    def __init__(
        self,
        number: int,
        request_number: int,
        service: KnownService,
        question: Question,
        sent_at: float,
        *,
        opens: bool,
        restores: bool,
    ) -> None:
        self.number = number
        self.request_number = request_number
        self.service = service
        self.question = question
        self.sent_at = sent_at
        self.heard = False
        self.opens = opens
        self.restores = restores
        self.task = False
        self.sensing = False

    @property
    def answered(self) -> bool:
        """Whether a part of the answer has come."""
        return self.task or self.sensing

    @property
    def lacks_sensing(self) -> bool:
        """Whether the sensing part is what comes next of it."""
        return self.task or self.question.task_count == 0

    @property
    def finished(self) -> bool:
        """Whether all of it has."""
        question = self.question
        return self.lacks_sensing and (self.sensing or question.sensing_step is None)


class Calls:
    """The open calls, in the order in which they were sent.

    Parameters
    ----------
    session : bytes
    epoch : int
    opening : Opening
    effects : list of Effect
        What is to be sent, given up and told is added to it.
    """

    def __init__(self, session: bytes, epoch: int, opening: Opening, effects: list[Effect]) -> None:
        self._session = session
        self._epoch = epoch
        self._opening = opening
        self._effects = effects
        self._open: dict[int, Call] = {}
        self._number = 0
        self._first_request = epoch % _EPOCHS * _NUMBERS_OF_EPOCH

    def __iter__(self) -> Iterator[Call]:
        # Of a copy, so that they can be given up on the way.
        return iter(list(self._open.values()))

    def __len__(self) -> int:
        return len(self._open)

    def get(self, number: int) -> Call | None:
        """Return an open call; None if it is not open any more."""
        return self._open.get(number)

    def to(self, service: KnownService) -> list[Call]:
        """Return the calls to a service."""
        return [call for call in self._open.values() if call.service is service]

    def about(self, question: Question) -> list[Call]:
        """Return the calls that ask a question."""
        return [call for call in self._open.values() if call.question is question]

    def is_asked(self, service: KnownService, question: Question) -> bool:
        """Tell whether a service is being asked a question."""
        return any(call.service is service for call in self.about(question))

    def asked_at(self, service: KnownService, question: Question) -> float | None:
        """Return when it was last asked this question; None if it is not being asked."""
        times = [call.sent_at for call in self.about(question) if call.service is service]
        return max(times, default=None)

    def first_sent_at(self) -> float:
        """Return when the oldest of the open calls was sent."""
        return min(call.sent_at for call in self._open.values())

    def settle(self, call: Call) -> None:
        """Take note that nothing is awaited of a call any more."""
        if self._open.pop(call.number, None) is not None:
            call.service.detector.settled()

    def abandon(self, call: Call) -> None:
        """Give a call up."""
        self.settle(call)
        self._effects.append(Abandon(call.number))

    def send(
        self,
        service: KnownService,
        question: Question,
        now: float,
        *,
        whole_state: bool,
        also: bool,
    ) -> None:
        """Send a question, with what the service lacks.

        Parameters
        ----------
        service : KnownService
        question : Question
        now : float
        whole_state : bool
            Whether it needs the state for certain.
        also : bool
            Whether the robot waits for another service, or for nothing.
        """
        open_calls = self.to(service)
        for call in open_calls[: max(0, len(open_calls) - _MAX_CALLS + 1)]:
            self.abandon(call)
        state = question.state
        lack = service.lacks(question, whole_state=whole_state)
        self._number += 1
        number = self._number
        request_number = self._first_request + number
        request = Request(
            PROTOCOL_VERSION,
            self._session,
            self._epoch,
            request_number,
            state.trial,
            state.step,
            state.sensed,
            question.digest,
            lack.observations,
            self._opening if lack.opening else None,
            lack.checkpoint,
        )
        self._open[number] = Call(
            number,
            request_number,
            service,
            question,
            now,
            opens=lack.opening,
            restores=lack.checkpoint is not None,
        )
        service.detector.asked(now)
        payload = encode(request)
        if lack.opening and not lack.fresh:
            self._report("restore", service=service.name, step=state.step, bytes=len(payload))
        question.times_asked += 1
        if question.times_asked > 1 and not also:
            waited_s = 0.0 if question.needed_at is None else now - question.needed_at
            self._report(
                "retry",
                service=service.name,
                step=state.step,
                attempt=question.times_asked,
                waited_ms=1e3 * waited_s,
            )
        self._effects.append(Send(service.name, number, payload))

    def _report(self, name: str, **fields: object) -> None:
        self._effects.append(Report(name, fields))
