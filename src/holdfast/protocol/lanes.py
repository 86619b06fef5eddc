"""Three lanes for the tasks of a service, so that long decisions never hold all its threads.

A robot chooses how long its decisions take. In one queue a few that take seconds would keep all
other robots waiting, even after their senders had gone. So each task begins
in the lane of the *brief* ones. Its job first estimates what it costs
(:mod:`~holdfast.protocol.decision_cost`); if that is too much for the lane, nothing is computed,
and the task moves to that of the *medium* ones or of the *long* ones:

- Brief tasks may have all workers.
- Medium ones have all workers but one. They take turns with the brief ones.
- Long ones have as many threads of their own, at least one, so that the system divides the cores
  between them and the others. They also share a bound on memory.

An estimate can be wrong, or made wrong: a belief may hold states for which the problem's functions
take a thousand times as long as for those that were measured. So a brief or medium task that runs
for several times its lane's limit while others wait is cancelled, and computed as a long one.

So no owner holds all threads, with one worker either (there brief and medium tasks share it). The
lanes go by cost and not by owner, because without certificates all robots are one owner, and
nothing tells them apart. Each lane is a :class:`~holdfast.protocol.request_queue.RequestQueue`.
"""

from __future__ import annotations

import math

from holdfast.protocol.decision_cost import Cost, describe_cost
from holdfast.protocol.messages import Request
from holdfast.protocol.request_queue import RequestQueue
from holdfast.protocol.service_jobs import Job
from holdfast.protocol.service_limits import ServiceLimits
from holdfast.protocol.service_sessions import (
    BRIEF,
    LONG,
    MEDIUM,
    REQUESTED,
    Owner,
    PendingTask,
    Session,
)

__all__ = ["Lanes"]

_OVERDUE = 4.0
"""So many times the longest decision a job may run; hardly any takes 3 times its estimate."""

_OVERRUN = 5.0
"""So many times its lane's limit a brief or medium task may run while others wait."""


class Lanes:
    """The tasks that wait or run.

    Parameters
    ----------
    workers : int
        Tasks that may run at a time, besides the long ones.

    Attributes
    ----------
    limits_s : tuple of float
        Bounds on the estimated time of a task in each lane.
    """

    def __init__(self, workers: int, limits: ServiceLimits) -> None:
        self._workers = workers
        self._limits = limits
        fewer = max(1, workers - 1)
        self._lanes = [RequestQueue(number, limits) for number in (workers, fewer, fewer)]
        self.limits_s = (limits.max_brief_s, limits.max_medium_s, limits.max_decision_s)
        self._overdue_s = _OVERDUE * limits.max_decision_s
        self._brief_went_last = False

    @property
    def num_waiting(self) -> int:
        """Tasks not yet begun."""
        return sum(lane.num_waiting for lane in self._lanes)

    @property
    def num_running(self) -> int:
        """Tasks that workers have."""
        return sum(lane.num_running for lane in self._lanes)

    def is_overloaded(self, now: float, owner: Owner, *, newcomer: bool) -> bool:
        """Return whether a new request is to be turned away; each begins as a brief one."""
        return self._lanes[BRIEF].is_overloaded(now, owner, newcomer=newcomer)

    def wait_s(self, now: float, owner: Owner, *, newcomer: bool) -> float:
        """Estimate the wait of a new request."""
        return self._lanes[BRIEF].wait_s(now, owner, newcomer=newcomer)

    def _of(self, task: PendingTask) -> RequestQueue:
        """Return the lane of a task."""
        return self._lanes[task.lane]

    def is_alone(self, task: PendingTask) -> bool:
        """Return whether a task that is to be started may have all cores."""
        if task.lane == LONG and self._workers <= 2:
            return True  # no other long one runs beside it
        return self.num_running == 0 and self.num_waiting == 0

    # -- waiting ---------------------------------------------------------------------------------

    def enqueue(self, task: PendingTask) -> None:
        """Queue a task in its lane."""
        self._of(task).enqueue(task)

    def replace(self, task: PendingTask, request: Request, *, sensing: bool, size: int) -> None:
        """Give a waiting task's turn to a newer request."""
        self._of(task).replace(task, request, sensing=sensing, size=size)

    def remove(self, task: PendingTask) -> None:
        """Remove a task that was not begun."""
        self._of(task).remove(task)

    def promote(self, task: PendingTask) -> None:
        """Make a prefetch urgent: its robot waits for it now."""
        self._of(task).promote(task)

    def release_held(self, session: Session) -> None:
        """Queue a session's tasks that were held back behind those that have run."""
        for lane in self._lanes:
            lane.release_held(session)

    # -- running ---------------------------------------------------------------------------------

    def take(self, now: float) -> PendingTask | None:
        """Remove and return the next task; None if none waits or no thread is free."""
        brief, medium, long = self._lanes
        if brief.num_running + medium.num_running < self._workers:
            for lane in (medium, brief) if self._brief_went_last else (brief, medium):
                if (task := lane.take(now)) is not None:
                    self._brief_went_last = lane is brief
                    return task
        taken = long.running_bytes
        return long.take(now, self._limits.max_decision_bytes - taken if taken else math.inf)

    def handed_out(self, task: PendingTask, job: Job, now: float) -> None:
        """Note that a worker has a task."""
        self._of(task).handed_out(task, job, now)

    def started(self, job: Job, now: float) -> None:
        """Note that a worker starts its task only now, if it was not forgotten."""
        lane = self._running_in(job)
        if lane is not None:
            lane.started(job, now)

    def end(self, job: Job) -> PendingTask:
        """Note that a worker is free; return its task."""
        lane = self._running_in(job)
        assert lane is not None
        return lane.end(job)

    def runs(self, job: Job) -> bool:
        """Return whether a worker has a job of these tasks."""
        return self._running_in(job) is not None

    def _running_in(self, job: Job) -> RequestQueue | None:
        return next((lane for lane in self._lanes if lane.runs(job)), None)

    def postpone(self, task: PendingTask, cost: Cost | None, now: float) -> bool:
        """Queue a task again that costs more than its job was allowed, if a call waits for it.

        None: the estimate was too low, and the job was ended because it held up others.

        Return whether there is room. (A prefetch has always room, at most one for each session.)
        """
        session, limits = task.session, self._limits
        session.is_brief = False
        if not task.calls:
            return True  # nobody awaits it
        if cost is None:
            cost = Cost(math.inf, max(task.num_bytes, float(limits.max_medium_bytes)))
        fits = cost.seconds <= limits.max_medium_s and cost.num_bytes <= limits.max_medium_bytes
        task.move_to(MEDIUM if fits else LONG, cost)
        if task.slot == REQUESTED and self._of(task).is_overloaded(
            now, session.owner, newcomer=task.newcomer
        ):
            return False
        session.pending[task.digest] = task
        self.enqueue(task)
        return True

    # -- what nobody awaits, or takes too long ---------------------------------------------------

    def drop(self, task: PendingTask, now: float) -> bool:
        """Drop a task that nobody awaits; return whether it had not begun.

        One that runs is cancelled if it is long, or once it has run for longer than its lane's
        limit (:meth:`overdue`). A short one ends soon, and its result may be asked for again,
        over the robot's next link.
        """
        if task.running:
            if task.lane == LONG or self._overdue_at(task) <= now:
                self.cancel(task)
            return False
        task.session.remove_task(task)
        self.remove(task)
        return True

    def cancel(self, task: PendingTask) -> None:
        """End the job of a running task as soon as it can be; its worker is free then."""
        # Further calls that ask for the same do not wait for this one.
        task.session.remove_task(task)
        self._of(task).job_of(task).cancel()

    def cancel_all(self) -> None:
        """End all jobs that run, because nobody remembers them."""
        for lane in self._lanes:
            for job, _ in lane.running():
                job.cancel()

    def overdue_in_words(self, task: PendingTask, now: float) -> str:
        """Return why a running task is refused after all."""
        return (
            f"a decision that has taken {now - task.started_at:.0f} s: this service expected less "
            f"and takes at most {self._limits.max_decision_s:g} s (--max-decision-s). It has "
            f"{describe_cost(None, task.session.planning)}"
        )

    def overdue(self, now: float) -> list[PendingTask]:
        """Return the running tasks that take much longer than any decision may.

        If nobody awaits one: longer than its lane's limit.
        """
        return [task for _, task in self._running() if self._overdue_at(task) <= now]

    def interrupt_overrunning(self, now: float) -> None:
        """End the jobs of tasks that hold up others, for much longer than was expected.

        The calls still wait for them: once such a job has ended, its task is queued with the long
        ones (:meth:`postpone`).
        """
        if self._others_wait():
            for job, task in self._running():
                if self._overrun_at(task) <= now:
                    job.cancel()

    def next_end_at(self) -> float | None:
        """Return when one of the running tasks is next to be ended; None if none runs."""
        end_of = self._overrun_at if self._others_wait() else self._overdue_at
        return min((end_of(task) for _, task in self._running()), default=None)

    def _others_wait(self) -> bool:
        """Return whether brief or medium tasks wait for a worker."""
        return self._lanes[BRIEF].num_waiting + self._lanes[MEDIUM].num_waiting > 0

    def _overdue_at(self, task: PendingTask) -> float:
        most_s = self._overdue_s if task.calls else self.limits_s[task.lane]
        return task.started_at + most_s

    def _overrun_at(self, task: PendingTask) -> float:
        if task.lane == LONG or not task.calls:
            return self._overdue_at(task)
        return task.started_at + _OVERRUN * self.limits_s[task.lane]

    def _running(self) -> list[tuple[Job, PendingTask]]:
        """Return the jobs that run and their tasks, but for those that are cancelled."""
        return [
            (job, task)
            for lane in self._lanes
            for job, task in lane.running()
            if not job.is_cancelled
        ]
