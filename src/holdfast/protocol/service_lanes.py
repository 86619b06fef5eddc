"""Five lanes for the tasks of a service, so that none has to wait for what takes much longer.

A robot chooses how long its decisions take, and a new identity costs nothing without a certificate.
So tasks of different kinds have different threads, and the system divides the cores between these:

- *New*: of sessions with a problem that their owner has not brought before, and states that come
  from outside (checkpoints).
- *First*: of sessions with a known problem that were not served yet.
- *Brief*: of all other sessions. The lane has as many threads as the service has workers, each of
  the others one less, but at least one.
- *Medium* and *long*: what is estimated to take too long for the first three, or for the fourth.

A job first estimates what it costs (:mod:`~holdfast.protocol.decision_cost`); if that is too much
for its lane, the task moves. An estimate can be made wrong: for some beliefs the problem's
functions take a thousand times as long as for those that were measured. So a job ends by itself
once it has computed for several times its lane's limit, and it is computed anew as a long one, as
are the session's next ones until one takes less. Building a problem and measuring it count, but not
in the long lane, which would do it again.

The lanes go by cost and not by owner, because without certificates all robots are one owner. Each
is a :class:`~holdfast.protocol.request_queue.RequestQueue`. Long decisions share a bound on memory,
and new and first ones have half of the room for what waits each.
"""

from __future__ import annotations

import math

from holdfast.errors import MessageError
from holdfast.protocol.decision_cost import Cost, describe_cost
from holdfast.protocol.request_queue import RequestQueue
from holdfast.protocol.service_jobs import Job
from holdfast.protocol.service_limits import ServiceLimits
from holdfast.protocol.service_sessions import (
    FIRST,
    LONG,
    MEDIUM,
    NEW,
    REQUESTED,
    SHORT_S,
    PendingTask,
    Session,
)

_OVERRUN = 5.0
"""So many times its lane's limit a job may compute; hardly any takes 3 times its estimate. A short
one may so many times what is short: everything else waits for it."""

_OVERDUE = 4.0
"""The same of a long one, which is refused then."""


class Lanes:
    """The tasks that wait or run; so many brief ones at a time as there are workers."""

    def __init__(self, workers: int, limits: ServiceLimits) -> None:
        self._limits = limits
        fewer = max(1, workers - 1)
        self.max_running = workers + 4 * fewer  # tasks that may run at a time
        self._fewer = fewer
        self._lanes = [
            *(RequestQueue(fewer, limits, room=0.5) for _ in (NEW, FIRST)),
            *(RequestQueue(number, limits) for number in (workers, fewer, fewer)),
        ]
        brief_s = limits.max_brief_s
        # Bounds on the estimated time of a task in each lane.
        self.limits_s = (brief_s, brief_s, brief_s, limits.max_medium_s, limits.max_decision_s)

    def __getitem__(self, number: int) -> RequestQueue:
        return self._lanes[number]

    @property
    def num_waiting(self) -> int:
        """Tasks not yet begun."""
        return sum(lane.waiting.num for lane in self._lanes)

    @property
    def num_running(self) -> int:
        """Tasks that workers have."""
        return sum(len(lane.running) for lane in self._lanes)

    def is_alone(self, task: PendingTask) -> bool:
        """Return whether a task that is to be started may have all cores."""
        if task.lane == LONG and self._fewer == 1:
            return True  # no other long one runs beside it
        return not any(lane.running or lane.waiting.num for lane in self._lanes)

    def most_s(self, lane: int, expected_s: float = math.inf) -> float:
        """Return how long a job may compute; ``expected_s`` if it is a short one."""
        if expected_s < math.inf:
            return _OVERRUN * SHORT_S
        return (_OVERDUE if lane == LONG else _OVERRUN) * self.limits_s[lane]

    def release_held(self, session: Session) -> None:
        """Queue a session's tasks that were held back behind those that have run."""
        for lane in self._lanes:
            lane.release_held(session)

    # -- running ---------------------------------------------------------------------------------

    def take(self, now: float) -> PendingTask | None:
        """Remove and return the next task; None if none waits or no thread is free."""
        for number, lane in enumerate(self._lanes):
            if not lane.waiting.num:
                continue
            room_bytes = math.inf
            if number == LONG and lane.running:
                taken_bytes = sum(task.num_bytes for task in lane.running.values())
                room_bytes = self._limits.max_decision_bytes - taken_bytes
            if (task := lane.take(now, room_bytes)) is not None:
                return task
        return None

    def with_job(self, job: Job) -> RequestQueue | None:
        """Return the lane of which a worker has a job; None if it was forgotten."""
        return next((lane for lane in self._lanes if job in lane.running), None)

    def enqueue(self, task: PendingTask) -> None:
        """Queue a task of its session in its lane."""
        task.session.pending[task.digest] = task
        self[task.lane].enqueue(task)

    def postpone(
        self, task: PendingTask, job: Job, cost: Cost | None, now: float, *, awaited: bool
    ) -> bool:
        """Queue a task again in another lane, if a call waits for it; return whether there is room.

        It has taken longer than estimated if there is no ``cost``. (A prefetch has always room, at
        most one for each session.) Raises MessageError if it has used up the time of a long one.
        """
        session, limits = task.session, self._limits
        if cost is None and task.lane == LONG:
            raise MessageError(
                "invalid",
                f"a decision that has taken {self.most_s(LONG):.0f} s: this service expected less "
                f"and takes at most {limits.max_decision_s:g} s (--max-decision-s). It has "
                f"{describe_cost(None, session.planning)}",
            )
        if cost is None and job.expected_s < math.inf:
            # It blocks nobody on a thread, and its next ones go there until one is short again.
            task.expected_time.expect_long()
            if awaited:
                self.enqueue(task)
            return True
        session.is_brief = False
        if cost is None:
            session.overran = True
            cost = Cost(math.inf, max(task.num_bytes, float(limits.max_medium_bytes)))
        if not awaited:
            return True
        fits = cost.seconds <= limits.max_medium_s and cost.num_bytes <= limits.max_medium_bytes
        task.move_to(MEDIUM if fits else LONG, cost)
        if task.slot == REQUESTED and self[task.lane].is_overloaded(now, session.owner):
            return False
        self.enqueue(task)
        return True

    # -- what nobody awaits, or takes too long ---------------------------------------------------

    def drop(self, task: PendingTask) -> bool:
        """Drop a task that nobody awaits; return whether it had not begun.

        A long one that runs is cancelled. Others end soon, and their result may be asked for again,
        over the robot's next link.
        """
        if task.running:
            if task.lane == LONG:
                # Further calls that ask for the same do not wait for this one.
                task.session.remove_task(task)
                running = self[LONG].running.items()
                next(job for job, other in running if other is task).cancel()
            return False
        task.session.remove_task(task)
        self[task.lane].remove(task)
        return True

    def cancel_all(self) -> None:
        """End all jobs that run, because nobody remembers them."""
        for lane in self._lanes:
            for job in lane.running:
                job.cancel()
