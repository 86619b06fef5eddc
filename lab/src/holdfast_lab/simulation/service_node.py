"""A service's process: the production machine, workers that take virtual time, and a life."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from holdfast.errors import MessageError
from holdfast.protocol.messages import Request, decode_request
from holdfast.protocol.service import Service
from holdfast.protocol.service_jobs import (
    EndCall,
    Job,
    JobResult,
    SendReply,
    ServiceEffect,
)
from holdfast.protocol.service_limits import ServiceLimits
from holdfast_lab.simulation.event_queue import Clock

if TYPE_CHECKING:
    from holdfast_lab.simulation.world import World


class ServiceNode:
    """One service.

    Attributes
    ----------
    machine : Service or None
        What it knows; a process that keeps its memory leaves it to the next.
    incarnation : int
        Of the process; 0 before the first.
    up, stopped : bool
        Whether it runs, and whether it is stopped.
    stopped_until : float
        Until when it is to be.
    slownesses : list of float
        By how much it computes more slowly; the greatest of them counts.
    lacks_memory_for : list of str
        Parts of an answer for which it has no memory, each as often as there is a reason.
    """

    def __init__(self, name: str, world: World) -> None:
        run = world.run
        self.name = name
        self._world = world
        self._clock = Clock(world.queue, run.services_clock_offset_s, run.services_clock_rate)
        self._cost_s = {"task": run.task_s, "sensing": run.sensing_s}
        self._deferred: list[tuple[Callable[..., None], tuple[object, ...]]] = []
        self._wakes_at: float | None = None
        self._memory = 0
        self._short_ones_end_at = 0.0
        self.machine: Service | None = None
        self.incarnation = 0
        self.up = False
        self.stopped = False
        self.stopped_until = 0.0
        self.slownesses: list[float] = []
        self.lacks_memory_for: list[str] = []

    # -- its life --------------------------------------------------------------------------------

    def start(self, *, keeps_memory: bool = False) -> None:
        """Start a new process."""
        self.incarnation += 1
        self.up = True
        self.stopped_until = 0.0
        if not keeps_memory or self.machine is None:
            run = self._world.run
            problem = self._world.setup.planner.problem
            limits = ServiceLimits(
                max_sessions=run.sessions_kept,
                max_idle_s=run.forgets_after_s,
                answers_per_session=run.answers_kept,
            )
            self._memory += 1
            self._wakes_at = None
            self._short_ones_end_at = 0.0
            self.machine = Service(lambda _: problem, run.workers, limits)
        self.go_on()

    def end(self, *, keeps_memory: bool = False) -> None:
        """End the process."""
        self.up = False
        if not keeps_memory:
            self.stopped = False
            self._deferred.clear()
            self._memory += 1
            self.machine = None

    def stop(self, until: float) -> None:
        """Stop the process where it is."""
        self.stopped = True
        self.stopped_until = max(self.stopped_until, until)

    def go_on(self) -> None:
        """Let a stopped process go on: it finds all that came meanwhile."""
        self.stopped = False
        deferred, self._deferred = self._deferred, []
        for do, arguments in deferred:
            do(*arguments)

    def _is_later(self, do: Callable[..., None], *arguments: object) -> bool:
        """Tell whether the process is stopped; then this is done when it goes on."""
        if self.stopped:
            self._deferred.append((do, arguments))
        return self.stopped

    # -- what it does ----------------------------------------------------------------------------

    def receive(self, incarnation: int, call: int, payload: bytes, owner: str | None) -> None:
        """Take a request that was sent to this process, with a certificate if any."""
        if incarnation != self.incarnation or not self.up:
            return
        if self._is_later(self.receive, incarnation, call, payload, owner):
            return
        assert self.machine is not None
        self._world.checker.taken(self.name, incarnation, call, payload)
        request: Request | MessageError
        try:
            request = decode_request(payload)
        except MessageError as error:
            request = error
        now = self._clock.now()
        self._carry_out(self.machine.receive(call, request, len(payload), now, owner))

    def _carry_out(self, effects: list[ServiceEffect]) -> None:
        machine, network, queue = self.machine, self._world.network, self._world.queue
        assert machine is not None
        for effect in (*effects, *machine.next_jobs(self._clock.now())):
            if isinstance(effect, SendReply):
                network.reply(self, effect.call, effect.payload)
            elif isinstance(effect, EndCall):
                network.end(self, effect.call)
            elif isinstance(effect, Job):
                self._begin(effect)
        due = machine.next_wakeup()
        if due is not None and (self._wakes_at is None or due < self._wakes_at):
            self._wakes_at = due
            queue.after(self._clock.until(due), self._tick, self._memory, due)

    def _begin(self, job: Job) -> None:
        """Compute for as long as the run says, and not as this machine does.

        A short job begins when those before it have ended.
        """
        queue = self._world.queue
        most_s, job.interruption.most_s = job.interruption.most_s, math.inf
        cost_s = max(self.slownesses, default=1.0) * self._cost_s[job.kind]
        if cost_s > most_s:
            job.interruption.use_up()
        took_s, waits_s = min(cost_s, most_s), 0.0
        if job.expected_s < math.inf:
            waits_s = max(0.0, self._short_ones_end_at - queue.now)
            self._short_ones_end_at = queue.now + waits_s + took_s
        queue.after(waits_s + took_s, self._finish, self._memory, job, took_s)

    def _finish(self, memory: int, job: Job, took_s: float) -> None:
        if memory != self._memory or self._is_later(self._finish, memory, job, took_s):
            return
        assert self.machine is not None
        self.machine.started(job, self._clock.now() - took_s)
        if job.kind in self.lacks_memory_for:
            failure = ("out_of_memory", f"out of memory for a {job.kind} part")
            outcome = JobResult(failure=failure, problem=self._world.setup.planner.problem)
        else:
            outcome = self._world.setup.jobs.outcome(job)
        self._carry_out(self.machine.finished(job, outcome, self._clock.now()))

    def _tick(self, memory: int, due: float) -> None:
        if memory != self._memory or due != self._wakes_at:
            return
        if not self._is_later(self._tick, memory, due):
            assert self.machine is not None
            self._wakes_at = None
            self._carry_out(self.machine.tick(self._clock.reached(due)))
