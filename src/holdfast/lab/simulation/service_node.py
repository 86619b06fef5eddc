"""A service's process: the production machine, workers that take virtual time, and a life."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from holdfast.errors import MessageError
from holdfast.lab.simulation.event_queue import Clock, EventQueue
from holdfast.lab.simulation.memo_cache import JobCache
from holdfast.lab.simulation.schedule import RunSettings
from holdfast.problems.problem import Problem
from holdfast.protocol.messages import Request, decode_request
from holdfast.protocol.service import Service
from holdfast.protocol.service_jobs import (
    EndCall,
    Job,
    JobResult,
    SendReply,
    ServiceEffect,
    StartJob,
)
from holdfast.protocol.service_limits import ServiceLimits

if TYPE_CHECKING:
    from holdfast.lab.simulation.network import Network

__all__ = ["ServiceNode"]


class ServiceNode:
    """One service.

    Attributes
    ----------
    incarnation : int
        Of the process; 0 before the first.
    up, stopped : bool
        Whether it runs, and whether it is stopped.
    slowness : float
        Factor of what it takes to compute.
    lacks_memory_for : list of str
        Parts of an answer for which it has no memory, each as often as there is a reason.
    """

    def __init__(
        self,
        name: str,
        run: RunSettings,
        queue: EventQueue,
        clock: Clock,
        network: Network,
        problem: Problem,
        jobs: JobCache,
    ) -> None:
        self.name = name
        self._run = run
        self._queue = queue
        self._clock = clock
        self._network = network
        self._problem = problem
        self._jobs = jobs
        self._limits = ServiceLimits(
            max_sessions=run.sessions_kept,
            max_idle_s=run.forgets_after_s,
            answers_per_session=run.answers_kept,
        )
        self._cost_s = {"task": run.task_s, "sensing": run.sensing_s}
        self._deferred: list[tuple[Callable[..., None], tuple[object, ...]]] = []
        self._wakes_at: float | None = None
        self._life = 0
        self.machine: Service | None = None
        self.incarnation = 0
        self.up = False
        self.stopped = False
        self.slowness = 1.0
        self.lacks_memory_for: list[str] = []

    # -- its life --------------------------------------------------------------------------------

    def start(self, *, keeps_memory: bool = False) -> None:
        """Start a new process."""
        self.incarnation += 1
        self.up = True
        if not keeps_memory or self.machine is None:
            self._life += 1
            self._wakes_at = None
            self.machine = Service(lambda _: self._problem, self._run.workers, self._limits)
        self.go_on()

    def end(self, *, keeps_memory: bool = False) -> None:
        """End the process."""
        self.up = False
        if not keeps_memory:
            self.stopped = False
            self._deferred.clear()
            self._life += 1
            self.machine = None

    def stop(self) -> None:
        """Stop the process where it is."""
        self.stopped = self.up

    def go_on(self) -> None:
        """Let a stopped process go on: it finds all that came meanwhile."""
        self.stopped = False
        deferred, self._deferred = self._deferred, []
        for do, arguments in deferred:
            do(*arguments)

    # -- what it does ----------------------------------------------------------------------------

    def receive(self, incarnation: int, call: int, payload: bytes, owner: str | None) -> None:
        """Take a request that was sent to this process, with a certificate if any."""
        if incarnation != self.incarnation or not self.up:
            return
        if self.stopped:
            self._deferred.append((self.receive, (incarnation, call, payload, owner)))
            return
        assert self.machine is not None
        request: Request | MessageError
        try:
            request = decode_request(payload)
        except MessageError as error:
            request = error
        now = self._clock.now()
        self._carry_out(self.machine.receive(call, request, len(payload), now, owner))

    def _carry_out(self, effects: list[ServiceEffect]) -> None:
        machine = self.machine
        assert machine is not None
        for effect in effects:
            if isinstance(effect, SendReply):
                self._network.reply(self, effect.call, effect.payload)
            elif isinstance(effect, EndCall):
                self._network.end(self, effect.call)
            elif isinstance(effect, StartJob):
                machine.started(effect.job, self._clock.now())
                cost_s = self.slowness * self._cost_s[effect.job.kind]
                self._queue.after(cost_s, self._finish, self._life, effect.job)
        due = machine.next_wakeup()
        if due is not None and (self._wakes_at is None or due < self._wakes_at):
            self._wakes_at = due
            self._queue.after(self._clock.until(due), self._tick, self._life, due)

    def _finish(self, life: int, job: Job) -> None:
        if life != self._life:
            return
        if self.stopped:
            self._deferred.append((self._finish, (life, job)))
            return
        assert self.machine is not None
        if job.kind in self.lacks_memory_for:
            text = f"out of memory for a {job.kind} part"
            outcome = JobResult(failure=("out_of_memory", text), problem=self._problem)
        else:
            outcome = self._jobs.outcome(job)
        self._carry_out(self.machine.finished(job, outcome, self._clock.now()))

    def _tick(self, life: int, due: float) -> None:
        if life != self._life or due != self._wakes_at:
            return
        if self.stopped:
            self._deferred.append((self._tick, (life, due)))
            return
        assert self.machine is not None
        self._wakes_at = None
        self._carry_out(self.machine.tick(self._clock.reached(due)))
