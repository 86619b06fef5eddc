"""Chooses the service that answers the robot's current question.

All services give the same answer, because a decision is a function of the state in the question. So
the choice affects only time, and a wrong choice costs only time:

- The configured services, together *the cloud*, are tried in their order of preference.
- If none of them is usable, the local service decides (status *local recovery*) and is launched if
  it does not run. Each question still goes to the cloud as well; its first answer ends the recovery
  (status *keep alive*).
- A late decision may also be requested from a running local service (hedging, within a budget).
- If no service is usable, the robot holds still, reports that, and keeps trying all of them.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

from holdfast.errors import HoldfastError, ServiceRefusedError
from holdfast.planning.planner import Planner
from holdfast.planning.settings import OffloadSettings, RecoverySettings
from holdfast.problems.problem import Problem
from holdfast.protocol.local_service import HedgingBudget, RestartPolicy
from holdfast.protocol.messages import (
    NeedState,
    Progress,
    SensingAnswer,
    SessionConfiguration,
    TaskAnswer,
)
from holdfast.protocol.question import DecisionSource, Question
from holdfast.protocol.replica_set import Replica, ReplicaSet
from holdfast.protocol.requests import OpenRequest, OpenRequests
from holdfast.protocol.robot_events import (
    CallEnded,
    Launch,
    OwnAnswer,
    RecoveryExited,
    ReplyReceived,
    ServiceAppeared,
    ServiceVanished,
    TransportEvent,
)
from holdfast.protocol.status import Cause
from holdfast.protocol.verification import Verification

_LONGEST_SILENT_WAIT_S = 1.0
"""A longer wait is reported, unless a dead service takes longer to detect."""


class Dispatcher(DecisionSource):
    """Gets one question at a time answered by the services.

    It lives as long as the run.
    """

    def __init__(
        self,
        services: Sequence[str],  # the cloud's services in order of preference, at least one
        local_service_name: str | None,  # name of the local service; None if there is none
        offload: OffloadSettings,
        recovery_settings: RecoverySettings,
        session: bytes,
        epoch: int,
        session_configuration: SessionConfiguration,
        problem: Problem,
        secret: bytes,  # known only to this robot; selects the answers that are recomputed
        distrusted: Collection[str] = (),  # services that answered wrongly earlier in this run
    ) -> None:
        super().__init__()
        self.takes_tasks = offload.what == "sensing"
        detection_timeout_s = 1e-3 * offload.detection_timeout_ms
        wanted = recovery_settings.launch != "never"
        self._detection_timeout_s = detection_timeout_s
        self._patience_s = max(_LONGEST_SILENT_WAIT_S, detection_timeout_s)
        self._limit_s = 1e-3 * offload.decision_timeout_ms
        self._launch_at_start = recovery_settings.launch == "at_start"
        self._services = ReplicaSet(
            services,
            local_service_name if wanted else None,
            detection_timeout_s,
            1e-3 * offload.startup_timeout_ms,
            distrusted,
        )
        planner = Planner(problem, session_configuration.planning)
        self._verification = Verification(
            offload.verify_share, secret, local_service_name, planner, self.effects
        )
        self._calls = OpenRequests(
            session,
            epoch,
            session_configuration,
            detection_timeout_s,
            planner,
            self._verification,
            self.effects,
        )
        self._launches = RestartPolicy(recovery_settings)
        self._hedging = HedgingBudget(offload)
        self._reported_wait: Question | None = None
        self._woke_at = float("-inf")

    # -- what the robot's loop asks for ----------------------------------------------------------

    def start(self, now: float) -> None:
        """Begin the run."""
        self._services.start(now)
        for replica in self._services:
            if replica.distrusted is not None:
                self.effects.report("distrusted", service=replica.name, reason=replica.distrusted)
        if self._services.local is not None and self._launch_at_start:
            self._launches.want(now)
            self.wake(now)

    def ask(self, question: Question, now: float) -> None:
        """Replace the question."""
        super().ask(question, now)
        self._hedging.earn()
        for call in self._calls:
            # A service that has not answered yet may still do so, and is then known to live; but
            # one that already gave a part has shown that.
            if call.answered:
                self._calls.abandon(call)
        self._verification.keep([call.question for call in self._calls])
        self.wake(now)
        if self.stopped_by is None:
            self._try_others(question, now)

    def drop(self) -> None:
        """Drop the question: the trial has ended, or its answer is of no use."""
        super().drop()
        for call in self._calls:
            if call.answered or call.replica is self._services.local:
                self._calls.abandon(call)
        self.holding_since = None

    # -- what happens ----------------------------------------------------------------------------

    def handle(self, event: TransportEvent | OwnAnswer | RecoveryExited, now: float) -> None:
        """Handle an event of the transport, the own planner or the local service's process."""
        if isinstance(event, ReplyReceived | CallEnded):
            call = self._calls.get(event.call)
            if call is not None and isinstance(event, ReplyReceived):
                self._replied(call, event.payload, now)
            elif call is not None:
                self._ended(call, now)
        elif isinstance(event, ServiceAppeared):
            self._appeared(self._services.get(event.service), event.incarnation, now)
        elif isinstance(event, ServiceVanished):
            self._vanished(event, now)
        elif isinstance(event, OwnAnswer):
            self._decided(event)
        elif isinstance(event, RecoveryExited):
            self._local_exited(event, now)
        self.wake(now)

    def recompute(self) -> None:
        """Have the own planner answer the question too."""
        if self.question is not None:
            self._verification.check(self.question)

    @property
    def num_unverified(self) -> int:
        """Questions that the own planner still has to answer."""
        return len(self._verification)

    def next_wakeup(self) -> float | None:
        """Return when :meth:`wake` is due if nothing happens before; None if never."""
        if self.stopped_by is not None:
            return None
        services, question = self._services, self.question
        due: list[float | None] = []
        if self._calls:
            due += [replica.detector.deadline() for replica in services]
            due += [call.sent_at + self._limit_s for call in self._calls]
        if question is not None and not question.complete:
            if not self._is_being_asked(question, self._woke_at):
                due += [
                    self._calls.retry_at(replica, question)
                    for replica in services
                    if replica.detector.present and replica.refusal is None
                ]
                if services.is_starting(self._woke_at):
                    due.append(services.startup_until)
            elif self.needed_at is not None:
                due += [self._calls.probe_at(replica, question) for replica in services.cloud]
                due.append(self.needed_at + self._detection_timeout_s)
            if self.needed_at is not None and question is not self._reported_wait:
                due.append(self.needed_at + self._patience_s)
            due.append(self._hedge_at(question))
        local = services.local
        if local is not None:
            due.append(self._launches.next_wakeup(present=local.detector.present))
        # What was due when we worked last has been looked at; only something new can change it.
        later = [at for at in due if at is not None and at > self._woke_at]
        return min(later, default=None)

    def event_loop_stalled(self, seconds: float) -> None:
        """Excuse the services: for so long the robot's process could not receive."""
        for replica in self._services:
            replica.detector.excuse(seconds)
        for call in self._calls:
            call.excused_s += seconds

    # -- presence --------------------------------------------------------------------------------

    def _appeared(self, replica: Replica | None, incarnation: str, now: float) -> None:
        if replica is None or not replica.detector.appeared(incarnation, now):
            return
        self._calls.abandon_all(replica)
        if incarnation != replica.last_incarnation:
            replica.forget()
            replica.last_incarnation = incarnation
        if replica is self._services.local:
            launch_s = self._launches.appeared(now)
            if launch_s is not None:
                self.effects.report("launched", launch_ms=1e3 * launch_s)
            return
        self.effects.report("service_appeared", service=replica.name)
        question = self.question
        if self.tracker.is_recovering and question is not None and replica.refusal is None:
            # It need not wait for the next turn: with an answer to this one it holds the state.
            self._calls.send(replica, question, now)

    def _vanished(self, event: ServiceVanished, now: float) -> None:
        replica = self._services.get(event.service)
        if replica is None or not replica.detector.vanished(event.incarnation):
            return
        self._calls.abandon_all(replica)
        why = {"reason": event.reason} if event.reason else {}
        self.effects.report("service_vanished", service=replica.name, **why)
        if replica is self._services.local:
            self._launches.ended(now)

    def _local_exited(self, event: RecoveryExited, now: float) -> None:
        local, launches = self._services.local, self._launches
        if local is None:
            return
        self.effects.report("recovery_exited", reason=event.reason)
        if event.launch != launches.number or launches.pending:
            return  # It was seen to be gone before; only the reason is new.
        if local.detector.incarnation is not None:
            self._vanished(ServiceVanished(local.name, local.detector.incarnation), now)
        else:
            launches.failed(now)

    # -- answers ---------------------------------------------------------------------------------

    def _replied(self, call: OpenRequest, payload: bytes, now: float) -> None:
        replica, question, is_first = call.replica, call.question, not call.answered
        try:
            reply = self._calls.take(call, payload, now)
        except HoldfastError as error:
            self.stop(error)
            return
        self._drop_wrong_services()
        is_answer = isinstance(reply, TaskAnswer | SensingAnswer)
        if question is self.question:
            if is_answer or isinstance(reply, Progress):
                self._end_hold(now)
            elif isinstance(reply, NeedState) and not call.has_everything:
                # Told everything but the state, it came to another one: only the state will do.
                whole_state = reply.differs or call.opens
                self._calls.send(replica, question, now, whole_state=whole_state)
        if is_answer and replica is self._services.local:
            self._launches.succeeded()
        elif is_answer and is_first and self.tracker.is_recovering and replica.reliable:
            reason = f"{replica.name} has answered"
            self.effects.report("status", **self.tracker.change(Cause.CLOUD_ANSWERED, reason, now))

    def _ended(self, call: OpenRequest, now: float) -> None:
        self._calls.settle(call)
        question = call.question
        if question is not self.question or question.complete:
            return
        # The service is gone; if only this call was lost, the service's next answer
        # clears it.
        replica = call.replica
        replica.delay(now)
        if replica.detector.suspicion is None:
            replica.detector.suspect("a call ended without the answer")
            self._report_suspected(replica)

    def _decided(self, event: OwnAnswer) -> None:
        """Take the answer of the robot's own planner."""
        if not self._verification.decided(event, self.question):
            # What was done cannot be undone; from where it led, a new question is asked.
            self.drop()
        self._drop_wrong_services()

    def _drop_wrong_services(self) -> None:
        """Ask services no longer whose answers differ from the own planner's."""
        for wrong in self._verification.take_wrong():
            replica = self._services.get(wrong.service)
            if replica is None:
                continue
            replica.distrust(
                f"answered otherwise than the robot's own planner in step {wrong.step}"
            )
            self._calls.abandon_all(replica)
            self.effects.counts["wrong_answer"] += 1
            self.effects.report(
                "wrong_answer",
                service=replica.name,
                step=wrong.step,
                kind=wrong.kind,
                answered=wrong.answered,
                own=wrong.own,
                reason="not what the robot's own planner decides in the same state; it is not "
                "asked again in this run",
            )
            question = self.question
            if question is not None and wrong.service in dict(question.followed()).values():
                # What it said last was perhaps not looked at yet.
                self.drop()

    # -- deciding whom to ask --------------------------------------------------------------------

    def wake(self, now: float) -> None:
        """Do what is due now; every event is followed by it."""
        if self.stopped_by is not None:
            return
        self._woke_at = now
        self._suspect_silent(now)
        self._enforce_decision_timeout(now)
        self._tend_recovery(now)
        question = self.question
        if question is not None:
            if question.complete:
                self._end_hold(now)
            elif self._is_being_asked(question, now):
                self._hedge(question, now)
                if self.needed_at is not None:
                    # The service that has the question may be silent for long meanwhile.
                    self._try_others(question, now)
                self._report_wait(question, now)
            else:
                self._ask_or_hold(question, now)
        self._note_lost_cloud(now)

    def _suspect_silent(self, now: float) -> None:
        for replica in self._services:
            if replica.detector.suspect_if_silent(now):
                self._report_suspected(replica)
                if replica is self._services.local:
                    # It runs but does nothing: another one is started in its place, and is given
                    # more time, for it may be that its decisions simply take long.
                    replica.detector.extend_patience(2.0, self._limit_s)
                    self._launches.failed(now)

    def _enforce_decision_timeout(self, now: float) -> None:
        for call in self._calls:
            if now >= call.sent_at + self._limit_s:
                replica = call.replica
                self._calls.abandon(call)
                replica.delay(now)
                replica.detector.suspect(
                    f"a decision took longer than {1e3 * self._limit_s:.0f} ms"
                )
                self._report_suspected(replica)

    def _is_being_asked(self, question: Question, now: float) -> bool:
        """Return whether a usable service has the question."""
        calls = self._calls.about(question)
        if self.tracker.is_recovering and self._services.local_usable(now):
            # The cloud is only tried: it may say for long that it is at work.
            return any(call.replica is self._services.local for call in calls)
        return any(call.replica.detector.trusted for call in calls)

    def _ask_or_hold(self, question: Question, now: float) -> None:
        """Send the question to the best usable service; without one, start the recovery or hold."""
        services = self._services
        if not self.tracker.is_recovering:
            for replica in services.cloud:
                if replica.usable(now) and not self._calls.is_asked(replica, question):
                    self._calls.send(replica, question, now, waited_s=self.waited_s(now))
                    return
            if services.is_starting(now):
                return
            busy_until = services.busy_until(now)
            if busy_until is not None:
                since = now if self.needed_at is None else self.needed_at
                is_long = busy_until - since > self._detection_timeout_s
                if not is_long and not services.local_usable(now):
                    return
        if services.local is not None and not self.tracker.is_recovering:
            self._lose_cloud(now)
        if services.local is None or not services.local_usable(now):
            self._hold_and_retry(question, now)
        elif not self._calls.is_asked(services.local, question):
            self._calls.send(services.local, question, now, waited_s=self.waited_s(now))

    def _hold_and_retry(self, question: Question, now: float) -> None:
        """Ask any present service, suspected or not, at growing intervals."""
        services = self._services
        for replica in services:
            if (
                replica.detector.present
                and replica.refusal is None
                and self._calls.retry_at(replica, question) <= now
            ):
                replica.delay(now)
                self._calls.send(replica, question, now, waited_s=self.waited_s(now))
                if replica.detector.trusted:
                    return
        if services.all_refuse():
            self.stop(
                ServiceRefusedError(f"no service will decide: {services.explain_no_service()}")
            )
            return
        if self.needed_at is not None and self.holding_since is None:
            self.holding_since = now
            reason = services.explain_no_service()
            self.effects.report("holding", step=question.state.step, reason=reason)

    def _try_others(self, question: Question, now: float) -> None:
        """Ask services that do not decide, and for a late answer a further one, the question too.

        An answer of a suspected one brings it back.
        """
        needed_at = self.needed_at
        is_late = needed_at is not None and now >= needed_at + self._detection_timeout_s
        for replica in self._services.cloud:
            if replica.usable(now) and not self.tracker.is_recovering:
                if is_late and not self._calls.is_asked(replica, question):
                    # It has come back while one that is less preferred takes its time.
                    self._calls.send(replica, question, now)
                break
            at = self._calls.probe_at(replica, question)
            if at is not None and at <= now:
                if self._calls.is_asked(replica, question):
                    replica.delay(now)
                self._calls.send(replica, question, now)

    def _note_lost_cloud(self, now: float) -> None:
        """Start the recovery if the cloud was lost while nothing was asked of it."""
        if (
            self._services.local is not None
            and not self.tracker.is_recovering
            and not self._services.is_starting(now)
            and not any(replica.reliable for replica in self._services.cloud)
        ):
            self._lose_cloud(now)

    def _lose_cloud(self, now: float) -> None:
        """Start the recovery."""
        reason, silence_s = self._services.why_lost(), self._services.silence_s(now)
        self.effects.report(
            "status", **self.tracker.change(Cause.CLOUD_LOST, reason, now, silence_s)
        )
        self._tend_recovery(now)

    # -- standing still --------------------------------------------------------------------------

    def _report_wait(self, question: Question, now: float) -> None:
        """Report, once per question, that a service takes its time while the robot waits."""
        if self.needed_at is None or question is self._reported_wait:
            return
        if now >= self.needed_at + self._patience_s:
            self._reported_wait = question
            asked = {call.replica.name for call in self._calls.about(question)}
            self.effects.report(
                "waiting",
                service=", ".join(sorted(asked)),
                step=question.state.step,
                waited_ms=1e3 * self.waited_s(now),
            )

    def _end_hold(self, now: float) -> None:
        """Report that the robot need not hold still any more, if it does."""
        if self.holding_since is not None:
            self.effects.report("resumed", held_ms=1e3 * (now - self.holding_since))
            self.holding_since = None

    # -- the local service -----------------------------------------------------------------------

    def _tend_recovery(self, now: float) -> None:
        """Launch the local service when it is wanted, and again if it does not come up."""
        local, launches = self._services.local, self._launches
        if local is None:
            return
        if self.tracker.is_recovering:
            launches.want(now)
        waited_s = launches.overdue_launch_age_s(now, present=local.detector.present)
        if waited_s is not None:
            self.effects.report("launch_failed", reason=f"not seen after {1e3 * waited_s:.0f} ms")
            launches.failed(now, late=True)
        if launches.is_due(now):
            if local.detector.incarnation is not None:
                local.detector.vanished(local.detector.incarnation)
            self._calls.abandon_all(local)
            local.forget()
            number = launches.begin(now)
            self.effects.report("launch", service=local.name)
            self.effects.append(Launch(number))

    def _hedge_at(self, question: Question) -> float | None:
        """Return when the local service is asked as well; None if it is not."""
        local, due = self._services.local, self._hedging.due_at(self.needed_at)
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
        self.effects.report("hedge", step=question.state.step, waited_ms=1e3 * self.waited_s(now))
        self._calls.send(local, question, now)

    def _report_suspected(self, replica: Replica) -> None:
        self.effects.report(
            "service_suspected", service=replica.name, reason=replica.detector.suspicion
        )
