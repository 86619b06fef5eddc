"""Two lanes for the tasks of a service, so that long decisions never hold all its workers.

A robot chooses how long its decisions take. In one queue a few that take seconds would keep all
other robots waiting, whoever sent them and even after their senders had gone. So each task begins
in the *short* lane. Its job first estimates what it costs
(:mod:`~holdfast.protocol.decision_cost`); if that is too much for the lane, the task moves to the
*long* lane, which has all workers but one. The last worker is for short decisions. With one worker
there is a second thread for a long decision beside it.

No owner can hold all workers for longer than short decisions take. (Without certificates all robots
are one owner, and nothing tells them apart; that is why the lanes go by cost.) Where tasks wait in
both lanes, these take turns. Each lane is a
:class:`~holdfast.protocol.request_queue.RequestQueue`; the long one also bounds the memory of what
runs in it.
"""

from __future__ import annotations

import math

from holdfast.protocol.decision_cost import Cost, in_words
from holdfast.protocol.messages import Request
from holdfast.protocol.request_queue import RequestQueue
from holdfast.protocol.service_jobs import Job
from holdfast.protocol.service_limits import ServiceLimits
from holdfast.protocol.service_sessions import REQUESTED, Owner, PendingTask, Session

__all__ = ["Lanes"]

_OVERDUE = 4.0
"""So many times the longest decision a job may run; estimates are right within a factor of 3."""


class Lanes:
    """The tasks that wait or run.

    Parameters
    ----------
    workers : int
        Tasks that may run at a time; with one worker, one short task and one long one.
    """

    def __init__(self, workers: int, limits: ServiceLimits) -> None:
        self._most = max(2, workers)
        self._limits = limits
        self._overdue_s = _OVERDUE * limits.max_decision_s
        self._short = RequestQueue(workers, limits)
        self._long = RequestQueue(max(1, workers - 1), limits)
        self._long_went_last = False
        self._cancelled: set[Job] = set()

    @property
    def num_waiting(self) -> int:
        """Tasks not yet begun."""
        return self._short.num_waiting + self._long.num_waiting

    @property
    def num_running(self) -> int:
        """Tasks that workers have."""
        return self._short.num_running + self._long.num_running

    def is_overloaded(self, now: float, owner: Owner, *, newcomer: bool) -> bool:
        """Return whether a new request is to be turned away: each begins in the short lane."""
        return self._short.is_overloaded(now, owner, newcomer=newcomer)

    def wait_s(self, now: float, owner: Owner, *, newcomer: bool) -> float:
        """Estimate the wait of a new request."""
        return self._short.wait_s(now, owner, newcomer=newcomer)

    def _of(self, task: PendingTask) -> RequestQueue:
        """Return the lane of a task."""
        return self._long if task.is_long else self._short

    def is_alone(self, task: PendingTask) -> bool:
        """Return whether a task that is to be started may have all cores."""
        if task.is_long and self._most == 2:
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
        self._short.release_held(session)
        self._long.release_held(session)

    # -- running ---------------------------------------------------------------------------------

    def take(self, now: float) -> PendingTask | None:
        """Remove and return the next task; None if none waits or no worker is free."""
        if self.num_running >= self._most:
            return None
        first, second = self._short, self._long
        if not self._long_went_last:
            first, second = second, first
        for lane in (first, second):
            # So that both lanes have their turn, if both wait.
            room = math.inf if lane is self._short else self._room()
            task = lane.take(now, room)
            if task is not None:
                self._long_went_last = lane is self._long
                return task
        return None

    def _room(self) -> float:
        """Return the bytes that a long task may take beside those that run."""
        taken = self._long.running_bytes
        return self._limits.max_decision_bytes - taken if taken else math.inf

    def handed_out(self, task: PendingTask, job: Job, now: float) -> None:
        """Note that a worker has a task."""
        self._of(task).handed_out(task, job, now)

    def started(self, job: Job, now: float) -> None:
        """Note that a worker starts its task only now."""
        self._running_in(job).started(job, now)

    def end(self, job: Job) -> PendingTask:
        """Note that a worker is free; return its task."""
        self._cancelled.discard(job)
        return self._running_in(job).end(job)

    def _running_in(self, job: Job) -> RequestQueue:
        return self._long if self._long.runs(job) else self._short

    def postpone(self, task: PendingTask, cost: Cost, now: float) -> bool:
        """Queue a task again that costs more than its job was allowed, if a call waits for it.

        Return whether there is room. (A prefetch has always room, at most one for each session.)
        """
        session, limits = task.session, self._limits
        session.is_brief = False
        if not task.calls:
            return True  # nobody awaits it
        if cost.seconds > limits.max_short_s or cost.num_bytes > limits.max_short_bytes:
            task.lengthen(cost)
            if task.slot == REQUESTED and self._long.is_overloaded(
                now, session.owner, newcomer=task.newcomer
            ):
                return False
        session.pending[task.digest] = task
        self.enqueue(task)
        return True

    # -- what nobody awaits, or takes too long ---------------------------------------------------

    def drop(self, task: PendingTask) -> bool:
        """Drop a task that nobody awaits; return whether it had not begun.

        One that runs is cancelled if it is long. A short one ends soon, and its result may be asked
        for again, over the robot's next link.
        """
        if task.running:
            if task.is_long:
                self.cancel(task)
            return False
        task.session.remove_task(task)
        self.remove(task)
        return True

    def cancel(self, task: PendingTask) -> None:
        """End the job of a running task as soon as it can be; its worker is free then."""
        # Whoever asks for the same from now on does not wait for this one.
        task.session.remove_task(task)
        job = self._of(task).job_of(task)
        self._cancelled.add(job)
        job.cancel()

    def overdue_in_words(self, task: PendingTask, now: float) -> str:
        """Return why a running task is refused after all."""
        return (
            f"a decision that has taken {now - task.started_at:.0f} s: this service expected less "
            f"and takes at most {self._limits.max_decision_s:g} s (--max-decision-s). It has "
            f"{in_words(None, task.session.planning)}"
        )

    def overdue(self, now: float) -> list[PendingTask]:
        """Return the running tasks that take much longer than any decision may."""
        due = now - self._overdue_s
        return [
            task
            for lane in (self._short, self._long)
            for job, task in lane.running()
            if task.started_at <= due and job not in self._cancelled
        ]

    def overdue_at(self) -> float | None:
        """Return when the next running task will be; None if none runs."""
        return min(
            (
                task.started_at + self._overdue_s
                for lane in (self._short, self._long)
                for job, task in lane.running()
                if job not in self._cancelled
            ),
            default=None,
        )
