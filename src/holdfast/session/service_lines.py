"""Who is next: two lines of works that wait for a worker, and how long the wait is.

In one line are the works for which a robot stands still, in the other those that are ahead of their
robots. The first go before the second, but not for ever. Each session has one work in each line at
most; the one after it is held back until that has run. So a line is a row of turns, and a robot
that asks much waits for itself, not others for it.

How long a request that came now would wait follows from what the works in the lines are expected to
take. A service that would be too slow says so at once, so that the robot can ask elsewhere.
"""

from __future__ import annotations

from collections import OrderedDict

from holdfast.session.messages import Request
from holdfast.session.service_jobs import Job
from holdfast.session.service_limits import ServiceLimits
from holdfast.session.service_sessions import Session, Work

__all__ = ["Lines"]


class Lines:
    """The works that wait or run.

    Parameters
    ----------
    workers : int
        Jobs that may run at a time.
    limits : ServiceLimits

    Attributes
    ----------
    num_waiting : int
        Works that were not begun.
    """

    def __init__(self, workers: int, limits: ServiceLimits) -> None:
        self._workers = workers
        self._limits = limits
        self._patience_s = 1e-3 * limits.prefetch_patience_ms
        self._urgent: OrderedDict[Work, None] = OrderedDict()
        self._later: OrderedDict[Work, None] = OrderedDict()
        self._running: dict[Job, Work] = {}
        self._waiting_bytes = 0
        self._backlog_s = 0.0
        self.num_waiting = 0

    @property
    def num_running(self) -> int:
        """Works that a worker has."""
        return len(self._running)

    # -- waiting ---------------------------------------------------------------------------------

    def line_up(self, work: Work) -> None:
        """Let a work wait for its turn."""
        self._count(work, 1)
        if work.session.running[work.slot] is not None:
            work.session.held[work.slot] = work
        else:
            self._line_of(work)[work] = None

    def replace(self, work: Work, request: Request, *, sensing: bool, size: int) -> None:
        """Let a waiting work be of a newer request: it keeps its turn."""
        self._count(work, -1)
        work.become(request, sensing=sensing, size=size)
        self._count(work, 1)

    def withdraw(self, work: Work) -> None:
        """Take a work that was not begun out of its line."""
        session = work.session
        if session.held[work.slot] is work:
            session.held[work.slot] = None
        else:
            self._urgent.pop(work, None)
            self._later.pop(work, None)
        self._count(work, -1)

    def hasten(self, work: Work) -> None:
        """Let a prefetched work go with the urgent ones: its robot stands still now."""
        work.urgent = True  # also if it is held back yet
        if work in self._later:
            del self._later[work]
            self._urgent[work] = None

    def _line_of(self, work: Work) -> OrderedDict[Work, None]:
        return self._urgent if work.urgent else self._later

    def _count(self, work: Work, sign: int) -> None:
        self.num_waiting += sign
        self._waiting_bytes += sign * work.size
        # Sums of floating-point numbers drift; an empty line is exactly empty.
        self._backlog_s = self._backlog_s + sign * work.cost_s if self.num_waiting else 0.0

    # -- running ---------------------------------------------------------------------------------

    def take(self) -> Work | None:
        """Take the next work out of its line; None if none waits there or no worker is free."""
        if len(self._running) >= self._workers:
            return None
        work = self._next()
        if work is not None:
            self._urgent.pop(work, None)
            self._later.pop(work, None)
            self._count(work, -1)
        return work

    def _next(self) -> Work | None:
        urgent = next(iter(self._urgent), None)
        later = next(iter(self._later), None)
        if urgent is None or later is None:
            return urgent or later
        return urgent if urgent.since <= later.since + self._patience_s else later

    def begin(self, work: Work, job: Job, now: float) -> None:
        """Take note that a worker has a work that was taken."""
        work.running = True
        work.started_at = now
        work.session.running[work.slot] = work
        self._running[job] = work

    def begun(self, job: Job, now: float) -> None:
        """Take note that a worker has begun only now what it has."""
        self._running[job].started_at = now

    def end(self, job: Job) -> Work:
        """Take note that a worker is free; return the work that it had."""
        work = self._running.pop(job)
        work.running = False
        work.session.running[work.slot] = None
        return work

    def let_go_on(self, session: Session) -> None:
        """Line up the works of a robot that were held back for those that have run."""
        for held in session.held:
            if held is not None and session.running[held.slot] is None:
                session.held[held.slot] = None
                self._line_of(held)[held] = None

    # -- the wait --------------------------------------------------------------------------------

    def is_overloaded(self, now: float) -> bool:
        """Tell whether a request that came now is to be turned away."""
        limits = self._limits
        if self.num_waiting < self._workers:
            return False
        return (
            self.num_waiting >= limits.max_waiting
            or self._waiting_bytes >= limits.max_waiting_bytes
            or 1e3 * self.wait_s(now) > limits.max_wait_ms
        )

    def wait_s(self, now: float) -> float:
        """Estimate how long a request that came now would wait for its answer to be begun."""
        ahead_s = self._backlog_s
        for work in self._running.values():
            ahead_s += max(0.0, work.cost_s - (now - work.started_at))
        return ahead_s / self._workers
