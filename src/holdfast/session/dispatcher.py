"""Whom to ask: one question at a time, put to whichever service can answer it soonest.

All services give the same answer, because a decision is a function of the state that the question
names. So the choice between them is a matter of time alone, and being wrong costs time alone:

- the services named by the user are tried in their order of preference; together they are *the
  cloud*;
- if none of them can be used, the local service decides (status *local recovery*) and is launched
  if it does not run; meanwhile each question goes to the cloud as well, so that its first answer
  ends the recovery (status *keep alive*);
- a decision that is late may be asked of the local service too, if that runs already; a budget
  bounds this extra work;
- if nobody can be asked the robot holds still, says so, and asks whoever turns up.

A request carries what the service lacks: nothing but the last observations if it has answered
before, else the whole state.

The question itself stands in :mod:`~holdfast.session.question`, what is known of the services in
:mod:`~holdfast.session.known_services`, what is on its way to them in
:mod:`~holdfast.session.calls`, what their replies mean in :mod:`~holdfast.session.replies`, and
when the local one is started in :mod:`~holdfast.session.launches`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import numpy as np
import numpy.typing as npt

from holdfast.errors import HoldfastError
from holdfast.protocol.verification import OwnDecisionError, Verification
from holdfast.session.calls import Call, Calls
from holdfast.session.effects import Effect, Launch, Report, Stop
from holdfast.session.events import (
    Appeared,
    Decided,
    Ended,
    Planned,
    Replied,
    TransportEvent,
    Vanished,
)
from holdfast.session.hedging import Hedging
from holdfast.session.known_services import KnownService, KnownServices
from holdfast.session.launches import Launches
from holdfast.session.messages import Opening
from holdfast.session.question import Question
from holdfast.session.replies import News, Replies, StaleEpochError
from holdfast.session.standstill import Standstill
from holdfast.session.status import Cause, Status, next_status
from holdfast.settings import OffloadSettings, RecoverySettings

__all__ = ["Dispatcher", "ServiceRefusedError"]

FloatArray = npt.NDArray[np.float64]


class ServiceRefusedError(HoldfastError):
    """Every service that could decide refuses to, and asking again would not help."""


class Dispatcher:
    """Puts one question at a time to whichever service can answer it.

    It lives as long as the run; each method takes the time and adds to the effects that
    :meth:`take` returns.

    Parameters
    ----------
    services : sequence of str
        The cloud's services in order of preference; one at least.
    recovery : str or None
        The local service; None if there is none to be had.
    offload : OffloadSettings
    recovery_settings : RecoverySettings
    session : bytes
    epoch : int
    opening : Opening
    action_size, num_sensing_actions : int
        Of the problem, to check the answers.
    limited : callable
        What the problem's ``execute`` makes of actions, shape ``(count, action_size)`` in and out.
    secret : bytes
        Known to this robot alone: with it, it is drawn which answers are computed again.
    distrusted : collection of str
        Services that have answered wrongly in an earlier part of the run.

    Attributes
    ----------
    status : Status
    question : Question or None
        The one that is being asked or was answered last.
    effects : list of Effect
        What is to be done, in order.
    stopped : bool
        Whether the robot must not go on.
    recoveries : int
        Times that the local service took over.
    """

    def __init__(
        self,
        services: Sequence[str],
        recovery: str | None,
        offload: OffloadSettings,
        recovery_settings: RecoverySettings,
        session: bytes,
        epoch: int,
        opening: Opening,
        action_size: int,
        num_sensing_actions: int,
        limited: Callable[[FloatArray], FloatArray],
        secret: bytes,
        distrusted: Collection[str] = (),
    ) -> None:
        timeout_s = 1e-3 * offload.detection_timeout_ms
        wanted = recovery_settings.launch != "never"
        self._timeout_s = timeout_s
        self._limit_s = 1e-3 * offload.decision_timeout_ms
        self._startup_s = 1e-3 * offload.startup_timeout_ms
        self._launch_at_start = recovery_settings.launch == "at_start"
        self.effects: list[Effect] = []
        self._services = KnownServices(services, recovery if wanted else None, timeout_s)
        for service in self._services:
            if service.name in distrusted:
                service.distrust(
                    "answered otherwise than the robot's own planner in an earlier part of this "
                    "run; name another service, or begin anew in another directory"
                )
        self._calls = Calls(session, epoch, opening, self.effects)
        self._verification = Verification(
            offload.verify_share, secret, recovery, limited, self.effects
        )
        self._replies = Replies(
            self._calls, action_size, num_sensing_actions, self._verification, self.effects
        )
        self._launches = Launches(recovery_settings)
        self._hedging = Hedging(offload)
        self._standstill = Standstill(timeout_s, self.effects)
        self._startup_until: float | None = None
        self._worked_at = float("-inf")
        # Known as long as nothing happens that could change it; most task actions are performed
        # without a word to anybody.
        self._wakeup: float | None = None
        self._wakeup_is_known = False
        self._lost_at: float | None = None
        self.stopped = False
        self.status = Status.STANDARD
        self.question: Question | None = None
        self.recoveries = 0

    # -- what the robot's loop asks for ----------------------------------------------------------

    def start(self, now: float) -> None:
        """Begin the run."""
        self._startup_until = now + self._startup_s
        for service in self._services:
            if service.distrusted is not None:
                self._report("distrusted", service=service.name, reason=service.distrusted)
        if self._services.local is not None and self._launch_at_start:
            self._launches.want(now)
            self._work(now)

    def ask(self, question: Question, now: float) -> None:
        """Ask a new question; the one before is forgotten."""
        self.question = question
        self._hedging.earn()
        for call in self._calls:
            # A service that has not answered yet may still do so, and is then known to live; but
            # one that already gave a part has shown that.
            if call.answered:
                self._calls.abandon(call)
        self._work(now)
        self._try_others(now)

    def drop(self) -> None:
        """Forget the question: the trial is over."""
        self.question = None
        self._wakeup_is_known = False
        for call in self._calls:
            if call.answered or call.service is self._services.local:
                self._calls.abandon(call)
        self._standstill.forget()

    def need(self, now: float) -> None:
        """Say that the robot stands still until the rest of the answer is there."""
        if self.question is not None and self.question.needed_at is None:
            self.question.needed_at = now
            self._work(now)

    def go_on(self) -> None:
        """Say that the robot stands still no more."""
        if self.question is not None:
            self.question.needed_at = None
            self._wakeup_is_known = False

    def take(self) -> list[Effect]:
        """Return the effects so far, in order, and forget them."""
        effects = self.effects.copy()
        self.effects.clear()
        return effects

    # -- what happens ----------------------------------------------------------------------------

    def handle(self, event: TransportEvent | Planned, now: float) -> None:
        """Take note of what a transport delivered."""
        if isinstance(event, Replied):
            call = self._calls.get(event.call)
            if call is not None:
                self._replied(call, event.payload, now)
        elif isinstance(event, Ended):
            call = self._calls.get(event.call)
            if call is not None:
                self._ended(call, now)
        elif isinstance(event, Appeared):
            self._appeared(self._services.get(event.service), event.boot, now)
        elif isinstance(event, Vanished):
            self._vanished(self._services.get(event.service), event.boot, now)
        self._work(now)

    def decided(self, event: Decided, performed: int, now: float) -> None:
        """Take what the robot's own planner answers.

        Parameters
        ----------
        event : Decided
        performed : int
            Task actions of the question at hand that are performed, or ordered.
        now : float
        """
        try:
            usable = self._verification.decided(event, self.question, performed)
        except OwnDecisionError as error:
            self._stop(error)
            return
        if not usable:
            # What was done cannot be undone; from where it led, a new question is asked.
            self.drop()
        self._drop_wrong_services()
        self._work(now)

    def check(self) -> None:
        """Let the robot's own planner answer the question, too: its answer was of no use."""
        question = self.question
        if question is not None and question.given:
            self._verification.check(question, question.given[0].service)

    def dispute(self) -> None:
        """Let the robot's own planner answer the question before anything is done about it."""
        question = self.question
        if question is not None and question.given:
            self._verification.dispute(question, question.given[0].service)

    @property
    def limits_tell(self) -> bool:
        """Whether an action that the problem's ``execute`` would change is a wrong one."""
        return self._verification.limits_tell

    @property
    def is_holding(self) -> bool:
        """Whether the robot holds still because nobody can be asked."""
        return self._standstill.is_holding

    @property
    def num_unverified(self) -> int:
        """Questions that the robot's own planner still has to answer."""
        return len(self._verification)

    def recovery_exited(self, launch: int, reason: str, now: float) -> None:
        """Take note that a process of the local service has ended, or could not be started.

        Parameters
        ----------
        launch : int
            The number of its :class:`~holdfast.session.effects.Launch`.
        reason : str
        now : float
        """
        local, launches = self._services.local, self._launches
        if local is None:
            return
        if launch != launches.number or launches.pending:
            # It was seen to be gone before; only the reason is new.
            self._report("recovery_exited", reason=reason)
            return
        if local.detector.boot is not None:
            self._vanished(local, local.detector.boot, now)
        if not launches.pending:
            self._report("recovery_exited", reason=reason)
            launches.failed(now)
        self._work(now)

    def wake(self, now: float) -> None:
        """Time has passed."""
        self._work(now)

    def next_wakeup(self) -> float | None:
        """Return when :meth:`wake` must be called if nothing happens before."""
        if not self._wakeup_is_known:
            self._wakeup = self._next_wakeup()
            self._wakeup_is_known = True
        return self._wakeup

    def _next_wakeup(self) -> float | None:
        services, question = self._services, self.question
        due: list[float | None] = []
        if self._calls:
            due += [service.detector.deadline() for service in services]
            due.append(self._calls.first_sent_at() + self._limit_s)
        if question is not None and question.disputed and question.needed_at is not None:
            due.append(question.needed_at + self._limit_s)
        if question is not None and question.is_open:
            if not self._is_being_asked(question, self._worked_at):
                due += [
                    self._ask_again_at(service, question)
                    for service in services
                    if service.detector.present and service.refused is None
                ]
                if self._is_starting():
                    due.append(self._startup_until)
            elif question.needed_at is not None:
                due += [self._try_at(service, question) for service in services.cloud]
                due.append(question.needed_at + self._timeout_s)
            due.append(self._standstill.waiting_at(question))
            due.append(self._hedge_at(question))
        local = services.local
        if local is not None:
            due.append(self._launches.next_wakeup(present=local.detector.present))
        # What was due when we worked last has been looked at; only something new can change it.
        later = [at for at in due if at is not None and at > self._worked_at]
        return min(later, default=None)

    def was_deaf(self, seconds: float) -> None:
        """Take note that for this long nothing that came could be heard."""
        self._wakeup_is_known = False
        for service in self._services:
            service.detector.excuse(seconds)

    # -- presence --------------------------------------------------------------------------------

    def _appeared(self, service: KnownService | None, boot: str, now: float) -> None:
        if service is None or not service.detector.appeared(boot):
            return
        for call in self._calls.to(service):
            self._calls.abandon(call)
        if boot != service.last_boot:
            service.forget()
            service.last_boot = boot
        if service is self._services.local:
            launched_s = self._launches.since_launch_s(now)
            if launched_s is not None:
                self._report("launched", launch_ms=1e3 * launched_s)
            return
        self._report("service_appeared", service=service.name)
        question = self.question
        if (
            self.status is Status.LOCAL_RECOVERY
            and question is not None
            and service.refused is None
        ):
            # It need not wait for the next turn: with an answer to this one it holds the state.
            self._send(service, question, now, also=True)

    def _vanished(self, service: KnownService | None, boot: str, now: float) -> None:
        if service is None or not service.detector.vanished(boot):
            return
        for call in self._calls.to(service):
            self._calls.abandon(call)
        self._report("service_vanished", service=service.name)
        if service is self._services.local:
            self._launches.ended(now)

    # -- replies ---------------------------------------------------------------------------------

    def _replied(self, call: Call, payload: bytes, now: float) -> None:
        service, question = call.service, call.question
        try:
            news = self._replies.take(call, payload, now)
        except StaleEpochError as error:
            self._stop(error)
            return
        self._drop_wrong_services()
        if question is self.question:
            if news.at_work and not question.disputed:
                self._standstill.let_go(now)
            elif news in (News.LACKS, News.LACKS_STATE):
                self._send(service, question, now, whole_state=news is News.LACKS_STATE, also=True)
        if news in (News.ANSWERED, News.ANSWERED_MORE) and service is self._services.local:
            self._launches.succeeded()
        elif news is News.ANSWERED and self.status is Status.LOCAL_RECOVERY:
            self._change_status(Cause.CLOUD_ANSWERED, f"{service.name} has answered", now)

    def _ended(self, call: Call, now: float) -> None:
        self._calls.settle(call)
        question = call.question
        if question is not self.question or question.complete:
            return
        # Whoever was asked is gone; if it is only this call that was lost, its next answer
        # clears it.
        service = call.service
        service.delay(now)
        if service.detector.suspicion is None:
            service.detector.suspect("a call ended without the answer")
            self._report_suspected(service)

    def _drop_wrong_services(self) -> None:
        """Ask those no more who answered otherwise than the robot's own planner."""
        for wrong in self._verification.take_wrong():
            service = self._services.get(wrong.service)
            if service is None:
                continue
            service.distrust(
                f"answered otherwise than the robot's own planner in step {wrong.step}"
            )
            for call in self._calls.to(service):
                self._calls.abandon(call)
            self._report(
                "wrong_answer",
                service=service.name,
                step=wrong.step,
                kind=wrong.kind,
                reason="not what the robot's own planner decides in the same state; it is not "
                "asked again in this run",
            )
            question = self.question
            if question is not None and any(g.service == wrong.service for g in question.given):
                # What it said last was perhaps not looked at yet.
                self._verification.dispute(question, wrong.service)

    # -- deciding whom to ask --------------------------------------------------------------------

    def _work(self, now: float) -> None:
        """Do what the time and the situation ask for."""
        self._wakeup_is_known = False
        if self.stopped:
            return
        self._worked_at = now
        if self._startup_until is not None and now >= self._startup_until:
            self._startup_until = None
        self._look_for_silence(now)
        self._tend_recovery(now)
        question = self.question
        if question is None:
            self._note_lost_cloud(now)
            return
        if question.disputed:
            self._wait_for_own_planner(question, now)
            return
        if question.complete:
            self._standstill.let_go(now)
            self._note_lost_cloud(now)
            return
        if self._is_being_asked(question, now):
            self._hedge(question, now)
            if question.needed_at is not None:
                # Whoever is being asked may be silent for long, and the robot stands still.
                self._try_others(now)
            if self._standstill.waits_long(question, now):
                asked = {call.service.name for call in self._calls.about(question)}
                self._standstill.tell_waiting(question, asked, now)
            self._note_lost_cloud(now)
        else:
            self._choose(question, now)

    def _wait_for_own_planner(self, question: Question, now: float) -> None:
        self._standstill.hold(question, "the robot's own planner decides", now)
        needed_at = question.needed_at
        if needed_at is not None and now >= needed_at + self._limit_s:
            state = question.state
            self._stop(
                OwnDecisionError(
                    f"trial {state.trial}, step {state.step}: services answer differently, or "
                    "outside the problem's limits, and the robot's own planner has not decided "
                    f"within {1e3 * self._limit_s:g} ms, which is offload.decision_timeout_ms"
                )
            )

    def _look_for_silence(self, now: float) -> None:
        if not self._calls:
            return  # nothing is awaited
        for service in self._services:
            if service.detector.fell_silent(now):
                self._report_suspected(service)
                if service is self._services.local:
                    # It runs but does nothing: another one is started in its place, and is given
                    # more time, for it may be that its decisions simply take long.
                    service.detector.extend_patience(2.0, self._limit_s)
                    self._launches.failed(now)
        for call in self._calls:
            if now >= call.sent_at + self._limit_s:
                service = call.service
                self._calls.abandon(call)
                service.delay(now)
                service.detector.suspect(
                    f"a decision took longer than {1e3 * self._limit_s:.0f} ms"
                )
                self._report_suspected(service)

    def _is_being_asked(self, question: Question, now: float) -> bool:
        """Tell whether somebody is asked who can be counted on."""
        calls = self._calls.about(question)
        if self.status is Status.LOCAL_RECOVERY and self._local_usable(now):
            # The cloud is only tried: it may say for long that it is at work.
            return any(call.service is self._services.local for call in calls)
        return any(call.service.detector.trusted for call in calls)

    def _is_starting(self) -> bool:
        """Tell whether the services that could decide may still be on their way up."""
        return self._startup_until is not None and self._services.all_to_come()

    def _choose(self, question: Question, now: float) -> None:
        services = self._services
        if self.status is not Status.LOCAL_RECOVERY:
            for service in services.cloud:
                if service.usable(now) and not self._calls.is_asked(service, question):
                    self._send(service, question, now)
                    return
            if self._is_starting():
                return
            busy_until = services.busy_until(now)
            if busy_until is not None:
                since = now if question.needed_at is None else question.needed_at
                if busy_until - since <= self._timeout_s and not self._local_usable(now):
                    return
        if services.local is None:
            self._hold_and_retry(question, now)
            return
        if self.status is not Status.LOCAL_RECOVERY:
            self._lose_cloud(now)
            self._tend_recovery(now)
        if self._local_usable(now):
            if not self._calls.is_asked(services.local, question):
                self._send(services.local, question, now)
            return
        self._hold_and_retry(question, now)

    def _local_usable(self, now: float) -> bool:
        local = self._services.local
        return local is not None and local.usable(now)

    def _ask_again_at(self, service: KnownService, question: Question) -> float:
        """Return when a service that may not hear us is asked again."""
        asked_at = self._calls.asked_at(service, question)
        if asked_at is None:
            return service.retry_at
        return max(service.retry_at, asked_at + self._timeout_s)

    def _hold_and_retry(self, question: Question, now: float) -> None:
        """Ask whoever is there at all, suspected or not, at growing intervals."""
        services = self._services
        for service in services:
            if (
                service.detector.present
                and service.refused is None
                and self._ask_again_at(service, question) <= now
            ):
                service.delay(now)
                self._send(service, question, now)
                if service.detector.trusted:
                    return
        if services.hopeless():
            self._stop(ServiceRefusedError(f"no service will decide: {services.why_nobody()}"))
            return
        self._standstill.hold(question, services.why_nobody(), now)

    def _try_others(self, now: float) -> None:
        """Let services that were given up see this question too: an answer brings them back."""
        question = self.question
        if question is None:
            return
        needed_at = question.needed_at
        is_late = needed_at is not None and now >= needed_at + self._timeout_s
        for service in self._services.cloud:
            if service.usable(now) and self.status is not Status.LOCAL_RECOVERY:
                if is_late and not self._calls.is_asked(service, question):
                    # It has come back while one that is less preferred takes its time.
                    self._send(service, question, now, also=True)
                break
            at = self._try_at(service, question)
            if at is not None and at <= now:
                if self._calls.is_asked(service, question):
                    service.delay(now)
                self._send(service, question, now, also=True)

    def _try_at(self, service: KnownService, question: Question) -> float | None:
        """Return when a service that was given up may be asked; None if it need not be."""
        if not service.detector.present or service.refused is not None:
            return None
        if service.detector.trusted and self._calls.is_asked(service, question):
            return None  # it is at work, and says so
        # One try at a time, so that a service further away than a turn is long can answer.
        tries = [call.sent_at for call in self._calls.to(service) if not call.answered]
        return max(service.retry_at, max(tries, default=-1e9) + self._timeout_s)

    def _note_lost_cloud(self, now: float) -> None:
        """Notice that the cloud died while nothing was asked of it: recovery can start now."""
        if (
            self._services.local is not None
            and self.status is not Status.LOCAL_RECOVERY
            and not self._is_starting()
            and not self._services.any_reliable()
        ):
            self._lose_cloud(now)
            self._tend_recovery(now)

    def _lose_cloud(self, now: float) -> None:
        self._lost_at = now
        self.recoveries += 1
        self._change_status(Cause.CLOUD_LOST, self._services.why_lost(), now)

    def _change_status(self, cause: Cause, reason: str, now: float) -> None:
        before = self.status
        self.status = next_status(before, cause)
        fields: dict[str, object] = {"from": before.value, "to": self.status.value}
        if cause is Cause.CLOUD_LOST:
            silence_s = self._services.silence_s(now)
            if silence_s is not None:
                fields["silent_ms"] = 1e3 * silence_s
        elif self._lost_at is not None:
            fields["outage_ms"] = 1e3 * (now - self._lost_at)
        self._report("status", **fields, reason=reason)

    # -- the local service -----------------------------------------------------------------------

    def _tend_recovery(self, now: float) -> None:
        """Start the local service when it is wanted, and again when it does not come up."""
        local, launches = self._services.local, self._launches
        if local is None:
            return
        if self.status is Status.LOCAL_RECOVERY:
            launches.want(now)
        waited_s = launches.overdue_s(now, present=local.detector.present)
        if waited_s is not None:
            self._report("launch_failed", reason=f"not seen after {1e3 * waited_s:.0f} ms")
            launches.gave_up(now)
        if launches.is_due(now):
            if local.detector.boot is not None:
                local.detector.vanished(local.detector.boot)
            for call in self._calls.to(local):
                self._calls.abandon(call)
            local.forget()
            number = launches.begin(now)
            self._report("launch", service=local.name)
            self.effects.append(Launch(number))

    # -- hedging ---------------------------------------------------------------------------------

    def _hedge_at(self, question: Question) -> float | None:
        """Return when the local service shall be asked as well; None if it shall not."""
        local, due = self._services.local, self._hedging.due_at(question)
        if (
            due is None
            or local is None
            or not local.reliable
            or self._calls.is_asked(local, question)
        ):
            return None
        return max(due, local.retry_at)

    def _hedge(self, question: Question, now: float) -> None:
        local, due = self._services.local, self._hedge_at(question)
        if local is None or due is None or now < due:
            return
        self._hedging.spend()
        assert question.needed_at is not None
        self._report("hedge", step=question.state.step, waited_ms=1e3 * (now - question.needed_at))
        self._send(local, question, now, also=True)

    # -- sending ---------------------------------------------------------------------------------

    def _send(
        self,
        service: KnownService,
        question: Question,
        now: float,
        *,
        whole_state: bool = False,
        also: bool = False,
    ) -> None:
        """Send a question; ``also`` if another one is asked, too."""
        also = also or question is not self.question
        self._calls.send(service, question, now, whole_state=whole_state, also=also)

    # -- saying ----------------------------------------------------------------------------------

    def _report(self, name: str, **fields: object) -> None:
        self.effects.append(Report(name, fields))

    def _report_suspected(self, service: KnownService) -> None:
        self._report("service_suspected", service=service.name, reason=service.detector.suspicion)

    def _stop(self, error: HoldfastError) -> None:
        if not self.stopped:
            self.stopped = True
            self.effects.append(Stop(error))
