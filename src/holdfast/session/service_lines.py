"""Who is next: three lines of works that wait for a worker, and how long the wait is.

In one line are the works for which a robot stands still, in another those of robots that were never
served before, in the third those that are ahead of their robots. The first go before the others,
but not for ever: a work that has let others go first for long enough has its turn. To be somebody
new costs nothing, so one client can be thousands of robots; however long their line is, they have
every second turn at most while anybody else waits. Each session has one work in each line at most;
the one after it is held back until that has run. So a line is a row of turns, and a robot that asks
much waits for itself, not others for it.

In each line the owners of the sessions go by turns, and each owner's works in the order in which
they came. So however many sessions one certificate opens, they have one robot's turn together. What
has proved nothing is one owner, too.

How long a request that came now would wait follows from what the works in the lines are expected to
take. A service that would be too slow says so at once, so that the robot can ask elsewhere.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator

from holdfast.session.messages import Request
from holdfast.session.service_jobs import Job
from holdfast.session.service_limits import ServiceLimits
from holdfast.session.service_sessions import Owner, Session, Work

__all__ = ["Lines"]


class _Line:
    """Works that wait, their owners by turns."""

    def __init__(self) -> None:
        # Those whose turn comes next first.
        self._of: OrderedDict[Owner, OrderedDict[Work, None]] = OrderedDict()
        self._last_turn: dict[Owner, float] = {}

    def __contains__(self, work: Work) -> bool:
        return work in self._of.get(work.session.owner, ())

    def __iter__(self) -> Iterator[Work]:
        return (work for works in self._of.values() for work in works)

    def append(self, work: Work) -> None:
        """Let a work wait behind those of its owner; an owner who had none comes last."""
        self._of.setdefault(work.session.owner, OrderedDict())[work] = None

    def remove(self, work: Work) -> None:
        """Take a work out, if it is there."""
        owner = work.session.owner
        works = self._of.get(owner)
        if works is not None and works.pop(work, work) is None and not works:
            del self._of[owner]
            self._last_turn.pop(owner, None)

    def end_turn(self, owner: Owner, now: float) -> None:
        """Let an owner come last, if it has more."""
        if owner in self._of:
            self._of.move_to_end(owner)
            self._last_turn[owner] = now

    def first(self) -> Work | None:
        """Return the work whose turn is next; None if none waits."""
        works = next(iter(self._of.values()), None)
        return None if works is None else next(iter(works))

    def waits_since(self, work: Work) -> float:
        """Return when a work came, or its owner's turn before, if that was later."""
        return max(work.since, self._last_turn.get(work.session.owner, work.since))


class _Load:
    """How much works are, all together."""

    __slots__ = ("cost_s", "num", "num_bytes")

    def __init__(self) -> None:
        self.num = 0
        self.num_bytes = 0
        self.cost_s = 0.0

    def count(self, work: Work, sign: int) -> None:
        """Add a work, or take it off."""
        self.num += sign
        self.num_bytes += sign * work.size
        # Sums of floating-point numbers drift; what is empty is exactly empty.
        self.cost_s = self.cost_s + sign * work.cost_s if self.num else 0.0


class _Loads:
    """How much waits, of newcomers and of those that were served before."""

    __slots__ = ("known", "newcomers")

    def __init__(self) -> None:
        self.known = _Load()
        self.newcomers = _Load()

    @property
    def num(self) -> int:
        return self.known.num + self.newcomers.num

    @property
    def num_bytes(self) -> int:
        return self.known.num_bytes + self.newcomers.num_bytes

    def of(self, *, newcomer: bool) -> _Load:
        return self.newcomers if newcomer else self.known


class Lines:
    """The works that wait or run.

    Parameters
    ----------
    workers : int
        Jobs that may run at a time.
    limits : ServiceLimits
    """

    def __init__(self, workers: int, limits: ServiceLimits) -> None:
        self._workers = workers
        self._limits = limits
        self._urgent, self._newcomers, self._later = _Line(), _Line(), _Line()
        self._patience_s = 1e-3 * limits.prefetch_patience_ms
        self._patience_of_newcomers_s = 1e-3 * limits.max_wait_ms
        # Whether a newcomer had the last turn for which others waited too.
        self._newcomer_went_first = False
        self._running: dict[Job, Work] = {}
        self._waiting = _Loads()
        # Of those alone that have works which wait.
        self._waiting_of: dict[Owner, _Loads] = {}

    @property
    def num_waiting(self) -> int:
        """Works that were not begun."""
        return self._waiting.num

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
            self._line_of(work).append(work)

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
            self._later.remove(work)
            self._urgent.append(work)

    def _line_of(self, work: Work) -> _Line:
        if not work.urgent:
            return self._later
        return self._newcomers if work.newcomer else self._urgent

    def _leave(self, work: Work) -> None:
        for line in (self._urgent, self._newcomers, self._later):
            line.remove(work)

    def _count(self, work: Work, sign: int) -> None:
        owner = work.session.owner
        loads = self._waiting_of.setdefault(owner, _Loads())
        for each in (self._waiting, loads):
            each.of(newcomer=work.newcomer).count(work, sign)
        if not loads.num:
            del self._waiting_of[owner]

    # -- running ---------------------------------------------------------------------------------

    def take(self, now: float) -> Work | None:
        """Take the next work out of its line; None if none waits there or no worker is free."""
        if len(self._running) >= self._workers:
            return None
        known = self._next_of_known()
        newcomer = self._newcomers.first()
        if known is None or newcomer is None:
            work = known or newcomer
        elif self._goes_first(newcomer, known, now):
            work, self._newcomer_went_first = newcomer, True
        else:
            work, self._newcomer_went_first = known, False
        if work is not None:
            line = self._line_of(work)
            line.remove(work)
            line.end_turn(work.session.owner, now)
            self._count(work, -1)
        return work

    def _next_of_known(self) -> Work | None:
        """Return the next work of the robots that were served before; None if none waits."""
        urgent, later = self._urgent.first(), self._later.first()
        if urgent is None or later is None:
            return urgent or later
        due = self._waits_since(later) + self._patience_s
        return urgent if self._waits_since(urgent) <= due else later

    def _goes_first(self, newcomer: Work, known: Work, now: float) -> bool:
        """Tell whether a newcomer goes before a robot that was served before."""
        came, known_since = self._waits_since(newcomer), self._waits_since(known)
        if known.urgent:
            return not self._newcomer_went_first and (
                known_since > came + self._patience_of_newcomers_s
            )
        if now <= known_since + self._patience_s:
            return True
        return not self._newcomer_went_first and came <= known_since + self._patience_s

    def _waits_since(self, work: Work) -> float:
        """Return since when a work waits for its turn.

        The many works of one owner have been there for long, because they wait for each other. That
        must not put them before another's that has just come.
        """
        if len(self._waiting_of) == 1:
            return work.since
        return self._line_of(work).waits_since(work)

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
                self._line_of(held).append(held)

    # -- the wait --------------------------------------------------------------------------------

    def is_overloaded(self, now: float, owner: Owner, *, newcomer: bool) -> bool:
        """Tell whether a request that came now is to be turned away."""
        limits, waiting = self._limits, self._waiting
        ahead, ahead_s = self._ahead(now, owner, newcomer=newcomer)
        if ahead < self._workers:
            return False
        newcomers = waiting.newcomers
        return (
            waiting.num >= limits.max_waiting
            or waiting.num_bytes >= limits.max_waiting_bytes
            # Half of the room is kept for those that were served before.
            or (newcomer and 2 * newcomers.num >= limits.max_waiting)
            or (newcomer and 2 * newcomers.num_bytes >= limits.max_waiting_bytes)
            or self._has_its_share(owner)
            # Nobody who was served before is turned away because of newcomers.
            or 1e3 * ahead_s > limits.max_wait_ms * self._workers
        )

    def wait_s(self, now: float, owner: Owner, *, newcomer: bool) -> float:
        """Estimate how long a request that came now would wait for its answer to be begun."""
        _, ahead_s = self._ahead(now, owner, newcomer=newcomer)
        if not newcomer:
            # Of the newcomers as many at most are ahead as of the others: they go by turns.
            ahead_s += min(ahead_s, self._goes_before(owner, newcomer=True)[1])
        return ahead_s / self._workers

    def _has_its_share(self, owner: Owner) -> bool:
        """Tell whether one certificate has as much of the room as one may have."""
        own = self._waiting_of.get(owner)
        if owner is None or own is None:
            return False
        limits = self._limits
        return (
            own.num >= limits.max_waiting_per_robot or 2 * own.num_bytes >= limits.max_waiting_bytes
        )

    def _ahead(self, now: float, owner: Owner, *, newcomer: bool) -> tuple[int, float]:
        """Return how many works are ahead and what they may take, newcomers for newcomers alone."""
        ahead, ahead_s = self._goes_before(owner, newcomer=False)
        if newcomer:
            others, others_s = self._goes_before(owner, newcomer=True)
            ahead, ahead_s = ahead + others, ahead_s + others_s
        for work in self._running.values():
            ahead_s += max(0.0, work.cost_s - (now - work.started_at))
        return ahead, ahead_s

    def _goes_before(self, owner: Owner, *, newcomer: bool) -> tuple[int, float]:
        """Return what goes before one more work of an owner, in one of the lines.

        That is what the owner has there, and of each other's works as many, and one more.
        """
        whole = self._waiting.of(newcomer=newcomer)
        own = self._waiting_of.get(owner)
        if not whole.num or (own is not None and len(self._waiting_of) == 1):
            return whole.num, whole.cost_s
        turns = 1 + (0 if own is None else own.of(newcomer=newcomer).num)
        num, cost_s = 0, 0.0
        for loads in self._waiting_of.values():
            load = loads.of(newcomer=newcomer)
            if load.num:
                going = min(load.num, turns)
                num += going
                cost_s += load.cost_s * going / load.num
        return num, cost_s
