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
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from holdfast.errors import HoldfastError
from holdfast.planning import PlanningState, encode_checkpoint, needs_sensing
from holdfast.session.effects import Abandon, Effect, Launch, Report, Send, Stop
from holdfast.session.events import Appeared, Ended, Replied, TransportEvent
from holdfast.session.failure_detector import FailureDetector
from holdfast.session.messages import (
    DIGEST_SIZE,
    MAX_TASK_ACTIONS,
    PROTOCOL_VERSION,
    Busy,
    MessageError,
    NeedState,
    Observed,
    Opening,
    Progress,
    Refused,
    Reply,
    Request,
    SensingAnswer,
    TaskAnswer,
    decode_reply,
    encode,
    numbers_from,
)
from holdfast.session.status import Cause, Status, next_status
from holdfast.settings import OffloadSettings, PlanningSettings, RecoverySettings

__all__ = ["Dispatcher", "Provenance", "Question", "ServiceRefusedError", "StaleEpochError"]

FloatArray = npt.NDArray[np.float64]

_FIRST_RETRY_S = 0.02
_LAST_RETRY_S = 1.0
_MAX_REFUSALS = 3
_MAX_CALLS = 4
"""Bound on the calls to one service that may be open at a time."""

_MAX_REPLAYED_STEPS = 1024
"""A trial longer than this is not planned again for a service that knows nothing of it."""

_TELLING_INTERVAL_S = 1.0
"""What may happen many times a second is told this often, with a count."""

_LONGEST_SILENT_WAIT_S = 1.0
"""When the robot stands still for longer than this, somebody should know why."""

_LARGE_CHECKPOINT = 1 << 20
"""Bytes from which a service rather plans the trial again than be sent its state."""

_MAX_DRIFTS = 2
"""A service that came to another state this often in a row is sent the state each time."""

_HEDGING_BURST = 3.0
_LOCAL_PATIENCE = 4.0
"""The local service may be silent this much longer: to replace it costs more than to wait."""

_FINAL_REFUSALS = frozenset({"unknown_problem", "version", "too_large"})
_REFUSED_BY_ALL = frozenset({"invalid", "failed"})
"""Refusals that say something of the question itself: any other service would say the same."""


class StaleEpochError(HoldfastError):
    """Another process has taken this run over: this robot must not go on."""


class ServiceRefusedError(HoldfastError):
    """Every service that could decide refuses to, and asking again would not help."""


class Provenance(NamedTuple):
    """Where an answer came from and how long it took."""

    service: str
    round_trip_s: float
    computed_s: float


class Question:
    """What to do from a state on, and as much of the answer as has come.

    Parameters
    ----------
    settings : PlanningSettings
    state : PlanningState
    digest : bytes
        Of the state.
    observations : tuple of Observed
        What was sensed last in this trial.
    num_observations : int
        All that was sensed in this trial.

    Attributes
    ----------
    task_count : int
        Task actions that belong to the answer.
    sensing_step : int or None
        The sensing step that does; None if it is too far away.
    tasks : list of array or None
    sensing : SensingAnswer or None
    task_source, sensing_source : Provenance or None
    """

    __slots__ = (
        "_checkpoint",
        "digest",
        "needed_at",
        "num_observations",
        "observations",
        "sensing",
        "sensing_source",
        "sensing_step",
        "state",
        "task_count",
        "task_source",
        "tasks",
        "times_asked",
        "told_waiting",
    )

    def __init__(
        self,
        settings: PlanningSettings,
        state: PlanningState,
        digest: bytes,
        observations: tuple[Observed, ...],
        num_observations: int,
    ) -> None:
        self.state = state
        self.digest = digest[:DIGEST_SIZE]
        self.observations = observations
        self.num_observations = num_observations
        self.needed_at: float | None = None
        self.told_waiting = False
        self.times_asked = 0
        self.tasks: list[FloatArray] | None = None
        self.sensing: SensingAnswer | None = None
        self.task_source: Provenance | None = None
        self.sensing_source: Provenance | None = None
        self._checkpoint: bytes | None = None
        if needs_sensing(settings, state):
            self.task_count = 0
            self.sensing_step: int | None = state.step
        else:
            interval = settings.sensing_interval + 1
            following = (state.step // interval + 1) * interval
            self.task_count = min(following - state.step, MAX_TASK_ACTIONS)
            within = following - state.step <= MAX_TASK_ACTIONS
            self.sensing_step = following if within else None

    @property
    def complete(self) -> bool:
        """Whether nothing of the answer is missing."""
        return (self.tasks is not None or self.task_count == 0) and (
            self.sensing is not None or self.sensing_step is None
        )

    def checkpoint(self) -> bytes:
        """Return the state, encoded (once)."""
        if self._checkpoint is None:
            self._checkpoint = encode_checkpoint(self.state)
        return self._checkpoint


class _Call:
    """One request that is on its way."""

    __slots__ = ("number", "opens", "question", "restores", "sensing", "sent_at", "service", "task")

    def __init__(
        self,
        number: int,
        service: _Service,
        question: Question,
        sent_at: float,
        *,
        opens: bool,
        restores: bool,
    ) -> None:
        self.number = number
        self.service = service
        self.question = question
        self.sent_at = sent_at
        self.opens = opens
        self.restores = restores
        self.task = False
        self.sensing = False

    @property
    def answered(self) -> bool:
        """Whether a part of the answer has come."""
        return self.task or self.sensing

    @property
    def finished(self) -> bool:
        """Whether all of it has."""
        question = self.question
        return (self.task or question.task_count == 0) and (
            self.sensing or question.sensing_step is None
        )


class _Service:
    """What is known of one service."""

    __slots__ = (
        "acknowledged",
        "backoff_s",
        "calls",
        "detector",
        "drifts",
        "last_boot",
        "name",
        "num_busy",
        "opened",
        "refusals",
        "refused",
        "refused_code",
        "retry_at",
        "tell_busy_at",
    )

    def __init__(self, name: str, detection_timeout_s: float) -> None:
        self.name = name
        self.detector = FailureDetector(detection_timeout_s)
        self.calls: dict[int, _Call] = {}
        self.last_boot: str | None = None
        self.forget()

    def forget(self) -> None:
        """Note that another process has taken its place: it knows nothing."""
        self.opened = False
        self.acknowledged: tuple[int, int] | None = None
        self.drifts = 0
        self.refusals = 0
        self.refused: str | None = None
        self.refused_code = ""
        self.retry_at = 0.0
        self.backoff_s = _FIRST_RETRY_S
        self.num_busy = 0
        self.tell_busy_at = 0.0

    def usable(self, now: float) -> bool:
        return self.detector.trusted and self.refused is None and self.retry_at <= now

    def is_asked(self, question: Question) -> bool:
        return any(call.question is question for call in self.calls.values())

    def asked_at(self, question: Question) -> float | None:
        """Return when it was last asked this question; None if it is not being asked."""
        times = [call.sent_at for call in self.calls.values() if call.question is question]
        return max(times, default=None)

    def delay(self, now: float) -> None:
        """Ask it again only after a while, longer each time."""
        self.retry_at = now + self.backoff_s
        self.backoff_s = min(2.0 * self.backoff_s, _LAST_RETRY_S)


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
    ) -> None:
        timeout_s = 1e-3 * offload.detection_timeout_ms
        self._cloud = [_Service(name, timeout_s) for name in services]
        wanted = recovery is not None and recovery_settings.launch != "never"
        self._timeout_s = timeout_s
        self._patience_s = max(_LONGEST_SILENT_WAIT_S, timeout_s)
        self._local = (
            _Service(recovery, _LOCAL_PATIENCE * timeout_s)
            if recovery is not None and wanted
            else None
        )
        self._by_name = {service.name: service for service in self._cloud}
        if self._local is not None:
            self._by_name[self._local.name] = self._local
        self._offload = offload
        self._recovery = recovery_settings
        self._session = session
        self._epoch = epoch
        self._opening = opening
        self._action_size = action_size
        self._num_sensing_actions = num_sensing_actions
        self.effects: list[Effect] = []
        self._calls: dict[int, _Call] = {}
        self._number = 0
        self._startup_until: float | None = None
        self._worked_at = float("-inf")
        self._budget = _HEDGING_BURST
        self._holding_since: float | None = None
        self._lost_at: float | None = None
        self._launched_at: float | None = None
        self._launch_after: float | None = None
        self._launch_failures = 0
        self._launches = 0
        self.stopped = False
        self.status = Status.STANDARD
        self.question: Question | None = None
        self.recoveries = 0

    # -- what the robot's loop asks for ----------------------------------------------------------

    def start(self, now: float) -> None:
        """Begin the run."""
        self._startup_until = now + 1e-3 * self._offload.startup_timeout_ms
        if self._local is not None and self._recovery.launch == "at_start":
            self._launch_after = now
            self._work(now)

    def ask(self, question: Question, now: float) -> None:
        """Ask a new question; the one before is forgotten."""
        self.question = question
        self._budget = min(_HEDGING_BURST, self._budget + self._offload.max_hedged_share)
        for call in list(self._calls.values()):
            # A service that has not answered yet may still do so, and is then known to live; but
            # one that already gave a part has shown that.
            if call.answered:
                self._abandon(call)
        self._work(now)
        self._try_others(now)

    def drop(self) -> None:
        """Forget the question: the trial is over."""
        self.question = None
        for call in list(self._calls.values()):
            if call.answered or call.service is self._local:
                self._abandon(call)
        self._holding_since = None

    def need(self, now: float) -> None:
        """Say that the robot stands still until the rest of the answer is there."""
        if self.question is not None and self.question.needed_at is None:
            self.question.needed_at = now
            self._work(now)

    def take(self) -> list[Effect]:
        """Return the effects so far, in order, and forget them."""
        effects = self.effects.copy()
        self.effects.clear()
        return effects

    # -- what happens ----------------------------------------------------------------------------

    def handle(self, event: TransportEvent, now: float) -> None:
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
            self._appeared(self._by_name.get(event.service), event.boot, now)
        else:
            self._vanished(self._by_name.get(event.service), event.boot, now)
        self._work(now)

    def recovery_exited(self, launch: int, reason: str, now: float) -> None:
        """Take note that a process of the local service has ended, or could not be started.

        Parameters
        ----------
        launch : int
            The number of its :class:`~holdfast.session.effects.Launch`.
        reason : str
        now : float
        """
        local = self._local
        if local is None:
            return
        if launch != self._launches or self._launch_after is not None:
            # It was seen to be gone before; only the reason is new.
            self._report("recovery_exited", reason=reason)
            return
        if local.detector.boot is not None:
            self._vanished(local, local.detector.boot, now)
        if self._launch_after is None:
            self._report("recovery_exited", reason=reason)
            self._launch_failed(now)
        self._work(now)

    def wake(self, now: float) -> None:
        """Time has passed."""
        self._work(now)

    def next_wakeup(self) -> float | None:
        """Return when :meth:`wake` must be called if nothing happens before."""
        due: list[float] = []
        for service in self._by_name.values():
            deadline = service.detector.deadline()
            if deadline is not None:
                due.append(deadline)
        question = self.question
        if question is not None and not question.complete:
            if not self._is_being_asked(question):
                due += [
                    self._ask_again_at(service, question)
                    for service in self._by_name.values()
                    if service.detector.present and service.refused is None
                ]
                if self._startup_until is not None and not self._any_seen():
                    due.append(self._startup_until)
            if question.needed_at is not None and not question.told_waiting:
                due.append(question.needed_at + self._patience_s)
            hedge_at = self._hedge_at(question)
            if hedge_at is not None:
                due.append(hedge_at)
        if self._calls:
            oldest = min(call.sent_at for call in self._calls.values())
            due.append(oldest + 1e-3 * self._offload.decision_timeout_ms)
        if self._launch_after is not None:
            due.append(self._launch_after)
        elif self._is_launching():
            assert self._launched_at is not None
            due.append(self._launched_at + 1e-3 * self._recovery.launch_timeout_ms)
        # What was due when we worked last has been looked at; only something new can change it.
        return min((at for at in due if at > self._worked_at), default=None)

    def was_deaf(self, seconds: float) -> None:
        """Take note that for this long nothing that came could be heard."""
        for service in self._by_name.values():
            service.detector.excuse(seconds)

    # -- presence --------------------------------------------------------------------------------

    def _appeared(self, service: _Service | None, boot: str, now: float) -> None:
        if service is None or not service.detector.appeared(boot):
            return
        for call in list(service.calls.values()):
            self._abandon(call)
        if boot != service.last_boot:
            service.forget()
            service.last_boot = boot
        if service is self._local:
            if self._launched_at is not None:
                self._report("launched", launch_ms=1e3 * (now - self._launched_at))
            return
        self._report("service_appeared", service=service.name)
        question = self.question
        if self.status is Status.LOCAL_RECOVERY and question is not None:
            # It need not wait for the next turn: with an answer to this one it holds the state.
            self._send(service, question, now, also=True)

    def _vanished(self, service: _Service | None, boot: str, now: float) -> None:
        if service is None or not service.detector.vanished(boot):
            return
        for call in list(service.calls.values()):
            self._abandon(call)
        self._report("service_vanished", service=service.name)
        if service is self._local:
            lived_s = now - (self._launched_at or now)
            if lived_s > 1.0:
                self._launch_failures = 0
            self._launch_failed(now)

    # -- replies ---------------------------------------------------------------------------------

    def _replied(self, call: _Call, payload: bytes, now: float) -> None:
        service = call.service
        try:
            reply = decode_reply(payload)
            _check_number(reply, call.number)
            self._apply(call, reply, now)
        except MessageError as error:
            # Spoilt on its way, or by a service that errs: the answer is asked for again.
            self._report("malformed_reply", service=service.name, reason=str(error))
            self._settle(call)
            self.effects.append(Abandon(call.number))
            service.delay(now)

    def _apply(self, call: _Call, reply: Reply, now: float) -> None:
        service = call.service
        if isinstance(reply, TaskAnswer | SensingAnswer):
            if isinstance(reply, TaskAnswer):
                self._task_answer(call, reply, now)
            else:
                self._sensing_answer(call, reply, now)
            self._was_answered(call, reply, now)
            return
        service.detector.heard(now)
        if isinstance(reply, Progress):
            if call.question is self.question:
                self._let_go(now)
            return
        self._settle(call)
        self.effects.append(Abandon(call.number))
        if isinstance(reply, NeedState):
            self._need_state(call, reply, now)
        elif isinstance(reply, Busy):
            # Its own estimate, but never as often as it can answer.
            after_s = max(1e-3 * reply.retry_after_ms, service.backoff_s)
            service.delay(now)
            service.retry_at = now + after_s
            service.num_busy += 1
            if now >= service.tell_busy_at:
                service.tell_busy_at = now + _TELLING_INTERVAL_S
                self._report(
                    "busy",
                    service=service.name,
                    retry_after_ms=1e3 * after_s,
                    times=service.num_busy,
                )
        else:
            self._was_refused(call, reply, now)

    def _was_answered(self, call: _Call, reply: TaskAnswer | SensingAnswer, now: float) -> None:
        service, question = call.service, call.question
        first = not call.answered
        if isinstance(reply, TaskAnswer):
            call.task = True
        else:
            call.sensing = True
        service.detector.heard(now)
        service.opened = True
        service.refusals = 0
        service.retry_at = 0.0
        service.backoff_s = _FIRST_RETRY_S
        if not call.restores:
            service.drifts = 0
        holds = (question.state.trial, question.num_observations)
        service.acknowledged = max(service.acknowledged or holds, holds)
        if first and call.opens and (call.restores or question.state.step > 0):
            restore_ms = 1e3 * (now - call.sent_at)
            self._report(
                "restored", service=service.name, step=question.state.step, restore_ms=restore_ms
            )
        if question is self.question:
            self._let_go(now)
        if call.finished:
            self._settle(call)
        if service is self._local:
            self._launch_failures = 0
        elif first and self.status is Status.LOCAL_RECOVERY:
            self._change_status(Cause.CLOUD_ANSWERED, f"{service.name} has answered", now)

    def _task_answer(self, call: _Call, reply: TaskAnswer, now: float) -> None:
        question = call.question
        if reply.count != question.task_count:
            raise MessageError(
                "malformed", f"{reply.count} task actions where {question.task_count} were asked"
            )
        numbers = numbers_from(reply.actions, reply.count * self._action_size)
        actions = list(numbers.reshape(reply.count, self._action_size))
        if question.tasks is None:
            question.tasks = actions
            question.task_source = Provenance(
                call.service.name, now - call.sent_at, 1e-6 * reply.computed_us
            )
        elif not all(map(np.array_equal, question.tasks, actions)):
            self._disagrees(call, "task")

    def _sensing_answer(self, call: _Call, reply: SensingAnswer, now: float) -> None:
        question = call.question
        if reply.step != question.sensing_step:
            raise MessageError(
                "malformed",
                f"a sensing action for step {reply.step} where {question.sensing_step} was asked",
            )
        if question.task_count == 0 and reply.digest != question.digest:
            raise MessageError("malformed", "a sensing action for another state than was asked")
        if reply.sensing_action >= self._num_sensing_actions:
            raise MessageError("malformed", f"there is no sensing action {reply.sensing_action}")
        if question.sensing is None:
            question.sensing = reply
            question.sensing_source = Provenance(
                call.service.name, now - call.sent_at, 1e-6 * reply.computed_us
            )
        elif question.sensing.sensing_action != reply.sensing_action:
            self._disagrees(call, "sensing")

    def _disagrees(self, call: _Call, kind: str) -> None:
        self._report(
            "disagreement",
            service=call.service.name,
            step=call.question.state.step,
            kind=kind,
            reason="two services decided differently; the first answer stands",
        )

    def _need_state(self, call: _Call, reply: NeedState, now: float) -> None:
        service, question = call.service, call.question
        service.opened = False
        service.acknowledged = None
        if reply.differs:
            service.drifts += 1
        if call.opens and call.restores:
            # It was handed everything and asks for it again.
            service.delay(now)
            self._refusal(service, "need_state", "asks again for a state that it was sent")
            return
        if question is self.question:
            # Told everything but the state, it came to another one: only the state will do.
            self._send(service, question, now, whole_state=reply.differs or call.opens, also=True)

    def _was_refused(self, call: _Call, reply: Refused, now: float) -> None:
        service = call.service
        if reply.code == "stale_epoch":
            self._stop(
                StaleEpochError(
                    f"{service.name}: {reply.text}; another process has resumed this run, "
                    "so this one stops"
                )
            )
            return
        service.opened = False
        service.acknowledged = None
        service.delay(now)
        self._refusal(service, reply.code, reply.text)

    def _refusal(self, service: _Service, code: str, text: str) -> None:
        service.refusals += 1
        final = code in _FINAL_REFUSALS or service.refusals >= _MAX_REFUSALS
        self._report("refused", service=service.name, code=code, reason=text, final=final)
        if final:
            service.refused = text
            service.refused_code = code

    def _ended(self, call: _Call, now: float) -> None:
        self._settle(call)
        question = call.question
        if question is not self.question or question.complete:
            return
        # Whoever was asked is gone; if it is only this call that was lost, its next answer
        # clears it.
        service = call.service
        service.delay(now)
        if service.detector.suspicion is None:
            service.detector.suspect("a call ended without the answer")
            self._report(
                "service_suspected", service=service.name, reason=service.detector.suspicion
            )

    def _settle(self, call: _Call) -> None:
        if self._calls.pop(call.number, None) is not None:
            del call.service.calls[call.number]
            call.service.detector.settled()

    def _abandon(self, call: _Call) -> None:
        self._settle(call)
        self.effects.append(Abandon(call.number))

    # -- deciding whom to ask --------------------------------------------------------------------

    def _work(self, now: float) -> None:
        """Do what the time and the situation ask for."""
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
        if question.complete:
            self._let_go(now)
            self._note_lost_cloud(now)
            return
        if self._is_being_asked(question):
            self._hedge(question, now)
            self._tell_waiting(question, now)
            self._note_lost_cloud(now)
        else:
            self._choose(question, now)

    def _look_for_silence(self, now: float) -> None:
        for service in self._by_name.values():
            if service.detector.fell_silent(now):
                self._report(
                    "service_suspected", service=service.name, reason=service.detector.suspicion
                )
                if service is self._local:
                    # It runs but does nothing: another one is started in its place, and is given
                    # more time, for it may be that its decisions simply take long.
                    limit_s = 1e-3 * self._offload.decision_timeout_ms
                    service.detector.extend_patience(2.0, limit_s)
                    self._launch_failed(now)
        limit_s = 1e-3 * self._offload.decision_timeout_ms
        for call in list(self._calls.values()):
            if now - call.sent_at >= limit_s:
                self._abandon(call)
                call.service.delay(now)
                call.service.detector.suspect(f"a decision took longer than {1e3 * limit_s:.0f} ms")
                self._report(
                    "service_suspected",
                    service=call.service.name,
                    reason=call.service.detector.suspicion,
                )

    def _is_being_asked(self, question: Question) -> bool:
        return any(
            call.question is question and call.service.detector.trusted
            for call in self._calls.values()
        )

    def _any_seen(self) -> bool:
        return any(service.detector.seen for service in self._cloud)

    def _is_starting(self) -> bool:
        """Tell whether a service may still be on its way up."""
        return self._startup_until is not None and not self._any_seen()

    def _busy_until(self, now: float) -> float | None:
        """Return when the first service that only asked for patience may be asked again."""
        times = [
            service.retry_at
            for service in self._cloud
            if service.detector.trusted and service.refused is None and service.retry_at > now
        ]
        return min(times, default=None)

    def _choose(self, question: Question, now: float) -> None:
        if self.status is not Status.LOCAL_RECOVERY:
            for service in self._cloud:
                if service.usable(now) and not service.is_asked(question):
                    self._send(service, question, now)
                    return
            if self._is_starting():
                return
            busy_until = self._busy_until(now)
            if busy_until is not None:
                patience_s = 1e-3 * self._offload.detection_timeout_ms
                since = now if question.needed_at is None else question.needed_at
                if busy_until - since <= patience_s and not self._local_usable(now):
                    return
        if self._local is None:
            self._hold_and_retry(question, now)
            return
        if self.status is not Status.LOCAL_RECOVERY:
            self._lose_cloud(now)
            self._tend_recovery(now)
        if self._local_usable(now):
            if not self._local.is_asked(question):
                self._send(self._local, question, now)
            return
        self._hold_and_retry(question, now)

    def _local_usable(self, now: float) -> bool:
        return self._local is not None and self._local.usable(now)

    def _ask_again_at(self, service: _Service, question: Question) -> float:
        """Return when a service that may not hear us is asked again."""
        asked_at = service.asked_at(question)
        if asked_at is None:
            return service.retry_at
        return max(service.retry_at, asked_at + self._timeout_s)

    def _hold_and_retry(self, question: Question, now: float) -> None:
        """Ask whoever is there at all, suspected or not, at growing intervals."""
        for service in self._by_name.values():
            if (
                service.detector.present
                and service.refused is None
                and self._ask_again_at(service, question) <= now
            ):
                service.delay(now)
                self._send(service, question, now)
                if service.detector.trusted:
                    return
        hopeless = self._local is not None and self._local.refused_code in _REFUSED_BY_ALL
        if hopeless or all(service.refused is not None for service in self._by_name.values()):
            self._stop(ServiceRefusedError(f"no service will decide: {self._why_nobody()}"))
            return
        if question.needed_at is not None and self._holding_since is None:
            self._holding_since = now
            self._report("holding", step=question.state.step, reason=self._why_nobody())

    def _why_nobody(self) -> str:
        reasons = []
        for service in self._by_name.values():
            if service.refused is not None:
                why = f"{service.refused_code}: {service.refused}"
            elif not service.detector.present:
                absent = "is not there" if service.detector.seen else "has not appeared"
                why = "is being launched" if service is self._local else absent
            else:
                why = service.detector.suspicion or "is busy"
            reasons.append(f"{service.name}: {why}")
        return "; ".join(reasons)

    def _tell_waiting(self, question: Question, now: float) -> None:
        """Say once that the robot stands still although somebody is being asked."""
        if question.needed_at is None or question.told_waiting:
            return
        waited_s = now - question.needed_at
        if waited_s >= self._patience_s:
            question.told_waiting = True
            asked = {
                call.service.name for call in self._calls.values() if call.question is question
            }
            self._report(
                "waiting",
                service=", ".join(sorted(asked)),
                step=question.state.step,
                waited_ms=1e3 * waited_s,
            )

    def _let_go(self, now: float) -> None:
        """Note that somebody works on what the robot holds still for."""
        if self._holding_since is not None:
            self._report("resumed", held_ms=1e3 * (now - self._holding_since))
            self._holding_since = None

    def _try_others(self, now: float) -> None:
        """Let services that were given up see this question too: an answer brings them back."""
        question = self.question
        if question is None:
            return
        for service in self._cloud:
            if service.usable(now) and self.status is not Status.LOCAL_RECOVERY:
                break
            if not service.detector.present or service.refused is not None:
                continue
            # One try at a time, so that a service further away than a turn is long can answer.
            tries = [call.sent_at for call in service.calls.values() if not call.answered]
            if service.retry_at <= now and max(tries, default=-1e9) + self._timeout_s <= now:
                self._send(service, question, now, also=True)

    def _note_lost_cloud(self, now: float) -> None:
        """Notice that the cloud died while nothing was asked of it: recovery can start now."""
        if (
            self._local is not None
            and self.status is not Status.LOCAL_RECOVERY
            and not self._is_starting()
            and not any(
                service.detector.trusted and service.refused is None for service in self._cloud
            )
        ):
            self._lose_cloud(now)
            self._tend_recovery(now)

    def _lose_cloud(self, now: float) -> None:
        reason = "; ".join(
            f"{service.name} "
            + (
                service.refused
                or service.detector.suspicion
                or ("is busy" if service.detector.present else None)
                or ("is gone" if service.detector.seen else "has not appeared")
            )
            for service in self._cloud
        )
        self._lost_at = now
        self.recoveries += 1
        self._change_status(Cause.CLOUD_LOST, reason, now)

    def _change_status(self, cause: Cause, reason: str, now: float) -> None:
        before = self.status
        self.status = next_status(before, cause)
        fields: dict[str, object] = {"from": before.value, "to": self.status.value}
        if cause is Cause.CLOUD_LOST:
            silences = [s.detector.silence_s(now) for s in self._cloud if s.detector.seen]
            if silences:
                fields["silent_ms"] = 1e3 * min(silences)
        elif self._lost_at is not None:
            fields["outage_ms"] = 1e3 * (now - self._lost_at)
        self._report("status", **fields, reason=reason)

    # -- the local service -----------------------------------------------------------------------

    def _is_launching(self) -> bool:
        return (
            self._local is not None
            and self._launched_at is not None
            and self._launch_after is None
            and not self._local.detector.present
        )

    def _tend_recovery(self, now: float) -> None:
        """Start the local service when it is wanted, and again when it does not come up."""
        local = self._local
        if local is None:
            return
        if self._launch_after is None and self._launched_at is None:
            if self.status is not Status.LOCAL_RECOVERY:
                return
            self._launch_after = now
        if self._is_launching():
            assert self._launched_at is not None
            waited_s = now - self._launched_at
            if 1e3 * waited_s >= self._recovery.launch_timeout_ms:
                self._report("launch_failed", reason=f"not seen after {1e3 * waited_s:.0f} ms")
                self._launch_failed(now)
        if self._launch_after is not None and self._launch_after <= now:
            if local.detector.boot is not None:
                local.detector.vanished(local.detector.boot)
            for call in list(local.calls.values()):
                self._abandon(call)
            local.forget()
            self._launch_after = None
            self._launched_at = now
            self._launches += 1
            self._report("launch", service=local.name)
            self.effects.append(Launch(self._launches))

    def _launch_failed(self, now: float) -> None:
        """Launch again: at once the first time, then ever more rarely."""
        if self._launch_after is not None:
            return
        pause_s = 1e-3 * self._recovery.relaunch_delay_ms
        factor = min(2 ** max(0, self._launch_failures - 1), 32)
        self._launch_after = now + (0.0 if self._launch_failures == 0 else pause_s * factor)
        self._launch_failures += 1

    # -- hedging ---------------------------------------------------------------------------------

    def _hedge_at(self, question: Question) -> float | None:
        """Return when the local service shall be asked as well; None if it shall not."""
        local = self._local
        if (
            local is None
            or self._offload.decision_deadline_ms is None
            or question.needed_at is None
            or self._budget < 1.0
            or not local.detector.trusted
            or local.refused is not None
            or local.is_asked(question)
        ):
            return None
        return max(question.needed_at + 1e-3 * self._offload.decision_deadline_ms, local.retry_at)

    def _hedge(self, question: Question, now: float) -> None:
        due = self._hedge_at(question)
        if due is None or now < due or self._local is None:
            return
        self._budget -= 1.0
        assert question.needed_at is not None
        self._report("hedge", step=question.state.step, waited_ms=1e3 * (now - question.needed_at))
        self._send(self._local, question, now, also=True)

    # -- sending ---------------------------------------------------------------------------------

    def _send(
        self,
        service: _Service,
        question: Question,
        now: float,
        *,
        whole_state: bool = False,
        also: bool = False,
    ) -> None:
        """Send a question, with what the service lacks; ``also`` if another one is asked, too."""
        while len(service.calls) >= _MAX_CALLS:
            self._abandon(next(iter(service.calls.values())))
        state = question.state
        observations: tuple[Observed, ...] = ()
        checkpoint: bytes | None = None
        known = service.acknowledged
        start = known[1] if known is not None and known[0] == state.trial else 0
        missing = question.num_observations - start
        fresh = state.step == 0 and missing == 0
        if missing > 1 or not (service.opened or fresh):
            # It knows nothing, or others have decided since. To plan what it has missed keeps it
            # from other robots, just when it has too many; but a large state is worse.
            whole_state |= (
                8 * state.belief.states.size <= _LARGE_CHECKPOINT
                or state.step > _MAX_REPLAYED_STEPS
            )
        if service.drifts >= _MAX_DRIFTS or missing > len(question.observations):
            whole_state = True
        if whole_state:
            checkpoint = question.checkpoint()
        elif missing > 0:
            observations = question.observations[-missing:]
        opening = None if service.opened else self._opening
        self._number += 1
        number = self._number
        request = Request(
            PROTOCOL_VERSION,
            self._session,
            self._epoch,
            number,
            state.trial,
            state.step,
            state.sensed,
            question.digest,
            observations,
            opening,
            checkpoint,
        )
        call = _Call(
            number,
            service,
            question,
            now,
            opens=opening is not None,
            restores=checkpoint is not None,
        )
        self._calls[number] = call
        service.calls[number] = call
        service.detector.asked(now)
        payload = encode(request)
        if opening is not None and not fresh:
            self._report("restore", service=service.name, step=state.step, bytes=len(payload))
        question.times_asked += 1
        if question.times_asked > 1 and question is self.question and not also:
            waited_s = 0.0 if question.needed_at is None else now - question.needed_at
            self._report(
                "retry",
                service=service.name,
                step=state.step,
                attempt=question.times_asked,
                waited_ms=1e3 * waited_s,
            )
        self.effects.append(Send(service.name, number, payload))

    # -- saying ----------------------------------------------------------------------------------

    def _report(self, name: str, **fields: object) -> None:
        self.effects.append(Report(name, fields))

    def _stop(self, error: HoldfastError) -> None:
        if not self.stopped:
            self.stopped = True
            self.effects.append(Stop(error))


def _check_number(reply: Reply, asked: int) -> None:
    unread = reply.number == 0 and isinstance(reply, Busy | Refused)
    if reply.number != asked and not unread:
        raise MessageError("malformed", f"reply to request {reply.number}, asked was {asked}")
