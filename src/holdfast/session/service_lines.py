"""Who is next: three lines of works that wait for a worker, and how long the wait is.

In one line are the works for which a robot stands still, in another those of robots that were never
served before, in the third those that are ahead of their robots. The first go before the others,
but not for ever: a work that has let others go first for long enough has its turn. To be somebody
new costs nothing, so one client can be thousands of robots; however long their line is, they have
every second turn at most while anybody else waits. Each session has one work in each line at most;
the one after it is held back until that has run. So a line is a row of turns, and a robot that asks
much waits for itself, not others for it.

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
        self._urgent: OrderedDict[Work, None] = OrderedDict()
        self._newcomers: OrderedDict[Work, None] = OrderedDict()
        self._later: OrderedDict[Work, None] = OrderedDict()
        self._patience_s = 1e-3 * limits.prefetch_patience_ms
        self._patience_of_newcomers_s = 1e-3 * limits.max_wait_ms
        # Whether a newcomer had the last turn for which others waited too.
        self._newcomer_went_first = False
        self._running: dict[Job, Work] = {}
        self._waiting_bytes = 0
        self._bytes_of_newcomers = 0
        self._num_newcomers = 0
        self._backlog_s = 0.0
        self._backlog_of_newcomers_s = 0.0
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
            self._leave(work)
        self._count(work, -1)

    def hasten(self, work: Work) -> None:
        """Let a prefetched work go with the urgent ones: its robot stands still now."""
        work.urgent = True  # also if it is held back yet
        if work in self._later:
            del self._later[work]
            self._urgent[work] = None

    def _line_of(self, work: Work) -> OrderedDict[Work, None]:
        if not work.urgent:
            return self._later
        return self._newcomers if work.newcomer else self._urgent

    def _leave(self, work: Work) -> None:
        for line in (self._urgent, self._newcomers, self._later):
            line.pop(work, None)

    def _count(self, work: Work, sign: int) -> None:
        self.num_waiting += sign
        self._waiting_bytes += sign * work.size
        # Sums of floating-point numbers drift; an empty line is exactly empty.
        self._backlog_s = self._backlog_s + sign * work.cost_s if self.num_waiting else 0.0
        if work.newcomer:
            self._num_newcomers += sign
            self._bytes_of_newcomers += sign * work.size
            self._backlog_of_newcomers_s += sign * work.cost_s
        if not self._num_newcomers:
            self._backlog_of_newcomers_s = 0.0

    # -- running ---------------------------------------------------------------------------------

    def take(self, now: float) -> Work | None:
        """Take the next work out of its line; None if none waits there or no worker is free."""
        if len(self._running) >= self._workers:
            return None
        known = self._next_of_known()
        newcomer = next(iter(self._newcomers), None)
        if known is None or newcomer is None:
            work = known or newcomer
        elif self._goes_first(newcomer, known, now):
            work, self._newcomer_went_first = newcomer, True
        else:
            work, self._newcomer_went_first = known, False
        if work is not None:
            self._leave(work)
            self._count(work, -1)
        return work

    def _next_of_known(self) -> Work | None:
        """Return the next work of the robots that were served before; None if none waits."""
        urgent = next(iter(self._urgent), None)
        later = next(iter(self._later), None)
        if urgent is None or later is None:
            return urgent or later
        return urgent if urgent.since <= later.since + self._patience_s else later

    def _goes_first(self, newcomer: Work, known: Work, now: float) -> bool:
        """Tell whether a newcomer goes before a robot that was served before."""
        if known.urgent:
            return not self._newcomer_went_first and (
                known.since > newcomer.since + self._patience_of_newcomers_s
            )
        if now <= known.since + self._patience_s:
            return True
        return not self._newcomer_went_first and newcomer.since <= known.since + self._patience_s

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

    def is_overloaded(self, now: float, *, newcomer: bool) -> bool:
        """Tell whether a request that came now is to be turned away."""
        limits = self._limits
        ahead = self.num_waiting - (0 if newcomer else self._num_newcomers)
        if ahead < self._workers:
            return False
        return (
            self.num_waiting >= limits.max_waiting
            or self._waiting_bytes >= limits.max_waiting_bytes
            # Half of the room is kept for those that were served before.
            or (newcomer and 2 * self._num_newcomers >= limits.max_waiting)
            or (newcomer and 2 * self._bytes_of_newcomers >= limits.max_waiting_bytes)
            # Nobody who was served before is turned away because of newcomers.
            or 1e3 * self._ahead_s(now, newcomer=newcomer) > limits.max_wait_ms * self._workers
        )

    def wait_s(self, now: float, *, newcomer: bool) -> float:
        """Estimate how long a request that came now would wait for its answer to be begun."""
        ahead_s = self._ahead_s(now, newcomer=newcomer)
        if not newcomer:
            # Of the newcomers as many at most are ahead as of the others: they go by turns.
            ahead_s += min(ahead_s, self._backlog_of_newcomers_s)
        return ahead_s / self._workers

    def _ahead_s(self, now: float, *, newcomer: bool) -> float:
        """Add up what the works ahead are expected to take, newcomers for newcomers alone."""
        ahead_s = self._backlog_s - (0.0 if newcomer else self._backlog_of_newcomers_s)
        for work in self._running.values():
            ahead_s += max(0.0, work.cost_s - (now - work.started_at))
        return ahead_s
